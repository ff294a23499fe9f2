"""Extent of a scene along the beam, from which the bounds of all loops are set before tracing."""

import math

import numpy as np

from jaxlidar._checks import concrete_array, concrete_number
from jaxlidar._vectors import FAR
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.config import KERNEL_BINS
from jaxlidar.planning.rims import rims_of
from jaxlidar.planning.size_buckets import size_bucket
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet

# A flight crosses at most so many voxels, because a batch waits for its longest flight.
MAX_VOXELS = 16_384
# Fine bins of a ray segment at most.
_MAX_SEGMENT_BINS = 64
# Bins that a segment touches beside those of its length: partial bins at both ends, and the smoothing kernel.
_SEGMENT_MARGIN = 3


class PathLengths:
    """Path lengths from the rim of the footprint to the bounds of everything in the scene.

    Those of a survey are bounds for all of its shots.

    - `first`, `last`: two-way path, m, of the first and the last return of order one, relative to that of the
      aim point.
    - `start_distance`: distance before the reference plane, m, at which all rays start.
    - `vertical`: True if all beams are at nadir.

    **Raises:** ValueError where the scene reaches up to the sensor.
    """

    def __init__(self, lidar: Lidar, scene: Scene, survey: Survey | None = None):
        self.scene = scene
        shots = Survey.of(lidar) if survey is None else survey
        self.vertical = not np.any(shots.zenith)
        # 2.5 footprint radii hold all but 4e-6 of a Gaussian beam.
        aim, points, self.rays, distance, slant = (a.reshape(-1, *a.shape[2:]) for a in rims_of(shots, 2.5))
        # Distances from the reference plane at which rays meet surfaces, and the map's bottom and top.
        crossings = []
        for s in scene.surfaces:
            crossed, towards = s.shape.crossing(points + aim, self.rays)
            met = np.abs(towards) > 1e-6 if isinstance(s, AbstractSheet) else towards < -1e-6
            if met.any():
                crossings.append(crossed[met])
        if scene.canopy is not None:
            v = scene.canopy.voxels
            self.size, self.shape = concrete_array(v.voxel_size), np.array(v.shape)
            low = concrete_array(v.origin)[2]
            for z in (low, low + self.size[2] * self.shape[2]):
                crossings.append((z - points[:, 2]) / self.rays[:, 2])
        distances = np.concatenate(crossings) if crossings else np.zeros(1)
        nearest, farthest = float(distances.min()), float(distances.max())
        self.first = 2.0 * nearest
        self.last = 2.0 * (farthest + float(np.max(distance - slant)))
        self.start_distance = 0.05 * (farthest - nearest) + 1e-3 - nearest
        lowest = float(np.min(slant))
        if self.start_distance >= lowest:
            altitude = concrete_number(lidar.altitude)
            raise ValueError(
                f"altitude = {altitude:g} m: the scene reaches up to the sensor; "
                f"admissible is more than {altitude + self.start_distance - lowest:g} m"
            )

    @property
    def longest_chord(self) -> float:
        """Longest chord, m, of a footprint ray within one voxel."""
        if self.scene.canopy is None:
            return 1e-3
        steep = float(np.abs(self.rays[:, 2]).min())
        return float(min(np.linalg.norm(self.size), self.size[2] / steep)) * (1 + 1e-5)

    def first_steps(self, step: float) -> int:
        """Return a bound on the number of segments of a footprint ray, none longer than `step` m."""
        if self.scene.canopy is None:
            return 0
        steep = np.abs(self.rays[:, 2]).min()
        height = self.size[2] * self.shape[2]
        sideways = np.ceil(np.abs(self.rays[:, :2]).max(0) / steep * height / self.size[:2]) + 1
        if self.scene.canopy.sides == "open":
            sideways = np.minimum(sideways, self.shape[:2])
        divided = 0 if step >= self.longest_chord else math.ceil(height / steep / step)
        return int(self.shape[2] + sideways.sum() + divided + len(self.scene.surfaces) + 2)

    def longest_flight(self, longest: float) -> float:
        """Return the length, m, up to which flights are followed.

        It includes all flights whose light returns within `longest` m of the first return. Within a periodic
        canopy light could fly on almost for ever: under a beam of more than 64 degrees the length is
        at most ten times the sum of `longest` and the height of the canopy, and no flight crosses more than
        `MAX_VOXELS` voxels.
        """
        if self.scene.canopy is None or self.scene.canopy.sides == "open":
            return FAR
        # A flight of s m within the canopy lengthens the path by at least s (1 - sin) - height cos.
        height, cos = self.size[2] * self.shape[2], float(np.abs(self.rays[:, 2]).min())
        flight = (longest + height * cos) / max(1.0 - math.sqrt(1.0 - cos * cos), 0.1)
        return float(min(flight, self.longest_march))

    @property
    def longest_march(self) -> float:
        """Length, m, of the longest flight through a periodic canopy that crosses at most `MAX_VOXELS`."""
        return float(max(MAX_VOXELS - self.shape[2], 1) / np.sum(1.0 / self.size[:2]))

    def march_steps(self, longest: float) -> int:
        """Return a bound on the number of voxels that a flight of `longest_flight` crosses."""
        if self.scene.canopy is None:
            return 0
        if self.scene.canopy.sides == "open":
            return int(self.shape.sum()) + 3
        return self.voxels_along(self.longest_flight(longest))

    def voxels_along(self, flight: float) -> int:
        """Return a bound on the voxels of a periodic canopy that a flight of that length, m, crosses."""
        return int(self.shape[2] + sum(math.ceil(flight / s) for s in self.size[:2])) + 3


def longest_segment(chord: float, bin_length: float, max_step: float | None) -> tuple[float, int]:
    """Return the longest ray segment, m, of order one, and the number of bins that its deposit spans.

    `chord` is the longest chord within one voxel, `max_step` the user's limit. Without it the number of bins
    is a size bucket, and segments may be somewhat longer than the chord, so that one plan serves other
    directions, too.
    """
    if max_step is not None:
        segment = min(max_step, chord)
        return segment, max(math.ceil(segment / bin_length - 1e-6) + _SEGMENT_MARGIN, KERNEL_BINS)
    bins = min(math.ceil(1.02 * chord / bin_length), _MAX_SEGMENT_BINS)
    span = max(size_bucket(bins + _SEGMENT_MARGIN, 4), KERNEL_BINS)
    return (span - _SEGMENT_MARGIN) * bin_length, span
