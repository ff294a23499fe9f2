r"""Ground and canopy in the events of a photon counter, without a model of the scene.

1. **Dense surface.** In cells of 20 m by 1 m, slabs of 4 m are compared with the background: n photons
   where e are expected have the log-likelihood ratio n ln(n / e) - n + e. The path of slabs that maximises
   its sum, with a cost per metre of change, is the densest surface: the top of a canopy, or open ground.
2. **Ground.** Below or on that surface, at the height z in cells of 10 m, the rate of photons per metre is

       b + N_g g_w(h - z) + sum_k N_k c_k,w(h - z)

   with the background b, the Gaussian g_w of the ground's echo and hat functions c_k,w above it, which make
   up a canopy of any profile. The echo's standard deviation w is unknown too: a slope spreads ground and
   canopy over the heights that the footprint meets. The slope across the track is not seen, so widths are
   tried, and those far from what the slope along the track gives are unlikely. Low plants widen the echo as
   well, and one track cannot tell both: the standard error has the height between the two explanations.
   For each z and w the numbers N are those that maximise the likelihood, with a Dirichlet prior that the
   ground is not without light (expectation maximisation). As each further number makes any fit better, the
   likelihood is the one integrated over the numbers, by Laplace's method with the prior 1 / N: the maximum
   times prod_k (1 + N_k)^-1/2. Ground heights of neighbouring cells differ as a Laplace distribution with
   rare jumps, and widths hardly: a hidden Markov model, whose forward-backward recursion gives mean and
   standard deviation of the ground in each cell. It is run twice, about the smoothed surface of the pass
   before, so that the ground may bend.
3. **Signal.** The neighbours of a photon are those within an ellipse along the ground that is wider than high
   (Zhang and Kerekes 2015). By background alone their number is Poisson distributed. A photon is signal where
   that number or more occur in less than one case of ten thousand (compare DRAGANN, Neuenschwander and
   Pitts 2019). The background is that of the cells about it.
4. **Canopy.** There is one if more photons of signal clear the ground's echo than the background gives. Its
   height is a percentile, ATL08's 98th, of a beta distribution between a base and a top: mean and standard
   deviation over a grid of such distributions, weighted by their likelihood under the background and a prior.
   The percentile of the sample is too low where photons are few: of 20, the highest is at the 95th on
   average.

**Source:** Neuenschwander and Pitts (2019), Remote Sens. Environ. 221, 247; Zhang and Kerekes (2015), IEEE
Geosci. Remote Sens. Lett. 12, 726; Rabiner (1989), Proc. IEEE 77, 257, for the recursion.
"""

import functools
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import ArrayLike, Float, Int, Shaped

from inversion.fit.quality import Verdict
from jaxlidar import SPEED_OF_LIGHT
from jaxlidar.extend import as_numpy, check_integer, check_kind, check_range
from jaxlidar.formats.icesat2 import PhotonTrack
from jaxlidar.sensors.photon_counter import PhotonEvents

# Half-axes of the ellipse in m: along the track, in height.
_ALONG, _HIGH = 10.0, 3.0
# Probability that background alone passes for signal, and the fewest neighbours of signal.
_FALSE_ALARM, _FEWEST_NEIGHBOURS = 1e-4, 3
# Probabilities that background alone passes for ground, of which many places are searched; for canopy; and
# for photons below the ground.
_FALSE_GROUND, _FALSE_CANOPY, _FALSE_DEPTH = 1e-4, 1e-3, 1e-3
# Probability that background alone gives as many photons as a good ground has, anywhere in the window.
_FALSE_GOOD = 1e-5
# Height in m of the cells in which background is counted. Cells this many standard deviations above the mean
# hold signal.
_CELL_HEIGHT, _CLIP, _CLIP_ITERATIONS = 5.0, 3.0, 30
# Local background: counted below and above these distances from the dense surface in m, over the cells of
# this length, if so much height remains. Least background per square metre: strays are no ground.
_SURFACE_DEPTH, _SURFACE_HEIGHT, _BACKGROUND_LENGTH = 45.0, 45.0, 100.0
_MIN_BACKGROUND_HEIGHT, _LEAST_BACKGROUND = 20.0, 1e-3
# Dense surface: length and height of the cells, height of the slabs, and change in m that costs as much as a
# factor e in likelihood.
_SURFACE_CELL, _SURFACE_STEP, _SLAB, _SURFACE_CHANGE = 20.0, 1.0, 4, 4.0
_CENTRING_PASSES = 3
# Least log-likelihood ratio of a slab with light, and the weight of cells without any in smooth surfaces.
_LEAST_EVIDENCE, _EMPTY_WEIGHT = 5.0, 1e-3
# Ground: length of the cells in m; standard deviations of the echo in m, from that of level ground to that of
# a slope of 20 degrees; changes of the width between cells, in steps of these, with which the probability
# falls by a factor e; least spread of hat functions in m.
_GROUND_CELL, _ECHO_WIDTHS, _WIDTH_CHANGE, _LEAST_SPREAD = 10.0, (0.3, 0.45, 0.7, 1.0), 0.5, 0.05
# Radius (one standard deviation) of the footprint in m; what a slope that is not seen along the track costs
# in log-likelihood for each cell, as low plants look like one. The share (2 / n)^1/2 of the variance of the
# echo is uncertain, for n photons in the cells on either side, but not more than 200.
_FOOTPRINT, _UNSEEN_COST, _WIDTH_NEIGHBOURS, _MOST_PHOTONS = 2.75, 10.0, 3, 200
# Foot of low plants below the middle of an echo that they widen, in standard deviations that they add, for a
# parabolic profile from the ground to D: a mean of D / 2 over a deviation of D / sqrt(20).
_FOOT_SIGMAS = np.sqrt(5.0)
# Middles of the hat functions in m above the ground; strength of the prior; power of the integrated
# likelihood; iterations of expectation maximisation.
_HATS = (1.5, 3.5, 6.0, 9.0, 12.5, 16.5, 21.0, 26.0, 32.0)
_GROUND_PRIOR, _LAPLACE, _EXPECTATIONS = 0.2, 0.5, 25
# Heights above the ground in m for which the echo and the hat functions are tabulated, and their step.
_TABLE_RANGE, _TABLE_STEP = (-6.0, 50.0), 0.01
# Offsets from the surface in m that are tried in the two passes: lowest, highest, step.
_OFFSETS = ((-40.0, 3.0, 0.25), (-4.0, 4.0, 0.1))
# Scale in m of the changes of the ground against a smooth surface between cells, and probability of a jump.
_GROUND_CHANGE, _JUMP = 0.3, 1e-4
# Length in m over which surfaces are smoothed between the passes, and the standard error in m at which a
# height has half of its weight.
_SMOOTHING_LENGTH, _CERTAIN_ERROR = 30.0, 0.5
# Largest distance of ground photons from the ground, and least height of canopy above it, in standard
# deviations of the ground's echo; the latter is also at least so many m.
_RANGE_SIGMAS, _CLEARANCE_SIGMAS, _CANOPY_CLEARANCE = 2.5, 3.0, 1.0
# Error of the ground in m beside that of the recursion. Grounds of larger errors than the limit are doubtful:
# good ones are to be within 1 m, two standard errors. So are those of fewer photons than these.
_MODEL_ERROR, _DOUBTFUL_ERROR, _DOUBTFUL_PHOTONS = 0.1, 0.5, 3
# Photons just above the echo, over those in it, from which on the ground may be a part of a canopy.
_DOUBTFUL_EXCESS = 0.5
# Depths below the ground in which photons are counted: the least in m, steps of so many m, and their number;
# and the segments on either side that are counted with each.
_LEAST_DEPTH, _DEPTH_STEP, _DEPTH_STEPS, _DEPTH_NEIGHBOURS = 1.0, 1.0, 11, 2
# A ground that dense plants hide: its shares of the light, slabs below the echo in which it may lie (from so
# many standard deviations down, in steps of depth), segments on either side, and odds from which on the echo
# may be that of plants.
_HIDDEN_SHARES, _HIDDEN_SIGMAS, _HIDDEN_SLABS, _HIDDEN_NEIGHBOURS = (0.05, 0.1), 2.0, 2, 4
_HIDDEN_ODDS = 0.5
# Beta distributions of canopy: means and sums of their two parameters, bases over tops, and tops over the
# percentile of the sample. Power of the top with which the prior falls, so that even canopies under sunlight
# do not read high, and the error by other profiles (two layers) as a share of the height.
_BETA_MEANS, _BETA_SUMS = np.arange(0.2, 0.81, 0.1), np.array([2.0, 3.0, 4.5, 7.0])
_BASES, _TOPS, _TOP_PRIOR, _PROFILE_ERROR = (0.0, 0.3, 0.6), np.linspace(0.7, 2.0, 53), 3.0, 0.04
# Signal photons in a segment, over the fewest of a ground, with which its lower edge is the ground.
_RICH_SIGNAL = 4.0
# Length in m of the segments of ATL03. Segments that are printed.
_PRODUCT_SEGMENT, _PRINTED_SEGMENTS = 20.0, 20
# Labels of photons.
_NOISE, _GROUND, _CANOPY, _OTHER_SIGNAL = 0, 1, 2, 3


