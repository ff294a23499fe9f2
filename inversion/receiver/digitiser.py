"""Tables of a digitiser: amplitudes of counts, and a correction of the table from hard targets.

**Amplitudes.** Counts c need not be in proportion to the light received. A table T gives the amplitude of
every count, and its slope the noise, sigma_T = sigma_c dT/dc.

**Correction.** A table may hold for slow signals and be wrong for pulses, or at its end. Echoes of hard
targets are copies of their pulses p_k through one receiver, with response r (`receiver_impulse`). A
correction g of the table, common to all shots, is found by least squares from

    g(c) T(c) = a_k (r * p_k)(t - t_k) + b_k,

in turn with r, and with pulses that are corrected too. g is linear between knots, and one below the first
knot: weak signals set the scale.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Shaped

from inversion.receiver.impulse import HardTargetEcho, receiver_impulse
from jaxlidar.extend import as_numpy, check_number, check_range
from jaxlidar.formats.noise import above_pedestal

# Tables in decibels mark counts without an amplitude by entries below this (RIEGL's PulseWaves: -2e37).
_NO_AMPLITUDE = -1e3
# First samples of a pulse, whose median is its pedestal.
_PEDESTAL_SAMPLES = 5
# Rounds of correction and response, which converge together.
_ROUNDS = 12
# Weight of a correction of one at every knot, over the mean information on a knot.
_RIDGE = 1e-3
# Least rise of a corrected table from count to count, over the table's own.
_LEAST_RISE = 0.01
# Least slope of a table, in amplitude per count, where noise is derived from it.
_LEAST_SLOPE = 1e-9


class Amplitudes(NamedTuple):
    """Samples in proportion to the light received.

    - `values`: of the samples' shape.
    - `noise`: standard deviation of each; infinite for saturated samples.

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
    """Convert counts to amplitudes by a table, with their noise; saturated samples have infinite noise.

    Noise follows the slope of the table: where many counts span little amplitude, it is small.

    **Arguments:**

    - `counts`: samples as recorded, 0 or more.
    - `table`: (counts,) amplitude of 0, 1, 2, ... counts, increasing, two or more. Default None: counts are
      amplitudes.
    - `noise`: standard deviation of the counts, above 0.
    - `decibels`: True if `table` is 10 log10 of amplitudes, as RIEGL's are (`AirborneShots.tables`). The
      table is extrapolated linearly below its first entry above -1000 dB, so that noise about the pedestal
      keeps its mean. Default False.
    - `saturation`: counts from which on samples are saturated: their noise is infinite. Default None: those
      of the table's last entry, if there is a table.

    **Returns:** an `Amplitudes`.

    **Raises:** ValueError for counts that the table does not have, a table that does not increase, or has
    fewer than two entries, and `noise` that is not above 0.

    **Example:** a table that is linear at first and bends over above.

    >>> import inversion, numpy as np
    >>> table = np.array([0.0, 1.0, 2.0, 3.0, 5.0, 9.0])
    >>> converted = inversion.amplitudes(np.array([2, 4, 5]), table, noise=0.5)
    >>> converted.values.tolist(), converted.noise.tolist()
    ([2.0, 5.0, 9.0], [0.5, 1.5, inf])
    """
    check_range("noise", noise, 0.0, low_open=True)
    samples = as_numpy(counts, "counts")
    check_range("counts", samples, 0.0)
    if table is None:
        values, sigma = samples, np.full(samples.shape, float(noise))
    else:
        amplitude_of_count = amplitude_table(as_numpy(table, "table"), decibels)
        check_range("counts", samples, 0.0, amplitude_of_count.size - 1)
        saturation = amplitude_of_count.size - 1 if saturation is None else saturation
        table_counts = np.arange(amplitude_of_count.size)
        values = np.interp(samples, table_counts, amplitude_of_count)
        sigma = noise * np.interp(samples, table_counts, np.gradient(amplitude_of_count))
    if saturation is not None:
        check_number("saturation", saturation)
        sigma = np.where(samples >= saturation, np.inf, sigma)
    return Amplitudes(values, sigma)


def amplitude_table(table: np.ndarray, decibels: bool) -> np.ndarray:
    """Return the amplitudes of all counts, with the first ones extrapolated where the table has none.

    **Arguments:** `table`: (counts,). `decibels`: True for 10 log10 of amplitudes.

    **Raises:** ValueError for a table that has gaps, fewer than two entries, or does not increase.
    """
    has_amplitude = table > _NO_AMPLITUDE if decibels else np.isfinite(table)
    first = int(np.argmax(has_amplitude))
    if table.ndim != 1 or np.sum(has_amplitude) < 2 or not np.all(has_amplitude[first:]):
        raise ValueError(f"table has the shape {table.shape}, or gaps; admissible is (counts,), two or more")
    amplitude_of_count = 10.0 ** (np.where(has_amplitude, table, 0.0) / 10.0) if decibels else np.array(table)
    if first:
        rise = amplitude_of_count[first + 1] - amplitude_of_count[first]
        amplitude_of_count[:first] = amplitude_of_count[first] - rise * np.arange(first, 0, -1)
    if not np.all(np.diff(amplitude_of_count) > 0):
        fall = int(np.argmax(np.diff(amplitude_of_count) <= 0))
        raise ValueError(
            f"table has {amplitude_of_count[fall]:g} at {fall} counts and {amplitude_of_count[fall + 1]:g} "
            "at one more; admissible is a table that increases"
        )
    return amplitude_of_count


