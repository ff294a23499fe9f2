"""Means of batches and their standard errors."""

import math

import numpy as np
from jaxtyping import Float

# Samples below this share of the peak do not count in the error of a waveform.
COUNTS = 0.01


def widening(batches: int) -> float:
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


def standard_error(means: Float[np.ndarray, "batches *shape"]) -> Float[np.ndarray, "*shape"]:
    """Of the mean of batches, widened for few of them."""
    return widening(len(means)) * np.std(means, axis=0, ddof=1) / math.sqrt(len(means))


def errors_of(means: Float[np.ndarray, "batches wavelengths bins"]) -> tuple[float, float]:
    """Relative error (see `jaxlidar.simulate`) and largest standard error of the mean of batches."""
    mean = np.mean(means, axis=0)
    stderr = standard_error(means)
    seen = mean > COUNTS * np.max(mean, axis=1, keepdims=True)
    squares = np.where(seen, (stderr / np.where(seen, mean, 1.0)) ** 2, 0.0)
    relative = np.sqrt(np.sum(squares, axis=1) / np.maximum(np.sum(seen, axis=1), 1))
    return float(np.max(relative, initial=0.0)), float(np.max(stderr))


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
