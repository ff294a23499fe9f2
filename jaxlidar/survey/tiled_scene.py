"""The strategy tiled scene: the shots of each square tile of a scene that is larger than memory are one task.

A task asks `SceneParts.part` for the scene within the rectangle that its shots need, and traces them with one
of the other strategies. The rectangle reaches beyond the tile

- by the footprints of its shots, at all heights of the scene, and
- by a margin: as far as light may travel sideways and still return before the record ends.

A path comes down at the zenith angle z to where it first scatters, at most the height h above the reference
plane, flies the length L between scatterings, and returns. Its length, relative to the reference plane, is at
least L - 2 h / cos z - L sin z; it is recorded if that is at most l. So the margin is at most

    L = (l + 2 h / cos z) / (1 - sin z)

All tiles have one record, one number of orders and rectangles of one size, so that they share compiled
programs. To find the record, all parts are looked at twice: for what each would record, and then with that
record and their margins.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fingerprint import digest_of
from jaxlidar._jax.workers import in_turn, task
from jaxlidar.scenes.scene import check_kinds
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.sensors.survey import Survey
from jaxlidar.survey.choose_strategy import choose_strategy
from jaxlidar.survey.collect import ShotsInMemory, SurveyResults
from jaxlidar.survey.coverage import ground_heights, off_map
from jaxlidar.survey.strategy import AbstractStrategy, SurveyTask, slices_of_shots
from jaxlidar.survey.truths import truth_tasks

# Radius within which a Gaussian beam is followed, over its 1/e^2 radius; 2e-8 of its energy lies beyond. It
# is larger than in `footprint_splines`: what lies outside the rectangle is missing altogether.
_GAUSSIAN_EXTENT = 3.0
# Shots of a chunk of a store.
_SHOTS_PER_BLOCK = 256
# Rectangles reach beyond tiles by multiples of the tile's edge over this.
_STEPS = 10


class SceneTile(NamedTuple):
    """Numbers of the shots of a tile, and the corners of the rectangle of the scene that they need, m."""

    shots: Int[np.ndarray, " shots"]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]


class TileOptions(NamedTuple):
    """Arguments of `simulate_many` for all tiles, and what the results of all tiles have in common.

    `window`: times of the first and the last sample, ns; None: those that each part needs. `materials`,
    `surfaces`: names, of all parts.
    """

    rtol: float | None
    orders: int | None
    shared: bool | None
    truth: bool
    kept_names: tuple[str, ...]
    window: tuple[float, float] | None = None
    materials: tuple[str, ...] = ()
    surfaces: tuple[str, ...] = ()


def tiles_of(survey: Survey, scene: SceneParts, margin: float = 0.0) -> list[SceneTile]:
    """Return the tiles that have any shots, with rectangles of one size.

    All unscattered light of the shots of a tile lies within its rectangle, with `margin`, m, to spare.

    1. The tile of each shot, and how far its beam, between the scene's lowest and highest points, reaches
       beyond that tile.
    2. The largest of these distances and the margin extend all tiles.
    3. The tiles that have shots, with these.
    """
    direction, cosine = survey.direction, -survey.direction[:, 2]
    # The footprint on a plane at the scene's lowest or highest point: longer for oblique beams, and wider
    # below.
    largest_height = max(abs(z) for z in scene.z)
    followed_radius = survey.footprint_radius * (
        _GAUSSIAN_EXTENT if survey.lidar.profile == "gaussian" else 1.0
    )
    reach = (followed_radius / cosine * (1.0 + largest_height / survey.slant_range))[:, None]
    ends = np.stack([survey.position + z * (direction[:, :2] / direction[:, 2:]) for z in scene.z])
    # A shot belongs to the tile of the middle of its beam axis between the scene's lowest and highest points.
    corner = scene.tile * np.floor(ends.mean(axis=0) / scene.tile)
    overhang = np.maximum(corner - ends.min(axis=0), ends.max(axis=0) - corner - scene.tile) + reach
    step = scene.tile / _STEPS
    # One extension for all tiles, the largest of any shot, as parts must have one shape to share compiled
    # programs. It is a multiple of a step, so that similar surveys ask for the same rectangles.
    extension = step * np.ceil(max(float(overhang.max()) + margin, 0.0) / step)
    corners, tile_of_shot = np.unique(corner, axis=0, return_inverse=True)
    shots = [np.flatnonzero(tile_of_shot.reshape(-1) == n) for n in range(len(corners))]
    return [
        SceneTile(numbers, low - extension, low + scene.tile + extension)
        for numbers, low in zip(shots, corners)
    ]


def lossless_margin(survey: Survey, longest_path: float, top: float) -> float:
    """Return the distance, m, from its first scattering within which all light that is recorded travels.

    `longest_path`: longest path that is recorded, m, relative to twice the range of the reference plane;
    `top`: height of the scene, m. See the module's docstring for the formula.
    """
    zenith = np.deg2rad(float(survey.zenith.max()))
    return float(max((longest_path + 2.0 * top / np.cos(zenith)) / (1.0 - np.sin(zenith)), 0.0))


@dataclasses.dataclass(frozen=True)
class TiledSceneStrategy(AbstractStrategy):
    """A task traces the shots of a tile over its part of the scene; further tasks find their truth.

    - `setup`: of the first tile. - `tiles`: with their margins.
    - `off_map`, `ground_height`: (shots,), as in `Waveforms`. - `digests`: of all parts.
    - `margin`, `lossless_margin`: m, the one in use and the one that loses no light.
    """

    scene: SceneParts
    tiles: list[SceneTile]
    options: TileOptions
    off_map: Float[np.ndarray, " shots"]
    ground_height: Float[np.ndarray, " shots"]
    digests: list[str]
    margin: float
    lossless_margin: float
    shared: bool

    @staticmethod
    def of(
        survey: Survey,
        scene: SceneParts,
        rtol: float | None,
        max_orders: int | None,
        shared: bool | None,
        truth: bool,
        kept_names: tuple[str, ...],
    ) -> "TiledSceneStrategy":
        """Look at all parts of the scene, one after the other, and return the strategy.

        1. Without margins: the record that each part needs, and the largest number of orders.
        2. The record of all, and the margin from its length.
        3. With these: materials, surfaces, ground, coverage, and a digest of each part.

        **Raises:** as `simulate_many`, with the corners of the part.
        """
        if survey.has_sensor_position:
            raise ValueError(
                "survey: its shots are placed by their sensors; admissible over SceneParts, which "
                "need to know where beams go, are shots with an altitude"
            )
        options = TileOptions(rtol, max_orders, shared, truth, kept_names)
        tiles = tiles_of(survey, scene)
        plans = [_strategy_of_tile(survey, scene, tile, options).setup.plan for tile in tiles]
        ends = [plan.sample_start + plan.sample_interval * (plan.n_samples - 1) for plan in plans]
        orders, start = max(plan.orders for plan in plans), min(plan.sample_start for plan in plans)
        options = options._replace(orders=orders, window=(start, max(ends)))

        lossless = 0.0
        if orders > 1:
            # A part's record may end before that of all: paths may then be longer by as much.
            longest = max(float(plan.limits.max_path) for plan in plans)
            longest += (max(ends) - min(ends)) * SPEED_OF_LIGHT
            lossless = lossless_margin(survey, longest, scene.z[1])
        margin = lossless if scene.margin is None else float(scene.margin)

        tiles = tiles_of(survey, scene, margin)
        off_map_fractions, heights = np.zeros(len(survey)), np.zeros(len(survey))
        digests, shared_by_tile = [], []
        # Parts may differ in their materials, but the results of a survey have one set of names. Dicts
        # without values are sets that keep their order.
        materials: dict[str, None] = {}
        surfaces: dict[str, None] = {}
        first_strategy = None
        for tile in tiles:
            strategy = _strategy_of_tile(survey, scene, tile, options)
            first_strategy = strategy if first_strategy is None else first_strategy
            scene_part, plan = strategy.setup.scene, strategy.setup.plan
            off_map_fractions[tile.shots] = off_map(strategy.survey, scene_part)
            heights[tile.shots] = ground_heights(strategy.survey, scene_part, plan.limits.start_distance)
            # The part as it is given: the strategy's has been moved to the survey's origin.
            digests.append(digest_of(scene.between(tile.low, tile.high)))
            materials |= dict.fromkeys(plan.config.materials)
            surfaces |= dict.fromkeys(plan.config.materials[s.material] for s in plan.config.surfaces)
            shared_by_tile.append(bool(strategy.info()["shared"]))
        assert first_strategy is not None
        return TiledSceneStrategy(
            setup=first_strategy.setup,
            survey=survey,
            rtol=first_strategy.rtol,
            kept_names=kept_names,
            scene=scene,
            tiles=tiles,
            options=options._replace(materials=tuple(materials), surfaces=tuple(surfaces)),
            off_map=off_map_fractions,
            ground_height=heights,
            digests=digests,
            margin=margin,
            lossless_margin=lossless,
            shared=all(shared_by_tile),
        )

    def tasks(self, key: PRNGKeyArray) -> list[SurveyTask]:
        # Tasks get the function that returns parts, not the parts: all of them would fill the memory.
        tasks = []
        for function in (trace_tile, truth_of_tile) if self.options.truth else (trace_tile,):
            for n, tile in enumerate(self.tiles):
                arguments = self.survey, self.scene, tile, n, self.options
                unit = task(len(tasks), function, arguments, key)
                tasks.append(SurveyTask(unit, tile.shots, is_truth=function is truth_of_tile))
        return tasks

    @property
    def shot_slices(self) -> list[slice]:
        return slices_of_shots(len(self.survey), _SHOTS_PER_BLOCK)

    @property
    def contribution_sum(self) -> None:
        return None

    def info(self) -> dict[str, Any]:
        return {
            "shared": self.shared,
            "parts": len(self.tiles),
            "margin": self.margin,
            "margin of all light": self.lossless_margin,
        }


def _strategy_of_tile(
    survey: Survey, scene: SceneParts, tile: SceneTile, options: TileOptions
) -> AbstractStrategy:
    """Return the strategy of the shots of a tile. **Raises:** as `simulate_many`, with the part's corners."""
    scene_part = scene.between(tile.low, tile.high)
    try:
        check_kinds(survey.lidar, scene_part)
        return choose_strategy(
            survey.subset(tile.shots),
            scene_part,
            options.rtol,
            options.orders,
            options.shared,
            options.window,
            options.kept_names,
        )
    except ValueError as error:
        corners = f"part({tile.low.tolist()}, {tile.high.tolist()})"
        raise ValueError(f"{corners}, shots {tile.shots[:5].tolist()}: {error}") from error


