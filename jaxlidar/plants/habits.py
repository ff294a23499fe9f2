"""Growth habits of trees: parameters of an L-system whose branching follows da Vinci's rule.

Where an axis of diameter d branches, into an axis that continues and laterals of diameters d_i,

    d^p = sum of d_i^p                        (da Vinci's rule; p = 2 conserves the cross-section),
    l(d) = (d/D)^q                            (length from a point of an axis to its tip, relative),

with p = `exponent`, q = `length_exponent` and the diameter D of the trunk (Richter 1970, The Notebooks of
Leonardo da Vinci, 394). Laterals are therefore shorter than the axis that bears them, and the outline of the
crown follows from the division of the cross-section. The L-system rewrites the end of an axis of diameter d,
as long as d^p >= 2 d_min^p, with d_min = `smallest_diameter`:

1. The laterals of the node take the random fraction `share` of d^p together, each at least d_min^p. The axis
   continues with d' = d (1 - sum of fractions)^(1/p).
2. An internode of the length l(d) - l(d') is added, in `pieces` that bend at random and by tropism.
3. Each lateral begins at its end, as an axis of its own.

An axis that is thinner ends in a twig that tapers to exactly d_min. Thinner wood is not modelled; buds sit on
shoots without wood. Lengths are scaled to the height of the tree at the end.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from jaxlidar._fields.checks import (
    Magnitude,
    check_integer,
    check_kind,
    check_number,
    check_seed,
    check_shape,
    warn_unit,
)
from jaxlidar.plants.lsystem import Item, LSystem, Rule, Word
from jaxlidar.plants.tree import Tree
from jaxlidar.plants.turtle import turtle

# In degrees: 360 (1 - 1/golden ratio).
GOLDEN_ANGLE = 137.50776405
# Standard deviations in degrees: of a lateral's azimuth around its axis, and of a shoot's bend at each bud.
DIVERGENCE_SPREAD = 15.0
SHOOT_SPREAD = 28.0
# Fields of a tree that have an element per bud.
# The tallest tree has 116 m, the thickest 12 m.
_HEIGHT = Magnitude("m", 0.0, 200.0, {"cm": 1e-2, "mm": 1e-3})
_DIAMETER = Magnitude("m", 0.0, 20.0, {"cm": 1e-2, "mm": 1e-3})
BUDS = ("bud_position", "bud_direction", "bud_radius")


@final
@dataclass(frozen=True)
class Branching:
    """The branching pattern of an axis: number, thickness and angles of its lateral branches.

    **Arguments:**

    - `laterals`: number of lateral branches at a node, 1 or more. Near the twigs, where this number would be
      too thin, a node has one. Default 1.
    - `share`: (low, high) fraction of the cross-section that the laterals of a node take together, within
      [0, 1]; drawn uniformly. No lateral gets thicker than the axis that continues. Default (0.2, 0.5).
    - `angle`: angle between a lateral and the axis that continues, degrees, 0 to 180. With one lateral, both
      turn away from the old direction, the thicker one less. Default 50.
    - `angle_spread`: standard deviation of `angle`, degrees, 0 or more. Default 8.
    - `divergence`: rotation around the axis from one node to the next, degrees. A normal deviate with a
      standard deviation of 15 degrees is added. Default: the golden angle, 137.5.
    - `bend`: standard deviation of the random bends of an axis of the smallest diameter, degrees per piece
      of an internode, 0 or more. Thicker wood bends less, by the fourth root of its diameter. Default 7.
    - `tropism`: upward bend of a horizontal piece, degrees; negative is downward. Default 2.

    **Raises:** ValueError for values outside the ranges above; TypeError for arguments that are no numbers.

    **Example:**

    >>> import jaxlidar as jl
    >>> habit = jl.conifer(trunk=jl.Branching(laterals=4, angle=80.0))
    >>> print(f"whorls of {habit.trunk.laterals}, {habit.trunk.angle} degrees from the trunk")
    whorls of 4, 80.0 degrees from the trunk
    """

    laterals: int = 1
    share: tuple[float, float] = (0.2, 0.5)
    angle: float = 50.0
    angle_spread: float = 8.0
    divergence: float = GOLDEN_ANGLE
    bend: float = 7.0
    tropism: float = 2.0

    def __post_init__(self):
        object.__setattr__(self, "laterals", check_integer("laterals", self.laterals))
        check_shape("share", self.share, (2,))
        for share in self.share:
            check_number("share", share, 0.0, 1.0)
        if self.share[0] > self.share[1]:
            raise ValueError(f"share = {self.share} is not (low, high) with low <= high")
        check_number("angle", self.angle, 0.0, 180.0)
        check_number("angle_spread", self.angle_spread, 0.0)
        check_number("divergence", self.divergence)
        check_number("bend", self.bend, 0.0)
        check_number("tropism", self.tropism)


@final
@dataclass(frozen=True)
class Habit:
    """The growth habit of a tree: sizes and branching proportions from which `grow` makes individuals.

    Defaults give the broadleaved tree of Table 2 of the paper.

    **Arguments:**

    - `height`: from the base to the highest wood, m, positive. Default 15.
    - `trunk_diameter`: diameter of the thickest stem at the base, m, positive. Default 0.89.
    - `smallest_diameter`: diameter at the ends of the branches, m, positive, at most `trunk_diameter`.
      Default 0.03.
    - `clump_diameter`: diameter of the leaf clump around a bud, m, positive. Default 0.06.
    - `exponent`: exponent p of da Vinci's rule, positive. Default 2.
    - `length_exponent`: exponent q in length ~ diameter^q, for the length from a point of an axis to its tip;
      positive. Default 0.65.
    - `bole`: fraction of the trunk's length that is below its first node, in [0, 1). Default 0.08.
    - `stems`: number of stems that grow from the base, 1 or more. All but the first have 0.6 to 1 times
      `trunk_diameter`, drawn uniformly. Default 1.
    - `stem_angle`: outward lean of the stems, degrees, 0 to 90. Each stem leans by 0.4 to 1.3 times this,
      drawn uniformly. Default 0.
    - `trunk`: `Branching` of the axes of order 0. Default `Branching()`.
    - `branches`: `Branching` of all other axes. Default `Branching()`.
    - `pieces`: number of straight segments in an internode, 1 or more. Default 3.
    - `twig`: length of the twig beyond the last fork, as a fraction of the length that an axis as thin as
      `smallest_diameter` would have; positive. Twigs that start thicker are longer. Default 0.4.
    - `shoots`: number of shoots on each twig, 0 or more. The last one continues the twig. Default 8.
    - `shoot_length`: length of a shoot, m, positive. Default 0.6.
    - `shoot_angle`: angle between shoot and twig, degrees, 0 to 180. Default 50.
    - `shoot_buds`: number of buds on each shoot, at equal distances, 1 or more. Default 8.

    **Raises:** ValueError for values outside these ranges, TypeError for other kinds; warns of sizes in cm.

    **Example:**

    >>> import jaxlidar as jl
    >>> habit = jl.Habit(height=12.0, trunk_diameter=0.5, smallest_diameter=0.1)
    >>> tree = jl.grow(habit, seed=1)
    >>> print(f"{tree.height:.1f} m tall, {tree.trunk_diameter:.1f} m thick")
    12.0 m tall, 0.5 m thick
    """

    height: float = 15.0
    trunk_diameter: float = 0.89
    smallest_diameter: float = 0.03
    clump_diameter: float = 0.06
    exponent: float = 2.0
    length_exponent: float = 0.65
    bole: float = 0.08
    stems: int = 1
    stem_angle: float = 0.0
    trunk: Branching = field(default_factory=Branching)
    branches: Branching = field(default_factory=Branching)
    pieces: int = 3
    twig: float = 0.4
    shoots: int = 8
    shoot_length: float = 0.6
    shoot_angle: float = 50.0
    shoot_buds: int = 8

    def __post_init__(self):
        sizes = ("height", "trunk_diameter", "clump_diameter", "twig", "shoot_length")
        for name in (*sizes, "exponent", "length_exponent"):
            check_number(name, getattr(self, name), 0.0, low_open=True)
        check_number("smallest_diameter", self.smallest_diameter, 0.0, self.trunk_diameter, low_open=True)
        check_number("bole", self.bole, 0.0, 1.0, high_open=True)
        check_number("stem_angle", self.stem_angle, 0.0, 90.0)
        check_number("shoot_angle", self.shoot_angle, 0.0, 180.0)
        for name, low in (("stems", 1), ("pieces", 1), ("shoots", 0), ("shoot_buds", 1)):
            object.__setattr__(self, name, check_integer(name, getattr(self, name), low))
        check_kind("trunk", self.trunk, Branching, "a Branching")
        check_kind("branches", self.branches, Branching, "a Branching")
        warn_unit("height", self.height, _HEIGHT)
        warn_unit("trunk_diameter", self.trunk_diameter, _DIAMETER)

    def wood(self) -> LSystem:
        """The L-system that grows the wood.

        `R` is the root. `A(d)` and `B(d)` are the growing ends of trunk and branches of diameter d (m). `S`
        marks where `foliage` puts a shoot. All other symbols are those of `jaxlidar.turtle`. Lengths are
        relative: 1 is the length of the trunk above the bole.

        **Returns:** an `LSystem`.
        """
        rules = [Rule("R", self._stems, random=True)]
        for symbol, branching in (("A", self.trunk), ("B", self.branches)):
            rules += self._axis(symbol, branching)
        return LSystem("R", rules)

    def foliage(self, wood: Word) -> LSystem:
        """The L-system that puts shoots and buds on the wood in one step.

        **Arguments:**

        - `wood`: the word of the wood, with lengths in m.

        **Returns:** an `LSystem`.
        """
        step = self.shoot_length / self.shoot_buds

        def shoot(*, rng: np.random.Generator) -> Iterator[Item]:
            count = wood.where("S").size
            for i in range(self.shoot_buds):
                yield from [("+&"[i % 2], rng.normal(0.0, SHOOT_SPREAD, count)), ("f", step)]
                yield ("J", 0.5 * self.clump_diameter)

        return LSystem(wood, [Rule("S", shoot, random=True)])

    def _length_to_tip(self, diameter: Any) -> Any:
        """l(d): relative length from the point where an axis has this diameter to its tip."""
        return (diameter / self.trunk_diameter) ** self.length_exponent

    def _stems(self, *, rng: np.random.Generator) -> Iterator[Item]:
        """Successor of the root: each stem's bole and growing end."""
        azimuth = rng.uniform(0.0, 360.0)
        for i in range(self.stems):
            d = self.trunk_diameter * (1.0 if i == 0 else rng.uniform(0.6, 1.0))
            lean = self.stem_angle * rng.uniform(0.4, 1.3)
            yield from ["[", ("/", azimuth + i * GOLDEN_ANGLE), ("&", lean)]
            bole = self._length_to_tip(d) * self.bole / (1 - self.bole)
            yield from self._internode(bole, d, d, self.trunk, rng)
            yield from [("A", d), "]"]

    def _axis(self, symbol: str, branching: Branching) -> list[Rule]:
        """Rules of an axis: all laterals; one lateral if those are too thin; else a twig."""
        p, smallest = self.exponent, self.smallest_diameter
        # Diameters from which a node's axes can have the smallest diameter each: laterals and one more axis.
        all_laterals, one_lateral = ((n * smallest**p) ** (1 / p) for n in (branching.laterals + 1, 2))

        def twig(d: Any, *, rng: np.random.Generator) -> Iterator[Item]:
            yield from self._twig(d, branching, rng)

        def node(laterals: int) -> Any:
            def fork(d: Any, *, rng: np.random.Generator) -> Iterator[Item]:
                yield from self._node(symbol, d, laterals, branching, rng)

            return fork

        return [
            Rule(symbol, node(branching.laterals), condition=lambda d: d >= all_laterals, random=True),
            Rule(
                symbol,
                node(1),
                condition=lambda d: (d >= one_lateral) & (d < all_laterals),
                random=True,
            ),
            Rule(symbol, twig, condition=lambda d: d < one_lateral, random=True),
        ]

    def _node(
        self, symbol: str, d: Any, laterals: int, branching: Branching, rng: np.random.Generator
    ) -> Iterator[Item]:
        """Successor of axes of (n,) diameters d: an internode, its laterals, and the axis that continues."""
        n, p = len(d), self.exponent
        # No lateral is thinner than the smallest diameter or thicker than the axis that continues.
        low, high = (self.smallest_diameter / d) ** p, 1 / (laterals + 1)
        fractions = rng.uniform(*branching.share, (laterals, n)) / laterals
        fractions = np.clip(fractions, np.minimum(low, high), high)
        remainder = 1 - fractions.sum(axis=0)
        d_next = d * remainder ** (1 / p)
        length = self._length_to_tip(d) - self._length_to_tip(d_next)
        yield from self._internode(length, d, d, branching, rng)
        yield ("/", branching.divergence + rng.normal(0.0, DIVERGENCE_SPREAD, n))
        for fraction in fractions:
            angle = np.clip(rng.normal(branching.angle, branching.angle_spread, n), 0.0, 180.0)
            # With one lateral, the axis turns away from it, in proportion to the lateral's cross-section.
            deflection = fraction / (fraction + remainder) * angle if laterals == 1 else 0.0
            yield from ["[", ("&", angle - deflection), ("B", d * fraction ** (1 / p)), "]"]
            if laterals > 1:
                yield ("/", 360 / laterals + rng.normal(0.0, DIVERGENCE_SPREAD, n))
            else:
                yield ("^", deflection)
        yield (symbol, d_next)

    def _twig(self, d: Any, branching: Branching, rng: np.random.Generator) -> Iterator[Item]:
        """Successor of axes too thin to branch: a tapering internode with shoots."""
        smallest = self.smallest_diameter
        length = self._length_to_tip(d) - self._length_to_tip(smallest) * (1 - self.twig)
        # An axis of just the smallest diameter may have come out thinner by rounding.
        d = np.maximum(d, smallest)
        azimuth = rng.uniform(0.0, 360.0, len(d))
        # The last shoot continues the twig.
        last = self.shoots - 1
        shoots = [(azimuth + i * GOLDEN_ANGLE, self.shoot_angle * (i < last)) for i in range(self.shoots)]
        yield from self._internode(np.maximum(length, 0.0), d, smallest, branching, rng, shoots)

    def _internode(
        self,
        length: Any,
        d_start: Any,
        d_end: Any,
        branching: Branching,
        rng: np.random.Generator,
        shoots: Sequence[tuple[Any, Any]] = (),
    ) -> Iterator[Item]:
        """Pieces with bends between them, and shoots (azimuth, angle in degrees) at their ends.

        `d_start` and `d_end` are diameters in m.
        """
        k = self.pieces
        bend = branching.bend * (self.smallest_diameter / d_start) ** 0.25
        for i in range(k):
            radii = [0.5 * (d_start + (d_end - d_start) * (i + j) / k) for j in (0, 1)]
            yield from [(symbol, rng.normal(0.0, bend, np.shape(d_start))) for symbol in "+&"]
            yield from [("T", branching.tropism), ("F", length / k, *radii)]
            for azimuth, angle in shoots[i * len(shoots) // k : (i + 1) * len(shoots) // k]:
                yield from ["[", ("/", azimuth), ("&", angle), "S", "]"]


def grow(habit: Habit | None = None, *, seed: int | np.random.Generator = 0) -> Tree:
    """Grow one tree of a habit, with its base at the origin.

    The L-system of the wood is rewritten until no axis can branch further. Lengths are then scaled to the
    height of the habit, and shoots and buds are added. Buds whose clumps would reach below the base are
    dropped.

    **Arguments:**

    - `habit`: a `Habit`. Default None: `broadleaf()`, the tree of Table 2 of the paper.
    - `seed`: random seed, or a NumPy generator. Default 0.

    **Returns:** a `Tree`.

    **Raises:** ValueError if the wood of the habit does not grow upward; TypeError for an object that is no
    `Habit`.

    **Example:**

    >>> import jaxlidar as jl
    >>> tree = jl.grow(jl.shrub(height=1.0), seed=3)
    >>> print(f"{tree.height:.2f} m tall, {int(tree.roots.sum())} stems")
    1.00 m tall, 9 stems
    """
    habit = broadleaf() if habit is None else habit
    check_kind("habit", habit, Habit, "a Habit or None")
    check_seed(seed)
    rng = np.random.default_rng(seed)
    word = habit.wood().rewrite(seed=rng)
    relative_height = turtle(word).height
    if not relative_height > 1e-6:
        raise ValueError(
            f"height = {habit.height:g} cannot be had: the wood of this habit does not grow upward"
        )
    lengths = word.parameters.copy()
    lengths[word.where("F"), 0] *= habit.height / relative_height
    word = replace(word, parameters=lengths)
    tree = turtle(habit.foliage(word).rewrite(1, seed=rng))
    is_above_base = tree.bud_position[:, 2] >= tree.bud_radius
    return replace(tree, **{name: getattr(tree, name)[is_above_base] for name in BUDS})


def broadleaf(**changes: Any) -> Habit:
    """Return the habit of an open-grown broadleaved tree: the tree of Table 2 of the paper, 15 m tall.

    **Arguments:**

    - `changes`: fields of `Habit` with other values, by name.

    **Returns:** a `Habit`.

    **Raises:** ValueError for values outside the ranges of `Habit`; TypeError for unknown fields.

    **Example:**

    >>> import jaxlidar as jl
    >>> habit = jl.broadleaf(height=20.0)
    >>> habit.height, habit.trunk_diameter, habit.smallest_diameter
    (20.0, 0.89, 0.03)
    """
    return Habit(**changes)


def conifer(**changes: Any) -> Habit:
    """Return the habit of a spruce-like conifer, 20 m tall: a straight trunk, whorls, a conical crown.

    **Arguments:**

    - `changes`: fields of `Habit` with other values, by name.

    **Returns:** a `Habit`.

    **Raises:** ValueError for values outside the ranges of `Habit`; TypeError for unknown fields.

    **Example:**

    >>> import jaxlidar as jl
    >>> habit = jl.conifer(height=25.0)
    >>> print(f"{habit.height} m tall, whorls of {habit.trunk.laterals} branches")
    25.0 m tall, whorls of 5 branches
    """
    habit = Habit(
        height=20.0,
        trunk_diameter=0.4,
        smallest_diameter=0.012,
        clump_diameter=0.04,
        length_exponent=0.9,
        bole=0.08,
        trunk=Branching(laterals=5, share=(0.14, 0.24), angle=85.0, bend=1.0, tropism=3.0),
        branches=Branching(share=(0.15, 0.35), angle=50.0, divergence=180.0, bend=4.0, tropism=0.0),
        shoot_length=0.3,
    )
    return Habit(**(vars(habit) | changes))


def spreading_tree(**changes: Any) -> Habit:
    """Return the habit of a spreading broadleaved tree, 10 m tall and mostly wider: an old oak in a field.

    **Arguments:**

    - `changes`: fields of `Habit` with other values, by name.

    **Returns:** a `Habit`.

    **Raises:** ValueError for values outside the ranges of `Habit`; TypeError for unknown fields.

    **Example:**

    >>> import jaxlidar as jl
    >>> tree = jl.grow(jl.spreading_tree(smallest_diameter=0.1))
    >>> print(f"{tree.height:.1f} m tall, {tree.trunk_diameter:.1f} m thick")
    10.0 m tall, 0.7 m thick
    """
    habit = Habit(
        height=10.0,
        trunk_diameter=0.7,
        length_exponent=0.5,
        bole=0.16,
        trunk=Branching(share=(0.45, 0.5), angle=95.0, tropism=1.0),
        branches=Branching(share=(0.35, 0.5), angle=64.0, tropism=3.0),
    )
    return Habit(**(vars(habit) | changes))


def shrub(**changes: Any) -> Habit:
    """Return the habit of a shrub with nine stems from one base, 2.5 m tall.

    **Arguments:**

    - `changes`: fields of `Habit` with other values, by name.

    **Returns:** a `Habit`.

    **Raises:** ValueError for values outside the ranges of `Habit`; TypeError for unknown fields.

    **Example:**

    >>> import jaxlidar as jl
    >>> habit = jl.shrub(height=1.5, stems=4)
    >>> print(f"{habit.stems} stems, {habit.height} m tall")
    4 stems, 1.5 m tall
    """
    habit = Habit(
        height=2.5,
        trunk_diameter=0.05,
        smallest_diameter=0.008,
        clump_diameter=0.04,
        bole=0.1,
        stems=9,
        stem_angle=30.0,
        trunk=Branching(share=(0.2, 0.5), angle=40.0, tropism=2.0),
        branches=Branching(share=(0.2, 0.5), angle=45.0, tropism=2.0),
        shoots=5,
        shoot_length=0.25,
        shoot_buds=6,
    )
    return Habit(**(vars(habit) | changes))
