"""Ground and canopy in the events of a photon counter, without a model of the scene.

1. **Noise.** Signal is dense. The neighbours of a photon are those within an ellipse that is wider than high
   (Zhang and Kerekes 2015). By background alone their number is Poisson distributed, with the mean of the
   ellipse's area times the density of background. A photon is signal where that number or more occur in less
   than one case of a thousand (compare DRAGANN, Neuenschwander and Pitts 2019).
2. **Ground.** In each segment of the track it is a straight line, fitted to the signal by iteratively
   reweighted least squares with weights that fall off quickly above the line and slowly below it,

       w(r) = 1 / (1 + (r / s)^4),    s = 1 m for r > 0, 5 m for r < 0,

   so that the line sinks through the canopy (Kraus and Pfeifer 1998); at the end, by photons within a metre.
3. **Canopy.** Its height is a percentile, ATL08's 98th, of the heights above that line of signal two metres
   above it and more (Neuenschwander and Pitts 2019).

**Source:** Kraus and Pfeifer (1998), ISPRS J. Photogramm. 53, 193; Neuenschwander and Pitts (2019), Remote
Sens. Environ. 221, 247; Zhang and Kerekes (2015), IEEE Geosci. Remote Sens. Lett. 12, 726.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int
from scipy import spatial, stats

from jaxlidar import SPEED_OF_LIGHT, PhotonEvents
from jaxlidar.extend import as_numpy, check_integer, check_kind, check_range

# Half-axes of the ellipse in m: along the track, in height.
_ALONG, _HIGH = 10.0, 3.0
# Probability that background alone passes for signal, and the fewest neighbours of signal.
_FALSE_ALARM, _FEWEST_NEIGHBOURS = 1e-3, 3
# Height in m of the cells in which background is counted. Cells this many standard deviations above the mean
# hold signal.
_CELL_HEIGHT, _CLIP, _CLIP_ITERATIONS = 5.0, 3.0, 30
# Residuals in m at which weights are a half, above the ground (Kraus and Pfeifer's) and below.
_HALF_WEIGHT_ABOVE, _HALF_WEIGHT_BELOW = 1.0, 5.0
# Iterations of the fit, the first ones with those weights. It starts from this percentile of the heights.
_ITERATIONS, _WEIGHTED_ITERATIONS, _START_PERCENTILE = 40, 30, 10.0
# Largest distance of ground from the line, and least height of canopy above it, m.
_GROUND_RANGE, _CANOPY_CLEARANCE = 1.0, 2.0
# Labels of photons.
_NOISE, _GROUND, _CANOPY, _OTHER_SIGNAL = 0, 1, 2, 3


class PhotonHeights(NamedTuple):
    """Ground and canopy of the segments of a track; NaN in segments with too few photons.

    - `distance`: (segments,) m along the track, of the middle of each segment.
    - `ground`: (segments,) m, height of the ground there.
    - `slope`: (segments,) rise of the ground per metre along the track.
    - `canopy`: (segments,) m, height of the canopy above the ground.
    - `label`: (events,) 0 for noise, 1 for ground, 2 for canopy, and 3 for signal that is neither: between
      the two, below the ground, or in a segment without ground.

    **Example:** the fraction of the photons that were taken for canopy.

    >>> import inversion, numpy as np
    >>> segment = np.array([10.0])
    >>> heights = inversion.PhotonHeights(segment, segment, segment, segment, label=np.array([0, 1, 2, 2]))
    >>> print(np.mean(heights.label == 2))
    0.5
    """

    distance: Float[np.ndarray, " segments"]
    ground: Float[np.ndarray, " segments"]
    slope: Float[np.ndarray, " segments"]
    canopy: Float[np.ndarray, " segments"]
    label: Int[np.ndarray, " events"]


def photon_ground_and_canopy(
    events: PhotonEvents,
    distance: Float[ArrayLike, " shots"],
    *,
    segment: float = 20.0,
    percentile: float = 98.0,
    background_rate: float | None = None,
    least: int = 5,
) -> PhotonHeights:
    """Return ground and canopy height along a track of photon events, by the density of photons.

    The method uses neither pulse nor dead time: where echoes are strong, both heights have the bias of first
    photons. The few photons of a thin top are lost with the noise, so canopies read low by a metre or so
    under sunlight. Light is taken to travel straight down.

    **Arguments:**

    - `events`: `PhotonEvents` of a track, as `jaxlidar.record` draws them of `Waveforms`.
    - `distance`: (shots,) m along the track of each shot, not all equal.
    - `segment`: length in m over which the ground is a line, positive. Default 20.
    - `percentile`: of the heights of canopy photons that is the canopy's, in [0, 100]. Default 98.
    - `background_rate`: events per second of background, not negative. Default None: estimated from the
      record, which then must be mostly background: see `PhotonCounter.window`.
    - `least`: fewest photons of a ground, or a canopy, an integer of at least 2. Default 5.

    **Returns:** a `PhotonHeights`.

    **Raises:** ValueError for inadmissible arguments, TypeError for `events` of another kind.

    **Source:** Neuenschwander and Pitts (2019), Remote Sens. Environ. 221, 247, for noise and canopy; Kraus
    and Pfeifer (1998), ISPRS J. Photogramm. 53, 193, for the ground.

    **Example:** flat ground at 3 m, by day.

    >>> import inversion, jax, jaxlidar as jl, numpy as np
    >>> lidar = jl.Lidar(wavelength=532.0, energy=3e-10, pulse=jl.GaussianPulse(1.5))
    >>> survey = jl.Survey.track(lidar, start=(0, 0), end=(60, 0), spacing=0.7)
    >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(height=3.0)), key=jax.random.key(0))
    >>> sun = jl.PhotonCounter(background_rate=2e6, window=(-300.0, 300.0))
    >>> events = jl.record(many, receiver=sun, mode="photons", key=jax.random.key(1))
    >>> heights = inversion.photon_ground_and_canopy(events, survey.position[:, 0])
    >>> print(f"{np.mean(heights.ground):.1f} m, {np.isfinite(heights.canopy).sum()} segments with canopy")
    3.0 m, 0 segments with canopy
    """
    check_kind("events", events, PhotonEvents, "PhotonEvents")
    check_range("distance", distance)
    check_range("segment", segment, 0.0, low_open=True)
    check_range("percentile", percentile, 0.0, 100.0)
    least = check_integer("least", least, 2)
    if background_rate is not None:
        check_range("background_rate", background_rate, 0.0)
    along = as_numpy(distance, "distance")
    if along.shape != (len(events.lost),) or np.ptp(along) == 0:
        raise ValueError(
            f"distance has shape {along.shape}; admissible is one for each of the {len(events.lost)} shots "
            "of events, which do not all lie at one place"
        )
    start, length = along.min(), np.ptp(along)
    # A track of a whole number of segments has no further one by rounding.
    n_segments = int(np.ceil(length / segment * (1 - 1e-9)))
    middle = start + segment * (np.arange(n_segments) + 0.5)
    x, z = along[events.shot], events.height
    number = np.clip(((x - start) / segment).astype(int), 0, n_segments - 1)
    if background_rate is None:
        density = _background_density(x - start, z, length, events.window)
    else:
        rate_per_metre = 1e-9 * background_rate * 2.0 / SPEED_OF_LIGHT
        density = rate_per_metre * len(along) * events.pulses / length

    is_signal = _count_neighbours(x, z) >= _fewest_neighbours(density)
    # Lines pass through the middle of their segments, where height and slope are least correlated.
    x_local = x - middle[number]
    ground, slope = _fit_ground(x_local[is_signal], z[is_signal], number[is_signal], n_segments)
    above = z - ground[number] - slope[number] * x_local
    is_near = is_signal & (np.abs(above) <= _GROUND_RANGE)
    has_ground = np.bincount(number[is_near], minlength=n_segments) >= least
    ground, slope = np.where(has_ground, ground, np.nan), np.where(has_ground, slope, np.nan)
    is_canopy = is_signal & (above >= _CANOPY_CLEARANCE) & has_ground[number]
    label = np.select(
        [is_near & has_ground[number], is_canopy, is_signal], [_GROUND, _CANOPY, _OTHER_SIGNAL], _NOISE
    )
    return PhotonHeights(
        distance=middle,
        ground=ground,
        slope=slope,
        canopy=_percentiles(above[is_canopy], number[is_canopy], n_segments, percentile, least),
        label=label,
    )


def _background_density(x: np.ndarray, z: np.ndarray, length: float, window: np.ndarray) -> float:
    """Background events per square metre of track and height: the mean of cells without signal.

    Sigma clipping of the counts n of cells, Poisson distributed: from the mean m of all cells, the mean of
    those with n <= m + 3 sqrt(m), again and again.
    """
    low, high = window.min(), window.max()
    shape = [max(1, round(size / _CELL_HEIGHT)) for size in (4.0 * length / _ALONG, high - low)]
    counts, _, _ = np.histogram2d(x, z, bins=shape, range=[[0.0, length], [low, high]])
    mean = counts.mean()
    for _ in range(_CLIP_ITERATIONS):
        mean = counts[counts <= mean + _CLIP * np.sqrt(mean)].mean()
    return float(mean * counts.size / (length * (high - low)))


def _fewest_neighbours(density: float) -> float:
    """Fewest neighbours of signal, by the Poisson distribution of those of background."""
    expected = np.pi * _ALONG * _HIGH * density
    return max(float(stats.poisson.isf(_FALSE_ALARM, expected)) + 1.0, _FEWEST_NEIGHBOURS)


def _count_neighbours(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Number of other photons within the ellipse around each photon."""
    if x.size == 0:
        return np.zeros(0)
    scaled = np.stack([x / _ALONG, z / _HIGH], axis=1)
    return spatial.KDTree(scaled).query_ball_point(scaled, 1.0, return_length=True) - 1