def _in_order_of_names(
    arrays: dict[str, np.ndarray], names: Any, missing: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the arrays of `names` in their order, `missing` for names without one, then all others."""
    return {**dict.fromkeys(names, missing), **arrays}


def trace_tile(
    survey: Survey,
    scene: SceneParts,
    tile: SceneTile,
    number: int,
    options: TileOptions,
    key: PRNGKeyArray,
) -> dict[str, Any]:
    """Trace the shots of a tile. Materials that its part of the scene lacks have zeros."""
    # With the window and the orders of all tiles the strategy comes out as in `TiledSceneStrategy.of`.
    strategy = _strategy_of_tile(survey, scene, tile, options)
    tasks = strategy.tasks(jax.random.fold_in(key, number))
    light = ShotsInMemory(len(tile.shots))
    survey_results = SurveyResults(strategy, light, ShotsInMemory(0), {})
    # One after the other: the task of a tile has one core.
    for survey_task, (_, result) in zip(tasks, in_turn([t.unit for t in tasks])):
        survey_results.add(survey_task, result)
    survey_results.sum_contributions()
    results: dict[str, Any] = dict(light.values)
    fates = [f"absorbed by {material}" for material in options.materials]
    names = {"components": options.materials, "energy_budget": fates, "energy_budget_stderr": fates}
    for field in names.keys() & results.keys():
        arrays = results[field]
        no_light = np.zeros_like(next(iter(arrays.values())))
        results[field] = _in_order_of_names(arrays, names[field], no_light)
    return results


def truth_of_tile(
    survey: Survey,
    scene: SceneParts,
    tile: SceneTile,
    number: int,
    options: TileOptions,
    key: PRNGKeyArray,
) -> dict[str, Any]:
    """Return the fields of the truth of the shots of a tile, as `truths_of_chunk` does."""
    strategy = _strategy_of_tile(survey, scene, tile, options)
    chunks = [chunk for _, chunk in in_turn([t.unit for t in truth_tasks(strategy, key)])]
    truths = jax.tree.map(lambda *a: np.concatenate(a), *chunks)
    # The last chunk is as large as the others, and filled up.
    truths = jax.tree.map(lambda a: a[: len(tile.shots)], truths)
    no_height = np.full(len(tile.shots), np.nan)
    samples, n_wavelengths = truths["gap_probability"], survey.lidar.wavelength.size
    nothing = np.zeros((len(samples), n_wavelengths, strategy.setup.plan.n_samples), samples.dtype)
    return truths | {
        "returns": _in_order_of_names(truths["returns"], options.materials, nothing),
        "surface_height": _in_order_of_names(truths["surface_height"], options.surfaces, no_height),
        "surface_spread": _in_order_of_names(truths["surface_spread"], options.surfaces, no_height),
    }
