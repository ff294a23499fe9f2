"""Shot by shot: one compiled program traces any shots of a survey, each until its tolerance is met.

What the voxel map costs (its layout, the optical depth above every voxel) is computed once for many shots.
So no shot needs a window of the map, and none costs more over a larger map: light is followed as far as it
goes, and only the voxels that it meets are read.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxlidar._programs import Program
from jaxlidar._statistics import relative_error
from jaxlidar._threads import ONE_CORE
from jaxlidar.campaign.records import BatchMoments, Record, record_of_shot
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.plan import MIN_BATCHES, Plan
from jaxlidar.planning.setup import Setup
from jaxlidar.trace.colouring import Recording, balance, components, recording_of
from jaxlidar.trace.response import trace_setting
from jaxlidar.trace.setting import Setting, aimed, setting_of, straight_transmittance

# Batches of one shot at most: a tolerance that is out of reach ends here.
MOST_BATCHES = 1024


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
def _batch(
    setting: Setting, transmittance: Array | None, recording: Recording, key: PRNGKeyArray
) -> tuple[Any, Any]:
    """Components and balance of one batch. It is traced once, although its shapes are asked for as well."""
    response = trace_setting(setting, transmittance, key)
    return components(response, recording), balance(response, recording)


def _one(setting: Setting, setup: Setup, aim: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """One shot, batch after batch."""
    by = jnp.asarray(aim.position) - setup.lidar.position
    setup, key = aimed_at(setup, aim), jax.random.fold_in(key, aim.number)
    setting, recording = aimed(setting, setup.lidar, by), recording_of(setup)
    transmittance = straight_transmittance(setup)

    def batch(n: Array) -> Any:
        return _batch(setting, transmittance, recording, jax.random.fold_in(key, n))

    def spread_of(parts: Any, shares: Any) -> tuple[Any, Any]:
        """The quantities whose standard errors are wanted."""
        return parts["first"] + parts["higher"], shares.ledger

    if not setup.plan.is_random:
        parts, shares = batch(jnp.zeros((), jnp.int32))
        exact, of_shares = jax.tree.map(jnp.zeros_like, spread_of(parts, shares))
        none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        return record_of_shot(recording, parts, shares, exact, of_shares, *none)

    def error(moments: BatchMoments, count: Array) -> Array:
        return relative_error(moments.mean[0], moments.stderr(count)[0], jnp)

    def going(state: Any) -> Array:
        count, _, moments = state
        # Looked at after every fourth batch: who stops at the first good moment is wrong more often.
        wanted = (count < MIN_BATCHES) | (count % 4 != 0) | (error(moments, count.astype(float)) > rtol)
        return wanted & (count < MOST_BATCHES)

    def step(state: Any) -> Any:
        count, mean, moments = state
        found, count = batch(count), count + 1
        number = count.astype(float)
        mean = jax.tree.map(lambda m, v: m + (v - m) / number, mean, found)
        return count, mean, moments.add(spread_of(*found), number)

    zero: Any = _zeros(jax.eval_shape(batch, jnp.zeros((), jnp.int32)))
    start = BatchMoments(spread_of(*zero), spread_of(*zero))
    count, found, moments = jax.lax.while_loop(going, step, (jnp.zeros((), jnp.int32), zero, start))
    number = count.astype(float)
    photons = count * photons_of(setup.plan)
    stderr, of_shares = moments.stderr(number)
    parts, shares = found
    return record_of_shot(recording, parts, shares, stderr, of_shares, error(moments, number), photons)


def _zeros(shapes: Any) -> Any:
    return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)


def _several(setup: Setup, aims: Aim, key: PRNGKeyArray, rtol: Array) -> Record:
    """Some shots, one after the other."""
    setting = setting_of(setup, derivatives="none")
    return jax.lax.map(lambda aim: _one(setting, setup, aim, key, rtol), aims)


several = Program(_several, **ONE_CORE)
