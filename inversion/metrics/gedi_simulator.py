r"""Metrics and noise of simulated footprints as the GEDI simulator defines and names them.

They are those of `gediMetric` with its default settings, for comparison with studies that used it. The
package's own estimates, with standard errors, are in `gedi_table.py`.

**Noise by link margin.** A footprint of cover c, over ground as bright as the plants and a slope of 2
degrees, returns an echo of the ground with the amplitude

    A = (1 - c) / (sqrt(2 pi) s),    s^2 = s_p^2 + s_f^2 tan^2(2 degrees),

for a waveform of unit energy (amplitudes are then 1/m of height), with s_p and s_f the standard deviations of
pulse and footprint in m. Noise is white and normal, with the standard deviation sigma in each sample of 0.15
m. The threshold t = n_n sigma is exceeded by noise alone somewhere within 30 m, that is 200 samples, with the
probability 0.05; the echo exceeds it with the probability 0.9 where A = t + n_s sigma:

    n_n = Phi^-1(1 - 0.05 / 200) = 3.48,    n_s = Phi^-1(0.9) = 1.28.

The link margin M, dB, is the ratio of what is left of the amplitude to the threshold,

    M = 10 log10((A - n_s sigma) / t),    so    sigma = A / (n_s + n_n 10^(M / 10)).

At M = 0 the ground below the cover c is thus detected in nine of ten footprints. The simulator also scales
the noise by each footprint's mean reflectance; here plants and ground are equally bright.

**Source:** Hancock et al. (2019), Earth Space Sci. 6, 294, and the program's source (gediMetric, gediNoise
and libClidar by S. Hancock), for the details that the paper leaves open; Lefsky et al. (2007), J. Appl.
Remote Sens. 1, 013537, for the extents of the edges.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxlidar import SPEED_OF_LIGHT, Progress
from jaxlidar.formats.tables import ColumnAxis
from jaxlidar.io import Column, GediShot, ShotTable

# Slope of the ground of a link margin; probabilities of a false alarm within a length and of a missed ground.
_SLOPE, _FALSE_ALARM, _MISSED = np.deg2rad(2.0), 0.05, 0.1
_SEARCH_LENGTH, _SAMPLE = 30.0, 0.15
# Reflectance of plants over that of the ground, of covers that correct for it.
_REFLECTANCE_RATIO = 0.57 / 0.4
# Length in m from the top of a record in which noise is estimated, and the threshold of the signal in its
# standard deviations.
_NOISE_LENGTH, _THRESHOLD = 15.0, 5.0
# Standard deviation in m of the Gaussian that smooths records for the lowest maximum and the inflection
# points, and of that which finds the Gaussians to start from.
_SMOOTHING, _START_SMOOTHING = 0.75 * 0.76, 1.2
# Least and largest standard deviation of a Gaussian in m, and its largest amplitude over that at the start.
_LEAST_SIGMA, _LARGEST_SIGMA, _LARGEST_AMPLITUDE = 0.764331, 50.0, 6.6
# Fractions: of the largest sample, below which no Gaussian starts, and of the largest amplitude, below which
# none counts; of the energy, above which the lowest Gaussian is the ground, and above the signal's true top.
_WEAK_START, _WEAK, _GROUND_ENERGY, _TOP_ENERGY = 1e-3, 5e-4, 1e-3, 1e-3
# Amplitudes, 1/m, in a record of unit energy: at which the signal begins and ends, and below which samples
# have no part in the foliage height diversity.
_SIGNAL, _LEAST_SAMPLE = 1e-3, 1e-5
# Gaussians are fitted to the samples above this fraction of the largest one, and as far in m around them.
_FIT_FRACTION, _FIT_MARGIN = 1.0 / 800.0, 6.0
# Scales of centre, amplitude and standard deviation of a Gaussian, and where its fit ends.
_FIT_SCALES, _FIT_TOLERANCES = (1.0, 0.3, 1.0), {"ftol": 1e-6, "xtol": 1e-6, "gtol": 1e-6}
# Single precision of the simulator: energies are equal within this fraction.
_ROUNDING = 1e-7
_PERCENTS = np.arange(101.0)
# Shots between reports of progress.
_SHOTS_PER_REPORT = 64
_AXIS = ColumnAxis("percent", _PERCENTS, "percent")


def link_margin_noise(margin: float, cover: float, pulse_std: float, footprint_std: float) -> float:
    """Return the standard deviation of white noise, 1/m, in a waveform of unit energy.

    **Arguments:** `margin`: link margin, dB. `cover`: canopy cover at which it holds, in [0, 1). `pulse_std`,
    `footprint_std`: standard deviations of pulse and footprint, m.
    """
    width = np.hypot(pulse_std, footprint_std * np.tan(_SLOPE))
    amplitude = (1.0 - cover) / (np.sqrt(2.0 * np.pi) * width)
    signal, noise = detection_thresholds()
    return float(amplitude / (signal + noise * 10.0 ** (margin / 10.0)))


def detection_thresholds() -> tuple[float, float]:
    """Return n_s and n_n of the module's docstring."""
    false_alarm = _FALSE_ALARM / (_SEARCH_LENGTH / _SAMPLE)
    return float(scipy.special.ndtri(1.0 - _MISSED)), float(scipy.special.ndtri(1.0 - false_alarm))


