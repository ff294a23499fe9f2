"""Forests: trees of given habits, placed at random by density with a minimum distance."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxlidar._checks import check_range
from jaxlidar.plants.habits import Habit, grow
from jaxlidar.plants.tree import Tree

# Darts in a row that find no room, after which an area is taken as full.
FRUITLESS = 20_000
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
) -> list[Tree]:
    """Place trees on a level rectangle, each turned by an azimuth of its own.

    Positions are drawn one by one, evenly over the rectangle, and kept where no stem stands closer than the
    minimum distance (random sequential addition). Crowns may reach over the edges.

    **Arguments:**

    - `habits`: a `Habit` or several. Default None: `broadleaf()`.
    - `density`: stems per hectare, positive; density times area is rounded to whole trees, at least one.
    - `area`: (east, north) sides in m, positive.
    - `minimum_distance`: between stems, m, 0 or more. Default 2.
    - `shares`: of each habit, in proportion to which trees are drawn; 0 or more, not all 0. Default None:
      equal.
    - `size`: (low, high) positive factor on heights and trunk diameters, drawn evenly. Default (1, 1).
    - `individuals`: how many of each habit are grown; trees are drawn from those, so that some are the same
      but for their azimuth. Default 8. None: every tree is grown, which takes longer.
    - `origin`: of the south-west corner, at the ground, m. Default (0, 0, 0).
    - `seed`: of all that is drawn, or a generator. Default 0.

    **Returns:** the trees, in the order in which they were placed; each one's place is its `base`.

    **Raises:** ValueError for what is outside the ranges above, and where so many trees cannot be placed at
    that distance: random placement fills at most about 0.7 / minimum_distance^2 stems per m2.
    """
    kinds = [Habit()] if habits is None else [habits] if isinstance(habits, Habit) else list(habits)
    if not kinds:
        raise ValueError("habits is empty; at least one habit is admissible")
    check_range("density", density, 0.0, low_open=True)
    check_range("area", area, 0.0, low_open=True)
    check_range("minimum_distance", minimum_distance, 0.0)
    check_range("size", size, 0.0, low_open=True)
    if size[0] > size[1]:
        raise ValueError(f"size = {size} is not (low, high) with low <= high")
    check_range("origin", origin)
    if individuals is not None:
        check_range("individuals", individuals, 1)
    weight = np.ones(len(kinds)) if shares is None else np.asarray(shares, dtype=float)
    if weight.shape != (len(kinds),):
        raise ValueError(
            f"shares has {weight.size} elements; admissible is one for each of {len(kinds)} habits"
        )
    check_range("shares", weight, 0.0)
    check_range("sum of shares", weight.sum(), 0.0, low_open=True)

    rng = np.random.default_rng(seed)
    places, kind_rng, growth = rng.spawn(3)
    count = max(1, round(density * area[0] * area[1] / 1e4))
    position = _places(count, area, minimum_distance, density, places)
    kind = kind_rng.choice(len(kinds), count, p=weight / weight.sum())
    number = np.arange(count) if individuals is None else kind_rng.integers(individuals, size=count)
    azimuth = kind_rng.uniform(0.0, 360.0, count)
    grown: dict[tuple[int, int], Tree] = {}
    trees = []
    for i in range(count):
        which = int(kind[i]), int(number[i])
        if which not in grown:
            habit, factor = kinds[which[0]], growth.uniform(*size)
            habit = replace(
                habit,
                height=factor * habit.height,
                trunk_diameter=max(factor * habit.trunk_diameter, habit.smallest_diameter),
            )
            grown[which] = grow(habit, seed=growth)
        trees.append(grown[which].rotated(azimuth[i]).translated(np.append(position[i], 0.0) + origin))
    return trees


def _places(
    count: int, area: tuple[float, float], distance: float, density: float, rng: np.random.Generator
) -> Float[np.ndarray, "{count} 2"]:
    """Points by dart throwing."""
    placed = np.empty((count, 2))
    done, missed = 0, 0
    while done < count:
        # Darts are thrown many at a time but judged one after the other, as if they were thrown singly.
        darts = rng.uniform(0.0, area, (BATCH, 2))
        away = np.linalg.norm(darts[:, None] - placed[None, :done], axis=2).min(axis=1, initial=np.inf)
        fresh = done
        for dart, free in zip(darts, away >= distance):
            new = placed[fresh:done]
            if free and np.all(np.linalg.norm(new - dart, axis=1) >= distance):
                placed[done] = dart
                done, missed = done + 1, 0
                if done == count:
                    break
            else:
                missed += 1
        if missed >= FRUITLESS:
            raise ValueError(
                f"density = {density:g} stems/ha with minimum_distance = {distance:g} m cannot be placed: "
                f"room was found for {done} of {count} trees, that is for at most about "
                f"{1e4 * done / (area[0] * area[1]):.3g} stems/ha"
            )
    return placed
