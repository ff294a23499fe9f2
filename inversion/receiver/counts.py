"""Amplitudes of counts, where a recorder's counts are not proportional to the light received."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from jaxlidar.extend import check_range

# Entries below this are marks of counts that have no amplitude, in files whose tables are in decibels.
_MARK = -1e3


class Amplitudes(NamedTuple):
    """Samples in proportion to the light received.

    - `values`: of the samples' shape.
    - `noise`: standard deviation of each; infinite where the sample is saturated.

    **Example:**

    >>> import inversion, numpy as np
    >>> inversion.amplitudes(np.array([1, 2]), np.array([0.0, 1.0, 2.0, 4.0]), noise=0.5).noise
    array([0.5 , 0.75])
    """

    values: Float[np.ndarray, "..."]
    noise: Float[np.ndarray, "..."]


def amplitudes(
    counts: ArrayLike | Sequence,
    table: ArrayLike | Sequence | None = None,
    *,
    noise: float,
    decibels: bool = False,
    saturation: float | None = None,
) -> Amplitudes:
    """Amplitudes of counts by a table, with their noise, and saturated samples left out.

    Noise follows the slope of the table: where many counts make little amplitude, it tells little.

    **Arguments:**

    - `counts`: samples as recorded, 0 or more.
    - `table`: (counts,) amplitude of 0, 1, 2, ... counts, increasing, two or more. Default None: counts are
      amplitudes.
    - `noise`: standard deviation of the counts, above 0.
    - `decibels`: whether `table` is 10 log10 of amplitudes, as RIEGL's are (`AirborneShots.tables`). Counts
      below its first entry above -1000 dB go on in a straight line, so that noise about the pedestal keeps
      its mean. Default False.
    - `saturation`: counts from which on samples are saturated: their noise is infinite. Default None: those
      of the table's last entry, if there is a table.

    **Returns:** an `Amplitudes`.

    **Raises:** ValueError for counts that the table does not have, a table that does not increase, or has
    fewer than two entries, and `noise` that is not above 0.

    **Example:** a table that is straight at first and bends over above.

    >>> import inversion, numpy as np
    >>> table = np.array([0.0, 1.0, 2.0, 3.0, 5.0, 9.0])
    >>> found = inversion.amplitudes(np.array([2, 4, 5]), table, noise=0.5)
    >>> found.values.tolist(), found.noise.tolist()
    ([2.0, 5.0, 9.0], [0.5, 1.5, inf])
    """
    check_range("noise", noise, 0.0, low_open=True)
    samples = np.asarray(counts, float)
    check_range("counts", samples, 0.0)
    if table is None:
        spread = np.full(samples.shape, float(noise))
        return Amplitudes(samples, spread if saturation is None else _left_out(spread, samples, saturation))
    heights = straight_table(np.asarray(table, float), decibels)
    check_range("counts", samples, 0.0, heights.size - 1)
    numbers = np.arange(heights.size)
    slope = np.gradient(heights)
    saturation = heights.size - 1 if saturation is None else saturation
    values = np.interp(samples, numbers, heights)
    spread = noise * np.interp(samples, numbers, slope)
    return Amplitudes(values, _left_out(spread, samples, saturation))


def straight_table(table: np.ndarray, decibels: bool) -> np.ndarray:
    """Amplitudes of all counts. **Raises:** ValueError for a table that cannot be used."""
    known = table > _MARK if decibels else np.isfinite(table)
    first = int(np.argmax(known))
    if table.ndim != 1 or np.sum(known) < 2 or not np.all(known[first:]):
        raise ValueError(f"table has the shape {table.shape}, or gaps; admissible is (counts,), two or more")
    heights = 10.0 ** (np.where(known, table, 0.0) / 10.0) if decibels else np.array(table)
    if first:
        rise = heights[first + 1] - heights[first]
        heights[:first] = heights[first] - rise * np.arange(first, 0, -1)
    if not np.all(np.diff(heights) > 0):
        place = int(np.argmax(np.diff(heights) <= 0))
        raise ValueError(
            f"table has {heights[place]:g} at {place} counts and {heights[place + 1]:g} at one more; "
            "admissible is a table that increases"
        )
    return heights


def _left_out(noise: np.ndarray, counts: np.ndarray, saturation: float) -> np.ndarray:
    return np.where(counts >= saturation, np.inf, noise)
