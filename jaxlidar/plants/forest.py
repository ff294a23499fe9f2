"""Forests: trees of given habits, placed at random with a given stem density and a minimum distance."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import (
    check_integer,
    check_kind,
    check_number,
    check_range,
    check_seed,
    check_shape,
    checked_array,
    kind_of,
)
from jaxlidar.plants.habits import Habit, grow
from jaxlidar.plants.stand import Stand
from jaxlidar.plants.tree import Tree

# No tree is taller, m: the tallest that is known has 116 m.
MAX_TREE_HEIGHT = 150.0
# The area is taken as full after this many rejected positions in a row.
MAX_REJECTED = 20_000
# Positions drawn at a time.
BATCH = 200


def forest(
    habits: Habit | Sequence[Habit] | None = None,
    *,
    density: float,
    area: tuple[float, float],
    minimum_distance: float = 2.0,
    shares: Sequence[float] | None = None,
    size: tuple[float, float] = (1.0, 1.0),
    individuals: int | None = 8,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int | np.random.Generator = 0,
) -> Stand:
    """Grow a forest stand: trees at random positions on a level rectangle, each with a random azimuth.

    Positions are drawn one by one, uniformly over the rectangle. A position is accepted if no stem is closer
    than the minimum distance (random sequential addition). Crowns may reach over the edges.

    **Arguments:**

    - `habits`: a `Habit` or several. Default None: `broadleaf()`.
    - `density`: stems per hectare, positive. Density times area is rounded to whole trees, at least one.
    - `area`: (east, north) side lengths in m, positive.
    - `minimum_distance`: smallest distance between stems in m, 0 or more. Default 2.
    - `shares`: relative frequency of each habit, one number per habit, 0 or more, not all 0. Default None:
      equal.
    - `size`: (low, high), positive: the range of a factor on height and trunk diameter, drawn uniformly for
      each individual grown. Trunks do not get thinner than the habit's smallest diameter. Default (1, 1).
    - `individuals`: largest number of different trees that are grown of each habit, 1 or more. The trees of
      the stand are drawn from these, so that some differ in position and azimuth only. None: every tree is
      grown separately, which takes longer. Default 8.
    - `origin`: (x, y, z) of the south-west corner at the ground, m. Default (0, 0, 0).
    - `seed`: random seed, or a NumPy generator. Default 0.

    **Returns:** a `Stand`, a sequence of `Tree` in the order of placement. The position of a tree is its
    `base`.

    **Raises:** ValueError for arguments outside the ranges above, and if the trees cannot be placed at that
    distance; TypeError for an object that is no `Habit`. Random placement fills at most about
    0.7 / minimum_distance^2 stems per m2.

    **Example:**

    >>> import jaxlidar as jl
    >>> trees = jl.forest(jl.shrub(stems=2), density=200.0, area=(30.0, 20.0), individuals=2)
    >>> print(f"{len(trees)} trees of {trees[0].height:.1f} m")
    12 trees of 2.5 m
    """
    check_range("size", size, 0.0, low_open=True)
    check_shape("size", size, (2,))
    if size[0] > size[1]:
        raise ValueError(f"size = {size} is not (low, high) with low <= high")
    # Streams of their own: another minimum distance, for instance, leaves the trees as they are.
    check_seed(seed)
    position_rng, kind_rng, growth_rng = np.random.default_rng(seed).spawn(3)
    kinds = checked_habits(habits)
    kind, position, number, azimuth = _draw_copies(
        kinds, density, area, minimum_distance, shares, individuals, origin, position_rng, kind_rng
    )
    # By habit and number of the individual.
    grown: dict[tuple[int, int], Tree] = {}
    for individual in zip(kind.tolist(), number.tolist()):
        if individual not in grown:
            habit, factor = kinds[individual[0]], growth_rng.uniform(*size)
            habit = replace(
                habit,
                height=factor * habit.height,
                trunk_diameter=max(factor * habit.trunk_diameter, habit.smallest_diameter),
            )
            grown[individual] = grow(habit, seed=growth_rng)
    order = {individual: i for i, individual in enumerate(grown)}
    copies = np.array([order[individual] for individual in zip(kind.tolist(), number.tolist())])
    return Stand(list(grown.values()), position, copies, azimuth)


def stand_of_leaf_area(
    leaf_area_index: float,
    heights: Any,
    habits: Habit | Sequence[Habit] | None = None,
    *,
    density: float,
    area: tuple[float, float],
    minimum_distance: float = 2.0,
    shares: Sequence[float] | None = None,
    individuals: int = 8,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int | np.random.Generator = 0,
) -> Stand:
    """Make a stand of a given leaf area index, whose trees have given heights.

    Trees stand at random positions, as those of `forest`. Each is a copy of one of a few individuals of its
    habit, scaled as a whole to its height. The n heights are drawn one from each of n classes that are
    equally probable, so that they follow their distribution more closely than independent ones would. Leaf
    area is divided among the trees by the areas of their crowns, and among the clumps of a tree evenly.
    Crowns may reach over the edges of the area; their leaves count.

    **Arguments:**

    - `leaf_area_index`: one-sided leaf area per ground area, 0 or more.
    - `heights`: the distribution of tree heights, m, within (0, 150]: one number for all, a sample of numbers
      such as measured heights, or an object with the inverse of the distribution function as method `ppf`,
      such as `scipy.stats.norm(20.0, 2.0)`.
    - `habits`: a `Habit` or several; their heights do not count. Default None: `broadleaf()`.
    - `density`, `area`, `minimum_distance`, `shares`, `origin`, `seed`: as those of `forest`.
    - `individuals`: number of different trees that are grown of each habit, 1 or more. Default 8.

    **Returns:** a `Stand` with leaf areas.

    **Raises:** as `forest`; ValueError for a leaf area index or heights outside of their range; TypeError for
    heights of another kind.

    **Example:**

    >>> import jaxlidar as jl
    >>> how = {"density": 400.0, "area": (30.0, 20.0), "individuals": 2}
    >>> stand = jl.stand_of_leaf_area(3.0, (1.5, 2.0, 3.5), jl.shrub(stems=2), **how)
    >>> voxels = jl.voxelise(stand, 0.5)
    >>> print(f"leaf area index {2 * float(voxels.leaf.sum()) * 0.5**3 / 600:.2f}")
    leaf area index 3.00
    """
    check_number("leaf_area_index", leaf_area_index, 0.0)
    individuals = check_integer("individuals", individuals)
    check_seed(seed)
    position_rng, kind_rng, growth_rng = np.random.default_rng(seed).spawn(3)
    kinds = checked_habits(habits)
    kind, position, number, azimuth = _draw_copies(
        kinds, density, area, minimum_distance, shares, individuals, origin, position_rng, kind_rng
    )
    n = len(position)
    height = _quantiles(heights, (kind_rng.permutation(n) + kind_rng.uniform(size=n)) / n)
    trees = [grow(habit, seed=growth_rng) for habit in kinds for _ in range(individuals)]
    copies = kind * individuals + number
    factor = height / np.array([tree.height for tree in trees])[copies]
    stand = Stand(trees, position, copies, azimuth, factor[:, None] * np.ones(3))
    return stand.with_leaf_area_index(leaf_area_index, area[0] * area[1])


def _quantiles(heights: Any, probability: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the quantiles of a distribution of heights, or of a sample, in m."""
    if callable(inverse := getattr(heights, "ppf", None)):
        values = np.asarray(inverse(probability), float)
        check_range("quantiles of heights", values, 0.0, MAX_TREE_HEIGHT, low_open=True)
        check_shape("heights.ppf(probability)", values, probability.shape)
        return values
    if isinstance(heights, str) or (not np.iterable(heights) and not np.isscalar(heights)):
        raise TypeError(
            f"heights is {kind_of(heights)}; admissible are a number, a sample of numbers, or a distribution "
            "with a method ppf, such as scipy.stats.norm(20.0, 2.0)"
        )
    sample = checked_array("heights", heights, (None,), 0.0, MAX_TREE_HEIGHT, one_for_all=True, low_open=True)
    return np.quantile(sample, probability, method="inverted_cdf")


