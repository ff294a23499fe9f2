r"""GEDI's level 2A metrics from its level 1B records, by the rules of the product.

1. Subtract the mean noise, and smooth the record y by two Gaussians: one for ends and energy, w, and one for
   modes, m.
2. The signal begins at the highest two samples in a row of w above the front threshold, and ends at the
   lowest two above the back threshold. Thresholds are in the product's standard deviations of the noise; for
   a simulated record without noise, in thousandths of the largest sample.
3. Modes are maxima of m above the back threshold; the lowest one is taken for the ground.
4. The relative height RH_q is the height above the lowest mode below which the fraction q / 100 of the energy
   sum w between the two ends lies.

The theoretical basis document (Hofton and Blair 2019) leaves details open. These reproduce the product's
values for recorded shots:

- The work is done at a quarter of a bin (0.0375 m): samples in between are interpolated linearly, and
  elevations are those of quarter bins.
- Smoothing widths are standard deviations in bins. The Gaussian is cut at 2.5 standard deviations, and its
  value there is subtracted.
- A relative height is that of the last quarter bin, from below, up to which the energy is less than the
  fraction.

With setting group 1, for which the product's values of 60 shots are at hand, elevations and relative heights
then differ by 0.02 m (one standard deviation), which the end of the kernel explains. The product's later
choice among several modes of one group ("algorithm 10") is not reproduced.
"""

import os
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from inversion.fit.quality import Verdict, judge_record
from inversion.metrics.records import refuse_baseline
from jaxlidar.extend import as_array, as_numpy, check_integer, check_number, check_range, even_step
from jaxlidar.survey.records import record_bucket

# Subdivisions of a bin, where a Gaussian is cut (in standard deviations), and shots computed at a time.
_SUBDIVISIONS, _CUT, _CHUNK = 4, 2.5, 64
# Half the lags of the longest kernel of the published settings.
_HALF_LAGS = 65
_RH_FRACTIONS = np.arange(101) / 100
# Records are smoothed by the receiver as by a Gaussian of this standard deviation, ns or samples; the
# transmitted pulse is not.
RECEIVER_SMOOTHING = 1.7
# Noise by which thresholds count where a record has none, over the largest sample: below it lies rounding.
NOISE_OF_THRESHOLDS = 1e-3
# Lags in ns of the pulse about its time zero.
_LAGS = np.arange(-64.0, 65.0)
# What is used of a shot.
_SHOT_FIELDS = ("elevation", "waveform", "noise_mean", "noise_std")


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
    """Return the settings of one of GEDI's six algorithm setting groups.

    **Arguments:**

    - `group`: 1 to 6. The product selects group 1 in most places; group 5, with the lowest threshold, finds
      the ground under dense canopies, and takes noise for ground elsewhere.

    **Returns:** a `GediSettings`.

    **Raises:** ValueError for any other group.

    **Source:** Hofton and Blair (2019), GEDI transmit and receive waveform processing (theoretical basis
    document 1.0), table 5.

    **Example:**

    >>> import inversion
    >>> inversion.gedi_settings(5)
    GediSettings(smoothing=6.5, mode_smoothing=3.5, front_threshold=3.0, back_threshold=2.0)
    """
    return _GROUPS[check_integer("group", group, 1, len(_GROUPS))]


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


def gedi_metrics(shots: Any, settings: GediSettings | None = None) -> GediMetrics:
    """Compute GEDI's lowest mode, highest return and relative heights, by the rules of level 2A.

    Shots may differ in length. They are computed in batches of equal size buckets, each compiled once.

    **Arguments:**

    - `shots`: a list of shots, those of `jaxlidar.io.read_gedi_l1b` or objects with the same `elevation`,
      `waveform`, `noise_mean` and `noise_std`; the last is 0 for a simulated record without noise.
    - `settings`: see `gedi_settings`. Default: those of group 1.

    **Returns:** a `GediMetrics`.

    **Raises:** TypeError for a path, one shot alone and other things than shots. ValueError for settings that
    are not above 0, for records that are not finite, of fewer than three samples or with another background
    than `noise_mean`, and for elevations that do not decrease in even steps.

    **Source:** Hofton and Blair (2019), GEDI transmit and receive waveform processing (theoretical basis
    document 1.0); Dubayah et al. (2020), Sci. Remote Sens. 1, 100002.

    **Example:**

    >>> import inversion, jaxlidar.io
    >>> shots = jaxlidar.io.read_gedi_l1b("GEDI01_B.h5")  # doctest: +SKIP
    >>> metrics = inversion.gedi_metrics(shots, inversion.gedi_settings(1))  # doctest: +SKIP
    >>> rh98 = metrics.rh[:, 98]  # doctest: +SKIP
    """
    shots = list_of_shots(shots)
    settings = gedi_settings(1) if settings is None else GediSettings(*settings)
    for name, value in settings._asdict().items():
        check_range(name, value, 0.0, low_open=True)
    return metrics_of_records(pad_shots(shots), [settings])[0]


