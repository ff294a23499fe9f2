"""GEDI's level 2A metrics from its level 1B records, computed as the product computes them.

The record less its mean noise is smoothed by a Gaussian; the signal begins at the highest and ends at the
lowest two samples in a row above a threshold; modes are maxima of the record smoothed by another Gaussian,
above the threshold of the signal's end; relative heights are those below which shares of the smoothed energy
between the two ends lie, above the lowest mode. Thresholds are in standard deviations of the noise that the
product gives.

The theoretical basis document does not say all. The rest was found from what the product answers for recorded
shots:

- The work is done at a quarter of a bin (0.0375 m): samples in between are interpolated, and elevations are
  those of quarter bins.
- Smoothing widths are standard deviations in bins, and the Gaussian is cut where it ends: here at 2.5 of
  them, less its value there.
- A relative height is that of the last quarter bin from below whose energy, with all below it, is less than
  the share.

With group 1, of which the answers are known for 60 shots, elevations and relative heights then differ by 0.02
m (one standard deviation). What is left is the kernel's end. The product's later choice among several modes
of one group ("algorithm 10") is not made here.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from inversion.metrics.records import ladder
from jaxlidar.extend import check_range

# Parts of a bin, where a Gaussian is cut (in standard deviations), and shots computed at a time.
_PARTS, _CUT, _CHUNK = 4, 2.5, 64
# Half of the longest kernel of the published settings.
_REACH = 65
_LEVELS = np.arange(101) / 100


class GediSettings(NamedTuple):
    """Settings of GEDI's receive waveform processing.

    - `smoothing`: standard deviation in bins of the Gaussian that smooths the record, for the signal's ends
      and relative heights. The document's "smoothing width (noise)".
    - `mode_smoothing`: the same for modes. Its "smoothing width (signal)".
    - `front_threshold`: of the signal's beginning, in standard deviations of the noise.
    - `back_threshold`: of the signal's end and of modes.

    **Example:** group 1 with a lower threshold for the ground.

    >>> import inversion
    >>> inversion.gedi_settings(1)._replace(back_threshold=4.0)
    GediSettings(smoothing=6.5, mode_smoothing=6.5, front_threshold=3.0, back_threshold=4.0)
    """

    smoothing: float
    mode_smoothing: float
    front_threshold: float
    back_threshold: float


_GROUPS = {
    1: GediSettings(6.5, 6.5, 3.0, 6.0),
    2: GediSettings(6.5, 3.5, 3.0, 3.0),
    3: GediSettings(6.5, 3.5, 3.0, 6.0),
    4: GediSettings(6.5, 6.5, 6.0, 6.0),
    5: GediSettings(6.5, 3.5, 3.0, 2.0),
    6: GediSettings(6.5, 3.5, 3.0, 4.0),
}


def gedi_settings(group: int) -> GediSettings:
    """The settings of one of GEDI's six algorithm setting groups.

    **Arguments:**

    - `group`: 1 to 6. Group 1 is what the product selects in most places; group 5, with the lowest threshold,
      finds the ground under dense canopies, and takes noise for it elsewhere.

    **Returns:** a `GediSettings`.

    **Raises:** ValueError for any other group.

    **Source:** Hofton and Blair (2019), GEDI transmit and receive waveform processing (theoretical basis
    document 1.0), table 5.

    **Example:**

    >>> import inversion
    >>> inversion.gedi_settings(5)
    GediSettings(smoothing=6.5, mode_smoothing=3.5, front_threshold=3.0, back_threshold=2.0)
    """
    if isinstance(group, bool) or not isinstance(group, int | np.integer) or int(group) not in _GROUPS:
        raise ValueError(f"group = {group!r} is outside the admissible range: whole numbers from 1 to 6")
    return _GROUPS[int(group)]


class GediMetrics(NamedTuple):
    """Metrics of shots, named as in the product. NaN where a shot has no signal, or no mode.

    - `elev_lowestmode`: (shots,) elevation of the lowest mode in m, which the product takes for the ground.
    - `elev_highestreturn`, `elev_lowestreturn`: (shots,) elevations in m at which the signal begins and ends.
    - `rh`: (shots, 101) heights in m above the lowest mode below which 0, 1, ... 100 % of the energy return.
    - `num_detectedmodes`: (shots,) number of modes.

    **Example:** of one made-up shot over flat ground at 100 m.

    >>> import inversion, numpy as np, types
    >>> elevation = 120.0 - 0.15 * np.arange(300)
    >>> record = 200.0 + 400.0 * np.exp(-0.5 * ((elevation - 100.0) / 0.9) ** 2)
    >>> shot = types.SimpleNamespace(elevation=elevation, waveform=record, noise_mean=200.0, noise_std=3.0)
    >>> metrics = inversion.gedi_metrics([shot])
    >>> print(f"{metrics.elev_lowestmode[0]:.1f} m, RH98 {metrics.rh[0, 98]:.1f} m")
    100.0 m, RH98 2.4 m
    """

    elev_lowestmode: Float[np.ndarray, " shots"]
    elev_highestreturn: Float[np.ndarray, " shots"]
    elev_lowestreturn: Float[np.ndarray, " shots"]
    rh: Float[np.ndarray, "shots 101"]
    num_detectedmodes: Int[np.ndarray, " shots"]


def gedi_metrics(shots: Sequence[Any], settings: GediSettings | None = None) -> GediMetrics:
    """GEDI's lowest mode, highest return and relative heights, as level 2A computes them.

    Shots may differ in length. They are computed in batches, and compiled once for each of a ladder of sizes.

    **Arguments:**

    - `shots`: what `jaxlidar.io.read_gedi_l1b` gives, or anything with `elevation`, `waveform`, `noise_mean`
      and `noise_std` as there.
    - `settings`: see `gedi_settings`. Default: those of group 1.

    **Returns:** a `GediMetrics`.

    **Raises:** ValueError for settings that are not above 0, and for records that are not finite or of fewer
    than three samples.

    **Source:** Hofton and Blair (2019), GEDI transmit and receive waveform processing (theoretical basis
    document 1.0); Dubayah et al. (2020), Sci. Remote Sens. 1, 100002.

    **Example:**

    >>> import inversion, jaxlidar.io
    >>> shots = jaxlidar.io.read_gedi_l1b("GEDI01_B.h5")  # doctest: +SKIP
    >>> metrics = inversion.gedi_metrics(shots, inversion.gedi_settings(1))  # doctest: +SKIP
    >>> rh98 = metrics.rh[:, 98]  # doctest: +SKIP
    """
    chosen = gedi_settings(1) if settings is None else GediSettings(*settings)
    for name, value in chosen._asdict().items():
        check_range(name, value, 0.0, low_open=True)
    kernels = [_kernel(width) for width in chosen[:2]]
    # Of one size for all published settings, so that they share a program.
    reach = max(_REACH, *(kernel.size // 2 for kernel in kernels))
    kernels = jnp.asarray(np.stack([np.pad(kernel, reach - kernel.size // 2) for kernel in kernels]), float)
    thresholds = jnp.asarray(chosen[2:], float)
    counts = np.array([np.size(shot.waveform) for shot in shots], int)
    top, step = np.empty((2, len(shots)))
    rows = np.zeros((5 + _LEVELS.size, len(shots)))
    sizes = np.array([ladder(int(count)) for count in counts])
    for size in np.unique(sizes):
        (members,) = np.nonzero(sizes == size)
        for first in range(0, members.size, _CHUNK):
            chunk = members[first : first + _CHUNK]
            records = np.zeros((_CHUNK, size))
            noise, count = np.ones(_CHUNK), np.full(_CHUNK, 3)
            for row, i in enumerate(chunk):
                shot = shots[i]
                records[row, : counts[i]] = _record(shot)
                noise[row], count[row] = shot.noise_std, counts[i]
                top[i] = shot.elevation[0]
                step[i] = (shot.elevation[0] - shot.elevation[-1]) / (counts[i] - 1)
            arrays = jnp.asarray(records, float), jnp.asarray(count), jnp.asarray(noise, float)
            found = _metrics(*arrays, kernels, thresholds)
            for place, values in enumerate(found[:5]):
                rows[place, chunk] = np.asarray(values)[: chunk.size]
            rows[5:, chunk] = np.asarray(found[5])[: chunk.size].T
    part = step / _PARTS
    lit, mode = rows[0] > 0, (rows[0] > 0) & (rows[1] > 0)
    lowest = np.where(mode, top - part * rows[4], np.nan)
    return GediMetrics(
        elev_lowestmode=lowest,
        elev_highestreturn=np.where(lit, top - part * rows[2], np.nan),
        elev_lowestreturn=np.where(lit, top - part * rows[3], np.nan),
        rh=np.where(mode, part * (rows[4] - rows[5:]), np.nan).T,
        num_detectedmodes=rows[1].astype(int),
    )


def _record(shot: Any) -> np.ndarray:
    record = np.asarray(shot.waveform, float)
    if record.ndim != 1 or record.size < 3 or np.shape(shot.elevation) != record.shape:
        raise ValueError(
            f"waveform and elevation have the shapes {record.shape} and {np.shape(shot.elevation)}; "
            "admissible is (bins,) for both, three or more"
        )
    check_range("waveform", record)
    check_range("noise_std", shot.noise_std, 0.0)
    return record - shot.noise_mean


def _kernel(width: float) -> np.ndarray:
    """A Gaussian at parts of a bin, cut and brought to zero at its ends."""
    sigma = width * _PARTS
    reach = max(1, int(np.ceil(_CUT * sigma)))
    lags = np.arange(-reach, reach + 1)
    kernel = np.maximum(np.exp(-0.5 * (lags / sigma) ** 2) - np.exp(-0.5 * _CUT**2), 0.0)
    return kernel / kernel.sum()


@jax.jit
def _metrics(
    records: Float[Array, "shots bins"],
    count: Int[Array, " shots"],
    noise: Float[Array, " shots"],
    kernels: Float[Array, "2 lags"],
    thresholds: Float[Array, "2"],
) -> tuple[Array, ...]:
    """Whether there is a signal, the number of modes, and places in parts of a bin, of several records."""
    size = records.shape[1] * _PARTS
    half = kernels.shape[1] // 2
    padded = ladder(size + kernels.shape[1])
    spectra = jnp.fft.rfft(kernels, padded)

    def one(record, count, noise):
        place = jnp.arange(size)
        real = place <= (count - 1) * _PARTS
        fine = jnp.where(real, jnp.interp(place / _PARTS, jnp.arange(record.size), record), 0.0)
        smooth = jnp.fft.irfft(jnp.fft.rfft(fine, padded)[None, :] * spectra, padded)[:, half : half + size]
        wave, modes = jnp.where(real[None, :], smooth, 0.0)
        front, back = (threshold * noise for threshold in thresholds)
        pair = jnp.minimum(wave[:-1], wave[1:])
        begins, ends = pair > front, pair > back
        first, last = jnp.argmax(begins), size - 1 - jnp.argmax(ends[::-1])
        lit = jnp.any(begins) & jnp.any(ends) & (first < last)
        mode = (modes[1:-1] > modes[:-2]) & (modes[1:-1] >= modes[2:]) & (modes[1:-1] > back)
        lowest = size - 2 - jnp.argmax(mode[::-1])
        within = (place >= first) & (place <= last)
        below = jnp.cumsum(jnp.where(within, wave, 0.0)[::-1])
        share = lax.cummax(below) / jnp.maximum(below[-1], jnp.finfo(wave.dtype).tiny)
        less = jnp.searchsorted(share, jnp.asarray(_LEVELS, share.dtype))
        heights = jnp.minimum(size - less, last).at[-1].set(first)
        return lit, jnp.sum(mode), first, last, lowest, heights

    return jax.vmap(one)(records, count, noise)
