"""Means of batches and their standard errors."""

import math
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Float

# Samples below this share of the peak do not count in the error of a waveform.
COUNTS = 0.01


def widening(batches: Any) -> Any:
    """Quantile of Student's t for the probability of two standard errors of a normal distribution, over two.

    By its expansion in 1 / degrees of freedom (Abramowitz and Stegun 26.7.5): to 0.1 % for eight batches.
    """
    x, n = 2.0, batches - 1
    terms = (
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
    )
    return (x + sum(t / n ** (i + 1) for i, t in enumerate(terms))) / x


class Moments:
    """Mean and spread of batches, one after the other, in double precision; arrays of any one shape."""

    def __init__(self):
        self.count = 0
        self.mean = np.zeros(())
        self._squares = np.zeros(())

    def add(self, value: Float[ArrayLike, "*shape"]) -> None:
        """Take one more batch in (Welford 1962, Technometrics 4, 419)."""
        value = np.asarray(value)
        self.count += 1
        if self.count == 1:
            self.mean, self._squares = np.array(value, float), np.zeros(value.shape)
            return
        # In place: for spectra, new arrays take longer than the sums.
        off = np.subtract(value, self.mean, dtype=float)
        step = off / self.count
        self.mean += step
        step *= off
        step *= self.count - 1
        self._squares += step

    @property
    def stderr(self) -> Float[np.ndarray, "*shape"]:
        """Standard error of the mean, widened for few batches; infinite for one."""
        if self.count < 2:
            return np.full_like(self.mean, np.inf)
        spread = np.sqrt(np.maximum(self._squares, 0.0) / (self.count - 1))
        return widening(self.count) * spread / math.sqrt(self.count)


def errors_of(moments: Moments) -> tuple[float, float]:
    """Relative error of a waveform (see `jaxlidar.simulate`), and its largest standard error."""
    return float(relative_error(moments.mean, moments.stderr)), float(np.max(moments.stderr))


def relative_error(mean: Any, stderr: Any, xp: Any = np) -> Any:
    """Root mean square of stderr / mean over the samples that count, for the worst wavelength.

    `mean`, `stderr`: (*shots, wavelengths, samples). `xp`: NumPy, or `jax.numpy` within compiled programs.
    """
    seen = mean > COUNTS * xp.max(mean, axis=-1, keepdims=True)
    squares = xp.where(seen, (stderr / xp.where(seen, mean, 1.0)) ** 2, 0.0)
    relative = xp.sqrt(xp.sum(squares, axis=-1) / xp.maximum(xp.sum(seen, axis=-1), 1))
    return xp.max(relative, axis=-1, initial=0.0)


def batches_needed(batches: int, error: float, rtol: float) -> int:
    """How many batches in all would bring the relative error down to `rtol`.

    Errors fall with the square root. At most four times as many as there are, and a multiple of four: what is
    left of a round would leave cores idle.
    """
    needed = batches * (error / rtol) ** 2
    if needed > batches:
        needed *= (widening(math.ceil(needed)) / widening(batches)) ** 2
    needed = 4 * math.ceil(1.05 * needed / 4)
    return int(min(max(needed, batches + 4), 4 * batches))