def _fit_ground(
    x: np.ndarray, z: np.ndarray, number: np.ndarray, n_segments: int
) -> tuple[np.ndarray, np.ndarray]:
    """Height at x = 0 and slope of the ground in each segment; arbitrary in segments without photons.

    Weighted least squares of z = height + slope x, all segments at once, each iteration on the residuals of
    the last one:

    1. Start from a low percentile of the heights, without slope.
    2. Weights: first those that sink through the canopy, at the end one for photons near the line.
    3. Solve the 2 x 2 normal equations of each segment for corrections of height and slope.
    """
    height, slope = _percentiles(z, number, n_segments, _START_PERCENTILE, 1), np.zeros(n_segments)
    height = np.nan_to_num(height)
    for iteration in range(_ITERATIONS):
        residual = z - height[number] - slope[number] * x
        if iteration < _WEIGHTED_ITERATIONS:
            half_weight = np.where(residual > 0, _HALF_WEIGHT_ABOVE, _HALF_WEIGHT_BELOW)
            weight = 1.0 / (1.0 + (residual / half_weight) ** 4)
        else:
            weight = (np.abs(residual) <= _GROUND_RANGE).astype(float)
        w, wx, wxx, wr, wxr = (
            np.bincount(number, weight * a, n_segments)
            for a in (np.ones_like(x), x, x * x, residual, x * residual)
        )
        # One is added to the sum of w x^2: a prior that the slope does not change, of the weight of a photon
        # 1 m from the middle. It fixes the slope of segments in which x hardly varies.
        determinant = w * wxx - wx**2 + w
        w = np.maximum(w, 1e-300)
        slope_change = (w * wxr - wx * wr) / np.maximum(determinant, 1e-300)
        slope = slope + slope_change
        height = height + (wr - slope_change * wx) / w
    return height, slope


def _percentiles(
    z: np.ndarray, number: np.ndarray, n_segments: int, percentile: float, least: int
) -> np.ndarray:
    """Percentile of the values of each segment, as `numpy.percentile`; NaN for fewer than `least` values.

    All values are sorted once, by segment and size; a segment's percentile then lies at a position known from
    its count.
    """
    order = np.lexsort((z, number))
    count = np.bincount(number, minlength=n_segments)
    filled = np.flatnonzero(count >= least)
    first = (np.cumsum(count) - count)[filled]
    position = first + 0.01 * percentile * (count[filled] - 1)
    low = np.floor(position).astype(int)
    high = np.minimum(low + 1, max(z.size - 1, 0))
    z = z[order]
    percentiles = np.full(n_segments, np.nan)
    percentiles[filled] = z[low] + (position - low) * (z[high] - z[low])
    return percentiles
