"""Stands: many copies of a few trees, each with its own place, azimuth, size and leaf area."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final, overload

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._fields.checks import Numbers, check_kind, check_number, check_range, check_shape, checked_array
from jaxlidar._fields.crs import common_system, crs_name
from jaxlidar.plants.tree import Tree
from jaxlidar.scenes.terrain import Terrain


@final
@dataclass(frozen=True, eq=False)
class Stand(Sequence[Tree]):
    """A stand: n trees that are copies of a few individuals. It is a sequence of `Tree`.

    `jaxlidar.voxelise` takes a stand of thousands of trees, as it voxelises the individuals alone.
    `forest`, `stand_of_leaf_area` and `stand_from_inventory` make stands.

    **Arguments:**

    - `individuals`: a `Tree`, or several.
    - `position`: (n, 3) x, y and z in m of the `base` of each tree.
    - `individual`: (n,) integers, which of the individuals each tree is a copy of, from 0. Default None: the
      first.
    - `azimuth`: (n,) degrees by which each copy is turned clockwise, seen from above. Default None: 0.
    - `scale`: (n, 3) factors of each copy on horizontal distances from the base, on heights above it, and on
      radii of wood, positive. Leaf clumps are scaled so that their volume follows the crown's. Default None:
      1.
    - `leaf_area`: one-sided leaf area of every clump in m2, 0 or more: one number, or (n,), one for each
      tree. Default None: not stated.
    - `crs`: coordinate reference system of `position`, as that of `Terrain`. Default None: not known.

    **Raises:** ValueError for arrays of other shapes, for no individual or no tree, for numbers of
    individuals that there are not, and for values outside the ranges above; TypeError for individuals that
    are no `Tree`, and for numbers of individuals that are no integers.

    **Example:** three copies of one shrub, the last twice as tall.

    >>> import jaxlidar as jl
    >>> shrub = jl.grow(jl.shrub(height=1.0, stems=1))
    >>> place = [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (6.0, 0.0, 0.5)]
    >>> stand = jl.Stand(shrub, place, scale=[(1, 1, 1), (1, 1, 1), (1, 2, 1)], leaf_area=0.001)
    >>> stand.height.round(2).tolist(), stand[2].base.tolist()
    ([1.0, 1.0, 2.0], [6.0, 0.0, 0.5])
    """

    individuals: tuple[Tree, ...]
    position: Float[np.ndarray, "n 3"]
    individual: Int[np.ndarray, " n"]
    azimuth: Float[np.ndarray, " n"]
    scale: Float[np.ndarray, "n 3"]
    leaf_area: Float[np.ndarray, " n"] | None
    crs: str | None

    def __init__(
        self,
        individuals: Tree | Sequence[Tree],
        position: Numbers,
        individual: Numbers | None = None,
        azimuth: Numbers | None = None,
        scale: Numbers | None = None,
        leaf_area: Numbers | None = None,
        crs: str | int | None = None,
    ):
        check_kind("individuals", individuals, Tree | Sequence, "a Tree or several")
        trees = [individuals] if isinstance(individuals, Tree) else list(individuals)
        for tree in trees:
            check_kind("one of individuals", tree, Tree, "a Tree")
        if not trees:
            raise ValueError("individuals is empty; at least one tree is admissible")
        place = checked_array("position", position, (None, 3))
        n = len(place)
        number = np.zeros(n, int)
        if individual is not None:
            check_range("individual", individual, 0, len(trees) - 1)
            number = np.asarray(individual)
            if not np.issubdtype(number.dtype, np.integer):
                raise TypeError(f"individual is an array of {number.dtype}; admissible are integers")
            check_shape("individual", number, (n,))
        turn = np.zeros(n) if azimuth is None else checked_array("azimuth", azimuth, (n,))
        factors = np.ones((n, 3))
        if scale is not None:
            factors = checked_array("scale", scale, (n, 3), 0.0, low_open=True)
        area = None
        if leaf_area is not None:
            area = checked_array("leaf_area", leaf_area, (n,), 0.0, one_for_all=True)
        # Each individual is scaled and turned about its base.
        copied = tuple(tree.translated(-tree.base) for tree in trees)
        values = (copied, place, number, turn, factors, area, crs_name(crs))
        for name, value in zip(self.__dataclass_fields__, values):
            object.__setattr__(self, name, value)

    @staticmethod
    def joined(stands: "Sequence[Stand | Tree]") -> "Stand":
        """Join several stands, and single trees, which stay where they are.

        **Arguments:**

        - `stands`: any number of `Stand` or `Tree`, at least one.

        **Returns:** a `Stand`.

        **Raises:** ValueError where there is none, and for stands of which some have leaf areas and some not;
        TypeError for an object of another kind.
        """
        check_kind("stands", stands, Sequence, "several Stand, as in [stand, other]")
        for stand in stands:
            check_kind("one of stands", stand, Stand | Tree, "a Stand or a Tree")
        if not len(stands):
            raise ValueError("stands is empty; at least one stand is admissible")
        alike = [s if isinstance(s, Stand) else Stand(s, s.base[None]) for s in stands]
        areas = [stand.leaf_area for stand in alike if stand.leaf_area is not None]
        if areas and len(areas) < len(alike):
            raise ValueError(
                f"stands: {len(areas)} of {len(alike)} have leaf areas; admissible is all or none"
            )
        first = np.cumsum([0, *(len(stand.individuals) for stand in alike)])
        return Stand(
            [tree for stand in alike for tree in stand.individuals],
            np.concatenate([stand.position for stand in alike]),
            np.concatenate([stand.individual + i for stand, i in zip(alike, first)]),
            np.concatenate([stand.azimuth for stand in alike]),
            np.concatenate([stand.scale for stand in alike]),
            np.concatenate(areas) if areas else None,
            common_system({f"stands[{i}]": stand.crs for i, stand in enumerate(alike)}),
        )

    def __len__(self) -> int:
        return len(self.position)

    @overload
    def __getitem__(self, index: int) -> Tree: ...

    @overload
    def __getitem__(self, index: slice) -> "Stand": ...

    def __getitem__(self, index: int | slice) -> "Tree | Stand":
        if isinstance(index, slice):
            area = None if self.leaf_area is None else self.leaf_area[index]
            return Stand(
                self.individuals,
                self.position[index],
                self.individual[index],
                self.azimuth[index],
                self.scale[index],
                area,
                self.crs,
            )
        tree = self.individuals[self.individual[index]]
        scaled = tree.scaled(self.scale[index])
        return scaled.rotated(float(self.azimuth[index])).translated(self.position[index])

    def __str__(self) -> str:
        count = len(self.individuals)
        copies = f"copies of {count} individual{'s' if count > 1 else ''}"
        low, high = self.height.min(), self.height.max()
        area = "" if self.leaf_area is None else f", {self.tree_leaf_area.sum():,.0f} m2 of leaves"
        return f"Stand of {len(self):,} trees, {copies}: {low:.1f} to {high:.1f} m tall{area}"

    @property
    def height(self) -> Float[np.ndarray, " n"]:
        """Height of each tree, m: from its base to its highest wood."""
        return self.scale[:, 1] * np.array([tree.height for tree in self.individuals])[self.individual]

    @property
    def trunk_diameter(self) -> Float[np.ndarray, " n"]:
        """Diameter of each tree's thickest stem at its base, m."""
        diameter = np.array([tree.trunk_diameter for tree in self.individuals])
        return self.scale[:, 2] * diameter[self.individual]

    @property
    def crown_diameter(self) -> Float[np.ndarray, " n"]:
        """Diameter of each crown, m: that of a circle as large as the crown's convex hull from above."""
        diameter = np.array([tree.crown_diameter for tree in self.individuals])
        return self.scale[:, 0] * diameter[self.individual]

    @property
    def tree_leaf_area(self) -> Float[np.ndarray, " n"]:
        """One-sided leaf area of each tree, m2.

        **Raises:** ValueError where the stand has no leaf areas.
        """
        if self.leaf_area is None:
            raise ValueError("leaf_area = None: the stand states no leaf area; see with_leaf_area_index")
        return self.leaf_area * self._clump_counts()

    def _clump_counts(self) -> Int[np.ndarray, " n"]:
        """Return the number of leaf clumps of each tree."""
        return np.array([len(tree.bud_radius) for tree in self.individuals])[self.individual]

    def with_tree_leaf_area(self, area: Numbers) -> "Stand":
        """Return the stand with other leaf areas of its trees, each divided evenly among their clumps.

        **Arguments:**

        - `area`: (n,) one-sided leaf area of each tree, m2, 0 or more.

        **Returns:** a `Stand`.

        **Raises:** ValueError for areas of another number or sign, and for a tree that has a leaf area and no
        leaf clumps.
        """
        areas, counts = checked_array("area", area, (len(self),), 0.0), self._clump_counts()
        bare = np.flatnonzero((counts == 0) & (areas > 0))
        if bare.size:
            raise ValueError(
                f"area = {areas[bare[0]]:g} m2 of tree {bare[0]}, which has no leaf clumps; admissible is 0"
            )
        return self._with(leaf_area=areas / np.maximum(counts, 1))

    def with_leaf_area_index(self, leaf_area_index: float, area: float) -> "Stand":
        """Return the stand with a given leaf area index, divided among trees by the areas of their crowns.

        So the leaf area per area below a crown is the same for every tree that has leaves.

        **Arguments:**

        - `leaf_area_index`: one-sided leaf area of all trees together per ground area, 0 or more.
        - `area`: ground area, m2, positive.

        **Returns:** a `Stand`.

        **Raises:** ValueError for arguments outside these ranges, and where no tree has leaf clumps.
        """
        check_number("leaf_area_index", leaf_area_index, 0.0)
        check_number("area", area, 0.0, low_open=True)
        crown_area = np.where(self._clump_counts() > 0, self.crown_diameter**2, 0.0)
        if not crown_area.sum() > 0.0:
            raise ValueError(
                f"leaf_area_index = {leaf_area_index:g}, but no tree of the stand has leaf clumps"
            )
        return self.with_tree_leaf_area(leaf_area_index * area * crown_area / crown_area.sum())

    def above(self, terrain: Terrain) -> "Stand":
        """Return the stand on a terrain: the base of each tree is lifted by the height of the ground below.

        Trees stand upright; their own z, where it is not zero, is their height above the ground.

        **Arguments:**

        - `terrain`: a `Terrain` below all trees.

        **Returns:** a `Stand`.

        **Raises:** ValueError for trees that stand off the terrain, and one with another `crs`; TypeError for
        an object that is none.
        """
        check_kind("terrain", terrain, Terrain, "a Terrain")
        crs = common_system({"stand": self.crs, "terrain": terrain.crs})
        lift = np.asarray(terrain.height_at(self.position[:, 0], self.position[:, 1]), float)
        return self._with(position=self.position + lift[:, None] * [0.0, 0.0, 1.0], crs=crs)

    def _with(self, **changes: Any) -> "Stand":
        """Return the stand with other values of some fields."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return Stand(**(fields | changes))