class PhotonHeights(NamedTuple):
    """Ground and canopy of the segments of a track; NaN in segments with too few photons.

    - `distance`: (segments,) m along the track, of the middle of each segment.
    - `ground`: (segments,) m, height of the ground there.
    - `slope`: (segments,) rise of the ground per metre along the track.
    - `canopy`: (segments,) m, height of the canopy above the ground: a percentile of a distribution that is
      fitted to its photons, without what the slope in a footprint adds. ATL08's is that of the photons.
    - `label`: (events,) 0 for noise, 1 for ground, 2 for canopy, and 3 for signal that is neither: between
      the two, below the ground, or in a segment without ground.
    - `ground_stderr`, `canopy_stderr`: (segments,) m, standard errors.
    - `quality`: (segments,) "good", "doubtful", or "bad" for a segment without ground.
    - `reasons`: a text for each segment, empty for a good one.
    - `segment_id`: (segments,) the product's numbers of the segments of a `PhotonTrack`; else 0, 1, ...

    **Example:** the fraction of the photons that were taken for canopy.

    >>> import inversion, numpy as np
    >>> segment = np.array([10.0])
    >>> from inversion.metrics.photons import PhotonHeights
    >>> heights = PhotonHeights(segment, segment, segment, segment, label=np.array([0, 1, 2, 2]))
    >>> print(np.mean(heights.label == 2))
    0.5
    """

    distance: Float[np.ndarray, " segments"]
    ground: Float[np.ndarray, " segments"]
    slope: Float[np.ndarray, " segments"]
    canopy: Float[np.ndarray, " segments"]
    label: Int[np.ndarray, " events"]
    ground_stderr: Float[np.ndarray, " segments"] = np.zeros(0)
    canopy_stderr: Float[np.ndarray, " segments"] = np.zeros(0)
    quality: Shaped[np.ndarray, " segments"] = np.zeros(0, str)
    reasons: tuple[str, ...] = ()
    segment_id: Int[np.ndarray, " segments"] = np.zeros(0, int)

    def __str__(self) -> str:
        """Return a line for each segment, of at most twenty."""
        lines = ["distance   ground    s.e.   canopy    s.e.  quality"]
        for i in range(min(len(self.distance), _PRINTED_SEGMENTS)):
            numbers = (self.ground[i], self.ground_stderr[i], self.canopy[i], self.canopy_stderr[i])
            ground, ground_error, canopy, canopy_error = ("-" if np.isnan(x) else f"{x:.2f}" for x in numbers)
            lines.append(
                f"{self.distance[i]:8.1f} {ground:>8} {ground_error:>7} {canopy:>8} {canopy_error:>7}  "
                f"{self.quality[i]} {self.reasons[i]}".rstrip()
            )
        if len(self.distance) > _PRINTED_SEGMENTS:
            lines.append(f"... {len(self.distance) - _PRINTED_SEGMENTS} more segments")
        return "\n".join(lines)


