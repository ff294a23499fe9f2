"""Simulation of many scenes at once: the requests of several fits in one compiled call.

The call has a fixed number of lanes, one for each fit that runs, and threads that share them. How many
batches of photons a lane traces is data: few or all, or none where it is idle, by one compiled program.
"""

import dataclasses
import os
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from inversion.fit.model import Evaluation, Model, Problem, evaluate
from inversion.fit.solver import Request
from inversion.fit.unknowns import Settled
from jaxlidar import Lidar, Plan, Scene
from jaxlidar.extend import ONE_CORE, side_by_side


class Lanes(NamedTuple):
    """So many threads, each with so many lanes."""

    threads: int
    each: int

    @property
    def number(self) -> int:
        """Lanes of all threads."""
        return self.threads * self.each

    @staticmethod
    def of(number: int) -> "Lanes":
        """At least so many lanes, on all cores."""
        threads = min(max(os.cpu_count() or 1, 1), number)
        return Lanes(threads, -(-number // threads))


class Simulator:
    """Simulates the requests of all lanes in one compiled call; several threads share the lanes."""

    def __init__(
        self,
        lidars: list[Lidar],
        scenes: list[Scene],
        plan: Plan,
        settled: list[Settled],
        key: PRNGKeyArray,
        lanes: Lanes,
    ):
        self.model = Model(lidars[0], scenes[0], plan, settled, key)
        self.lanes, self.lidars, self.scenes = lanes, lidars, scenes

    def __call__(self, requests: dict[int, Request]) -> dict[int, Evaluation]:
        # Dealt to the threads by their work.
        numbers = sorted(requests, key=lambda i: self._batches(requests[i]))
        threads = min(self.lanes.threads, len(numbers))
        groups = [numbers[i::threads] for i in range(threads)]
        found: dict[int, Evaluation] = {}
        with side_by_side(self.lanes.threads) as run:
            for more in run(lambda group: self._group(group, requests), groups):
                found |= more
        return found

    def _batches(self, request: Request) -> int:
        return self.model.few if request.few else len(self.model.keys)

    def _group(self, group: list[int], requests: dict[int, Request]) -> dict[int, Evaluation]:
        # The compiled call has a fixed number of lanes: idle ones trace nothing.
        idle = self.lanes.each - len(group)
        padded = [*group, *[group[-1]] * idle]
        counts = [*(self._batches(requests[i]) for i in group), *[0] * idle]
        values = jax.tree.map(
            lambda *a: jnp.stack(a), *(self.model.values(requests[i].values) for i in padded)
        )
        lidar, scene = _stacked(self.lidars, padded), _stacked(self.scenes, padded)
        model = self.model
        problem = dataclasses.replace(model.problem, lidar=lidar, scene=scene)
        own = Own(len(self.lidars) > 1, len(self.scenes) > 1)
        out = _simulate(problem, values, jnp.stack(model.keys), jnp.array(counts), own)
        total, columns, batches = (np.asarray(a, float) for a in out)
        return {
            i: Evaluation(
                total[n],
                np.moveaxis(columns[n][model.order], 0, -1),
                None,
                batches[n][: counts[n]] if model.problem.plan.is_random else None,
                counts[n] < len(model.keys),
            )
            for n, i in enumerate(group)
        }


def _stacked(given: list[Any], numbers: list[int]) -> Any:
    if len(given) == 1:
        return given[0]
    dynamic, static = zip(*(eqx.partition(given[i], eqx.is_array) for i in numbers))
    return eqx.combine(jax.tree.map(lambda *a: jnp.stack(a), *dynamic), static[0])


class Own(NamedTuple):
    """Whether every footprint has a lidar, or a scene, of its own."""

    lidar: bool
    scene: bool


@eqx.filter_jit(**ONE_CORE)
def _simulate(
    problem: Problem, values: Any, keys: Array, counts: Array, own: Own
) -> tuple[Array, Array, Array]:
    lidar, fixed_lidar = eqx.partition(problem.lidar, eqx.is_array)
    scene, fixed_scene = eqx.partition(problem.scene, eqx.is_array)

    def one(lidar: Lidar, scene: Scene, values: Any, count: Array) -> tuple[Array, Array, Array]:
        lidar, scene = eqx.combine(lidar, fixed_lidar), eqx.combine(scene, fixed_scene)
        return evaluate(dataclasses.replace(problem, lidar=lidar, scene=scene), values, keys, count)

    if problem.plan.orders == 1:
        axes = (0 if own.lidar else None, 0 if own.scene else None, 0, 0)
        return jax.vmap(one, in_axes=axes)(lidar, scene, values, counts)

    # Batched with vmap, every lane would be traced until the photons of the slowest have ended.
    def in_turn(each: tuple) -> tuple[Array, Array, Array]:
        return one(each[0] if own.lidar else lidar, each[1] if own.scene else scene, *each[2:])

    mapped = (lidar if own.lidar else None, scene if own.scene else None, values, counts)
    return jax.lax.map(in_turn, mapped)
