"""Records and pulses in the form that compiled programs take: one sampling, a few sizes, many shots.

**Size buckets.** XLA compiles a program for one shape. Records are padded with zeros to the next size of 64,
96, 128, 192, 256, 384, ... samples, so that records of all lengths up to a size share a program.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import as_array, check_range, concrete, even_step
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.sensors.pulse import AbstractPulse

# The ends of a pulse are cut where its samples stay below this fraction of its peak.
_FAINT = 1e-6
# Largest relative difference of steps for which records share the samples of a pulse.
_EQUAL_STEPS = 1e-6

# A recorded pulse at the sampling of the record, (lags,) or (shots, lags), or a pulse of jaxlidar.
Pulse = Float[ArrayLike, "... lags"] | AbstractPulse


# -- programs for many sizes and many shots ------------------------------------------------------------


def record_bucket(count: int) -> int:
    """Smallest of 64, 96, 128, 192, 256, 384, ... that is not below `count`."""
    return size_bucket(max(count, 64))


def pad_to(samples: Array, size: int) -> Array:
    """Append zeros to the last axis, up to `size` samples."""
    return jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(0, size - samples.shape[-1])])


def over_shots(*, sequential: bool = False, **ranks: int) -> Callable[[Callable], Callable]:
    """Return a decorator that makes a compiled function of many shots out of a function of one shot.

    The decorated function takes arrays by keyword. Their leading dimensions are shots and broadcast against
    one another; results have the broadcast dimensions first.

    **Arguments:**

    - `sequential`: compute one shot after the other, not all at once. For iterations that end after a number
      of steps that differs between shots: side by side, all shots would take as many as the slowest.
    - `ranks`: by the name of each argument, its number of dimensions for one shot.
    """

    def decorate(function: Callable) -> Callable:
        def batched(**arguments: Array):
            shots = jnp.broadcast_shapes(
                *(array.shape[: array.ndim - ranks[name]] for name, array in arguments.items())
            )
            if not shots:
                return function(**arguments)
            rows = {}
            for name, array in arguments.items():
                shape = array.shape[array.ndim - ranks[name] :]
                rows[name] = jnp.broadcast_to(array, shots + shape).reshape(-1, *shape)

            def of_row(row: dict[str, Array]):
                return function(**row)

            results = lax.map(of_row, rows) if sequential else jax.vmap(of_row)(rows)
            return jax.tree.map(lambda array: array.reshape(*shots, *array.shape[1:]), results)

        # JAX names the compiled program after the function.
        batched.__name__ = function.__name__
        return jax.jit(batched)

    return decorate


# -- axes and records ----------------------------------------------------------------------------------


class EvenAxis(NamedTuple):
    """Times or heights in equal steps. Programs see the steps only: single precision rounds large values.

    - `first`: () or (shots,) the first value; in NumPy's double precision unless it is traced.
    - `step`: () or (shots,) the positive step; likewise.
    """

    first: Array | np.ndarray
    step: Array | np.ndarray

    def relative(self, x: ArrayLike, field: str) -> Array:
        """Difference of values from the first one, rounded after it is taken; NaN for missing values."""
        values, first = concrete(x), concrete(self.first)
        if values is None or first is None:
            return as_array(x, field) - as_array(self.first)
        return as_array(values - first)

    def absolute(self, x: Array) -> Array:
        """Inverse of `relative`, in the precision of `x`."""
        return jnp.asarray(self.first, x.dtype) + x


def even_axis(field: str, axis: ArrayLike, *, decreasing: bool = False) -> EvenAxis:
    """Check the axis of a record, (bins,) or (shots, bins), two bins or more.

    **Raises:** as `even_step`; the steps of an axis that JAX traces are not checked.
    """
    check_range(field, axis)
    values = concrete(axis)
    if values is None:
        traced = as_array(axis, field)
        extent = traced[..., -1] - traced[..., 0]
        return EvenAxis(traced[..., 0], (-extent if decreasing else extent) / (traced.shape[-1] - 1))
    return EvenAxis(values[..., 0], even_step(field, axis, decreasing=decreasing))


def divide_by_largest(
    x: ArrayLike, field: str, noise: ArrayLike | None = None
) -> tuple[Array, Array | np.ndarray]:
    """Divide each row of samples by its largest magnitude, before it is rounded to single precision.

    Squares of energies below 1e-19 J or above 1e19 J do not exist in single precision. Derivatives take the
    magnitude as constant: it cancels in results.

    **Arguments:** `x`: (..., bins) finite samples. `noise`: their standard deviation; samples of infinite
    noise become zero and do not count. Default: all count.

    **Returns:** (..., bins) samples, at most 1 in magnitude, and (...) the magnitudes, 1 for rows of zeros.

    **Raises:** ValueError for samples that are not finite.
    """
    check_range(field, x)
    values, sigma = concrete(x), concrete(0.0 if noise is None else noise)
    if values is None or sigma is None:
        samples = as_array(x, field)
        if noise is not None:
            is_used = jnp.broadcast_to(jnp.isfinite(as_array(noise)), samples.shape)
            samples = jnp.where(is_used, samples, 0.0)
        magnitude = lax.stop_gradient(jnp.max(jnp.abs(samples), axis=-1))
        magnitude = jnp.where(magnitude > 0, magnitude, 1.0)
        return samples / magnitude[..., None], magnitude
    values = np.where(np.isinf(sigma), 0.0, values)
    magnitude = np.max(np.abs(values), axis=-1)
    magnitude = np.where(magnitude > 0, magnitude, 1.0)
    return jnp.asarray((values / magnitude[..., None]).astype(_float_type(x))), magnitude


def divide(x: ArrayLike, divisor: Array | np.ndarray, field: str) -> Array:
    """Quotient of two numbers, taken in double precision where JAX traces neither."""
    values, divisor_values = concrete(x), concrete(divisor)
    if values is None or divisor_values is None:
        dividend, denominator = jnp.broadcast_arrays(as_array(x, field), as_array(divisor))
        return dividend / denominator
    quotient, dtype = values / divisor_values, _float_type(x)
    # A number that the type cannot hold is large, not infinite: infinite noise has another meaning.
    limit = float(jnp.finfo(dtype).max)
    return jnp.asarray(np.where(np.isinf(quotient), quotient, np.clip(quotient, -limit, limit)).astype(dtype))


def _float_type(x: ArrayLike) -> jnp.dtype:
    """Type of a floating-point JAX array, the default one of anything else."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating):
        return x.dtype
    return jnp.zeros(()).dtype