def photon_ground_and_canopy(
    events: PhotonEvents | PhotonTrack,
    distance: Float[ArrayLike, " shots"] | None = None,
    *,
    segment: float = 20.0,
    percentile: float = 98.0,
    background_rate: float | None = None,
    least: int = 5,
) -> PhotonHeights:
    """Return ground and canopy height along a track of photon events, by the density of photons.

    The method uses neither pulse nor dead time: where echoes are strong, both heights have the bias of first
    photons. Light is taken to travel straight down. Slopes may be up to 20 degrees, in any direction: the
    width of the ground's echo is estimated with its height, for footprints like those of ICESat-2. A slope
    across the track and plants of 1 to 4 m widen it alike: the standard error holds both, so that most
    grounds on more than 10 degrees are "doubtful". So is an echo without canopy below which a twentieth or a
    tenth of the light may come from a ground that plants hide. Under a canopy that lets hardly any photon
    reach the ground, the ground is the lower edge of what returns, and "doubtful" if the canopy goes on above
    it. Where no surface is certain, a ground is "good" if background alone would hardly give as many photons
    anywhere in the window.

    **Arguments:**

    - `events`: a `PhotonTrack` of `jaxlidar.io.read_atl03`, or `PhotonEvents` of a track, as
      `jaxlidar.record` draws them of `Waveforms`.
    - `distance`: (shots,) m along the track of each shot, not all equal. Needed for `PhotonEvents`; photons
      of a `PhotonTrack` have theirs.
    - `segment`: length in m over which the ground is given, positive. Default 20: those of a `PhotonTrack`
      are then its geolocation segments, and rows are those of ATL08 at 20 m.
    - `percentile`: of the heights of canopy photons that is the canopy's, in [0, 100]. Default 98.
    - `background_rate`: events per second of background, not negative. Default None: estimated from the
      record about each place, which then must be mostly background: see `PhotonCounter.window`.
    - `least`: fewest photons of a canopy, an integer of at least 2. Default 5. A ground needs three, and more
      than the background gives.

    **Returns:** a `PhotonHeights`.

    **Raises:** ValueError for inadmissible arguments, TypeError for `events` of another kind.

    **Source:** Neuenschwander and Pitts (2019), Remote Sens. Environ. 221, 247, for noise and canopy; the
    ground by a hidden Markov model, as in the module's docstring.

    **Example:** flat ground at 3 m, by day.

    >>> import inversion, jax, jaxlidar as jl, numpy as np
    >>> lidar = jl.Lidar(wavelength=532.0, energy=3e-10, pulse=jl.GaussianPulse(1.5))
    >>> survey = jl.Survey.track(lidar, start=(0, 0), end=(60, 0), spacing=0.7)
    >>> many = jl.simulate_many(survey, jl.Scene(ground=jl.Ground(height=3.0)), key=jax.random.key(0))
    >>> sun = jl.PhotonCounter(background_rate=2e6, window=(-300.0, 300.0))
    >>> events = sun.count(many, key=jax.random.key(1))
    >>> heights = inversion.photon_ground_and_canopy(events, survey.position[:, 0])
    >>> print(f"{np.mean(heights.ground):.1f} m, {np.isfinite(heights.canopy).sum()} segments with canopy")
    3.0 m, 0 segments with canopy
    """
    check_kind("events", events, PhotonEvents | PhotonTrack, "PhotonEvents or a PhotonTrack")
    if distance is not None:
        check_range("distance", distance)
    check_range("segment", segment, 0.0, low_open=True)
    check_range("percentile", percentile, 0.0, 100.0)
    least = check_integer("least", least, 2)
    if background_rate is not None:
        check_range("background_rate", background_rate, 0.0)
    if isinstance(events, PhotonTrack):
        photons = _photons_of_track(events, distance, background_rate)
        is_of_product = segment == _PRODUCT_SEGMENT
        starts = (
            events.segment_start if is_of_product else photons.start + _even_starts(photons.length, segment)
        )
        lengths = np.full(starts.shape, float(segment))
        if is_of_product:
            is_stated = np.isfinite(events.segment_length) & (events.segment_length > 0)
            lengths = np.where(is_stated, events.segment_length, lengths)
        identifiers = events.segment_id if is_of_product else np.arange(starts.size)
    else:
        photons = _photons_of_events(events, distance, background_rate)
        starts = photons.start + _even_starts(photons.length, segment)
        lengths, identifiers = np.full(starts.shape, float(segment)), np.arange(starts.size)
    middle = starts + 0.5 * lengths
    number = np.clip(np.searchsorted(starts, photons.x, side="right") - 1, 0, starts.size - 1)

    surface = _dense_surface(photons)
    background = _local_background(photons, surface)
    curve = _ground_curve(photons, surface, background)
    above = photons.z - curve.height_at(photons.x)
    expected = background.density_at(middle)
    slope = curve.slope_at(middle, lengths)
    is_signal = _count_neighbours(photons.x, above) >= _fewest_neighbours(background.density_at(photons.x))

    # Ground: more photons in its echo than the background gives.
    n_segments = starts.size
    echo_width = curve.width_at(middle, lengths)
    ground_range = _RANGE_SIGMAS * echo_width
    is_near = np.abs(above) <= ground_range[number]
    near = np.bincount(number[is_near], minlength=n_segments)
    by_background = expected * lengths * 2.0 * ground_range
    fewest = np.maximum(scipy.stats.poisson.isf(_FALSE_GROUND, by_background) + 1.0, _DOUBTFUL_PHOTONS)
    # Good ground: where the dense surface has more photons than background gives any slab of the window, the
    # test for one place is enough. Elsewhere the count must be rare over all places.
    slab, window = _SLAB * _SURFACE_STEP, float(np.ptp(photons.window))
    at_surface = np.abs(photons.z - surface.height_at(photons.x)) <= 0.5 * slab
    surface_count = np.bincount(number[at_surface], minlength=n_segments)
    is_certain = surface_count >= _rare_count(expected * lengths * slab, window / slab)
    rare = _rare_count(by_background, window / (2.0 * ground_range))
    fewest_good = np.where(is_certain, fewest, rare)
    signal_count = np.bincount(number[is_signal & (above > -ground_range[number])], minlength=n_segments)
    # Below a canopy of many photons the lower edge counts as ground, if a doubtful one.
    has_ground = (near >= fewest) | (signal_count >= _RICH_SIGNAL * fewest)

    # Canopy: what clears the ground's echo, and is more than the background gives.
    clearance = np.maximum(_CANOPY_CLEARANCE, _CLEARANCE_SIGMAS * echo_width)
    # A height over the ground needs some photon of the ground.
    is_canopy = is_signal & (above >= clearance[number]) & (has_ground & (near >= 1))[number]
    sample_height, count = _percentiles(above[is_canopy], number[is_canopy], n_segments, percentile, least)
    # Its median tells how deep it is: the percentile may be a stray's.
    median, _ = _percentiles(above[is_canopy], number[is_canopy], n_segments, 50.0, least)
    background_count = expected * lengths * np.maximum(np.nan_to_num(median) - clearance, 0.0)
    fewest_canopy = scipy.stats.poisson.isf(_FALSE_CANOPY, background_count) + 1.0
    has_canopy = np.isfinite(sample_height) & (count >= fewest_canopy)
    is_canopy &= has_canopy[number]
    is_ground = is_signal & is_near & has_ground[number]
    label = np.select([is_ground, is_canopy, is_signal], [_GROUND, _CANOPY, _OTHER_SIGNAL], _NOISE)

    # A canopy that goes on down to the ground hides its echo: where many photons lie just above the echo, the
    # ground may be a part of that layer. At most it is so in half of all cases, and then lies a range higher.
    is_just_above = (above > ground_range[number]) & (above <= 3.0 * ground_range[number])
    just_above = np.bincount(number[is_just_above], minlength=n_segments)
    excess = np.maximum(just_above - by_background, 0.0) / np.maximum(near - by_background, 1.0)
    model_error = _MODEL_ERROR + np.sqrt(0.5) * ground_range * np.minimum(excess, 1.0)
    ground_stderr = np.hypot(curve.stderr_at(middle, lengths), model_error)
    # Light from below the ground: there is a deeper one. It is sought in slabs of two steps of depth, over
    # segments about each.
    steps = (-above - np.maximum(_LEAST_DEPTH, _CLEARANCE_SIGMAS * echo_width)[number]) / _DEPTH_STEP
    is_below = (steps >= 0.0) & (steps < _DEPTH_STEPS)
    below = np.bincount(
        number[is_below] * _DEPTH_STEPS + steps[is_below].astype(int), minlength=n_segments * _DEPTH_STEPS
    )
    slabs = np.ones((2 * _DEPTH_NEIGHBOURS + 1, 2))
    below = scipy.signal.convolve2d(below.reshape(n_segments, _DEPTH_STEPS), slabs, mode="same")
    by_depth = _moving_sum(expected * lengths, _DEPTH_NEIGHBOURS) * 2.0 * _DEPTH_STEP
    is_deeper = below.max(axis=1) > scipy.stats.poisson.isf(_FALSE_DEPTH / _DEPTH_STEPS, by_depth)
    # Without a canopy, the echo may be that of low plants, which hide the ground.
    odds = _odds_of_hidden_ground(
        (-above - _HIDDEN_SIGMAS * echo_width[number]) / _DEPTH_STEP,
        number,
        near,
        expected * lengths,
        ground_range,
    )
    is_hidden = ~has_canopy & (odds > _HIDDEN_ODDS)
    verdicts = [
        _verdict(
            bool(has_ground[i]),
            float(ground_stderr[i]),
            int(near[i]),
            float(by_background[i]),
            int(fewest_good[i]),
            bool(is_deeper[i]),
            bool(excess[i] > _DOUBTFUL_EXCESS),
            bool(is_hidden[i]),
        )
        for i in range(n_segments)
    ]
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(n_segments + 1))
    canopy, canopy_stderr = np.full((2, n_segments), np.nan)
    for i in np.flatnonzero(has_canopy):
        canopy[i], canopy_stderr[i] = _canopy_percentile(
            above[order[edges[i] : edges[i + 1]]],
            sample_height[i],
            clearance[i],
            expected[i] * lengths[i],
            np.sqrt(max(echo_width[i] ** 2 - _ECHO_WIDTHS[0] ** 2, 0.0)),
            0.01 * percentile,
        )
    return PhotonHeights(
        distance=middle,
        ground=np.where(has_ground, curve.height_at(middle), np.nan),
        slope=np.where(has_ground, slope, np.nan),
        canopy=canopy,
        label=label,
        ground_stderr=np.where(has_ground, ground_stderr, np.nan),
        canopy_stderr=np.hypot(canopy_stderr, ground_stderr),
        quality=np.array([verdict.quality for verdict in verdicts], str),
        reasons=tuple("; ".join(verdict.reasons) for verdict in verdicts),
        segment_id=np.asarray(identifiers),
    )