def simulator_table(
    shots: list[GediShot], footprint_std: float, progress: Callable[[Progress], Any] | None = None
) -> ShotTable:
    """Return the metrics of shots under the names that the GEDI simulator gives them.

    Records are first denoised: of what exceeds the noise by 5 standard deviations, taken from the uppermost
    15 m, each stretch is extended until the record falls to the mean noise; the rest is zero.

    **Arguments:** `shots`: of level 1B, simulated or recorded. `footprint_std`: standard deviation of the
    footprint in m. `progress`: is called with a `Progress` after every few shots. Default None.

    **Returns:** a `ShotTable`, a row for each shot, with `shot_number` and the columns of `_COLUMNS`, of
    which `rhGauss`, `rhMax` and `rhInfl` are (shots, 101); NaN where nothing exceeds the noise.

    `gHeight` is that of a sum of Gaussians fitted to the record, which is smoothed by 0.57 m first where it
    has noise. One starts between neighbouring inflection points of the record smoothed by 1.2 m. In some
    records with noise the lowest Gaussian is a ripple up to some metres below the ground. The covers by half
    of an echo are E_c / (E_c + 1.425 E_g), with E_g twice the energy below each ground, E_c the rest, and
    1.425 the reflectance of plants over that of the ground.
    """
    rows, start_time = [], time.perf_counter()
    for shot in shots:
        rows.append(_row(shot, footprint_std))
        if progress is not None and (len(rows) % _SHOTS_PER_REPORT == 0 or len(rows) == len(shots)):
            progress(Progress(len(rows), len(shots), time.perf_counter() - start_time))
    numbers = np.array([shot.shot_number for shot in shots], np.uint64)
    columns = {"shot_number": Column(numbers, "", "unique number of the product")}
    for name, (unit, text) in _COLUMNS.items():
        missing = np.full(_PERCENTS.size, np.nan) if name in _RELATIVE_HEIGHTS else np.nan
        values = np.array([missing if row is None else row[name] for row in rows], float)
        axis = _AXIS if name in _RELATIVE_HEIGHTS else None
        shape = (len(shots), _PERCENTS.size) if axis is not None else (len(shots),)
        columns[name] = Column(values.reshape(shape), unit, text, axis)
    return ShotTable(columns, {"title": "footprints: metrics of the GEDI simulator"})


# Columns: unit and description.
_RELATIVE_HEIGHTS = ("rhGauss", "rhMax", "rhInfl")
_COLUMNS = {
    "gHeight": ("m", "ground: centre of the lowest Gaussian with 0.1 % of the energy or more"),
    "maxGround": ("m", "ground: lowest maximum of the record smoothed by 0.57 m"),
    "inflGround": ("m", "ground: centre of gravity between the lowest two inflection points of that"),
    "signal top": ("m", "elevation of the first sample above 0.001 of the energy per m"),
    "signal bottom": ("m", "elevation of the last sample above 0.001 of the energy per m"),
    "cover": ("", "one less the fraction of the Gaussians' energy in that of the ground"),
    "leading edge ext": ("m", "from the signal's top to the first sample that is its mean or more"),
    "trailing edge extent": ("m", "from the signal's bottom to the first sample that is its mean or more"),
    "rhGauss": ("m", "elevation up to which 0 to 100 % of the energy lie, above gHeight"),
    "rhMax": ("m", "elevation up to which 0 to 100 % of the energy lie, above maxGround"),
    "rhInfl": ("m", "elevation up to which 0 to 100 % of the energy lie, above inflGround"),
    "gaussHalfCov": ("", "cover, with twice the energy below gHeight as that of the ground"),
    "maxHalfCov": ("", "cover, with twice the energy below maxGround as that of the ground"),
    "infHalfCov": ("", "cover, with twice the energy below inflGround as that of the ground"),
    "waveEnergy": ("counts m", "energy"),
    # 1 - (n_n + n_s) sigma sqrt(2 pi) s / E of the module's docstring; NaN for a record without noise.
    "blairSense": ("", "cover through which the ground is detected with the probability 0.9, by the noise"),
    "FHD": ("", "foliage height diversity, -sum p ln p of the samples' fractions p of the energy"),
    # Negative below the ground.
    "niM2": ("m2", "mean of the height above gHeight squared, weighted by the energy"),
    "niM2.1": ("m2.1", "mean of the height above gHeight to the power of 2.1, weighted by the energy"),
    "gSlope": ("degrees", "slope that would widen the pulse as the ground's Gaussian is wide"),
}


