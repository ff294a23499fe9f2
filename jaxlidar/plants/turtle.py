"""Turtle interpretation of L-systems: a word becomes branch segments and leaf buds in space.

The turtle has a position x and an orthonormal frame of heading H, left L and up U = H x L (Prusinkiewicz and
Lindenmayer 1990, The Algorithmic Beauty of Plants, section 1.5). `F` moves it by

    x <- x + length * H.

A turn by the angle a about one vector of the frame rotates the two others into one another,

    A <- cos(a) A + s sin(a) B,    B <- cos(a) B - s sin(a) A,

with s, A and B by symbol:

    +  -    turn left, right    about U    A = H, B = L, s = 1, -1
    &  ^    pitch down, up      about L    A = H, B = U, s = -1, 1
    \\  /    roll left, right    about H    A = L, B = U, s = -1, 1

Tropism `T(e)` (section 2.1) rotates the whole frame about the horizontal axis k = H x z / |H x z| by the
angle a = e |H x z|, which is proportional to the sine of the angle between the heading and the vertical z. A
vector v becomes, by Rodrigues' formula,

    v <- v cos(a) + (k x v) sin(a) + k (k . v) (1 - cos(a)).
"""

from collections.abc import Sequence
from math import cos, radians, sin, sqrt

import numpy as np

from jaxlidar._fields.checks import check_kind, check_number, check_range, checked_array
from jaxlidar.plants.lsystem import Item, Word
from jaxlidar.plants.tree import Tree

Vector = tuple[float, float, float]
# A, B (0: heading, 1: left, 2: up) and s of the module's docstring.
TURNS = {"+": (0, 1, 1), "-": (0, 1, -1), "&": (0, 2, -1), "^": (0, 2, 1), "\\": (1, 2, -1), "/": (1, 2, 1)}
# A heading counts as vertical if the sine of its angle from the vertical is below this.
VERTICAL = 1e-9