# -- photons -----------------------------------------------------------------------------------------------


class _Photons(NamedTuple):
    """Photons of a track.

    - `x`, `z`: (photons,) m along the track and height.
    - `start`, `length`: m, of the track.
    - `window`: heights in m between which photons are recorded.
    - `density`: background per square metre where it is given, else None.
    """

    x: np.ndarray
    z: np.ndarray
    start: float
    length: float
    window: tuple[float, float]
    density: float | None


def _photons_of_events(
    events: PhotonEvents, distance: ArrayLike | None, background_rate: float | None
) -> _Photons:
    if distance is None:
        raise ValueError("distance is None; admissible for PhotonEvents is the distance of each shot in m")
    along = as_numpy(distance, "distance")
    if along.shape != (len(events.lost),) or np.ptp(along) == 0:
        raise ValueError(
            f"distance has shape {along.shape}; admissible is one for each of the {len(events.lost)} shots "
            "of events, which do not all lie at one place"
        )
    length = float(np.ptp(along))
    density = None
    if background_rate is not None:
        density = _per_metre(background_rate) * len(along) * events.pulses / length
    window = (float(events.window.min()), float(events.window.max()))
    return _Photons(along[events.shot], events.height, float(along.min()), length, window, density)


def _photons_of_track(
    track: PhotonTrack, distance: ArrayLike | None, background_rate: float | None
) -> _Photons:
    if distance is not None:
        raise ValueError("distance is given; admissible for a PhotonTrack is None: its photons have theirs")
    density = None
    if background_rate is not None and len(track):
        pulses = int(np.ptp(track.pulse)) + 1
        density = _per_metre(background_rate) * pulses / track.length
    window = (float(track.height.min()), float(track.height.max())) if len(track) else (0.0, 1.0)
    start = float(track.segment_start[0])
    return _Photons(track.distance, track.height, start, track.length, window, density)


