"""The geometry of a tree: branch segments, which are cone frustums, and leaf clumps around buds."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import final

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxlidar._fields.checks import check_kind, check_number, check_range, check_shape, checked_array


@final
@dataclass(frozen=True, eq=False)
class Tree:
    """The geometry of a tree: n branch segments, each a cone frustum, and m spherical leaf clumps.

    Coordinates are in metres, x east, y north, z up. A parent segment comes before its children. A tree with
    several roots has several stems. Arrays are NumPy arrays in double precision.

    **Arguments:**

    - `start`, `end`: (n, 3) the two ends of each segment's axis, m.
    - `radius_start`, `radius_end`: (n,) radii at these ends, m, positive.
    - `parent`: (n,) index of the segment on which each segment grows; -1 for a root.
    - `order`: (n,) branching order, 0 or more: 0 for the trunk, 1 for branches on the trunk, and so on.
    - `bud_position`: (m, 3) centres of the leaf clumps, m.
    - `bud_direction`: (m, 3) unit vectors along the axes of the leaves.
    - `bud_radius`: (m,) radii of the clumps, m, positive.

    **Raises:** ValueError for arrays of other shapes, values that are not finite, radii that are not
    positive, negative orders, directions that are not unit vectors, and parents that do not come before their
    children; TypeError for fields that are no NumPy arrays, and for parents and orders that are no integers.

    **Example:**

    >>> import jaxlidar as jl
    >>> tree = jl.turtle("F[+FJ]FJ", angle=45, length=2.0, radius=0.1)
    >>> print(f"{tree.height:.1f} m tall, {tree.wood_volume:.3f} m3 of wood, orders {tree.order.tolist()}")
    4.0 m tall, 0.188 m3 of wood, orders [0, 1, 0]
    """

    start: Float[np.ndarray, "n 3"]
    end: Float[np.ndarray, "n 3"]
    radius_start: Float[np.ndarray, " n"]
    radius_end: Float[np.ndarray, " n"]
    parent: Int[np.ndarray, " n"]
    order: Int[np.ndarray, " n"]
    bud_position: Float[np.ndarray, "m 3"]
    bud_direction: Float[np.ndarray, "m 3"]
    bud_radius: Float[np.ndarray, " m"]

    def __str__(self) -> str:
        clumps = f" and {len(self.bud_radius):,} leaf clumps" if len(self.bud_radius) else ""
        return (
            f"Tree of {len(self.start):,} branch segments{clumps}: {self.height:.2f} m tall, "
            f"{self.wood_volume:.3g} m3 of wood"
        )

    def __post_init__(self):
        for field in fields(self):
            check_kind(field.name, getattr(self, field.name), np.ndarray, "a NumPy array")
        for name in ("parent", "order"):
            dtype = getattr(self, name).dtype
            if not np.issubdtype(dtype, np.integer):
                raise TypeError(f"{name} is an array of {dtype}; admissible are integers")
        n, m = len(self.start), len(self.bud_position)
        for name, shape in (
            *((name, (n, 3)) for name in ("start", "end")),
            *((name, (n,)) for name in ("radius_start", "radius_end", "parent", "order")),
            *((name, (m, 3)) for name in ("bud_position", "bud_direction")),
            ("bud_radius", (m,)),
        ):
            check_shape(name, getattr(self, name), shape)
        for name in ("start", "end", "bud_position", "bud_direction"):
            check_range(name, getattr(self, name))
        for name in ("radius_start", "radius_end", "bud_radius"):
            check_range(name, getattr(self, name), 0.0, low_open=True)
        check_range("order", self.order, 0)
        check_range("parent", self.parent, -1)
        misplaced = np.flatnonzero(self.parent >= np.arange(n))
        if misplaced.size:
            i = misplaced[0]
            raise ValueError(f"parent = {self.parent[i]} of segment {i} is outside the range [-1, {i - 1}]")
        length = np.linalg.norm(self.bud_direction, axis=1)
        check_range("length of bud_direction", length, 1 - 1e-6, 1 + 1e-6)

    @staticmethod
    def joined(trees: Iterable["Tree"]) -> "Tree":
        """Join the segments and leaf clumps of several trees into one `Tree`.

        **Arguments:**

        - `trees`: any number of `Tree`, at least one.

        **Returns:** a `Tree` with the stems of all.

        **Raises:** ValueError if there is no tree; TypeError for an object that is no `Tree`.
        """
        check_kind("trees", trees, Iterable, "several Tree, as in [tree, other]")
        trees = tuple(trees)
        if not trees:
            raise ValueError("trees is empty; at least one tree is admissible")
        for tree in trees:
            check_kind("one of trees", tree, Tree, "a Tree")
        columns = {f.name: np.concatenate([getattr(t, f.name) for t in trees]) for f in fields(Tree)}
        # Indices of parents count from the first segment of their own tree.
        sizes = [len(t.start) for t in trees]
        offset = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
        columns["parent"] = np.where(columns["parent"] < 0, -1, columns["parent"] + offset)
        return Tree(**columns)

    @property
    def roots(self) -> Bool[np.ndarray, " n"]:
        """True for each segment that is a root: it grows from the ground, not from another segment."""
        return self.parent < 0

    @property
    def base(self) -> Float[np.ndarray, "3"]:
        """Position of the stem base: the mean of the points where the roots start, m."""
        return self.start[self.roots].mean(axis=0) if len(self.start) else np.zeros(3)

    @property
    def height(self) -> float:
        """Height of the wood: from the base to the highest point of the axes, m. Leaf clumps do not count."""
        if not len(self.start):
            return 0.0
        return float(max(self.start[:, 2].max(), self.end[:, 2].max()) - self.base[2])

    @property
    def trunk_diameter(self) -> float:
        """Diameter of the thickest stem at its base, m."""
        return 2 * float(self.radius_start[self.roots].max(initial=0.0))

    @property
    def crown_diameter(self) -> float:
        """Diameter of the crown, m: that of a circle as large as the convex hull of the crown from above.

        The hull is that of the centres of the leaf clumps, and without clumps of the ends of the wood.
        """
        points = (self.bud_position if len(self.bud_position) else self.end)[:, :2]
        # A hull has an area where points are not on one line.
        if np.linalg.matrix_rank(points - points.mean(axis=0) if len(points) else points, tol=1e-9) < 2:
            return 0.0
        return float(2.0 * np.sqrt(scipy.spatial.ConvexHull(points).volume / np.pi))

    @property
    def smallest_diameter(self) -> float:
        """Smallest diameter of all segments, m; infinite if there are no segments."""
        return 2 * float(np.minimum(self.radius_start, self.radius_end).min(initial=np.inf))

    @property
    def length(self) -> Float[np.ndarray, " n"]:
        """Length of each segment, m."""
        return np.linalg.norm(self.end - self.start, axis=1)

    @property
    def wood_volume(self) -> float:
        """Volume of wood in m3: the sum of pi/3 l (a^2 + a b + b^2). Overlaps at the joints count twice."""
        a, b = self.radius_start, self.radius_end
        return float(np.sum(np.pi / 3 * self.length * (a * a + a * b + b * b)))

    @property
    def clump_volume(self) -> float:
        """Volume of the leaf clumps in m3: the sum of their spheres. Overlaps count twice."""
        return float(np.sum(4 / 3 * np.pi * self.bud_radius**3))

    def leafless(self) -> "Tree":
        """Return the tree in leaf-off condition: the same wood without leaf clumps.

        **Returns:** a `Tree`.
        """
        return replace(
            self, bud_position=np.zeros((0, 3)), bud_direction=np.zeros((0, 3)), bud_radius=np.zeros(0)
        )

    def with_bud_radius(self, radius: float) -> "Tree":
        """Return the same tree with leaf clumps of another radius, that is with another leaf cover.

        **Arguments:**

        - `radius`: radius of all clumps, m, positive.

        **Returns:** a `Tree`.

        **Raises:** ValueError for a radius that is not positive.
        """
        check_number("radius", radius, 0.0, low_open=True)
        return replace(self, bud_radius=np.full(len(self.bud_radius), float(radius)))

    def translated(self, offset: tuple[float, float, float] | Float[np.ndarray, "3"]) -> "Tree":
        """Move the tree to another position.

        **Arguments:**

        - `offset`: (east, north, up) displacement, m.

        **Returns:** a `Tree`.

        **Raises:** ValueError for an offset that is not finite or not three numbers.
        """
        d = checked_array("offset", offset, (3,))
        return replace(self, start=self.start + d, end=self.end + d, bud_position=self.bud_position + d)

    def rotated(self, angle: float) -> "Tree":
        """Rotate the tree about the z axis through the origin.

        **Arguments:**

        - `angle`: degrees, clockwise seen from above, as azimuths are.

        **Returns:** a `Tree`.

        **Raises:** ValueError for an angle that is not finite.
        """
        check_number("angle", angle)
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        # The transpose of the usual matrix: clockwise seen from above.
        rotation = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(
            self,
            start=self.start @ rotation.T,
            end=self.end @ rotation.T,
            bud_position=self.bud_position @ rotation.T,
            bud_direction=self.bud_direction @ rotation.T,
        )

    def scaled(self, factor: float | Sequence[float] | Float[np.ndarray, "3"]) -> "Tree":
        """Scale the tree about the origin: all coordinates and radii, of wood and leaf clumps.

        **Arguments:**

        - `factor`: scale factor, positive; or three: on horizontal distances, on heights, and on radii of
          wood. The volume of leaf clumps then follows that of the crown.

        **Returns:** a `Tree`.

        **Raises:** ValueError for a factor that is not positive, and for another number of factors.
        """
        horizontal, vertical, radial = checked_array(
            "factor", factor, (3,), 0.0, one_for_all=True, low_open=True
        )
        stretch = np.array([horizontal, horizontal, vertical])
        return replace(
            self,
            start=self.start * stretch,
            end=self.end * stretch,
            radius_start=self.radius_start * radial,
            radius_end=self.radius_end * radial,
            bud_position=self.bud_position * stretch,
            bud_radius=self.bud_radius * np.cbrt(stretch.prod()),
        )
