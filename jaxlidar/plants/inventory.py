"""Stands from forest inventories: tables with a row for each tree."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import check_integer, check_kind, check_seed, kind_of
from jaxlidar._fields.columns import check_columns, match_columns
from jaxlidar.plants.forest import MAX_TREE_HEIGHT
from jaxlidar.plants.habits import Habit, broadleaf, conifer, grow, shrub, spreading_tree
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.tree import Tree

# Names of columns, without case, spaces, underscores and units.
COLUMNS = {
    "x": ("x", "easting", "east", "e"),
    "y": ("y", "northing", "north", "n"),
    "height": ("height", "treeheight", "totalheight", "h", "ht"),
    "z": ("z", "elevation", "groundelevation"),
    "diameter": ("diameter", "dbh", "d", "bhd", "stemdiameter", "trunkdiameter"),
    "crown": ("crown", "crowndiameter", "crownwidth", "cd"),
    "leaf_area": ("leafarea", "la"),
    "species": ("species", "sp", "speciesname"),
}
# Quantities of a tree that may be missing: the proportions of the habit give them.
_OPTIONAL_CELLS = ("diameter", "crown")
# Admissible values, (low, high], in m or m2; low belongs to those of leaf area and coordinates.
_LIMITS = {
    "x": (-1e9, 1e9),
    "y": (-1e9, 1e9),
    "z": (-1e9, 1e9),
    "height": (0.0, MAX_TREE_HEIGHT),
    "diameter": (0.0, 15.0),
    "crown": (0.0, 100.0),
    "leaf_area": (0.0, 1e5),
}
# No tree is thicker than this fraction of its height: such diameters are in centimetres.
_MAX_SLENDERNESS = 0.5


class Inventory(NamedTuple):
    """Trees of a forest inventory: one element for each tree.

    - `x`, `y`: (n,) positions of the stems, m.
    - `height`: (n,) m.
    - `species`: n names; None where the table has none.
    - `z`: (n,) heights of the stem bases, m; None where the table has none.
    - `diameter`, `crown`: (n,) diameters of stem and crown, m, NaN where they were not measured; None where
      the table has none.
    - `leaf_area`: (n,) one-sided leaf areas of the trees, m2; None where the table has none.
    - `crs`: coordinate reference system of `x` and `y`, such as "EPSG:32633"; None where it is not known.

    **Example:**

    >>> import numpy as np, jaxlidar as jl
    >>> from jaxlidar.plants.inventory import Inventory
    >>> inventory = Inventory(np.array([1.0, 4.0]), np.array([2.0, 2.0]), np.array([12.0, 15.5]))
    >>> print(f"{inventory.height.max()} m, crowns: {inventory.crown}")
    15.5 m, crowns: None
    """

    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    species: tuple[str, ...] | None = None
    z: Float[np.ndarray, " n"] | None = None
    diameter: Float[np.ndarray, " n"] | None = None
    crown: Float[np.ndarray, " n"] | None = None
    leaf_area: Float[np.ndarray, " n"] | None = None
    crs: str | None = None


def stand_from_inventory(
    inventory: Inventory | Mapping[str, Sequence] | Any,
    habits: Habit | Mapping[str, Habit] | None = None,
    *,
    leaf_area_index: float | None = None,
    area: float | None = None,
    individuals: int = 8,
    seed: int | np.random.Generator = 0,
) -> Stand:
    """Make a stand of the trees of a forest inventory.

    Every tree stands at its place and has the height, stem diameter and crown diameter of the table, as far
    as the table has them: it is a copy of an individual of its habit, scaled along these. What a tree lacks
    has the proportions of the individual. Azimuths are random.

    **Arguments:**

    - `inventory`: an `Inventory`, such as `jaxlidar.io.read_inventory` returns; or a table by columns, such
      as a dict of lists or a pandas DataFrame. It has columns x, y and height, and may have species, z,
      diameter (also dbh), crown (crown diameter) and leaf_area, under these names in any case. Lengths are in
      m, or in the unit that the name of the column ends with, as in "dbh [cm]" or "dbh_cm"; leaf areas in m2.
      Diameters and crowns may be NaN. Other columns are not read; a `UserWarning` names those that nearly
      have one of these names.
    - `habits`: the habit of each species by name, or one `Habit` for all. Default None: the species
      broadleaf, conifer, shrub and spreading_tree; without a column of species, `broadleaf()`.
    - `leaf_area_index`: one-sided leaf area per ground area, 0 or more, which is divided among the trees by
      the areas of their crowns. Default None: the leaf areas of the table, if it has them; otherwise the
      stand states none.
    - `area`: ground area of `leaf_area_index`, m2, positive. Give both or neither. Default None.
    - `individuals`: number of different trees that are grown of each habit, 1 or more. Default 8.
    - `seed`: random seed, or a NumPy generator. Default 0.

    **Returns:** a `Stand`, in the order of the rows. `Stand.above` puts it on a terrain.

    **Raises:** ValueError, naming row (from 0) and column, for cells that are no numbers or outside their
    range, for stems thicker than half the tree's height, and for species without a habit; for columns that
    are missing or ambiguous; for a leaf area index beside leaf areas, or without an area. TypeError for
    objects of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> rows = {"species": ["hazel", "hazel"], "x": [2.0, 6.5], "y": [3.0, 4.0], "height": [2.0, 2.6]}
    >>> rows |= {"crown": [1.5, 2.0], "dbh [cm]": [4.0, 5.5]}
    >>> stand = jl.stand_from_inventory(rows, {"hazel": jl.shrub(stems=2)}, individuals=1)
    >>> [f"{tree.height:.1f} m at {tree.base[0]:.1f}" for tree in stand]
    ['2.0 m at 2.0', '2.6 m at 6.5']
    """
    table: Any = inventory
    crs = None
    if isinstance(inventory, Inventory):
        # Checked as any other table.
        columns, crs = inventory._replace(crs=None)._asdict(), inventory.crs
        table = {name: column for name, column in columns.items() if column is not None}
    if not hasattr(table, "keys") or not hasattr(table, "__getitem__"):
        raise TypeError(
            f"inventory is {kind_of(table)}; admissible is a table by columns, such as a dict of lists, a "
            "DataFrame, or what jaxlidar.io.read_inventory returns"
        )
    names = list(table.keys())
    trees = inventory_of_columns(
        "the inventory", [str(name) for name in names], lambda i: list(table[names[i]])
    )
    if (leaf_area_index is None) != (area is None):
        raise ValueError("leaf_area_index and area belong together: give both or neither")
    if leaf_area_index is not None and trees.leaf_area is not None:
        raise ValueError("leaf_area_index is given, but the table has a column leaf_area; give one of them")
    individuals = check_integer("individuals", individuals)
    check_seed(seed)
    turn_rng, growth_rng = np.random.default_rng(seed).spawn(2)
    by_species = _habits_by_species(habits, trees)
    species = trees.species if isinstance(habits, Mapping) or habits is None else None
    names = list(dict.fromkeys(species)) if species else [""]
    grown = [grow(by_species[name], seed=growth_rng) for name in names for _ in range(individuals)]
    n = len(trees.x)
    kind = np.array([names.index(name) for name in species]) if species else np.zeros(n, int)
    copies = kind * individuals + turn_rng.integers(individuals, size=n)
    stand = Stand(
        grown,
        np.column_stack([trees.x, trees.y, np.zeros(n) if trees.z is None else trees.z]),
        copies,
        turn_rng.uniform(0.0, 360.0, n),
        _scales(trees, grown, copies),
        crs=crs,
    )
    if leaf_area_index is not None and area is not None:
        return stand.with_leaf_area_index(leaf_area_index, area)
    return stand if trees.leaf_area is None else stand.with_tree_leaf_area(trees.leaf_area)


def _scales(trees: Inventory, grown: list[Tree], copies: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Return the horizontal, vertical and radial scale of each tree."""

    def ratio(values: np.ndarray | None, of_individuals: list[float], default: np.ndarray) -> np.ndarray:
        own = np.array(of_individuals)[copies]
        if values is None:
            return default
        return np.where(np.isnan(values) | (own <= 0.0), default, values / np.where(own > 0.0, own, 1.0))

    vertical = trees.height / np.array([tree.height for tree in grown])[copies]
    horizontal = ratio(trees.crown, [tree.crown_diameter for tree in grown], vertical)
    radial = ratio(trees.diameter, [tree.trunk_diameter for tree in grown], vertical)
    return np.column_stack([horizontal, vertical, radial])


