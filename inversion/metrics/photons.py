"""Ground and canopy in the events of a photon counter, without a model of the scene.

Three steps, each a simple published one:

1. Noise is told by density: by the number of neighbours of each photon, as DRAGANN does (Neuenschwander and
   Pitts 2019), within an ellipse that is wider than high (Zhang and Kerekes 2015). A photon is signal where
   background alone would give as many in one case of a thousand, by the Poisson distribution.
2. The ground of a segment of the track is a straight line, fitted with weights that fall off quickly above it
   and slowly below, so that it sinks through the canopy (Kraus and Pfeifer 1998); at the end, a fit of what
   lies within a metre.
3. The canopy's height is a percentile, ATL08's 98th, of the heights above that line of what lies two metres
   above it and more (Neuenschwander and Pitts 2019).

Sources: Kraus and Pfeifer (1998), ISPRS J. Photogramm. 53, 193; Neuenschwander and Pitts (2019), Remote Sens.
Environ. 221, 247; Zhang and Kerekes (2015), IEEE Geosci. Remote Sens. Lett. 12, 726.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float, Int
from scipy import spatial, stats

from jaxlidar import SPEED_OF_LIGHT, PhotonEvents
from jaxlidar.extend import check_integer, check_kind, check_range

# Half-axes of the ellipse in m: along the track, in height.
_ALONG, _HIGH = 10.0, 3.0
# How often background alone may seem to be signal, and the fewest neighbours of signal.
_FALSE_ALARM, _NEIGHBOURS = 1e-3, 3
# Height in m of the cells in which background is counted, and from how many standard deviations above their
# mean on they hold signal.
_CELL, _CLIP = 5.0, 3.0
# Residuals in m at which weights are a half, above the ground (Kraus and Pfeifer's) and below.
_ABOVE, _BELOW = 1.0, 5.0
# Ground lies within, canopy beyond so many metres of the line.
_GROUND, _CANOPY = 1.0, 2.0


class PhotonHeights(NamedTuple):
    """Ground and canopy of the segments of a track; NaN where there were too few photons.

    - `distance`: (segments,) m along the track, of the middle of each segment.
    - `ground`: (segments,) m, height of the ground there.
    - `slope`: (segments,) rise of the ground per metre along the track.
    - `canopy`: (segments,) m, height of the canopy above the ground.
    - `label`: (events,) 0 for noise, 1 for ground, 2 for canopy, and 3 for signal that is neither: between
      the two, below the ground, or in a segment without ground.

    **Example:** the share of the photons that were taken for canopy.

    >>> import inversion, numpy as np
    >>> one = np.array([10.0])
    >>> found = inversion.PhotonHeights(one, one, one, one, label=np.array([0, 1, 2, 2]))
    >>> print(np.mean(found.label == 2))
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
    """Ground and canopy height along a track of photon events, by the density of photons.

    It knows neither pulse nor dead time: where echoes are strong, both heights have the bias of first
    photons. The few photons of a thin top are lost with the noise, so canopies read low by a metre or so
    under sunlight. Light is taken to come straight down.

    **Arguments:**

    - `events`: `PhotonEvents` of a track, as `jaxlidar.record` draws them of `Waveforms`.
    - `distance`: (shots,) m along the track of each shot; they span more than nothing.
    - `segment`: length in m over which the ground is a line, positive. Default 20.
    - `percentile`: of the heights of canopy photons that is the canopy's, in [0, 100]. Default 98.
    - `background_rate`: events per second of background, not negative. Default None: found in the record,
      which then must be mostly background: see `PhotonCounter.window`.
    - `least`: photons that a ground, or a canopy, has at least, an integer of at least 2. Default 5.

    **Returns:** a `PhotonHeights`.

    **Raises:** ValueError for inadmissible arguments, TypeError for things of another kind.

    **Source:** Neuenschwander and Pitts (2019), Remote Sens. Environ. 221, 247, for noise and canopy; Kraus
    and Pfeifer (1998), ISPRS J. Photogramm. 53, 193, for the ground.

    **Example:** flat ground at 3 m, by day.

    >>> import inversion, jax, jaxlidar as jl, numpy as np
    >>> lidar = jl.Lidar(wavelength=532.0, energy=3e-10, pulse=jl.GaussianPulse(1.5))
    >>> survey = jl.Survey.track(lidar, start=(0, 0), end=(60, 0), spacing=0.7)
    >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(height=3.0)), key=jax.random.key(0))
    >>> sun = jl.PhotonCounter(background_rate=2e6, window=(-300.0, 300.0))
    >>> events = jl.record(many, receiver=sun, mode="photons", key=jax.random.key(1))
    >>> found = inversion.photon_ground_and_canopy(events, survey.position[:, 0])
    >>> print(f"{np.mean(found.ground):.1f} m, {np.isfinite(found.canopy).sum()} segments with canopy")
    3.0 m, 0 segments with canopy
    """
    check_kind("events", events, PhotonEvents, "PhotonEvents")
    check_range("distance", distance)
    check_range("segment", segment, 0.0, low_open=True)
    check_range("percentile", percentile, 0.0, 100.0)
    least = check_integer("least", least, 2)
    along = np.asarray(distance, float)
    if along.shape != (len(events.lost),) or np.ptp(along) == 0:
        raise ValueError(
            f"distance has shape {along.shape}; admissible is one for each of the {len(events.lost)} shots "
            "of events, which do not all lie at one place"
        )
    start = along.min()
    segments = int(np.ceil(np.ptp(along) / segment * (1 - 1e-9)))
    middle = start + segment * (np.arange(segments) + 0.5)
    x, z = along[events.shot], events.height
    number = np.clip(((x - start) / segment).astype(int), 0, segments - 1)
    if background_rate is None:
        density = _background(x - start, z, np.ptp(along), events.window)
    else:
        check_range("background_rate", background_rate, 0.0)
        per_metre = 1e-9 * background_rate * 2.0 / SPEED_OF_LIGHT
        density = per_metre * len(along) * events.pulses / np.ptp(along)

    is_signal = _neighbours(x, z) >= _fewest(density)
    local = x - middle[number]
    ground, slope = _lines(local[is_signal], z[is_signal], number[is_signal], segments)
    above = z - ground[number] - slope[number] * local
    near = is_signal & (np.abs(above) <= _GROUND)
    enough = np.bincount(number[near], minlength=segments) >= least
    ground, slope = np.where(enough, ground, np.nan), np.where(enough, slope, np.nan)
    high = is_signal & (above >= _CANOPY) & enough[number]
    label = np.select([near & enough[number], high, is_signal], [1, 2, 3], 0)
    return PhotonHeights(
        distance=middle,
        ground=ground,
        slope=slope,
        canopy=_percentiles(above[high], number[high], segments, percentile, least),
        label=label,
    )