class PaddedShots(NamedTuple):
    """Records of shots in batches of one size, less their noise and over their largest samples.

    - `top`, `step`: (shots,) elevation of the first sample and distance of samples in m.
    - `batches`: of each batch the numbers of its shots, at most `_CHUNK`, and with rows for `_CHUNK` shots
      the records, their numbers of samples, and the noise.
    """

    top: np.ndarray
    step: np.ndarray
    batches: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]


def pad_shots(shots: list[Any], *, size: int | None = None, is_checked: bool = False) -> PaddedShots:
    """Check the records of shots and pad them to their size buckets, or all of them to `size` samples.

    **Arguments:** `is_checked`: the records have been checked before, by `record_above_noise` and
    `even_step`.

    **Raises:** ValueError as `gedi_metrics`.
    """
    n_samples = np.array([np.size(shot.waveform) for shot in shots], int)
    top, step = np.empty((2, len(shots)))
    sizes = np.array([record_bucket(int(count)) for count in n_samples], int)
    if size is not None:
        sizes = np.full_like(sizes, size)
    batches = []
    for padded_size in np.unique(sizes):
        (members,) = np.nonzero(sizes == padded_size)
        for first in range(0, members.size, _CHUNK):
            chunk = members[first : first + _CHUNK]
            # Chunks are filled up to one size, so that all share a program; the filling is records of zeros.
            records = np.zeros((_CHUNK, padded_size))
            noise, count = np.ones(_CHUNK), np.full(_CHUNK, 3)
            for row, i in enumerate(chunk):
                shot = shots[i]
                record = shot.waveform - shot.noise_mean if is_checked else record_above_noise(shot)
                # Over the largest sample, which single precision holds whatever the unit of the record.
                peak = np.max(np.abs(record)) or 1.0
                records[row, : n_samples[i]] = record / peak
                noise[row], count[row] = shot.noise_std / peak or NOISE_OF_THRESHOLDS, n_samples[i]
                top[i], bottom = shot.elevation[0], shot.elevation[-1]
                if not is_checked:
                    even_step("elevation", shot.elevation, decreasing=True)
                step[i] = (top[i] - bottom) / (n_samples[i] - 1)
            batches.append((chunk, records, count, noise))
    return PaddedShots(top, step, batches)