def _row(shot: GediShot, footprint_std: float) -> dict[str, Float[np.ndarray, "..."] | float] | None:
    """Return the metrics of a shot by name; None where nothing exceeds the noise."""
    height = np.asarray(shot.elevation, float)
    step = float(height[0] - height[-1]) / (height.size - 1)
    quiet = shot.signal[: max(int(_NOISE_LENGTH / step), 2)]
    sigma = float(quiet.std())
    record = denoised(np.asarray(shot.signal, float), _THRESHOLD * sigma)
    total = float(record.sum() * step)
    if not total > 0:
        return None
    smoothed = smooth(record, _SMOOTHING / step)
    # As the simulator's authors do, a record with noise is smoothed before the fit.
    gaussians = fit_gaussians(height, smoothed if sigma > 0 else record)
    ground = gaussians.ground
    grounds = {"gHeight": float(gaussians.centre[ground])}
    grounds |= {
        "maxGround": lowest_maximum(height, smoothed),
        "inflGround": lowest_inflections(height, smoothed),
    }
    energy = gaussians.amplitude * gaussians.sigma
    (signal,) = np.nonzero(record > _SIGNAL * total)
    top, bottom = (float(height[i]) for i in signal[[0, -1]])
    between = slice(signal[0], signal[-1] + 1)
    (bright,) = np.nonzero(record[between] >= record[between].mean())
    levels = energy_heights(height, record)
    pulse_std = _pulse_std(shot)
    above = height - grounds["gHeight"]
    fractions = record[record > _LEAST_SAMPLE * total] / record.sum()
    # The width beyond that of the pulse, as a slope across the footprint.
    narrowest = np.hypot(pulse_std, _SMOOTHING if sigma > 0 else 0.0)
    excess = np.sqrt(max(float(gaussians.sigma[ground]) ** 2 - narrowest**2, 0.0))
    width = np.hypot(pulse_std, footprint_std * np.tan(_SLOPE))
    weakest = sum(detection_thresholds()) * sigma * np.sqrt(2.0 * np.pi) * width
    covers = {name: half_cover(height, record, z) for name, z in grounds.items()}
    return {
        **grounds,
        "signal top": top,
        "signal bottom": bottom,
        "cover": float(1.0 - energy[ground] / energy.sum()),
        "leading edge ext": top - float(height[between][bright[0]]),
        "trailing edge extent": float(height[between][bright[-1]]) - bottom,
        **{name: levels - z for name, z in zip(_RELATIVE_HEIGHTS, grounds.values())},
        **dict(zip(("gaussHalfCov", "maxHalfCov", "infHalfCov"), covers.values())),
        "waveEnergy": total,
        "blairSense": 1.0 - weakest / total if sigma > 0 else np.nan,
        "FHD": float(-np.sum(fractions * np.log(fractions))),
        **{
            name: float(np.average(np.sign(above) * np.abs(above) ** power, weights=record))
            for name, power in (("niM2", 2.0), ("niM2.1", 2.1))
        },
        "gSlope": float(np.rad2deg(np.arctan2(excess, footprint_std))),
    }


def _pulse_std(shot: GediShot) -> float:
    """Return the standard deviation of the transmitted pulse, m of height."""
    time, power = np.asarray(shot.pulse_time, float), np.asarray(shot.pulse_power, float)
    mean = np.average(time, weights=power)
    return 0.5 * SPEED_OF_LIGHT * float(np.sqrt(np.average((time - mean) ** 2, weights=power)))