def _background(x: np.ndarray, z: np.ndarray, length: float, window: np.ndarray) -> float:
    """Events of background per square metre of track and height: the mean of cells that are not too full."""
    low, high = window.min(), window.max()
    shape = [max(1, round(size / _CELL)) for size in (4.0 * length / _ALONG, high - low)]
    counts, _, _ = np.histogram2d(x, z, bins=shape, range=[[0.0, length], [low, high]])
    mean = counts.mean()
    for _ in range(30):
        mean = counts[counts <= mean + _CLIP * np.sqrt(mean)].mean()
    return float(mean * counts.size / (length * (high - low)))


def _fewest(density: float) -> float:
    """The number of neighbours from which on a photon is signal."""
    expected = np.pi * _ALONG * _HIGH * density
    return max(float(stats.poisson.isf(_FALSE_ALARM, expected)) + 1.0, _NEIGHBOURS)


def _neighbours(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """How many others lie within the ellipse around each photon."""
    if x.size == 0:
        return np.zeros(0)
    scaled = np.stack([x / _ALONG, z / _HIGH], axis=1)
    return spatial.KDTree(scaled).query_ball_point(scaled, 1.0, return_length=True) - 1


def _lines(x: np.ndarray, z: np.ndarray, number: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Height at x = 0 and slope of the ground of each segment; of any kind where there are no photons."""
    height, slope = _percentiles(z, number, segments, 10.0, 1), np.zeros(segments)
    height = np.nan_to_num(height)
    for step in range(40):
        above = z - height[number] - slope[number] * x
        if step < 30:
            weight = 1.0 / (1.0 + (above / np.where(above > 0, _ABOVE, _BELOW)) ** 4)
        else:
            weight = (np.abs(above) <= _GROUND).astype(float)
        total, wx, wxx, wr, wxr = (
            np.bincount(number, weight * a, segments) for a in (np.ones_like(x), x, x * x, above, x * above)
        )
        # As much as a photon a metre away says that the slope stays: it is known where x hardly varies.
        spread = total * wxx - wx**2 + total
        total = np.maximum(total, 1e-300)
        turn = (total * wxr - wx * wr) / np.maximum(spread, 1e-300)
        slope = slope + turn
        height = height + (wr - turn * wx) / total
    return height, slope


def _percentiles(z: np.ndarray, number: np.ndarray, segments: int, q: float, least: int) -> np.ndarray:
    """A percentile of each segment, between neighbours by a straight line; NaN where there are too few."""
    order = np.lexsort((z, number))
    count = np.bincount(number, minlength=segments)
    some = np.flatnonzero(count >= least)
    place = (np.cumsum(count) - count)[some] + 0.01 * q * (count[some] - 1)
    low = np.floor(place).astype(int)
    high = np.minimum(low + 1, max(z.size - 1, 0))
    z = z[order]
    found = np.full(segments, np.nan)
    found[some] = z[low] + (place - low) * (z[high] - z[low])
    return found
