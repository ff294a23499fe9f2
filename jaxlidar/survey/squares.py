"""A survey over a scene in parts: its shots by squares, each of which is a chunk with a part of its own."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fingerprint import digest_of
from jaxlidar._workers import Task, done, task
from jaxlidar.instrument.survey import Survey
from jaxlidar.scenes.scene import check_kinds
from jaxlidar.scenes.scene_parts import SceneParts
from jaxlidar.survey.coverage import ground_heights, off_map
from jaxlidar.survey.prepare import prepared
from jaxlidar.survey.records import Record
from jaxlidar.survey.truths import Truths
from jaxlidar.survey.ways import AbstractWay
from jaxlidar.survey.with_truth import WithTruth

# A Gaussian beam is followed so far, in units of its radius; 2e-8 of its energy lies beyond.
_REACH = 3.0
# Shots that are finished together, and squares whose records are kept for the next ones.
_TOGETHER, _KEPT = 256, 4
# Rectangles reach beyond squares by steps of the square's edge over this.
_STEPS = 10


class Square(NamedTuple):
    """Shots of a square, and the corners of the rectangle of its part, m."""

    shots: Int[np.ndarray, " shots"]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]


class Asked(NamedTuple):
    """How the shots of all squares are traced; `window`: first and last sample time, ns.

    `truth`: whether the truth of shots is asked for, too.
    """

    rtol: float | None
    orders: int
    shared: bool | None
    window: tuple[float, float]
    truth: bool


def squares_of(survey: Survey, scene: SceneParts, margin: float = 0.0) -> list[Square]:
    """The squares that have any shots, with rectangles of one size: parts of one shape share programs.

    All light of the shots of a square falls within its rectangle, with `margin`, m, to spare.
    """
    axis, radius = survey.direction, survey.footprint_radius
    steep = -axis[:, 2]
    farthest = max(abs(z) for z in scene.z)
    radius = radius * (_REACH if survey.lidar.profile == "gaussian" else 1.0)
    radius = (radius / steep * (1.0 + farthest / survey.slant_range))[:, None]
    ends = np.stack([survey.position + z * (axis[:, :2] / axis[:, 2:]) for z in scene.z])
    corner = scene.tile * np.floor(ends.mean(axis=0) / scene.tile)
    beyond = np.maximum(corner - ends.min(axis=0), ends.max(axis=0) - corner - scene.tile) + radius
    step = scene.tile / _STEPS
    room = step * np.ceil(max(float(beyond.max()) + margin, 0.0) / step)
    places, number = np.unique(corner, axis=0, return_inverse=True)
    shots = [np.flatnonzero(number.reshape(-1) == n) for n in range(len(places))]
    return [Square(own, place - room, place + scene.tile + room) for own, place in zip(shots, places)]


def all_light(survey: Survey, last: float, top: float) -> float:
    """How far, m, from where it first scatters light can be that is still recorded.

    `last`: length of the longest path that is recorded, m, to the reference plane and from there; `top`:
    height of the scene, m. A path that comes down to where it first scatters, flies the length L among
    scatterings, and returns, has at least the length L - 2 top / cos z - L sin z at the zenith angle z.
    """
    zenith = np.deg2rad(float(survey.zenith.max()))
    return float(max((last + 2.0 * top / np.cos(zenith)) / (1.0 - np.sin(zenith)), 0.0))


def some_of(survey: Survey, shots: Int[np.ndarray, " shots"]) -> Survey:
    """Some shots of a survey."""
    return Survey(survey.lidar, survey.position[shots], survey.zenith[shots], survey.azimuth[shots])


@dataclasses.dataclass(frozen=True)
class BySquares(AbstractWay):
    """A task for each square, which asks for its part of the scene; then one for the truth of each, if asked.

    - `setup`: of the first square. - `squares`: with their margins. - `materials`, `surfaces`: of all parts.
    - `beside`, `heights`: of every shot, see `Waveforms.off_map` and `Waveforms.ground_height`.
    - `digests`: of all parts. - `margin`, `all_light`: m, of the parts and of all light.
    """

    scene: SceneParts
    squares: list[Square]
    asked: Asked
    materials: tuple[str, ...]
    surfaces: tuple[str, ...]
    beside: Float[np.ndarray, " shots"]
    heights: Float[np.ndarray, " shots"]
    digests: list[str]
    margin: float
    all_light: float
    shared: bool

    @staticmethod
    def of(
        survey: Survey,
        scene: SceneParts,
        rtol: float | None,
        max_orders: int | None,
        shared: bool | None,
        truth: bool,
    ) -> "BySquares":
        """Looks at all parts, one after the other: first for what is recorded, then with their margins.

        **Raises:** as `simulate_many`, with the corners of the part.
        """
        squares = squares_of(survey, scene)
        begins, ends, lasts, orders = [], [], [], []
        for square in squares:
            way = _way(survey, scene, square, rtol, max_orders, shared, None)
            plan = way.setup.plan
            begins.append(plan.sample_start)
            ends.append(plan.sample_start + plan.sample_interval * (plan.n_samples - 1))
            lasts.append(float(plan.limits.max_path))
            orders.append(plan.orders)
        asked = Asked(rtol, max(orders), shared, (min(begins), max(ends)), truth)
        # The window is as long for all: so are the paths, by what it grows.
        grown = max(asked.window[1] - end for end in ends) * SPEED_OF_LIGHT
        whole = all_light(survey, max(lasts) + grown, scene.z[1])
        margin = whole if asked.orders > 1 else 0.0
        margin = margin if scene.margin is None else float(scene.margin)
        squares = squares_of(survey, scene, margin)
        beside, heights, digests, shares = np.zeros(len(survey)), np.zeros(len(survey)), [], []
        materials: dict[str, None] = {}
        surfaces: dict[str, None] = {}
        first = None
        for square in squares:
            way = _way(survey, scene, square, rtol, asked.orders, shared, asked.window)
            first = way if first is None else first
            place = way.survey, way.setup.scene
            beside[square.shots] = off_map(*place)
            heights[square.shots] = ground_heights(*place, way.setup.plan.limits.start_distance)
            digests.append(digest_of(scene.between(square.low, square.high)))
            config = way.setup.plan.config
            materials |= dict.fromkeys(config.materials)
            surfaces |= dict.fromkeys(config.materials[s.material] for s in config.surfaces)
            shares.append(bool(way.described()["shared"]))
        assert first is not None
        known = tuple(materials), tuple(surfaces), beside, heights, digests, margin
        light = whole if asked.orders > 1 else 0.0
        return BySquares(first.setup, survey, first.rtol, scene, squares, asked, *known, light, all(shares))

    def tasks(self, key: PRNGKeyArray) -> list[Task]:
        given = [(self.survey, self.scene, square, n, self.asked) for n, square in enumerate(self.squares)]
        found = [task(n, trace_square, one, key) for n, one in enumerate(given)]
        if self.asked.truth:
            found += [task(n, truth_of_square, one, key) for n, one in enumerate(given, len(given))]
        return found

    @property
    def count(self) -> int:
        return len(self.squares) * (2 if self.asked.truth else 1)

    @property
    def slices(self) -> list[slice]:
        many = len(self.survey)
        return [slice(first, min(first + _TOGETHER, many)) for first in range(0, many, _TOGETHER)]

    def kind_of(self, number: int) -> type[Record | Truths]:
        return Record if number < len(self.squares) else Truths

    def records(self, results: Mapping[int, Any]) -> Iterator[tuple[slice, Record]]:
        number, turn = (np.empty(len(self.survey), int) for _ in range(2))
        for n, square in enumerate(self.squares):
            number[square.shots], turn[square.shots] = n, np.arange(len(square.shots))
        kept: dict[int, Record] = {}
        for shots in self.slices:
            parts, order = [], []
            for n in np.unique(number[shots]):
                record = kept.pop(int(n), None)
                record = self._whole(int(n), results) if record is None else record
                kept[int(n)] = record
                own = np.flatnonzero(number[shots] == n)
                order.append(own)
                parts.append(jax.tree.map(lambda a, t=turn[shots][own]: a[t], record))
                while len(kept) > _KEPT:
                    del kept[next(iter(kept))]
            back = np.argsort(np.concatenate(order), kind="stable")
            yield shots, jax.tree.map(lambda *a, b=back: np.concatenate(a)[b], *parts)

    def _whole(self, number: int, results: Mapping[int, Any]) -> Record:
        """The record of a square with all materials: of those that its part has not, nothing returns."""
        record: Record = results[number]
        ledgers = []
        for energy_budget in (record.energy_budget, record.energy_budget_stderr):
            none = np.zeros_like(energy_budget["escaped"])
            absorbed = [f"absorbed by {m}" for m in self.materials]
            ledgers.append({**dict.fromkeys(absorbed, none), **energy_budget})
        truth = None
        if self.asked.truth:
            known: Truths = results[number + len(self.squares)]
            none, nowhere = np.zeros_like(record.reflectance), np.full(len(known.top_height), np.nan)
            truth = dataclasses.replace(
                known,
                returns=_with_all(known.returns, self.materials, none),
                surface_height=_with_all(known.surface_height, self.surfaces, nowhere),
                surface_spread=_with_all(known.surface_spread, self.surfaces, nowhere),
            )
        components = _with_all(record.components, self.materials, np.zeros_like(record.reflectance))
        return record._replace(
            components=components, energy_budget=ledgers[0], energy_budget_stderr=ledgers[1], truth=truth
        )

    def described(self) -> dict[str, Any]:
        return {
            "shared": self.shared,
            "parts": len(self.squares),
            "margin": self.margin,
            "margin of all light": self.all_light,
        }


def _way(
    survey: Survey,
    scene: SceneParts,
    square: Square,
    rtol: float | None,
    orders: int | None,
    shared: bool | None,
    window: tuple[float, float] | None,
) -> AbstractWay:
    """The way of the shots of a square. **Raises:** as `simulate_many`, with the corners of the part."""
    part = scene.between(square.low, square.high)
    try:
        check_kinds(survey.lidar, part)
        return prepared(some_of(survey, square.shots), part, rtol, orders, shared, window)
    except ValueError as error:
        corners = f"part({square.low.tolist()}, {square.high.tolist()})"
        raise ValueError(f"{corners}, shots {square.shots[:5].tolist()}: {error}") from error


def _with_all(some: dict[str, np.ndarray], names: tuple[str, ...], none: np.ndarray) -> dict[str, Any]:
    """Items of all names, in their order, then the rest; `none` in place of those that are not there."""
    return {**dict.fromkeys(names, none), **some}


def trace_square(
    survey: Survey, scene: SceneParts, square: Square, number: int, asked: Asked, key: PRNGKeyArray
) -> Record:
    """The records of the shots of a square."""
    way = _way(survey, scene, square, asked.rtol, asked.orders, asked.shared, asked.window)
    results = _done(way.tasks(jax.random.fold_in(key, number)))
    each = [record for _, record in way.records(results)]
    return jax.tree.map(lambda *a: np.concatenate(a), *each)


def truth_of_square(
    survey: Survey, scene: SceneParts, square: Square, number: int, asked: Asked, key: PRNGKeyArray
) -> Truths:
    """The truth of the shots of a square; nothing is drawn."""
    way = _way(survey, scene, square, asked.rtol, asked.orders, asked.shared, asked.window)
    tasks = WithTruth(way.setup, way.survey, way.rtol, way).tasks(key)[way.count :]
    each = [known for _, known in sorted(_done(tasks).items())]
    known: Truths = jax.tree.map(lambda *a: np.concatenate(a), *each)
    # The last chunk is as large as the others.
    return jax.tree.map(lambda a: a[: len(square.shots)], known)


def _done(tasks: list[Task]) -> dict[int, Any]:
    """The results of tasks, one after the other."""
    results = {}
    for one in tasks:
        outcome = done(one)
        if outcome.error is not None:
            raise outcome.error
        results[one.number] = outcome.arrays
    return results