def _per_metre(rate: float) -> float:
    """Return events per metre of height and pulse of a rate in events per second."""
    return 1e-9 * rate * 2.0 / SPEED_OF_LIGHT


def _even_starts(length: float, segment: float) -> np.ndarray:
    """Return the starts of segments; a track of a whole number of them has no further one by rounding."""
    return segment * np.arange(max(1, int(np.ceil(length / segment * (1 - 1e-9)))))


def _cells(photons: _Photons, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the cell of each photon, and the middles of the cells, of about `size` m."""
    count = max(1, round(photons.length / size))
    size = photons.length / count
    number = np.clip(((photons.x - photons.start) / size).astype(int), 0, count - 1)
    return number, photons.start + size * (np.arange(count) + 0.5)


# -- dense surface and background --------------------------------------------------------------------------


class _Curve(NamedTuple):
    """Heights at the middles of cells, piecewise linear between them.

    - `x`, `z`: (cells,) m. `stderr`: (cells,) standard errors of the heights in m.
    - `weight`: (cells,) in (0, 1], small where no photons support the height.
    - `width`: (cells,) root mean square of the standard deviation of the ground's echo, in m.
    """

    x: np.ndarray
    z: np.ndarray
    stderr: np.ndarray
    weight: np.ndarray
    width: np.ndarray

    def height_at(self, x: np.ndarray) -> np.ndarray:
        """Interpolate, and extrapolate by the slope of the outermost cells."""
        if self.x.size < 2:
            return np.full(np.shape(x), self.z[0])
        i = np.clip(np.searchsorted(self.x, x) - 1, 0, self.x.size - 2)
        fraction = (x - self.x[i]) / (self.x[i + 1] - self.x[i])
        return self.z[i] + fraction * (self.z[i + 1] - self.z[i])

    def slope_at(self, x: np.ndarray, length: np.ndarray) -> np.ndarray:
        """Return the mean slope over lengths about places."""
        half = 0.5 * np.maximum(length, 2.0 * _GROUND_CELL)
        return (self.height_at(x + half) - self.height_at(x - half)) / (2.0 * half)

    def stderr_at(self, x: np.ndarray, length: np.ndarray) -> np.ndarray:
        """Return the root mean square error over lengths about places: errors of neighbours are alike."""
        return self._rms_at(self.stderr, x, length)

    def width_at(self, x: np.ndarray, length: np.ndarray) -> np.ndarray:
        """Return the root mean square width of the echo over lengths about places."""
        return self._rms_at(self.width, x, length)

    def _rms_at(self, values: np.ndarray, x: np.ndarray, length: np.ndarray) -> np.ndarray:
        offsets = np.linspace(-0.5, 0.5, 5)[:, None] * length
        return np.sqrt(np.mean(np.interp(x + offsets, self.x, values) ** 2, axis=0))


class _Background(NamedTuple):
    """Background per square metre in the cells of a track, at their middles `x`."""

    x: np.ndarray
    density: np.ndarray

    def density_at(self, x: np.ndarray) -> np.ndarray:
        """Interpolate between the middles of cells."""
        return np.interp(x, self.x, self.density)


def _dense_surface(photons: _Photons) -> _Curve:
    """Return the surface of the most photons: step 1 of the module's docstring.

    Each cell takes the height of the largest max-marginal, by forward and backward passes of the max-product
    recursion. With a cost in proportion to the change, a pass is two running maxima.
    """
    number, middle = _cells(photons, _SURFACE_CELL)
    low, high = photons.window
    levels = max(_SLAB, int(np.ceil((high - low) / _SURFACE_STEP)))
    row = np.clip(((photons.z - low) / _SURFACE_STEP).astype(int), 0, levels - 1)
    count = np.bincount(number * levels + row, minlength=middle.size * levels).reshape(-1, levels)
    background = photons.density
    if background is None:
        background = _mean_background(photons)
    area = photons.length / middle.size * _SLAB * _SURFACE_STEP
    expected = max(background, _LEAST_BACKGROUND) * area
    slab = np.stack([np.convolve(cell, np.ones(_SLAB), mode="same") for cell in count])
    ratio = scipy.special.xlogy(slab, slab / expected) - slab + expected
    evidence = np.where(slab > expected, ratio, 0.0)
    cost = _SURFACE_STEP / _SURFACE_CHANGE * np.arange(levels)

    def best_change(score: np.ndarray) -> np.ndarray:
        upward = np.maximum.accumulate(score + cost) - cost
        downward = np.maximum.accumulate((score - cost)[::-1])[::-1] + cost
        return np.maximum(upward, downward)

    forward, backward = np.zeros_like(evidence), np.zeros_like(evidence)
    for k in range(1, middle.size):
        forward[k] = best_change(forward[k - 1] + evidence[k - 1])
        backward[-k - 1] = best_change(backward[-k] + evidence[-k])
    height = low + _SURFACE_STEP * np.argmax(forward + evidence + backward, axis=1)
    at_surface = np.take_along_axis(evidence, np.argmax(forward + evidence + backward, axis=1)[:, None], 1)
    weight = np.where(at_surface[:, 0] > _LEAST_EVIDENCE, 1.0, _EMPTY_WEIGHT)
    zeros = np.zeros(middle.size)
    surface = _Curve(middle, height.astype(float), zeros, weight, zeros)
    for _ in range(_CENTRING_PASSES):
        offset = photons.z - surface.height_at(photons.x)
        near = np.abs(offset) < _SLAB * _SURFACE_STEP
        shift = _percentiles(offset[near], number[near], middle.size, 50.0, 3)[0]
        surface = surface._replace(z=surface.z + np.nan_to_num(shift))
    return surface


def _mean_background(photons: _Photons) -> float:
    """Background per square metre of track and height: the mean of cells without signal.

    Sigma clipping of the counts n of cells, Poisson distributed: from the mean m of all cells, the mean of
    those with n <= m + 3 sqrt(m), again and again.
    """
    low, high = photons.window
    shape = [max(1, round(size / _CELL_HEIGHT)) for size in (4.0 * photons.length / _ALONG, high - low)]
    x = photons.x - photons.start
    counts, _, _ = np.histogram2d(x, photons.z, bins=shape, range=[[0.0, photons.length], [low, high]])
    mean = counts.mean()
    for _ in range(_CLIP_ITERATIONS):
        mean = counts[counts <= mean + _CLIP * np.sqrt(mean)].mean()
    return float(mean * counts.size / (photons.length * (high - low)))


def _local_background(photons: _Photons, surface: _Curve) -> _Background:
    """Return the background along the track: as given, or counted well below and above the surface.

    Where the window leaves too little height there, it is the mean of the track.
    """
    number, middle = _cells(photons, _GROUND_CELL)
    if photons.density is not None:
        return _Background(middle, np.full(middle.size, max(photons.density, _LEAST_BACKGROUND)))
    low, high = photons.window
    below = np.maximum(surface.height_at(middle) - _SURFACE_DEPTH - low, 0.0)
    above = np.maximum(high - surface.height_at(middle) - _SURFACE_HEIGHT, 0.0)
    offset = photons.z - surface.height_at(photons.x)
    is_away = (offset < -_SURFACE_DEPTH) | (offset > _SURFACE_HEIGHT)
    count = np.bincount(number[is_away], minlength=middle.size)
    half = max(1, round(0.5 * _BACKGROUND_LENGTH / _GROUND_CELL))
    length = photons.length / middle.size
    area = length * (below + above)
    count, area = _moving_sum(count, half), _moving_sum(area, half)
    is_enough = below + above >= _MIN_BACKGROUND_HEIGHT
    density = np.where(is_enough, count / np.maximum(area, 1e-9), _mean_background(photons))
    return _Background(middle, np.maximum(density, _LEAST_BACKGROUND))


def _moving_sum(values: np.ndarray, half: int) -> np.ndarray:
    """Return the sum of each value and of `half` neighbours on either side, of those that there are."""
    return np.convolve(np.pad(values, half), np.ones(2 * half + 1), mode="valid")


# -- ground ------------------------------------------------------------------------------------------------


def _ground_curve(photons: _Photons, surface: _Curve, background: _Background) -> _Curve:
    """Return the ground along the track: step 2 of the module's docstring."""
    number, middle = _cells(photons, _GROUND_CELL)
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(middle.size + 1))
    length = photons.length / middle.size
    height, stderr, width = surface.height_at(middle), *np.zeros((2, middle.size))
    support = np.interp(middle, surface.x, surface.weight)
    for low, high, step in _OFFSETS:
        # Heights that are not certain bend the smooth surface less.
        weight = np.maximum(support / (1.0 + (stderr / _CERTAIN_ERROR) ** 2), _EMPTY_WEIGHT)
        curve = _Curve(middle, _smoothed(height, weight, length), stderr, weight, width)
        offsets = np.arange(low, high + 0.5 * step, step)
        residual = photons.z - curve.height_at(photons.x)
        evidence = np.array(
            [
                [_log_likelihood(residual[order[a:b]], offsets, float(d), length, w) for w in _ECHO_WIDTHS]
                for a, b, d in zip(edges[:-1], edges[1:], background.density)
            ]
        )
        # The slope that a width implies, less that along the track, is the slope across it.
        implied = np.sqrt(np.square(_ECHO_WIDTHS) - _ECHO_WIDTHS[0] ** 2) / _FOOTPRINT
        along = curve.slope_at(middle, np.full(middle.size, length))[:, None]
        unseen = np.sqrt(np.abs(implied**2 - along**2))
        posterior = _posterior(evidence - _UNSEEN_COST * unseen[..., None], offsets)
        width = np.sqrt(posterior.sum(axis=2) @ np.square(_ECHO_WIDTHS))
        posterior = posterior.sum(axis=1)
        mean = posterior @ offsets
        stderr = np.sqrt(np.maximum(posterior @ offsets**2 - mean**2, 0.0))
        height = curve.z + mean
    is_near = np.abs(photons.z - height[number]) <= _RANGE_SIGMAS * width[number]
    count = _moving_sum(np.bincount(number[is_near], minlength=middle.size), _WIDTH_NEIGHBOURS)
    variance = stderr**2 + _ambiguity(mean, width, along[:, 0], count, _posterior(evidence, offsets), offsets)
    return curve._replace(z=height, stderr=np.sqrt(variance), width=width)