def turtle(
    word: str | Sequence[Item] | Word,
    *,
    angle: float = 90.0,
    length: float = 1.0,
    radius: float = 0.01,
    bud_radius: float = 0.03,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    heading: tuple[float, float, float] = (0.0, 0.0, 1.0),
    left: tuple[float, float, float] = (-1.0, 0.0, 0.0),
) -> Tree:
    """Interpret a word of an L-system as the geometry of a tree, by turtle graphics.

    A turtle moves through space as the symbols say, and adds branch segments and leaf buds to the tree. It
    has a position, a heading H, a left L, an up U = H x L, and a branch radius. Angles are in degrees,
    lengths and radii in m. Parameters in parentheses are optional; the defaults are `angle`, `length`,
    `bud_radius` and the turtle's present branch radius.

    - `F(length, radius, end radius)`: moves forward and adds a branch segment. Without an end radius, the
      segment is a cylinder.
    - `f(length)`: moves forward.
    - `+(angle)`, `-(angle)`: turns left, right.
    - `&(angle)`, `^(angle)`: pitches down, up.
    - `\\(angle)`, `/(angle)`: rolls left, right.
    - `|`: turns to the opposite direction, about U.
    - `$`: rolls so that L is horizontal.
    - `T(angle)`: bends the heading upward by angle * sin(angle between the heading and the vertical);
      downward if `angle` is negative.
    - `!(radius)`: sets the branch radius.
    - `J(radius)`: adds a leaf bud.
    - `[`, `]`: stores the state, and returns to the state stored last. They enclose a branch.

    All other symbols are skipped.

    **Arguments:**

    - `word`: a string of symbols, a sequence of symbols with parameters in the form that `LSystem` takes, or
      what `LSystem.rewrite` returns.
    - `angle`: angle of symbols without a parameter, degrees. Default 90.
    - `length`: length of symbols without a parameter, m. Default 1.
    - `radius`: branch radius at the start, m, positive. Default 0.01.
    - `bud_radius`: radius of leaf clumps where `J` has no parameter, m, positive. Default 0.03.
    - `position`: (x, y, z) of the start, m. Default (0, 0, 0).
    - `heading`: heading at the start, a vector of any length but zero. Default (0, 0, 1): up.
    - `left`: left at the start, a vector not along the heading; only its component across the heading counts.
      Default (-1, 0, 0): west.

    **Returns:** a `Tree`. The order of a segment is the number of branchings between it and its root.

    **Raises:** ValueError for brackets that do not match, radii that are not positive, a heading or left of
    zero length, a left along the heading, and numbers that are not finite or of another shape; TypeError for
    a word of another kind.

    **Source:** Prusinkiewicz and Lindenmayer (1990), The Algorithmic Beauty of Plants, sections 1.5, 1.10 and
    2.1.

    **Example:**

    >>> import jaxlidar as jl
    >>> tree = jl.turtle("F[+FJ]FJ", angle=45, length=2.0, radius=0.1)
    >>> print(f"{len(tree.start)} segments; buds at heights {tree.bud_position[:, 2].round(2).tolist()} m")
    3 segments; buds at heights [3.41, 4.0] m
    """
    check_kind("word", word, str | Sequence | Word, "a string, or a sequence of symbols")
    word = word if isinstance(word, Word) else Word.of(word)
    check_number("angle", angle)
    check_number("length", length)
    check_number("radius", radius, 0.0, low_open=True)
    check_number("bud_radius", bud_radius, 0.0, low_open=True)
    x, y, z = checked_array("position", position, (3,)).tolist()
    frame = _frame(heading, left)
    # `branching`: the next segment begins a branch.
    parent, order, branching = -1, 0, False
    # Plain numbers in flat lists and no calls: this loop takes most of the time that a tree takes.
    segments: list[float] = []
    parents_and_orders: list[int] = []
    buds: list[float] = []
    stack = []
    for code, arity, row in zip(word.codes.tolist(), word.arity.tolist(), word.parameters.tolist()):
        symbol = chr(code)
        if symbol in TURNS:
            i, j, sign = TURNS[symbol]
            a = radians(row[0] if arity else angle)
            c, s = cos(a), sign * sin(a)
            (a0, a1, a2), (b0, b1, b2) = frame[i], frame[j]
            frame[i] = (c * a0 + s * b0, c * a1 + s * b1, c * a2 + s * b2)
            frame[j] = (c * b0 - s * a0, c * b1 - s * a1, c * b2 - s * a2)
        elif symbol in "Ff":
            step = row[0] if arity else length
            hx, hy, hz = frame[0]
            x_end, y_end, z_end = x + step * hx, y + step * hy, z + step * hz
            if symbol == "F":
                radius_start = row[1] if arity > 1 else radius
                radius = row[2] if arity > 2 else radius_start
                # A branch is one order above the axis that bears it; stems that share a base are trunks.
                order += branching and parent >= 0
                segments += (x, y, z, x_end, y_end, z_end, radius_start, radius)
                parents_and_orders += (parent, order)
                parent, branching = len(parents_and_orders) // 2 - 1, False
            x, y, z = x_end, y_end, z_end
        elif symbol == "J":
            buds += (x, y, z, *frame[0], row[0] if arity else bud_radius)
        elif symbol == "[":
            stack.append((x, y, z, tuple(frame), radius, parent, order, branching))
            branching = True
        elif symbol == "]":
            if not stack:
                raise ValueError("word has a ']' without its '['")
            x, y, z, stored_frame, radius, parent, order, branching = stack.pop()
            frame = list(stored_frame)
        elif symbol == "T":
            hx, hy, _ = frame[0]
            sine = sqrt(hx * hx + hy * hy)
            if sine > VERTICAL:
                kx, ky = hy / sine, -hx / sine
                a = radians(sine * (row[0] if arity else angle))
                c, s = cos(a), sin(a)
                for i, (vx, vy, vz) in enumerate(frame):
                    projection = (kx * vx + ky * vy) * (1 - c)
                    frame[i] = (
                        vx * c + s * ky * vz + kx * projection,
                        vy * c - s * kx * vz + ky * projection,
                        vz * c + s * (kx * vy - ky * vx),
                    )
        elif symbol == "!":
            radius = row[0] if arity else radius
        elif symbol == "|":
            frame = [tuple(-v for v in frame[0]), tuple(-v for v in frame[1]), frame[2]]
        elif symbol == "$":
            # L = z x H / |z x H|, and U = H x L. With a vertical heading, any left is horizontal.
            hx, hy, hz = frame[0]
            sine = sqrt(hx * hx + hy * hy)
            if sine > VERTICAL:
                lx, ly = -hy / sine, hx / sine
                frame = [frame[0], (lx, ly, 0.0), (-hz * ly, hz * lx, hx * ly - hy * lx)]
    if stack:
        raise ValueError(f"word has {len(stack)} '[' without their ']'")
    wood = np.array(segments, dtype=float).reshape(-1, 8)
    link = np.array(parents_and_orders, dtype=int).reshape(-1, 2)
    bud = np.array(buds, dtype=float).reshape(-1, 7)
    # Many turns leave a rounding error in the length of the frame's vectors.
    direction = bud[:, 3:6] / np.linalg.norm(bud[:, 3:6], axis=1, keepdims=True)
    return Tree(
        start=wood[:, :3],
        end=wood[:, 3:6],
        radius_start=wood[:, 6],
        radius_end=wood[:, 7],
        parent=link[:, 0],
        order=link[:, 1],
        bud_position=bud[:, :3],
        bud_direction=direction,
        bud_radius=bud[:, 6],
    )


def _frame(heading: Vector, left: Vector) -> list[Vector]:
    """Heading, left and up, made orthonormal. **Raises:** as `turtle`."""
    H, L = checked_array("heading", heading, (3,)), checked_array("left", left, (3,))
    for name, value in (("heading", H), ("left", L)):
        check_range(f"length of {name}", np.linalg.norm(value), 0.0, low_open=True)
    H, L = H / np.linalg.norm(H), L / np.linalg.norm(L)
    L = L - (L @ H) * H
    if np.linalg.norm(L) < 1e-9:
        raise ValueError(f"left = {tuple(left)} is along the heading; any other direction is admissible")
    L = L / np.linalg.norm(L)
    U = np.cross(H, L)
    return [(float(v[0]), float(v[1]), float(v[2])) for v in (H, L, U)]