def checked_habits(habits: Any) -> list[Habit]:
    """Return the habits of a stand as a list.

    **Raises:** ValueError where there is none; TypeError for objects of another kind.
    """
    check_kind("habits", habits, Habit | Sequence | None, "a Habit or several")
    kinds = [Habit()] if habits is None else [habits] if isinstance(habits, Habit) else list(habits)
    if not kinds:
        raise ValueError("habits is empty; at least one habit is admissible")
    for habit in kinds:
        check_kind("one of habits", habit, Habit, "a Habit")
    return kinds


def _draw_copies(
    kinds: list[Habit],
    density: float,
    area: tuple[float, float],
    minimum_distance: float,
    shares: Sequence[float] | None,
    individuals: int | None,
    origin: tuple[float, float, float],
    position_rng: np.random.Generator,
    kind_rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw the habit, the position (n, 3), the individual of its habit, and the azimuth of each tree.

    **Raises:** as `forest`.
    """
    check_number("density", density, 0.0, low_open=True)
    check_range("area", area, 0.0, low_open=True)
    check_shape("area", area, (2,))
    check_number("minimum_distance", minimum_distance, 0.0)
    check_range("origin", origin)
    check_shape("origin", origin, (3,))
    if individuals is not None:
        individuals = check_integer("individuals", individuals)
    shares = [1.0] * len(kinds) if shares is None else shares
    check_range("shares", shares, 0.0)
    weight = np.asarray(shares, dtype=float)
    if weight.shape != (len(kinds),):
        raise ValueError(
            f"shares has {weight.size} elements; admissible is one for each of {len(kinds)} habits"
        )
    check_range("sum of shares", weight.sum(), 0.0, low_open=True)

    count = max(1, round(density * area[0] * area[1] / 1e4))
    base = np.append(
        _stem_positions(count, area, minimum_distance, density, position_rng), np.zeros((count, 1)), 1
    )
    kind = kind_rng.choice(len(kinds), count, p=weight / weight.sum())
    number = np.arange(count) if individuals is None else kind_rng.integers(individuals, size=count)
    azimuth = kind_rng.uniform(0.0, 360.0, count)
    return kind, base + np.asarray(origin, float), number, azimuth


def _stem_positions(
    count: int, area: tuple[float, float], distance: float, density: float, rng: np.random.Generator
) -> Float[np.ndarray, "{count} 2"]:
    """Draw random positions, no two of them closer than `distance`; `density` is for the error message."""
    positions = np.empty((count, 2))
    n_placed, n_rejected = 0, 0
    while n_placed < count:
        # Candidates are drawn many at a time but judged one after the other, as if they were drawn singly.
        candidates = rng.uniform(0.0, area, (BATCH, 2))
        gap = np.linalg.norm(candidates[:, None] - positions[None, :n_placed], axis=2)
        is_free = gap.min(axis=1, initial=np.inf) >= distance
        first_of_batch = n_placed
        for candidate, free in zip(candidates, is_free):
            # Against those placed since the gaps were computed.
            recent = positions[first_of_batch:n_placed]
            if free and np.all(np.linalg.norm(recent - candidate, axis=1) >= distance):
                positions[n_placed] = candidate
                n_placed, n_rejected = n_placed + 1, 0
                if n_placed == count:
                    break
            else:
                n_rejected += 1
        if n_rejected >= MAX_REJECTED:
            raise ValueError(
                f"density = {density:g} stems/ha with minimum_distance = {distance:g} m cannot be placed: "
                f"room was found for {n_placed} of {count} trees, that is for at most about "
                f"{1e4 * n_placed / (area[0] * area[1]):.3g} stems/ha"
            )
    return positions
