"""Means of batches and their standard errors."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._programs import Program

# Samples below this share of the peak do not count in the error of a waveform.
COUNTS = 0.01
# So many batches are spread to all wavelengths by one call: of the fewest that are traced.
ROWS = 8


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


class Spectra(NamedTuple):
    """What is known of a waveform at all wavelengths.

    - `whole`: its mean, all samples together. - `stderr`: of every sample. - `relative`: its relative error
      (see `jaxlidar.simulate`). - `largest`: its largest standard error.
    """

    whole: Any
    stderr: Any
    relative: Any
    largest: Any


class WaveformMoments(Moments):
    """Moments of the first wavelengths and samples of waveforms."""

    def __init__(self, wavelengths: int, samples: int):
        super().__init__()
        self._size = (wavelengths, samples)

    def add(self, value: Float[ArrayLike, "more_wavelengths more_samples"]) -> None:
        """Take one more batch in."""
        wavelengths, samples = self._size
        super().add(np.asarray(value)[:wavelengths, :samples])

    def spectra(self) -> Spectra:
        """What is known so far, for two batches and more."""
        mean, stderr = self.mean, self.stderr
        return Spectra(mean.sum(axis=1), stderr, float(relative_error(mean, stderr)), float(np.max(stderr)))


class FewMoments:
    """Moments of waveforms of which few wavelengths are known, and `shares` that spread them to all others.

    Sums of squares over batches are those of rows that follow from the batches' one by one. These are linear
    in the batches, and so are spread as they are.
    """

    def __init__(self, shares: Float[ArrayLike, "few wavelengths"]):
        self.count, self._shares = 0, jnp.asarray(shares)
        self._mean = np.zeros(())
        self._rows: list[np.ndarray] = []
        self._squares: Any = None

    def add(self, value: Float[ArrayLike, "few samples"]) -> None:
        """Take one more batch in (Welford 1962)."""
        self.count += 1
        off = np.asarray(value, float) - self._mean
        self._mean = self._mean + off / self.count
        if len(self._rows) == ROWS:
            self._squares, self._rows = _compiled_squares(self._waiting(), self._shares, self._squares), []
        self._rows.append(off * math.sqrt((self.count - 1) / self.count))

    def spectra(self) -> Spectra:
        """What is known so far, for two batches and more."""
        scale = widening(self.count) ** 2 / (self.count * (self.count - 1.0))
        mean, scale = (jnp.asarray(a, self._shares.dtype) for a in (self._mean, scale))
        found, squares = _compiled_spectra(mean, self._waiting(), self._shares, self._squares, scale)
        self._squares, self._rows = squares, []
        return found._replace(relative=float(found.relative), largest=float(found.largest))

    def _waiting(self) -> Float[Array, "rows few samples"]:
        """The rows that are not among the squares yet, and zeros."""
        zeros = [np.zeros_like(self._mean)] * (ROWS - len(self._rows))
        return jnp.asarray(np.stack([*self._rows, *zeros]), self._shares.dtype)


def _spread_squares(
    rows: Float[Array, "rows few samples"],
    shares: Float[Array, "few wavelengths"],
    squares: Float[Array, "wavelengths samples"] | None,
) -> Float[Array, "wavelengths samples"]:
    """Squares of rows at all wavelengths, added up."""
    # One by one: all rows at once are too many numbers for a cache.
    found = jnp.zeros(()) if squares is None else squares
    for row in rows:
        found = found + (shares.T @ row) ** 2
    return found


def _spectra(
    mean: Float[Array, "few samples"],
    rows: Float[Array, "rows few samples"],
    shares: Float[Array, "few wavelengths"],
    squares: Float[Array, "wavelengths samples"] | None,
    scale: Float[Array, ""],
) -> tuple[Spectra, Float[Array, "wavelengths samples"]]:
    """What is known with so many rows more, and the squares with these."""
    squares = _spread_squares(rows, shares, squares)
    mean, stderr = shares.T @ mean, jnp.sqrt(scale * squares)
    known = Spectra(jnp.sum(mean, axis=1), stderr, relative_error(mean, stderr, jnp), jnp.max(stderr))
    return known, squares


_compiled_squares = Program(_spread_squares)
_compiled_spectra = Program(_spectra)


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