# -- pulses --------------------------------------------------------------------------------------------


def sample_pulse(pulse: Pulse | None, step: ArrayLike) -> Float[Array, "... padded"]:
    """Sample a pulse as a record is sampled: peak one, time zero in the middle, padded to a size bucket.

    1. Evaluate an `AbstractPulse` over its support, or take the samples.
    2. Cut the faint ends, equally on both sides, so that time zero stays in the middle.
    3. Pad both sides to a size bucket, and divide by the peak.

    **Arguments:**

    - `pulse`: see `gaussian_decomposition`. None gives a single sample of one: no pulse at all.
    - `step`: () or (shots,) sampling interval in ns.

    **Returns:** (..., lags), an odd number of lags.

    **Raises:** ValueError for an even number of lags, for samples that are not finite or have no positive
    peak, and for an `AbstractPulse` where a JAX transformation traces `step`.
    """
    if pulse is None:
        return jnp.ones(1)
    if isinstance(pulse, AbstractPulse):
        steps = concrete(step)
        if steps is None:
            raise ValueError(
                "pulse is to be sampled at steps that a JAX transformation is tracing; admissible there are "
                "samples"
            )
        if np.ptp(steps) <= _EQUAL_STEPS * np.min(steps):
            steps = np.min(steps)
        half = max(1, math.ceil(max(map(abs, pulse.support())) / np.min(steps)))
        samples = pulse.power(np.arange(-half, half + 1) * steps[..., None])
    else:
        samples = divide_by_largest(pulse, "pulse")[0] if np.size(pulse) > 1 else as_array(pulse, "pulse")
        check_range("pulse", samples)
    if samples.ndim < 1 or samples.shape[-1] % 2 == 0:
        raise ValueError(
            f"pulse has the shape {samples.shape}; admissible is (lags,) with an odd number of lags, the "
            "middle one at the pulse's time zero: pad one end with zeros, or give its times as well, as "
            "jaxlidar.SampledPulse(time=, power=)"
        )
    # Ends can be cut only where the samples have values; inside a transformation all lags stay.
    values = concrete(samples)
    if values is not None:
        peak = values.max(axis=-1)
        check_range("peak of pulse", peak, 0.0, low_open=True)
        is_bright = np.abs(values) > _FAINT * peak[..., None]
        bright_lags = np.flatnonzero(np.any(is_bright, axis=tuple(range(values.ndim - 1))))
        middle = values.shape[-1] // 2
        half = max(middle - int(bright_lags[0]), int(bright_lags[-1]) - middle)
        samples = samples[..., middle - half : middle + half + 1]
    half = samples.shape[-1] // 2
    padding = record_bucket(half) - half
    samples = jnp.pad(samples, [(0, 0)] * (samples.ndim - 1) + [(padding, padding)])
    return samples / jnp.max(samples, axis=-1, keepdims=True)