def corrected_table(
    table: ArrayLike | Sequence,
    pulses: Sequence[Shaped[np.ndarray, " lags"]],
    echoes: Sequence[Shaped[np.ndarray, " bins"]],
    *,
    noise: float,
    knots: ArrayLike | Sequence,
    decibels: bool = False,
    before: int = 4,
    after: int = 8,
) -> Float[np.ndarray, " counts"]:
    """Return a table of amplitudes that makes echoes of hard flat targets alike, whatever their strength.

    Pulses and echoes are of one table. It takes some tens of shots whose echoes reach all knots with
    different strengths; where none does, the table stays as it is.

    1. Convert pulses and echoes to amplitudes by the corrected table, and estimate the receiver's response.
    2. Fit each echo by its pulse through the response.
    3. Solve the weighted least squares for g at the knots, with amplitude and background of every echo free,
       and a weak prior that g is one.
    4. Repeat; at the end, make the table increase.

    **Arguments:**

    - `table`: (counts,) amplitude of 0, 1, 2, ... counts, as for `amplitudes`.
    - `pulses`: of each shot, (lags,) counts as recorded; five samples or more precede the pulse.
    - `echoes`: of each shot, (bins,) counts as recorded, at the same sampling.
    - `noise`: standard deviation of counts, above 0.
    - `knots`: (n,) counts, increasing, two or more, between which the correction is linear. It is one up to
      the first knot, and constant beyond the last one.
    - `decibels`: as for `amplitudes`. Default False.
    - `before`: lags of the receiver's response before time zero, as for `receiver_impulse`. Default 4.
    - `after`: those after it. Default 8.

    **Returns:** (counts,) amplitudes, not in decibels, increasing, for `amplitudes`.

    **Raises:** ValueError for numbers of pulses and echoes that differ, or are zero, for knots that do not
    increase, for a pulse without a sample above its pedestal, and as `amplitudes`.

    **Example:** counts of a digitiser that compresses strong signals, and a table that does not show it.

    >>> import inversion, numpy as np
    >>> pulse = 100.0 * np.exp(-0.5 * (np.arange(-12.0, 13.0) / 1.7) ** 2)
    >>> compressed = lambda light: np.where(light > 110.0, 110.0 + 0.6 * (light - 110.0), light)
    >>> echoes = [compressed(a * np.pad(pulse, 12)) for a in np.linspace(0.5, 2.0, 20)]
    >>> options = {"noise": 0.3, "knots": [110.0, 130.0, 150.0, 165.0]}
    >>> table = inversion.corrected_table(np.arange(256.0), [pulse] * 20, echoes, **options)
    >>> print(f"150 counts are {110.0 + 40.0 / 0.6:.0f}, by the table {table[150]:.0f}")
    150 counts are 177, by the table 176
    """
    if not len(pulses) == len(echoes) > 0:
        raise ValueError(
            f"pulses and echoes are {len(pulses)} and {len(echoes)}; admissible are as many, one or more"
        )
    check_range("noise", noise, 0.0, low_open=True)
    knot_counts = as_numpy(knots, "knots")
    check_range("knots", knot_counts, 0.0)
    if knot_counts.ndim != 1 or knot_counts.size < 2 or not np.all(np.diff(knot_counts) > 0):
        raise ValueError(f"knots = {knots!r}; admissible are two or more that increase")
    uncorrected = amplitude_table(as_numpy(table, "table"), decibels)
    counts = np.arange(uncorrected.size)
    pulses, echoes = ([as_numpy(r, n) for r in x] for n, x in (("pulses", pulses), ("echoes", echoes)))
    for name, records in (("pulses", pulses), ("echoes", echoes)):
        for record in records:
            check_range(name, record, 0.0, uncorrected.size - 1)
    correction = np.ones(knot_counts.size)
    for _ in range(_ROUNDS):
        corrected = uncorrected * np.interp(counts, knot_counts, correction)
        slope = np.gradient(corrected)
        power = [np.interp(pulse, counts, corrected) for pulse in pulses]
        sent = [above_pedestal(p, float(np.median(p[:_PEDESTAL_SAMPLES])), "pulses") for p in power]
        received = [np.interp(echo, counts, corrected) for echo in echoes]
        sigmas = [noise * np.maximum(np.interp(echo, counts, slope), _LEAST_SLOPE) for echo in echoes]
        response = receiver_impulse(sent, received, noise=sigmas, before=before, after=after)

        n_free = knot_counts.size - 1
        information, right_side = np.zeros((n_free, n_free)), np.zeros(n_free)
        for pulse, echo, sigma, echo_counts in zip(sent, received, sigmas, echoes):
            model, _ = HardTargetEcho(pulse, echo, sigma).fit(response)
            # Amplitude and background of the echo are free: their columns are projected out.
            basis = np.linalg.qr(np.stack([model, np.ones_like(model)], axis=1) / sigma[:, None])[0]
            # Column j is the whitened derivative with respect to g at knot j: its hat function times T.
            columns = np.stack(
                [np.interp(echo_counts, knot_counts, unit) for unit in np.eye(knot_counts.size)], axis=1
            )
            columns = columns * (np.interp(echo_counts, counts, uncorrected) / sigma)[:, None]
            columns = columns - basis @ (basis.T @ columns)
            # g is one at the first knot, whose column is therefore known.
            information += columns[:, 1:].T @ columns[:, 1:]
            right_side -= columns[:, 1:].T @ columns[:, 0]
        ridge = _RIDGE * np.trace(information) / n_free
        correction[1:] = np.linalg.solve(information + ridge * np.eye(n_free), right_side + ridge)
    rise = np.diff(uncorrected * np.interp(counts, knot_counts, correction))
    least_rise = _LEAST_RISE * np.diff(uncorrected)
    return uncorrected[0] + np.append(0.0, np.cumsum(np.maximum(rise, least_rise)))