def _habits_by_species(habits: Any, trees: Inventory) -> Mapping[str, Habit]:
    """Return habits by the species that they are of; one for all is that of the species without a name.

    **Raises:** ValueError for a species without a habit; TypeError for objects of another kind.
    """
    check_kind("habits", habits, Habit | Mapping | None, "a Habit, a dict of them by species, or None")
    if isinstance(habits, Habit):
        return {"": habits}
    if habits is None:
        presets = (broadleaf, conifer, shrub, spreading_tree)
        habits = {"": broadleaf()} if trees.species is None else {f.__name__: f() for f in presets}
    for name, habit in habits.items():
        check_kind(f"habits[{name!r}]", habit, Habit, "a Habit")
    if trees.species is None and "" not in habits:
        raise ValueError(
            f"habits has {', '.join(habits)}, but the table has no column species; admissible is one Habit"
        )
    for row, name in enumerate(trees.species or ()):
        if name not in habits:
            raise ValueError(
                f"row {row}: species = {name!r} has no habit; habits has {', '.join(map(repr, habits))}"
            )
    return habits


def inventory_of_columns(
    location: str,
    names: Sequence[str],
    cells_of: Callable[[int], Sequence[Any]],
    places: Sequence[str] | None = None,
) -> Inventory:
    """Return the inventory of a table, with lengths in m.

    **Arguments:** `location`: the table, for messages. `names`: of its columns. `cells_of`: returns the cells
    of a column, by its index. `places`: of the rows, for messages. Default None: "row 0" and so on.

    **Raises:** ValueError as `stand_from_inventory`.
    """
    columns = match_columns(location, names, COLUMNS)
    check_columns(location, names, columns, COLUMNS, ("height",))
    cells = {column.index: cells_of(column.index) for column in columns.values()}
    n = len(cells[columns["x"].index])
    for column in columns.values():
        if len(cells[column.index]) != n:
            raise ValueError(f"column {column.name!r} has {len(cells[column.index])} rows; x has {n}")
    if n == 0:
        raise ValueError(f"{location}: there is no row; admissible is one or more")
    places = places or [f"row {i}" for i in range(n)]
    quantities: dict[str, Any] = {}
    for quantity, (i, name, _) in columns.items():
        rows = list(zip(places, cells[i]))
        if quantity == "species":
            quantities[quantity] = tuple(_species(place, cell) for place, cell in rows)
        else:
            unit = columns[quantity].size(location, "area" if quantity == "leaf_area" else "length")
            quantities[quantity] = np.array(
                [_quantity(place, name, quantity, cell, unit) for place, cell in rows]
            )
    inventory = Inventory(**quantities)
    if inventory.diameter is not None:
        thick = np.flatnonzero(inventory.diameter > _MAX_SLENDERNESS * inventory.height)
        if thick.size:
            i, name = int(thick[0]), columns["diameter"].name
            raise ValueError(
                f"{places[i]}: {name} = {inventory.diameter[i]:g} m of a tree of "
                f"{inventory.height[i]:g} m; admissible is up to {_MAX_SLENDERNESS:g} of the height. A "
                "column in centimetres is named 'diameter [cm]'"
            )
    return inventory