def denoised(signal: Float[np.ndarray, " bins"], threshold: float) -> Float[np.ndarray, " bins"]:
    """Return a record with zeros but in the positive stretches that reach the threshold."""
    is_positive = signal > 0
    # Numbers of the stretches of positive samples.
    stretch = np.cumsum(np.diff(is_positive, prepend=False) & is_positive)
    seen = np.unique(stretch[is_positive & (signal >= threshold)])
    return np.where(is_positive & np.isin(stretch, seen), signal, 0.0)


def smooth(values: Float[np.ndarray, " bins"], width: float) -> Float[np.ndarray, " bins"]:
    """Smooth by a Gaussian of a standard deviation in samples; ends have the weights of what is there."""
    weights = scipy.ndimage.gaussian_filter1d(np.ones_like(values), width, mode="constant", truncate=5.0)
    return scipy.ndimage.gaussian_filter1d(values, width, mode="constant", truncate=5.0) / weights


def _bend(values: Float[np.ndarray, " bins"]) -> Float[np.ndarray, " bins"]:
    """Return twice each sample less its neighbours: the negative second derivative; zero at the ends."""
    return np.pad(2.0 * values[1:-1] - values[2:] - values[:-2], 1)


def _minima(values: Float[np.ndarray, " bins"]) -> Int[np.ndarray, " minima"]:
    """Return the numbers of local minima, but of the two samples at either end."""
    is_minimum = (values[1:-1] <= values[:-2]) & (values[1:-1] < values[2:])
    numbers = np.flatnonzero(is_minimum) + 1
    return numbers[(numbers >= 2) & (numbers < values.size - 2)]


def lowest_maximum(height: Float[np.ndarray, " bins"], smoothed: Float[np.ndarray, " bins"]) -> float:
    """Return the height of the lowest maximum of a smoothed record."""
    is_maximum = (smoothed[1:-1] >= smoothed[:-2]) & (smoothed[1:-1] > smoothed[2:])
    return float(height[1:-1][is_maximum].min(initial=np.inf)) if is_maximum.any() else np.nan


def lowest_inflections(height: Float[np.ndarray, " bins"], smoothed: Float[np.ndarray, " bins"]) -> float:
    """Return the centre of gravity of a smoothed record between its lowest two inflection points.

    They are where its second derivative is largest, on either side of an echo.
    """
    lowest = _minima(_bend(smoothed))[-2:]
    if lowest.size < 2:
        return np.nan
    # The upper one belongs to the echo above.
    between = slice(lowest[0] + 1, lowest[1] + 1)
    return float(np.average(height[between], weights=smoothed[between]))


def energy_heights(
    height: Float[np.ndarray, " bins"], record: Float[np.ndarray, " bins"]
) -> Float[np.ndarray, "101"]:
    """Return the heights of the lowest samples up to which 0 to 100 % of the energy lie, from below."""
    height, record = height[::-1], record[::-1]
    is_lit = record > 0
    energy = np.cumsum(record)[is_lit]
    levels = 0.01 * _PERCENTS * energy[-1] * (1.0 - _ROUNDING)
    return height[is_lit][np.searchsorted(energy, levels)]


def half_cover(
    height: Float[np.ndarray, " bins"], record: Float[np.ndarray, " bins"], ground: float
) -> float:
    """Return the cover, with twice the energy below the ground as that of the ground."""
    of_ground = 2.0 * record[height <= ground].sum()
    return _cover(record.sum() - of_ground, of_ground)


def _cover(of_plants: float, of_ground: float) -> float:
    """Return the cover by energies; 0 where plants have none."""
    return float(of_plants / (of_plants + _REFLECTANCE_RATIO * of_ground)) if of_plants > 0 else 0.0


class Gaussians(NamedTuple):
    """Gaussians of a record: centres and standard deviations in m, and amplitudes, (n,) each."""

    centre: Float[np.ndarray, " n"]
    amplitude: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]

    @property
    def ground(self) -> int:
        """Number of the lowest Gaussian that has a thousandth of the energy."""
        energy = self.amplitude * self.sigma
        counts = energy >= _GROUND_ENERGY * energy.sum()
        return int(np.argmin(np.where(counts, self.centre, np.inf)))


