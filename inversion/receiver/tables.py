"""Correction of a table of amplitudes, estimated from hard targets.

A recorder's table may hold for slow signals and be off for pulses, or at its end. All echoes of hard targets
are copies of their pulses through one receiver. With T the table, a correction g of it, common to all shots,
is found in turn with the receiver's response r (`receiver_impulse`):

    g(c) T(c) = a_k (r * p_k)(t - t_k) + b_k,    p_k with the corrected table,

by least squares, g straight between knots. Below the first knot it is one: weak signals set the scale.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import ArrayLike, Float, Shaped

from inversion.receiver.counts import straight_table
from inversion.receiver.impulse import Echo, receiver_impulse
from jaxlidar.extend import check_range
from jaxlidar.io.pedestal import above_pedestal

# First samples of a pulse, which its pedestal is the median of.
_QUIET = 5
# Rounds of correction and response, which converge together.
_ROUNDS = 12
# Of the mean information on a knot, that the correction is one.
_RIDGE = 1e-3
# Least rise of a corrected table from count to count, of the table's own.
_LEAST_RISE = 0.01


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
    """A table of amplitudes that makes echoes of hard flat targets alike, whatever their strength.

    Pulses and echoes are of one table. What is needed are some tens of shots whose echoes reach all knots
    with different strengths; where none does, the table stays as it is.

    **Arguments:**

    - `table`: (counts,) amplitude of 0, 1, 2, ... counts, as for `amplitudes`.
    - `pulses`: of each shot, (lags,) counts as recorded; five samples or more precede the pulse.
    - `echoes`: of each shot, (bins,) counts as recorded, at the same sampling.
    - `noise`: standard deviation of counts, above 0.
    - `knots`: (n,) counts, increasing, two or more, between which the correction is straight: it is one up to
      the first knot, and beyond the last one what it is there.
    - `decibels`: as for `amplitudes`. Default False.
    - `before`: lags of the receiver's response before time zero, as for `receiver_impulse`. Default 4.
    - `after`: those after it. Default 8.

    **Returns:** (counts,) amplitudes, not in decibels, increasing, for `amplitudes`.

    **Raises:** ValueError where there are not as many pulses and echoes, or none, for knots that do not
    increase, for a pulse without a sample above its pedestal, and as `amplitudes`.

    **Example:** counts of a digitiser that is compressed above, and a table that does not know.

    >>> import inversion, numpy as np
    >>> pulse = 100.0 * np.exp(-0.5 * (np.arange(-12.0, 13.0) / 1.7) ** 2)
    >>> compressed = lambda light: np.where(light > 110.0, 110.0 + 0.6 * (light - 110.0), light)
    >>> echoes = [compressed(a * np.pad(pulse, 12)) for a in np.linspace(0.5, 2.0, 20)]
    >>> more = {"noise": 0.3, "knots": [110.0, 130.0, 150.0, 165.0]}
    >>> table = inversion.corrected_table(np.arange(256.0), [pulse] * 20, echoes, **more)
    >>> print(f"150 counts are {110.0 + 40.0 / 0.6:.0f}, by the table {table[150]:.0f}")
    150 counts are 177, by the table 176
    """
    if not len(pulses) == len(echoes) > 0:
        raise ValueError(
            f"pulses and echoes are {len(pulses)} and {len(echoes)}; admissible are as many, one or more"
        )
    check_range("noise", noise, 0.0, low_open=True)
    at = np.asarray(knots, float)
    check_range("knots", at, 0.0)
    if at.ndim != 1 or at.size < 2 or not np.all(np.diff(at) > 0):
        raise ValueError(f"knots = {knots!r}; admissible are two or more that increase")
    plain = straight_table(np.asarray(table, float), decibels)
    counts = np.arange(plain.size)
    for name, records in (("pulses", pulses), ("echoes", echoes)):
        for record in records:
            check_range(name, np.asarray(record, float), 0.0, plain.size - 1)
    gain = np.ones(at.size)
    for _ in range(_ROUNDS):
        now = plain * np.interp(counts, at, gain)
        slope = np.gradient(now)
        power = [np.interp(p, counts, now) for p in pulses]
        sent = [above_pedestal(p, float(np.median(p[:_QUIET])), "pulses") for p in power]
        light = [np.interp(e, counts, now) for e in echoes]
        spread = [noise * np.maximum(np.interp(e, counts, slope), 1e-9) for e in echoes]
        response = receiver_impulse(sent, light, noise=spread, before=before, after=after)
        information, left = np.zeros((at.size - 1, at.size - 1)), np.zeros(at.size - 1)
        for pulse, echo, sigma, record in zip(sent, light, spread, echoes):
            model, _ = Echo(pulse, echo, sigma).fitted(response)
            # Amplitude and background of the echo are what fits best: they are projected out.
            basis = np.linalg.qr(np.stack([model, np.ones_like(model)], axis=1) / sigma[:, None])[0]
            hats = np.stack([np.interp(record, at, row) for row in np.eye(at.size)], axis=1)
            hats = hats * (np.interp(record, counts, plain) / sigma)[:, None]
            hats = hats - basis @ (basis.T @ hats)
            information += hats[:, 1:].T @ hats[:, 1:]
            left -= hats[:, 1:].T @ hats[:, 0]
        ridge = _RIDGE * np.trace(information) / (at.size - 1)
        gain[1:] = np.linalg.solve(information + ridge * np.eye(at.size - 1), left + ridge)
    rise = np.diff(plain * np.interp(counts, at, gain))
    return plain[0] + np.append(0.0, np.cumsum(np.maximum(rise, _LEAST_RISE * np.diff(plain))))
