"""Fine time bins and samples that cover a scene, or the window that the caller gives."""

import dataclasses
import math
from typing import NamedTuple

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import check_number, check_numbers, check_shape, concrete_number
from jaxlidar.planning.config import KERNEL_BINS, TimeBins
from jaxlidar.planning.memory import MAX_DENSE_PULSE
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import Lidar


class SampleTimes(NamedTuple):
    """The digitiser's samples: time of the first and interval, ns, their number, and fine bins of each."""

    start: float
    interval: float
    count: int
    bins_per_sample: int


def target_bin_width(
    interval: float, pulse_feature: float, pulse_std: float, bin_width: float | None
) -> float:
    """Return the width of fine bins to aim at, ns: from the pulse's finest feature, or the user's."""
    if bin_width is None:
        # A quarter of the finest feature, as the B-spline that spreads returns over bins widens it. A pulse
        # without duration has no features.
        feature_width = max(0.25 * pulse_feature, 0.05 * interval)
        return min(interval, feature_width if pulse_std > 0 else 0.5 * interval)
    check_number("bin_width", bin_width, 0.0, low_open=True)
    return bin_width


def bins_and_samples(
    lidar: Lidar,
    scene: Scene,
    path_lengths: PathLengths,
    tail: float,
    window: tuple[float, float] | None,
    target: float,
) -> tuple[TimeBins, SampleTimes]:
    """Return fine bins about `target` ns wide, a whole number of them per sample, and the samples.

    1. A sample has a whole number of fine bins, none wider than `target`.
    2. Returns come from the first of order one to the last and its tail.
    3. Samples cover these and the pulse, or the window of the user; the returns of a window are those that
       the pulse carries into it.
    4. Fine bins go from the first return that reaches a sample to the last, and three more at each end.

    `tail` is the time, ns, during which multiple scattering is recorded after the last return of first order.
    """
    interval = concrete_number(lidar.sampling_interval)
    pulse_start, pulse_end = lidar.pulse.support(concrete_number(lidar.jitter))
    # The slack keeps a whole number from being rounded up.
    bins_per_sample = max(math.ceil(interval / target - 1e-6), 1)
    width = interval / bins_per_sample
    if lidar.opens_at_first_return:
        # Sampled finely here; the digitiser's bins are laid when the time of the first return is known.
        interval, bins_per_sample = width, 1
    first, last = path_lengths.first_path / SPEED_OF_LIGHT, path_lengths.last_path / SPEED_OF_LIGHT
    last += tail
    if window is None:
        # Samples are at multiples of the interval, so that small changes of the scene do not shift them.
        begin = math.floor((first + pulse_start) / interval) * interval
        samples = math.ceil((last + pulse_end - begin) / interval) + 1
    else:
        check_numbers("window", window)
        check_shape("window", window, (2,))
        begin, end = map(float, window)
        if not (math.isfinite(begin) and begin < end < math.inf):
            raise ValueError(f"window = {window} is not (first, last) with first < last, in ns")
        # The relative slack: an interval in single precision is off by its rounding.
        samples = math.floor((end - begin) / interval * (1 + 1e-6) + 1e-6) + 1
        # Returns that the pulse can carry into the window.
        first = max(first, begin - interval - pulse_end)
        last = max(begin + samples * interval - pulse_start, first + width)
    if scene.atmosphere is not None and scene.atmosphere.lidar_ratio is not None:
        # Air scatters light back before the scene does, from the start of the record on.
        first = min(first, begin - interval - pulse_end)
    # Fine bins share edges with the samples, which are centred on their times. Three more bins at each end
    # take the B-spline and rounding.
    edge = begin - 0.5 * interval
    if window is None:
        # The earliest first return for which samples begin here: whatever it is, the first bin lies equally
        # far from the first sample, so that programs are the same.
        first = min(first, begin - pulse_start)
    lead = math.ceil((edge - first) / width) + 3
    count = lead + math.ceil((last - edge) / width) + 3
    start = edge + width * (0.5 - lead)
    bins = TimeBins(start, width, max(count, 1), max_span=KERNEL_BINS)
    return bins, SampleTimes(begin, interval, samples, bins_per_sample)


def first_sample_in_bins(start: float, bins: TimeBins) -> float:
    """Return the centre of the first sample, at `start` ns, in fine bins from that of the first bin.

    Times from the emission may be so large that single precision does not resolve their difference.
    """
    return (start - bins.start) / bins.width


def pulse_band(
    pulse_support: tuple[float, float], interval: float, first_sample: float, bin_width: float
) -> tuple[int, int]:
    """Return the offsets of a sample from a fine bin, in fine bins, between which it takes from the bin.

    They are rounded outwards to an eighth of the width's octave, so that programs are not compiled for every
    pulse and window. `interval`: of the samples, ns.
    """
    half = 0.5 * interval
    low = math.floor((pulse_support[0] - half) / bin_width - first_sample) - 2
    high = math.ceil((pulse_support[1] + half) / bin_width - first_sample) + 2
    step = max((1 << (high - low).bit_length()) // 8, 1)
    return low // step * step, -(-high // step) * step


def band_of_long_record(
    pulse_support: tuple[float, float], samples: SampleTimes, bins: TimeBins
) -> tuple[int, int] | None:
    """Return the `pulse_band` of a record; None where a matrix of all bins and samples is small."""
    if bins.count * samples.count <= MAX_DENSE_PULSE:
        return None
    return pulse_band(pulse_support, samples.interval, first_sample_in_bins(samples.start, bins), bins.width)


def extend_to_air_return(bins: TimeBins, lidar: Lidar, samples: SampleTimes) -> TimeBins:
    """Extend bins back to where the air's own return would begin, whether it is simulated or not."""
    _, pulse_end = lidar.pulse.support(concrete_number(lidar.jitter))
    # The same margin of three bins as above.
    missing = math.ceil((bins.start - (samples.start - samples.interval - pulse_end)) / bins.width) + 3
    added = max(missing, 0)
    return dataclasses.replace(bins, start=bins.start - added * bins.width, count=bins.count + added)