def _ambiguity(
    mean: np.ndarray,
    width: np.ndarray,
    along: np.ndarray,
    count: np.ndarray,
    wide: np.ndarray,
    offsets: np.ndarray,
) -> np.ndarray:
    """Return the mean square error in m^2 by slopes across the track and low plants that look alike.

    Plants above a narrow echo may be the upper half of a wide one. The width that the slope along the track
    does not explain may be that of plants, with the ground at their foot. Each is so in half of all cases.

    **Arguments:** `mean`, `width`: (cells,) m, offset of the ground and width of its echo. `along`: slopes
    along the track. `count`: photons that tell the width. `wide`: (cells, widths, offsets) probabilities
    without a cost of slopes across it.
    """
    widest = np.maximum(width**2, wide.sum(axis=2) @ np.square(_ECHO_WIDTHS))
    explained = _ECHO_WIDTHS[0] ** 2 + (_FOOTPRINT * along) ** 2
    variance_error = np.sqrt(2.0 / np.clip(count, 2.0, _MOST_PHOTONS))
    added = np.maximum(widest - explained, 0.0) + variance_error * widest
    return 0.5 * (wide.sum(axis=1) @ offsets - mean) ** 2 + 0.5 * _FOOT_SIGMAS**2 * added


def _smoothed(height: np.ndarray, weight: np.ndarray, step: float) -> np.ndarray:
    """Smooth weighted heights by the Whittaker filter: second differences are penalised."""
    if height.size < 3:
        return height
    penalty = (_SMOOTHING_LENGTH / step) ** 4 / 10.0
    differences = scipy.sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(height.size - 2, height.size))
    matrix = scipy.sparse.diags(weight) + penalty * differences.T @ differences
    return scipy.sparse.linalg.spsolve(matrix.tocsc(), weight * height)


