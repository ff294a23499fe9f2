"""Shot by shot: one compiled program traces any shots of a survey, each until its tolerance is met.

Shots of one order have eight batches whose lattices of rays are made denser, for their errors fall faster
with the number of rays than with that of batches; the others have ever more batches.

What the voxel map costs (its layout, the optical depth above every voxel) is computed once for many shots.
So no shot needs a window of the map, and none costs more over a larger map: light is followed as far as it
goes, and only the voxels that it meets are read.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._programs import Program
from jaxlidar._statistics import relative_error
from jaxlidar._threads import ONE_CORE
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.plan import MIN_BATCHES
from jaxlidar.planning.setup import Setup
from jaxlidar.spectral.apply_optics import WaveformModel, budget_terms, component_samples, make_waveform_model
from jaxlidar.survey.records import BatchMoments, Record, record_of_shot
from jaxlidar.trace.device_scene import DeviceScene, aim_at, build_device_scene
from jaxlidar.trace.footprint import RaySlice
from jaxlidar.trace.response import Response, trace_device_scene, trace_first_only

# Batches of one shot, or parts of each of its lattices, at most: a tolerance that is out of reach ends here.
MOST_BATCHES = 1024
# Errors of randomised lattices in the plane fall with this power of the number of points where the integrand
# jumps, as at the edges of crowns (He and Wang 2015, SIAM J. Numer. Anal. 53, 2488).
_ORDER = 0.75


class Aim(NamedTuple):
    """Number, place (m, about the survey's middle) and direction (degrees) of shots; axis 0 is the shots'."""

    number: Int[Array, "*shots"] | np.ndarray
    position: Float[Array, "*shots 2"] | np.ndarray
    zenith: Float[Array, "*shots"] | np.ndarray
    azimuth: Float[Array, "*shots"] | np.ndarray

    def as_arrays(self) -> "Aim":
        """The same in JAX's present precision."""
        return Aim(jnp.asarray(self.number), *(jnp.asarray(a, float) for a in self[1:]))


def aims_of(survey: Survey, first: int, count: int) -> Aim:
    """Shots from number `first` on; the last one fills up what there are fewer than `count`."""
    shots = np.minimum(np.arange(first, first + count), len(survey) - 1)
    of_shots = (a[shots] for a in (survey.position, survey.zenith, survey.azimuth))
    return Aim(shots.astype(np.int32), *of_shots)


def aimed_at(setup: Setup, aim: Aim) -> Setup:
    """The setup of one shot."""
    return eqx.tree_at(
        lambda s: (s.lidar.position, s.lidar.zenith, s.lidar.azimuth),
        setup,
        (aim.position, aim.zenith, aim.azimuth),
    )


@eqx.filter_jit
def _part(scene: DeviceScene, key: PRNGKeyArray, ray_slice: RaySlice) -> Response:
    """The response of a part of the rays. It is traced once, although its shapes are asked for as well."""
    return trace_first_only(scene, key, ray_slice)


@eqx.filter_jit
def _batch(scene: DeviceScene, model: WaveformModel, key: PRNGKeyArray, parts: Array) -> tuple[Any, Any]:
    """Components and balance of one batch, whose lattice has so many parts where there is one order."""
    if scene.config.follows_higher_orders:
        response = trace_device_scene(scene, key)
    else:

        def add(number: Array, whole: Response) -> Response:
            part = _part(scene, key, RaySlice(number, parts))
            return jax.tree.map(jnp.add, whole, part)

        zero = _zeros(jax.eval_shape(_part, scene, key, RaySlice(parts, parts)))
        whole = jax.lax.fori_loop(0, parts, add, zero)
        response = jax.tree.map(lambda a: a / parts, whole)
    return component_samples(response, model), budget_terms(response, model)


class _Found(NamedTuple):
    """What batches found: how many, their mean, and the moments of what standard errors are wanted of."""

    count: Array
    mean: Any
    moments: BatchMoments

    @staticmethod
    def none(like: Any) -> "_Found":
        zero = _zeros(like)
        return _Found(jnp.zeros((), jnp.int32), zero, BatchMoments(_spread_of(zero), _spread_of(zero)))

    def add(self, found: Any) -> "_Found":
        """With one more batch."""
        count = self.count + 1
        number = count.astype(float)
        mean = jax.tree.map(lambda m, v: m + (v - m) / number, self.mean, found)
        return _Found(count, mean, self.moments.add(_spread_of(found), number))

    @property
    def error(self) -> Array:
        """Relative error of the waveform."""
        return relative_error(self.moments.mean[0], self.moments.stderr(self.count.astype(float))[0], jnp)


def _spread_of(found: Any) -> tuple[Any, Any]:
    """The quantities whose standard errors are wanted."""
    parts, shares = found
    return parts["first"] + parts["higher"], shares.energy_budget


def _one(scene: DeviceScene, setup: Setup, aim: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """One shot, batch after batch."""
    by = jnp.asarray(aim.position) - setup.lidar.position
    setup, key = aimed_at(setup, aim), jax.random.fold_in(key, aim.number)
    scene, model = aim_at(scene, setup.lidar, by), make_waveform_model(setup)

    def batch(n: Array, parts: Array) -> Any:
        return _batch(scene, model, jax.random.fold_in(key, n), parts)

    start = jnp.zeros((), jnp.int32), jnp.ones((), jnp.int32)
    if not setup.plan.is_random:
        parts, shares = batch(*start)
        exact, of_shares = jax.tree.map(jnp.zeros_like, _spread_of((parts, shares)))
        none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        return record_of_shot(model, parts, shares, exact, of_shares, *none)

    until = _more_batches if scene.config.follows_higher_orders else _denser_lattices
    found = until(batch, _Found.none(jax.eval_shape(batch, *start)), rtol)
    stderr, of_shares = found.moments.stderr(found.count.astype(float))
    parts, shares = found.mean
    photons = found.count * setup.plan.photons_traced
    return record_of_shot(model, parts, shares, stderr, of_shares, found.error, photons)


def _more_batches(batch: Callable[[Array, Array], Any], nothing: _Found, rtol: Array) -> _Found:
    """Batch after batch, until the error is below the tolerance."""

    def going(found: _Found) -> Array:
        # Looked at after every fourth batch: who stops at the first good moment is wrong more often.
        wanted = (found.count < MIN_BATCHES) | (found.count % 4 != 0) | (found.error > rtol)
        return wanted & (found.count < MOST_BATCHES)

    whole = jnp.ones((), jnp.int32)
    return jax.lax.while_loop(going, lambda found: found.add(batch(found.count, whole)), nothing)


def _denser_lattices(batch: Callable[[Array, Array], Any], nothing: _Found, rtol: Array) -> _Found:
    """Eight batches, again with lattices of as many more parts as the error calls for, until it is met."""

    def going(state: tuple[Array, _Found]) -> Array:
        parts, found = state
        return (found.count == 0) | ((found.error > rtol) & (parts < MOST_BATCHES))

    def denser(state: tuple[Array, _Found]) -> tuple[Array, _Found]:
        parts, found = state
        wanted = jnp.clip(1.2 * (found.error / rtol) ** (1.0 / _ORDER), 2.0, 32.0)
        more = jnp.ceil(parts * jnp.where(found.count > 0, wanted, 1.0)).astype(jnp.int32)
        parts = jnp.minimum(more, MOST_BATCHES)
        return parts, jax.lax.fori_loop(0, MIN_BATCHES, lambda n, f: f.add(batch(n, parts)), nothing)

    return jax.lax.while_loop(going, denser, (jnp.ones((), jnp.int32), nothing))[1]


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)


def _several(setup: Setup, aims: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """Some shots, one after the other."""
    scene = build_device_scene(setup, derivatives="none")
    return jax.lax.map(lambda aim: _one(scene, setup, aim, key, rtol), aims)


several = Program(_several, **ONE_CORE)
