"""A tree as geometry: branch segments, each a cone frustum, and leaf buds, each a clump of leaves."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxlidar._checks import check_range


@dataclass(frozen=True, eq=False)
class Tree:
    """Branch segments and leaf buds, in metres, x east, y north, z up.

    Segments are ordered so that a parent comes before its children; several roots make several stems. Arrays
    are double precision.

    **Arguments:**

    - `start`, `end`: (n, 3) the ends of each segment's axis.
    - `radius_start`, `radius_end`: (n,) its radii there, positive.
    - `parent`: (n,) index of the segment on which it grows, -1 for a root.
    - `order`: (n,) branching order: 0 for the trunk, 1 for what branches off it, and so on.
    - `bud_position`: (m, 3) centres of the leaf clumps.
    - `bud_direction`: (m, 3) unit vectors in which the leaves' axes point.
    - `bud_radius`: (m,) radii of the clumps, positive.

    **Raises:** ValueError for what is not finite, radii that are not positive, directions that are not unit
    vectors, and parents that do not come before their children.
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

    def __post_init__(self):
        n, m = len(self.start), len(self.bud_position)
        for name, shape in (
            *((name, (n, 3)) for name in ("start", "end")),
            *((name, (n,)) for name in ("radius_start", "radius_end", "parent", "order")),
            *((name, (m, 3)) for name in ("bud_position", "bud_direction")),
            ("bud_radius", (m,)),
        ):
            has = np.shape(getattr(self, name))
            if has != shape:
                raise ValueError(f"{name} has the shape {has}; admissible is {shape}")
        for name in ("start", "end", "bud_position", "bud_direction"):
            check_range(name, getattr(self, name))
        for name in ("radius_start", "radius_end", "bud_radius"):
            check_range(name, getattr(self, name), 0.0, low_open=True)
        check_range("order", self.order, 0)
        check_range("parent", self.parent, -1)
        late = np.flatnonzero(self.parent >= np.arange(n))
        if late.size:
            i = late[0]
            raise ValueError(f"parent = {self.parent[i]} of segment {i} is outside the range [-1, {i - 1}]")
        length = np.linalg.norm(self.bud_direction, axis=1)
        check_range("length of bud_direction", length, 1 - 1e-6, 1 + 1e-6)

    @staticmethod
    def joined(trees: Iterable["Tree"]) -> "Tree":
        """The segments and buds of all trees as one."""
        trees = tuple(trees)
        if not trees:
            raise ValueError("trees is empty; at least one tree is admissible")
        parts = {f.name: np.concatenate([getattr(t, f.name) for t in trees]) for f in fields(Tree)}
        sizes = [len(t.start) for t in trees]
        offset = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
        parts["parent"] = np.where(parts["parent"] < 0, -1, parts["parent"] + offset)
        return Tree(**parts)

    @property
    def roots(self) -> Bool[np.ndarray, " n"]:
        """Whether each segment grows from the ground, not from another segment."""
        return self.parent < 0

    @property
    def base(self) -> Float[np.ndarray, "3"]:
        """The mean of the points where the roots start, m."""
        return self.start[self.roots].mean(axis=0) if len(self.start) else np.zeros(3)

    @property
    def height(self) -> float:
        """From the base to the highest point of the wood's axes, m. Leaf clumps do not count."""
        if not len(self.start):
            return 0.0
        return float(max(self.start[:, 2].max(), self.end[:, 2].max()) - self.base[2])

    @property
    def trunk_diameter(self) -> float:
        """At the base, of the thickest stem, m."""
        return 2 * float(self.radius_start[self.roots].max(initial=0.0))

    @property
    def smallest_diameter(self) -> float:
        """Of all segments, m; infinite where there is none."""
        return 2 * float(np.minimum(self.radius_start, self.radius_end).min(initial=np.inf))

    @property
    def length(self) -> Float[np.ndarray, " n"]:
        """Of each segment, m."""
        return np.linalg.norm(self.end - self.start, axis=1)

    @property
    def wood_volume(self) -> float:
        """Sum of the frustums, pi/3 l (a^2 + a b + b^2), in m3. Overlaps at the joints count twice."""
        a, b = self.radius_start, self.radius_end
        return float(np.sum(np.pi / 3 * self.length * (a * a + a * b + b * b)))

    @property
    def clump_volume(self) -> float:
        """Sum of the clumps' spheres in m3. Overlaps count twice."""
        return float(np.sum(4 / 3 * np.pi * self.bud_radius**3))

    def leafless(self) -> "Tree":
        """The same wood without buds: the tree leaf-off."""
        return replace(
            self, bud_position=np.zeros((0, 3)), bud_direction=np.zeros((0, 3)), bud_radius=np.zeros(0)
        )

    def with_bud_radius(self, radius: float) -> "Tree":
        """The same tree with clumps of another radius (m), that is with more or less leaf cover."""
        check_range("radius", radius, 0.0, low_open=True)
        return replace(self, bud_radius=np.full(len(self.bud_radius), float(radius)))

    def translated(self, offset: tuple[float, float, float] | Float[np.ndarray, "3"]) -> "Tree":
        """Moved by `offset` = (east, north, up) in m."""
        by = np.asarray(offset, dtype=float)
        check_range("offset", by)
        return replace(self, start=self.start + by, end=self.end + by, bud_position=self.bud_position + by)

    def rotated(self, angle: float) -> "Tree":
        """Turned round the z axis by `angle` in degrees, clockwise seen from above, as azimuths are."""
        check_range("angle", angle)
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(
            self,
            start=self.start @ turn.T,
            end=self.end @ turn.T,
            bud_position=self.bud_position @ turn.T,
            bud_direction=self.bud_direction @ turn.T,
        )

    def scaled(self, factor: float) -> "Tree":
        """All lengths and radii, of wood and clumps, times `factor`, about the origin."""
        check_range("factor", factor, 0.0, low_open=True)
        return replace(
            self,
            start=self.start * factor,
            end=self.end * factor,
            radius_start=self.radius_start * factor,
            radius_end=self.radius_end * factor,
            bud_position=self.bud_position * factor,
            bud_radius=self.bud_radius * factor,
        )