def _log_likelihood(
    height: np.ndarray, offsets: np.ndarray, background: float, length: float, width: float
) -> np.ndarray:
    """Return the log-likelihood of the photons of one cell for each height of the ground, but for a constant.

    **Arguments:** `height`: (photons,) m. `offsets`: (offsets,) heights of the ground in m. `background`: per
    square metre. `length`: of the cell in m. `width`: standard deviation of the ground's echo in m.
    """
    low, high = offsets[0] - 3.0, offsets[-1] + _HATS[-1] * 1.4
    height = height[(height > low) & (height < high)]
    if height.size == 0:
        return np.zeros(offsets.size)
    # (offsets, photons, components), looked up: the rates' functions take most of the time otherwise.
    row = np.rint((height - offsets[:, None] - _TABLE_RANGE[0]) / _TABLE_STEP).astype(int)
    shapes = np.take(_rate_table(width), row, axis=0, mode="clip")
    # Rates per metre of height. Numbers of photons to start from: equal shares of what is not background.
    background *= length
    signal = max(height.size - background * (high - low), 1.0)
    numbers = np.full((offsets.size, 1, shapes.shape[2]), signal / shapes.shape[2], np.float32)
    for _ in range(_EXPECTATIONS):
        rate = np.float32(background) + shapes @ np.swapaxes(numbers, 1, 2)
        numbers *= np.swapaxes(1.0 / rate, 1, 2) @ shapes
        numbers[..., 0] += _GROUND_PRIOR
    rate = background + (shapes @ np.swapaxes(numbers, 1, 2))[..., 0].astype(float)
    ground, canopy = numbers[:, 0, 0].astype(float), numbers[:, 0, 1:].astype(float)
    prior = _GROUND_PRIOR * np.log(np.maximum(ground, 1e-6)) - _LAPLACE * np.log1p(canopy).sum(axis=1)
    return np.log(rate).sum(axis=1) - ground - canopy.sum(axis=1) + prior


@functools.lru_cache
def _rate_table(width: float) -> np.ndarray:
    """Return `_rate_shapes` at even heights: (heights, components), in single precision."""
    above = np.arange(*_TABLE_RANGE, _TABLE_STEP)
    return np.ascontiguousarray(_rate_shapes(above, width).T, np.float32)


def _rate_shapes(above: np.ndarray, width: float) -> np.ndarray:
    """Return the densities, of unit integral, of the ground's echo and of the hat functions above it.

    A hat function is a second difference of ramps, and the mean of a ramp max(x, 0) over a Gaussian of
    standard deviation s is x Phi(x / s) + s phi(x / s).

    **Arguments:** `above`: heights of photons above the ground in m, of any shape. `width`: standard
    deviation of the ground's echo in m.

    **Returns:** (components, ...) 1/m.
    """
    spread = np.sqrt(max(width**2 - _ECHO_WIDTHS[0] ** 2, _LEAST_SPREAD**2))
    echo = np.exp(-0.5 * (above / width) ** 2) / (width * np.sqrt(2.0 * np.pi))
    nodes = np.array((0.0, *_HATS, 1.4 * _HATS[-1])).reshape(-1, *[1] * above.ndim)
    x = (above - nodes) / spread
    ramps = spread * (x * scipy.special.ndtr(x) + np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi))
    hats = np.diff(np.diff(ramps, axis=0) / np.diff(nodes, axis=0), axis=0) * 2.0 / (nodes[2:] - nodes[:-2])
    # Rounding of the ramps must not give a negative rate.
    return np.concatenate([echo[None], np.maximum(hats, 0.0)])