def _species(place: str, cell: Any) -> str:
    """Return the name of a species. **Raises:** ValueError, naming the place, where it is missing."""
    if not isinstance(cell, str) or not cell.strip():
        raise ValueError(f"{place}: species = {cell!r}; admissible is a name")
    return cell.strip()


def _quantity(place: str, name: str, quantity: str, cell: Any, unit: float) -> float:
    """Return a number of the table in m or m2. **Raises:** ValueError, naming the place and the column."""
    try:
        # None and empty texts stand for what was not measured, as NaN does.
        value = np.nan if cell is None or not str(cell).strip() else unit * float(cell)
    except (TypeError, ValueError):
        raise ValueError(f"{place}: {name} = {cell!r} is no number") from None
    if np.isnan(value):
        if quantity in _OPTIONAL_CELLS:
            return value
        raise ValueError(f"{place}: {name} is missing; a tree needs its {quantity.replace('_', ' ')}")
    low, high = _LIMITS[quantity]
    is_open = quantity in ("height", *_OPTIONAL_CELLS)
    if not (low < value <= high or (value == low and not is_open)):
        opening, measure = "(" if is_open else "[", "m2" if quantity == "leaf_area" else "m"
        raise ValueError(
            f"{place}: {name} = {value:.9g} {measure} is outside the admissible range "
            f"{opening}{low:g}, {high:g}]"
        )
    return value