def fit_gaussians(height: Float[np.ndarray, " bins"], record: Float[np.ndarray, " bins"]) -> Gaussians:
    """Fit a sum of Gaussians to a record by bounded least squares.

    1. The record is smoothed, and its second derivative once more. A Gaussian starts between neighbouring
       maxima of that: at the centre of gravity, with the largest sample as its amplitude.
    2. All are fitted together. Bounds: centres within the record, standard deviations from that of the pulse,
       amplitudes up to 6.6 times those at the start.
    3. Those of less than 0.05 % of the largest amplitude do not count.
    """
    step = float(height[0] - height[-1]) / (height.size - 1)
    (lit,) = np.nonzero(record > _FIT_FRACTION * record.max())
    margin = int(np.ceil(_FIT_MARGIN / step))
    window = slice(max(lit[0] - margin, 0), lit[-1] + margin + 1)
    height, scale = height[window], record.max()
    values = record[window] / scale
    smoothed = smooth(values, _START_SMOOTHING / step)
    turns = _minima(smooth(_bend(smoothed), _START_SMOOTHING / step))
    turns = turns[smoothed[turns] > _ROUNDING] - 1
    starts = []
    for first, last in zip([0, *turns], [*turns, values.size - 1]):
        part = slice(first, last + 1)
        peak = first + int(np.argmax(values[part]))
        if values[peak] >= _WEAK_START:
            centre = np.average(height[part], weights=values[part])
            (lower,) = np.nonzero(values[peak:] <= values[peak] * np.exp(-0.5))
            sigma = 0.5 * (centre - height[peak + lower[0]]) if lower.size else 0.0
            starts.append((centre, values[peak], max(sigma, _LEAST_SIGMA + 0.02)))
    start = np.array(starts)
    low = np.broadcast_to([height[-1], 0.0, _LEAST_SIGMA], start.shape)
    ends = np.broadcast_to([height[0], _LARGEST_SIGMA], (len(start), 2))
    high = np.stack([ends[:, 0], _LARGEST_AMPLITUDE * start[:, 1], ends[:, 1]], axis=1)

    def terms(unknowns: np.ndarray) -> tuple[np.ndarray, ...]:
        centre, amplitude, sigma = unknowns.reshape(-1, 3, 1).transpose(1, 0, 2)
        distance = (height - centre) / sigma
        return amplitude, sigma, distance, np.exp(-0.5 * distance**2)

    def residual(unknowns: np.ndarray) -> np.ndarray:
        amplitude, _, _, shape = terms(unknowns)
        return np.sum(amplitude * shape, axis=0) - values

    def jacobian(unknowns: np.ndarray) -> np.ndarray:
        amplitude, sigma, distance, shape = terms(unknowns)
        of_centre = amplitude * shape * distance / sigma
        return np.stack([of_centre, shape, of_centre * distance], axis=1).reshape(-1, height.size).T

    fit = scipy.optimize.least_squares(
        residual,
        start.ravel(),
        jacobian,
        bounds=(low.ravel(), high.ravel()),
        x_scale=np.tile(_FIT_SCALES, len(start)),
        **_FIT_TOLERANCES,
    )
    centre, amplitude, sigma = fit.x.reshape(-1, 3).T
    return Gaussians(centre, np.where(amplitude < _WEAK * amplitude.max(), 0.0, scale * amplitude), sigma)


def true_metrics(
    height: Float[np.ndarray, " bins"],
    record: Float[np.ndarray, " bins"],
    ground: Float[np.ndarray, " bins"],
    pulse_std: float,
    footprint_std: float,
) -> dict[str, Float[np.ndarray, "..."] | float]:
    """Return what the simulator knows of a footprint beyond its record: metrics without noise, by name.

    **Arguments:** `height`: m, decreasing. `record`: without noise, some of it positive. `ground`: what the
    ground has of it. `pulse_std`, `footprint_std`: standard deviations in m.

    **Returns:** `true ground`: centre of gravity of the ground's echo in m, and `ground slope` in degrees, by
    its width; NaN without one. `true top`: elevation in m above which a thousandth of the energy lies. `ALS
    cover`: E_c / (E_c + 1.425 E_g). `rhReal`: (101,) relative heights in m above the true ground.
    """
    levels = energy_heights(height, record)
    of_ground = float(ground.sum())
    true_ground = slope = np.nan
    if of_ground > 0:
        true_ground = float(np.average(height, weights=ground))
        variance = np.average((height - true_ground) ** 2, weights=ground) - pulse_std**2
        slope = float(np.rad2deg(np.arctan2(np.sqrt(max(variance, 0.0)), footprint_std)))
    top = np.searchsorted(np.cumsum(record), _TOP_ENERGY * record.sum())
    return {
        "true ground": true_ground,
        "true top": float(height[top]),
        "ground slope": slope,
        "ALS cover": _cover(float(record.sum()) - of_ground, of_ground),
        "rhReal": levels - true_ground,
    }
