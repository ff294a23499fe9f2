"""Moments of waveforms, at all wavelengths or at pivot wavelengths that stand for them.

Waveforms at thousands of wavelengths follow linearly from those at some thirty pivot wavelengths: batch n has
W_n = C^T V_n, with the waveforms V_n at the pivots and the coefficients C (pivots, wavelengths) of an
interpolative decomposition (`jaxlidar.spectral.pivot_wavelengths`). Batches are evaluated at the pivots
alone. Their means are interpolated as they are. Standard errors are not linear, but the scaled deviations e_n
of `jaxlidar.sampling.moments` are, so that the squared deviations at all wavelengths are

    S = sum over n of (C^T e_n)^2
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._jax.products import matmul
from jaxlidar._jax.programs import Program
from jaxlidar.sampling.errors import relative_error, student_widening
from jaxlidar.sampling.moments import RunningMoments, scaled_deviation
from jaxlidar.spectral.apply_optics import WaveformModel

# Batches that one call interpolates to all wavelengths: as many as the fewest that are traced.
BLOCK = 8


class WaveformErrors(NamedTuple):
    """Mean and errors of a waveform.

    - `total`: (wavelengths,) mean, summed over samples. - `stderr`: (wavelengths, samples) standard errors.
    - `relative`: relative error, as `jaxlidar.simulate` defines it. - `largest`: largest standard error.
    """

    total: Any
    stderr: Any
    relative: Any
    largest: Any


class WaveformMoments:
    """Moments of the first `wavelengths` and `samples` of waveforms, which may be padded to larger shapes."""

    def __init__(self, wavelengths: int, samples: int):
        self._moments = RunningMoments.on_host(np.empty((wavelengths, samples)))

    def add(self, waveform: Float[ArrayLike, "padded_wavelengths padded_samples"]) -> None:
        """Add the waveform of one batch."""
        wavelengths, samples = self._moments.mean.shape
        self._moments = self._moments.update(np.asarray(waveform)[:wavelengths, :samples])

    @property
    def count(self) -> int:
        """Number of batches."""
        return self._moments.count

    def errors(self) -> WaveformErrors:
        """Return the errors of the batches so far, which are two or more."""
        mean, stderr = self._moments.mean, self._moments.stderr
        relative = float(relative_error(mean, stderr))
        return WaveformErrors(mean.sum(axis=1), stderr, relative, float(np.max(stderr)))


class PivotMoments:
    """Moments of waveforms at all wavelengths, from batches at pivot wavelengths.

    `interpolation`: the matrix C.
    """

    def __init__(self, interpolation: Float[ArrayLike, "pivots wavelengths"]):
        self._interpolation = jnp.asarray(interpolation)
        self._pivot_means: RunningMoments | None = None
        # Scaled deviations at the pivots that are not among the squares yet.
        self._deviations: list[np.ndarray] = []
        self._squares: Any = None

    def add(self, waveform: Float[ArrayLike, "pivots samples"]) -> None:
        """Add the waveform of one batch."""
        waveform = np.asarray(waveform, float)
        if self._pivot_means is None:
            self._pivot_means = RunningMoments.on_host((), waveform)
        means = self._pivot_means
        # Blocks of one size: one compiled program adds their squares.
        if len(self._deviations) == BLOCK:
            self._squares = _compiled_add_squares(self._block(), self._interpolation, self._squares)
            self._deviations = []
        self._deviations.append(scaled_deviation(waveform, means.mean_only, means.count + 1))
        self._pivot_means = means.update((), waveform)

    @property
    def count(self) -> int:
        """Number of batches."""
        return 0 if self._pivot_means is None else self._pivot_means.count

    def errors(self) -> WaveformErrors:
        """Return the errors of the batches so far, which are two or more."""
        assert self._pivot_means is not None
        count, dtype = self._pivot_means.count, self._interpolation.dtype
        variance_scale = student_widening(count) ** 2 / (count * (count - 1.0))
        mean, variance_scale = (jnp.asarray(a, dtype) for a in (self._pivot_means.mean_only, variance_scale))
        errors, squares = _compiled_errors(
            mean, self._block(), self._interpolation, self._squares, variance_scale
        )
        # The block is among the squares now: to ask again, as after an interrupt, adds nothing twice.
        self._squares, self._deviations = squares, []
        return errors._replace(relative=float(errors.relative), largest=float(errors.largest))

    def _block(self) -> Float[Array, "block pivots samples"]:
        """Return the deviations that are not among the squares yet, filled up with zeros to one shape."""
        assert self._pivot_means is not None
        padding = [np.zeros_like(self._pivot_means.mean_only)] * (BLOCK - len(self._deviations))
        return jnp.asarray(np.stack([*self._deviations, *padding]), self._interpolation.dtype)


def make_waveform_moments(
    model: WaveformModel, n_wavelengths: int, n_samples: int
) -> WaveformMoments | PivotMoments:
    """Return moments of no batch, for what `samples_and_budget` of a model returns, without its padding."""
    pivots = model.sample_pivots
    if pivots is None:
        return WaveformMoments(n_wavelengths, n_samples)
    return PivotMoments(np.asarray(pivots.coefficients)[:, :n_wavelengths])


def _add_squares(
    deviations: Float[Array, "block pivots samples"],
    interpolation: Float[Array, "pivots wavelengths"],
    squares: Float[Array, "wavelengths samples"] | None,
) -> Float[Array, "wavelengths samples"]:
    """Add the squares of scaled deviations at all wavelengths to those of earlier batches."""
    # One by one: a whole block at all wavelengths does not fit into a processor's cache.
    total = jnp.zeros(()) if squares is None else squares
    for deviation in deviations:
        total = total + matmul(interpolation.T, deviation) ** 2
    return total


def _errors(
    mean: Float[Array, "pivots samples"],
    deviations: Float[Array, "block pivots samples"],
    interpolation: Float[Array, "pivots wavelengths"],
    squares: Float[Array, "wavelengths samples"] | None,
    variance_scale: Float[Array, ""],
) -> tuple[WaveformErrors, Float[Array, "wavelengths samples"]]:
    """Return the errors with one more block of deviations, and the squared deviations with it.

    `variance_scale`: squared standard error of the mean over squared deviations.
    """
    squares = _add_squares(deviations, interpolation, squares)
    mean, stderr = matmul(interpolation.T, mean), jnp.sqrt(variance_scale * squares)
    errors = WaveformErrors(jnp.sum(mean, axis=1), stderr, relative_error(mean, stderr), jnp.max(stderr))
    return errors, squares


_compiled_add_squares = Program(_add_squares)
_compiled_errors = Program(_errors)
