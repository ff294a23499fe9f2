"""When light is recorded: fine bins and samples that cover a scene, or the window that the caller gives."""

import dataclasses
import math

from jaxlidar._checks import concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.planning.path_lengths import PathLengths
from jaxlidar.planning.trace_plan import KERNEL, Bins
from jaxlidar.scenes.scene import Scene


def fine_bin(interval: float, finest: float, duration: float, bin_width: float | None) -> float:
    """The width of fine bins to aim at, ns."""
    if bin_width is None:
        return min(interval, max(0.25 * finest, 0.05 * interval) if duration > 0 else 0.5 * interval)
    if not 0 < bin_width < math.inf:
        raise ValueError(f"bin_width = {bin_width:g} is outside the admissible range (0, inf)")
    return bin_width


def times_of(
    lidar: Lidar,
    scene: Scene,
    geometry: PathLengths,
    tail: float,
    window: tuple[float, float] | None,
    target: float,
) -> tuple[Bins, tuple[float, float, int, int]]:
    """Fine bins about `target` ns wide; and first sample, interval, number of samples and fine bins of each.

    `tail` is how long, ns, light scattered many times comes after the last of first order.
    """
    interval = concrete_number(lidar.sampling_interval)
    low, high = lidar.pulse.support(concrete_number(lidar.jitter))
    per_sample = max(math.ceil(interval / target - 1e-6), 1)
    width = interval / per_sample
    if lidar.receiver.window == "first return":
        # Sampled finely here; the digitiser's own bins are laid when the first return is known.
        interval, per_sample = width, 1
    first, last = geometry.first / SPEED_OF_LIGHT, geometry.last / SPEED_OF_LIGHT
    last += tail
    if window is None:
        begin = math.floor((first + low) / interval) * interval
        samples = math.ceil((last + high - begin) / interval) + 1
    else:
        begin, end = map(float, window)
        if not (math.isfinite(begin) and begin < end < math.inf):
            raise ValueError(f"window = {window} is not (first, last) with first < last, in ns")
        # An interval in single precision is off by its rounding.
        samples = math.floor((end - begin) / interval * (1 + 1e-6) + 1e-6) + 1
        # Returns that the pulse can carry into the window.
        first = max(first, begin - interval - high)
        last = max(begin + samples * interval - low, first + width)
    if scene.atmosphere is not None and scene.atmosphere.lidar_ratio is not None:
        # The air returns light from the start.
        first = min(first, begin - interval - high)
    edge = begin - 0.5 * interval
    lead = math.ceil((edge - first) / width) + 3
    count = lead + math.ceil((last - edge) / width) + 3
    start = edge + width * (0.5 - lead)
    return Bins(start, width, max(count, 1), row=KERNEL), (begin, interval, samples, per_sample)


def with_air(bins: Bins, lidar: Lidar, samples: tuple[float, float, int, int]) -> Bins:
    """Bins that reach back to where the air's own return would begin, whether it is simulated or not."""
    _, high = lidar.pulse.support(concrete_number(lidar.jitter))
    missing = math.ceil((bins.start - (samples[0] - samples[1] - high)) / bins.width) + 3
    more = max(missing, 0)
    return dataclasses.replace(bins, start=bins.start - more * bins.width, count=bins.count + more)