def metrics_of_records(padded: PaddedShots, settings: Sequence[GediSettings]) -> list[GediMetrics]:
    """Compute the metrics of padded shots with each of several settings: see `gedi_metrics`.

    Records are smoothed once for each width that the settings have.
    """
    # Two at least, so that all published settings share a program; of one size for the same reason.
    widths = list(dict.fromkeys(width for s in settings for width in (s.smoothing, s.mode_smoothing)))
    kernels = [_smoothing_kernel(width) for width in (widths * 2 if len(widths) == 1 else widths)]
    half_lags = max(_HALF_LAGS, *(kernel.size // 2 for kernel in kernels))
    kernels = as_array(np.stack([np.pad(kernel, half_lags - kernel.size // 2) for kernel in kernels]))
    chosen = np.array([[widths.index(s.smoothing), widths.index(s.mode_smoothing)] for s in settings])
    thresholds = as_array([[s.front_threshold, s.back_threshold] for s in settings])
    shape = (len(settings), len(padded.top))
    features = {name: np.zeros(shape) for name in _RecordFeatures._fields if name != "energy_below"}
    rh_position = np.zeros((*shape, _RH_FRACTIONS.size))
    for chunk, records, count, noise in padded.batches:
        computed = _record_features(
            as_array(records), jnp.asarray(count), as_array(noise), kernels, jnp.asarray(chosen), thresholds
        )
        for name, values in features.items():
            values[:, chunk] = np.asarray(getattr(computed, name))[:, : chunk.size]
        energy_below = np.asarray(computed.energy_below)[:, : chunk.size]
        rh_position[:, chunk] = _rh_positions(
            energy_below, features["first"][:, chunk], features["last"][:, chunk]
        )
    return [
        _metrics(padded, {name: values[n] for name, values in features.items()}, rh_position[n])
        for n in range(len(settings))
    ]


def _rh_positions(
    energy_below: Float[np.ndarray, "settings shots positions"],
    first: Float[np.ndarray, "settings shots"],
    last: Float[np.ndarray, "settings shots"],
) -> Float[np.ndarray, "settings shots 101"]:
    """Return the positions below which 0, 1, ... 100 % of the energy lie.

    On the host: a running maximum takes several times as long in a compiled program.
    """
    # Noise must not make the cumulated energy fall: the search needs it sorted.
    fraction = np.maximum.accumulate(energy_below, axis=-1)
    # Records of noise alone may have no energy in all: their fractions are infinite, and their metrics NaN.
    with np.errstate(over="ignore"):
        fraction /= np.maximum(energy_below[..., -1:], np.finfo(fraction.dtype).tiny)
    levels = _RH_FRACTIONS.astype(fraction.dtype)
    size = fraction.shape[-1]
    n_below = [np.searchsorted(row, levels) for row in fraction.reshape(-1, size)]
    position = np.minimum(size - np.reshape(n_below, (*first.shape, levels.size)), last[..., None])
    # All energy lies below the beginning of the signal, whatever rounding makes of the last fraction.
    position[..., -1] = first
    return position


def _metrics(
    padded: PaddedShots, features: dict[str, np.ndarray], rh_position: Float[np.ndarray, "shots 101"]
) -> GediMetrics:
    """Return the metrics by the features of records: see `_RecordFeatures`."""
    top, step = padded.top, padded.step
    # Positions count quarter bins downwards from the first sample.
    spacing = step / _SUBDIVISIONS
    has_signal = features["has_signal"] > 0
    has_mode = has_signal & (features["n_modes"] > 0)
    rh = spacing[:, None] * (features["lowest_mode"][:, None] - rh_position)
    return GediMetrics(
        elev_lowestmode=np.where(has_mode, top - spacing * features["lowest_mode"], np.nan),
        elev_highestreturn=np.where(has_signal, top - spacing * features["first"], np.nan),
        elev_lowestreturn=np.where(has_signal, top - spacing * features["last"], np.nan),
        rh=np.where(has_mode[:, None], rh, np.nan),
        num_detectedmodes=features["n_modes"].astype(int),
    )


def list_of_shots(shots: Any) -> list[Any]:
    """Return shots as a list. **Raises:** TypeError, with the right call, for other things."""
    if isinstance(shots, str | os.PathLike):
        raise TypeError(
            f"shots = {os.fspath(shots)!r} is a path; admissible are its shots, as in "
            "gedi_metrics(jaxlidar.io.read_gedi_l1b(path))"
        )
    if not isinstance(shots, Iterable):
        raise TypeError(
            f"shots is a {type(shots).__name__}; admissible is a list of shots, as in gedi_metrics([shot])"
        )
    shots = list(shots)
    for i, shot in enumerate(shots):
        missing = [name for name in _SHOT_FIELDS if not hasattr(shot, name)]
        if missing:
            raise TypeError(
                f"shots has a {type(shot).__name__} at index {i}, which has no {missing[0]}; admissible are "
                f"objects with {', '.join(_SHOT_FIELDS)}, as jaxlidar.io.read_gedi_l1b returns them"
            )
    return shots


def record_above_noise(shot: Any) -> np.ndarray:
    """Record of a shot less its mean noise. **Raises:** ValueError for shapes or values that do not serve."""
    record, _ = as_numpy(shot.waveform, "waveform"), as_numpy(shot.elevation, "elevation")
    if record.ndim != 1 or record.size < 3 or np.shape(shot.elevation) != record.shape:
        raise ValueError(
            f"waveform and elevation have the shapes {record.shape} and {np.shape(shot.elevation)}; "
            "admissible is (bins,) for both, three or more"
        )
    check_range("waveform", record)
    check_number("noise_mean", shot.noise_mean)
    check_number("noise_std", shot.noise_std, 0.0)
    above_noise = record - float(shot.noise_mean)
    refuse_baseline("waveform less noise_mean", above_noise, np.asarray(shot.noise_std, float))
    return above_noise


def pulse_samples(shot: Any) -> Float[np.ndarray, " lags"]:
    """Return the transmitted pulse of a shot at whole ns from its time zero."""
    return np.interp(_LAGS, shot.pulse_time, shot.pulse_power, left=0.0, right=0.0)


def judge_shot(shot: Any) -> Verdict:
    """Return the verdict on the record of a shot."""
    return judge_record(
        shot.waveform - shot.noise_mean,
        noise=shot.noise_std,
        pulse=pulse_samples(shot),
        degrade=getattr(shot, "degrade", None),
        stale_return=getattr(shot, "stale_return", None),
    )


def _smoothing_kernel(width: float) -> np.ndarray:
    """Gaussian at quarter bins, of unit sum, cut and brought to zero at its ends."""
    sigma = width * _SUBDIVISIONS
    half = max(1, int(np.ceil(_CUT * sigma)))
    lags = np.arange(-half, half + 1)
    kernel = np.maximum(np.exp(-0.5 * (lags / sigma) ** 2) - np.exp(-0.5 * _CUT**2), 0.0)
    return kernel / kernel.sum()


class _RecordFeatures(NamedTuple):
    """Features of records, (settings, shots, ...); positions in quarter bins from the first sample downwards.

    - `has_signal`: True if the record has a beginning and, below it, an end.
    - `n_modes`: number of modes.
    - `first`, `last`: positions of the signal's beginning and end.
    - `lowest_mode`: position of the lowest mode.
    - `energy_below`: (settings, shots, positions) energy of the signal up to positions that count from below.
    """

    has_signal: Array
    n_modes: Array
    first: Array
    last: Array
    lowest_mode: Array
    energy_below: Array


@jax.jit
def _record_features(
    records: Float[Array, "shots bins"],
    n_samples: Int[Array, " shots"],
    noise: Float[Array, " shots"],
    kernels: Float[Array, "kernels lags"],
    chosen: Int[Array, "settings 2"],
    thresholds: Float[Array, "settings 2"],
) -> _RecordFeatures:
    """Features of several records; the steps are those of the module's docstring.

    `chosen`: kernels of the settings by number, for the signal and for modes.
    """
    size = records.shape[1] * _SUBDIVISIONS
    half = kernels.shape[1] // 2
    # Long enough that the convolution does not wrap around.
    padded = record_bucket(size + kernels.shape[1])
    kernel_spectra = jnp.fft.rfft(kernels, padded)
    position = jnp.arange(size)

    def smooth(record, n_samples):
        # Nothing is extrapolated beyond the last sample.
        is_recorded = position <= (n_samples - 1) * _SUBDIVISIONS
        sample = jnp.arange(record.size, dtype=record.dtype)
        fine = jnp.interp(position.astype(record.dtype) / _SUBDIVISIONS, sample, record)
        fine = jnp.where(is_recorded, fine, 0.0)
        spectra = jnp.fft.rfft(fine, padded)[None, :] * kernel_spectra
        waves = jnp.fft.irfft(spectra, padded)[:, half : half + size]
        return jnp.where(is_recorded[None, :], waves, 0.0)

    def features_of(wave, mode_wave, noise, thresholds):
        front, back = (threshold * noise for threshold in thresholds)
        two_in_a_row = jnp.minimum(wave[:-1], wave[1:])
        is_above_front, is_above_back = two_in_a_row > front, two_in_a_row > back
        # The end is the lower of its two samples.
        first, last = jnp.argmax(is_above_front), size - 1 - jnp.argmax(is_above_back[::-1])
        has_signal = jnp.any(is_above_front) & jnp.any(is_above_back) & (first < last)

        inner = mode_wave[1:-1]
        is_mode = (inner > mode_wave[:-2]) & (inner >= mode_wave[2:]) & (inner > back)
        lowest_mode = size - 2 - jnp.argmax(is_mode[::-1])

        is_signal = (position >= first) & (position <= last)
        energy_below = jnp.cumsum(jnp.where(is_signal, wave, 0.0)[::-1])
        return _RecordFeatures(has_signal, jnp.sum(is_mode), first, last, lowest_mode, energy_below)

    waves = jax.vmap(smooth)(records, n_samples)

    def with_settings(numbers, thresholds):
        wave, mode_wave = waves[:, numbers[0]], waves[:, numbers[1]]
        return jax.vmap(features_of, (0, 0, 0, None))(wave, mode_wave, noise, thresholds)

    # One setting after the other: side by side they need more memory than the processor's caches have.
    return lax.map(lambda setting: with_settings(*setting), (chosen, thresholds))