def _posterior(evidence: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the probability of each width and offset in each cell by the forward-backward recursion.

    **Arguments:** `evidence`: (cells, widths, offsets) log-likelihoods.
    """
    change = np.exp(-np.abs(offsets[:, None] - offsets) / _GROUND_CHANGE)
    change = (1.0 - _JUMP) * change / change.sum(axis=1, keepdims=True) + _JUMP / offsets.size
    step = np.arange(evidence.shape[1])
    widen = np.exp(-np.abs(step[:, None] - step) / _WIDTH_CHANGE)
    widen /= widen.sum(axis=1, keepdims=True)
    likelihood = np.exp(evidence - evidence.max(axis=(1, 2), keepdims=True))
    forward, backward = likelihood.copy(), np.ones_like(likelihood)
    for k in range(len(evidence)):
        if k:
            forward[k] *= widen.T @ forward[k - 1] @ change
        forward[k] /= forward[k].sum()
    for k in range(len(evidence) - 2, -1, -1):
        backward[k] = widen @ (likelihood[k + 1] * backward[k + 1]) @ change.T
        backward[k] /= backward[k].sum()
    posterior = forward * backward
    return posterior / posterior.sum(axis=(1, 2), keepdims=True)


def _odds_of_hidden_ground(
    steps: np.ndarray, number: np.ndarray, near: np.ndarray, background: np.ndarray, ground_range: np.ndarray
) -> np.ndarray:
    """Return the odds for each segment that its echo is that of plants, and that the ground lies below.

    Below plants of N photons, a ground with the share p of the light returns h = N p / (1 - p) of them. Where
    n are found and b are expected without it, the ratio of the Poisson likelihoods is (1 + h / b)^n exp(-h).
    Its mean over shares and depths is the odds, if both cases are as likely before. Segments near an end have
    the odds of the nearest one with neighbours on both sides: fewer photons would not tell.

    **Arguments:** `steps`: (photons,) below the echo, in steps of depth; `number`: of their segments. `near`:
    (segments,) photons in the echo. `background`: (segments,) per m of height. `ground_range`: (segments,) m,
    half the height of the echo.
    """
    background = _moving_sum(background, _HIDDEN_NEIGHBOURS)
    n, half = near.size, _HIDDEN_NEIGHBOURS
    nearest = np.clip(np.arange(n), min(half, n // 2), max(n - 1 - half, n // 2))
    echo = np.maximum(_moving_sum(near, _HIDDEN_NEIGHBOURS) - background * 2.0 * ground_range, 0.0)
    ratios = []
    for k in range(_HIDDEN_SLABS):
        # Slabs of two steps. The first also has the tail of the echo.
        is_in_slab = (steps >= k) & (steps < k + 2)
        count = _moving_sum(np.bincount(number[is_in_slab], minlength=near.size), _HIDDEN_NEIGHBOURS)
        by_echo = echo * scipy.special.ndtr(-_HIDDEN_SIGMAS) if k == 0 else 0.0
        without = background * 2.0 * _DEPTH_STEP + by_echo
        for share in _HIDDEN_SHARES:
            hidden = echo * share / (1.0 - share)
            ratios.append(count * np.log1p(hidden / without) - hidden)
    return np.exp(scipy.special.logsumexp(ratios, axis=0) - np.log(len(ratios)))[nearest]


def _rare_count(expected: np.ndarray, places: np.ndarray | float) -> np.ndarray:
    """Return the smallest count that background reaches at any of `places` places only by `_FALSE_GOOD`."""
    probability = np.minimum(_FALSE_GOOD / np.maximum(places, 1.0), 1.0)
    return scipy.stats.poisson.isf(probability, expected) + 1.0


def _verdict(
    has_ground: bool,
    stderr: float,
    near: int,
    by_background: float,
    fewest_good: int,
    is_deeper: bool,
    has_excess: bool,
    is_hidden: bool,
) -> Verdict:
    """Return the verdict on the ground of a segment."""
    if not has_ground:
        return Verdict("bad", ("no ground: as many photons as the background gives",))
    verdict = Verdict("good", ())
    if not stderr <= _DOUBTFUL_ERROR:
        verdict &= Verdict("doubtful", (f"standard error {stderr:.2f} m",))
    if near - by_background < _DOUBTFUL_PHOTONS:
        verdict &= Verdict("doubtful", (f"{near} photons in the ground's echo",))
    elif near < fewest_good:
        reason = f"{near} photons in the ground's echo: background alone may give them somewhere"
        verdict &= Verdict("doubtful", (reason,))
    if is_deeper:
        verdict &= Verdict("doubtful", ("photons below the ground",))
    if is_hidden:
        verdict &= Verdict("doubtful", ("the echo may be that of low plants, with little light from below",))
    if has_excess:
        verdict &= Verdict("doubtful", ("the ground may be a part of the canopy, which goes on above it",))
    return verdict


# -- signal and canopy -------------------------------------------------------------------------------------


def _fewest_neighbours(density: np.ndarray) -> np.ndarray:
    """Fewest neighbours of signal, by the Poisson distribution of those of background."""
    expected = np.pi * _ALONG * _HIGH * density
    return np.maximum(scipy.stats.poisson.isf(_FALSE_ALARM, expected) + 1.0, _FEWEST_NEIGHBOURS)


def _count_neighbours(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Number of other photons within the ellipse around each photon."""
    if x.size == 0:
        return np.zeros(0)
    scaled = np.stack([x / _ALONG, z / _HIGH], axis=1)
    return scipy.spatial.KDTree(scaled).query_ball_point(scaled, 1.0, return_length=True) - 1


def _percentiles(
    z: np.ndarray, number: np.ndarray, n_segments: int, percentile: float, least: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the percentile of the values of each segment, NaN for fewer than `least`, and their number."""
    count = np.bincount(number, minlength=n_segments)
    of_segments = np.split(z[np.argsort(number, kind="stable")], np.cumsum(count)[:-1])
    percentiles = [np.percentile(a, percentile) if a.size >= least else np.nan for a in of_segments]
    return np.array(percentiles[:n_segments]), count


def _canopy_percentile(
    above: np.ndarray,
    sample_height: float,
    clearance: float,
    background: float,
    spread: float,
    quantile: float,
) -> tuple[float, float]:
    """Return a percentile of the canopy of a segment and its standard error, in m above the ground.

    The photons above the clearance are Poisson distributed with the rate b + N f(h), f a beta distribution
    between base and top, N the number that maximises the likelihood.

    **Arguments:** `above`: (photons,) m, heights above the ground. `sample_height`: percentile of the signal
    in m. `background`: photons per metre of height. `spread`: standard deviation in m by which the slope
    within the footprint spreads heights.
    """
    mean, total, base = (x.ravel() for x in np.meshgrid(_BETA_MEANS, _BETA_SUMS, _BASES))
    a, b = mean * total, (1.0 - mean) * total
    # Where the density is infinite at an end, a single photon there would decide.
    a, b, base = np.stack([a, b, base])[:, (a >= 0.9) & (b >= 0.9), None, None]
    top = sample_height * _TOPS[:, None]
    limit = sample_height * _TOPS[-1]
    above = above[(above > clearance) & (above < limit)]
    depth = (1.0 - base) * top
    share = np.clip((above - base * top) / depth, 0.0, 1.0)
    is_inside = (share > 0.0) & (share < 1.0)
    inner = np.where(is_inside, share, 0.5)
    density = np.exp((a - 1.0) * np.log(inner) + (b - 1.0) * np.log1p(-inner) - scipy.special.betaln(a, b))
    density = np.where(is_inside, density / depth, 0.0)
    hidden = np.clip((clearance - base * top) / depth, 0.0, 1.0)
    density /= np.maximum(scipy.special.betaincc(a, b, hidden), 1e-3)
    number = np.full((*density.shape[:2], 1), max(above.size - background * (limit - clearance), 1.0))
    for _ in range(_EXPECTATIONS):
        number *= np.sum(density / (background + number * density), axis=2, keepdims=True)
    evidence = (np.log(background + number * density).sum(axis=2, keepdims=True) - number)[..., 0]
    posterior = np.exp(evidence - evidence.max()) / top[:, 0] ** _TOP_PRIOR
    posterior /= posterior.sum()
    median, height = (base * top + depth * scipy.special.betaincinv(a, b, q) for q in (0.5, quantile))
    # The slope makes the square of the distance to the median larger: by z^2 spread^2 for a Gaussian profile
    # with its quantile z, and by about 1.6 times as much for an even one. Half of what is left is certain.
    z = scipy.special.ndtri(np.clip(quantile, 0.01, 0.99))
    square = (height - median) ** 2
    narrowed = np.sqrt(np.maximum(square - 1.3 * (z * spread) ** 2, 0.25 * square))
    height = (median + np.sign(height - median) * narrowed)[..., 0]
    mean_height = np.sum(posterior * height)
    variance = np.sum(posterior * (height - mean_height) ** 2)
    return mean_height, np.hypot(np.sqrt(variance), _PROFILE_ERROR * mean_height)
