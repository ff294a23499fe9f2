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
from jaxlidar._threads import ONE_CORE
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.setup import Setup
from jaxlidar.sampling.adaptive import StepRule, StoppingRule, sample_until_compiled
from jaxlidar.sampling.errors import relative_error
from jaxlidar.sampling.moments import RunningMoments
from jaxlidar.survey.records import Record, record_of_shot
from jaxlidar.trace.colouring import Recording, balance, components, recording_of
from jaxlidar.trace.footprint import Slice
from jaxlidar.trace.response import Response, follows, trace_only_first, trace_setting
from jaxlidar.trace.setting import Setting, aimed, setting_of, straight_transmittance

# Batches of one shot, or parts of each of its lattices, at most: a tolerance that is out of reach ends here.
MOST_BATCHES = 1024
# Batches of a shot follow one another, so that steps could be as small as one. The error is looked at after
# every fourth: an estimate that stops at the first moment at which it seems precise is wrong more often.
_EVERY_FOURTH = StepRule(max_growth=1.0, min_step=4)
# Errors of randomised lattices in the plane fall with this power of the number of points where the integrand
# jumps, as at the edges of crowns (He and Wang 2015, SIAM J. Numer. Anal. 53, 2488).
_DENSER = StepRule(order=0.75, safety=1.2, min_growth=2.0, max_growth=32.0)


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


def photons_of(plan: Plan) -> int:
    """Photons of a batch."""
    return plan.n_photons if plan.orders > 1 or plan.trace.drawn_first else 0


@eqx.filter_jit
def _part(setting: Setting, transmittance: Array | None, key: PRNGKeyArray, part: Slice) -> Response:
    """The response of a part of the rays. It is traced once, although its shapes are asked for as well."""
    return trace_only_first(setting, transmittance, key, part)


@eqx.filter_jit
def _batch(
    setting: Setting, transmittance: Array | None, recording: Recording, key: PRNGKeyArray, parts: Array
) -> tuple[Any, Any]:
    """Components and balance of one batch, whose lattice has so many parts where there is one order."""
    if follows(setting):
        response = trace_setting(setting, transmittance, key)
    else:

        def add(number: Array, whole: Response) -> Response:
            part = _part(setting, transmittance, key, Slice(number, parts))
            return jax.tree.map(jnp.add, whole, part)

        zero = _zeros(jax.eval_shape(_part, setting, transmittance, key, Slice(parts, parts)))
        whole = jax.lax.fori_loop(0, parts, add, zero)
        response = jax.tree.map(lambda a: a / parts, whole)
    return components(response, recording), balance(response, recording)


def _spread_of(found: Any) -> tuple[Any, Any]:
    """The quantities whose standard errors are wanted."""
    parts, shares = found
    return parts["first"] + parts["higher"], shares.ledger


def _one(setting: Setting, setup: Setup, aim: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """One shot, batch after batch."""
    by = jnp.asarray(aim.position) - setup.lidar.position
    setup, key = aimed_at(setup, aim), jax.random.fold_in(key, aim.number)
    setting, recording = aimed(setting, setup.lidar, by), recording_of(setup)
    transmittance = straight_transmittance(setup)

    def batch(n: Array, parts: Array) -> Any:
        return _batch(setting, transmittance, recording, jax.random.fold_in(key, n), parts)

    start = jnp.zeros((), jnp.int32), jnp.ones((), jnp.int32)
    if not setup.plan.is_random:
        parts, shares = batch(*start)
        exact, of_shares = jax.tree.map(jnp.zeros_like, _spread_of((parts, shares)))
        none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        return record_of_shot(recording, parts, shares, exact, of_shares, *none)

    refine = _add_batches if follows(setting) else _densify_lattices
    estimate = refine(batch, jax.eval_shape(batch, *start), rtol)
    stderr, of_shares = estimate.stderr
    parts, shares = estimate.mean_only
    photons = estimate.count * photons_of(setup.plan)
    error = _error_of(estimate)
    return record_of_shot(recording, parts, shares, stderr, of_shares, error, photons)


def _error_of(estimate: RunningMoments) -> Array:
    """Return the relative error of a waveform."""
    return relative_error(estimate.mean[0], estimate.stderr[0])


def _empty(shapes: Any) -> RunningMoments:
    """Return moments of no batch."""
    return RunningMoments.compiled(_spread_of(_zeros(shapes)), shapes)


def _add_batches(batch: Callable[[Array, Array], Any], shapes: Any, rtol: Array) -> RunningMoments:
    """Trace batch after batch until the error is below the tolerance."""
    undivided = jnp.ones((), jnp.int32)

    def add(n: Array, estimate: RunningMoments) -> RunningMoments:
        result = batch(n, undivided)
        return estimate.update(_spread_of(result), result)

    def refine(estimate: RunningMoments, size: Array, following: Array) -> RunningMoments:
        return jax.lax.fori_loop(size, following, add, estimate)

    stop = StoppingRule(rtol, min_size=MIN_BATCHES, max_size=MOST_BATCHES)
    return sample_until_compiled(refine, _empty(shapes), _error_of, stop, _EVERY_FOURTH)


def _densify_lattices(batch: Callable[[Array, Array], Any], shapes: Any, rtol: Array) -> RunningMoments:
    """Trace eight batches, again with lattices of more parts until the error is below the tolerance.

    Batches of coarser lattices are dropped: the error of denser ones falls faster than that of more batches.
    """
    empty = _empty(shapes)

    def refine(_: RunningMoments, size: Array, following: Array) -> RunningMoments:
        def add(n: Array, estimate: RunningMoments) -> RunningMoments:
            result = batch(n, following)
            return estimate.update(_spread_of(result), result)

        return jax.lax.fori_loop(0, MIN_BATCHES, add, empty)

    stop = StoppingRule(rtol, min_size=1, max_size=MOST_BATCHES)
    return sample_until_compiled(refine, empty, _error_of, stop, _DENSER)


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)


def _several(setup: Setup, aims: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """Some shots, one after the other."""
    setting = setting_of(setup, derivatives="none")
    return jax.lax.map(lambda aim: _one(setting, setup, aim, key, rtol), aims)


several = Program(_several, **ONE_CORE)
