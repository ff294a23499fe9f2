"""How far a scene reaches along the beam; from this the bounds of all loops are set before tracing."""

import math

import numpy as np

from jaxlidar._checks import concrete_array, concrete_number
from jaxlidar._vectors import FAR
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.planning.ladder import rung
from jaxlidar.planning.rims import rims_of
from jaxlidar.planning.trace_plan import KERNEL
from jaxlidar.scenes.scene import Scene
from jaxlidar.scenes.surfaces import AbstractSheet

# Voxels along one flight at most: a batch waits for its longest flight.
MOST_VOXELS = 16_384
# Fine bins of a stretch at most, and bins that it may spread to beside its own.
_LONGEST, _MARGINS = 64, 3


class PathLengths:
    """Path lengths from the rim of the footprint to the bounds of everything in the scene.

    Those of a survey are bounds for all of its shots.

    - `first`, `last`: two-way path, m, of the first and the last return of order one, relative to that of the
      aim point.
    - `upstream`: distance before the reference plane, m, at which all rays start.

    **Raises:** ValueError where the scene reaches up to the sensor.
    """

    def __init__(self, lidar: Lidar, scene: Scene, survey: Survey | None = None):
        self.scene = scene
        shots = Survey.of(lidar) if survey is None else survey
        self.vertical = not np.any(shots.zenith)
        aim, points, self.rays, distance, slant = (a.reshape(-1, *a.shape[2:]) for a in rims_of(shots, 2.5))
        levels = []
        for s in scene.surfaces:
            crossed, towards = s.shape.crossing(points + aim, self.rays)
            met = np.abs(towards) > 1e-6 if isinstance(s, AbstractSheet) else towards < -1e-6
            if met.any():
                levels.append(crossed[met])
        if scene.canopy is not None:
            v = scene.canopy.voxels
            self.size, self.shape = concrete_array(v.voxel_size), np.array(v.shape)
            low = concrete_array(v.origin)[2]
            for z in (low, low + self.size[2] * self.shape[2]):
                levels.append((z - points[:, 2]) / self.rays[:, 2])
        along = np.concatenate(levels) if levels else np.zeros(1)
        nearest, farthest = float(along.min()), float(along.max())
        self.first = 2.0 * nearest
        self.last = 2.0 * (farthest + float(np.max(distance - slant)))
        self.upstream = 0.05 * (farthest - nearest) + 1e-3 - nearest
        lowest = float(np.min(slant))
        if self.upstream >= lowest:
            altitude = concrete_number(lidar.altitude)
            raise ValueError(
                f"altitude = {altitude:g} m: the scene reaches up to the sensor; "
                f"admissible is more than {altitude + self.upstream - lowest:g} m"
            )

    @property
    def longest_chord(self) -> float:
        """Longest piece, m, of a footprint ray within one voxel."""
        if self.scene.canopy is None:
            return 1e-3
        steep = float(np.abs(self.rays[:, 2]).min())
        return float(min(np.linalg.norm(self.size), self.size[2] / steep)) * (1 + 1e-5)

    def first_steps(self, step: float) -> int:
        """Bound on the stretches of a footprint ray, none longer than `step` m."""
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
        """Length, m, up to which flights are followed.

        It takes in all flights whose light returns within `longest` m of the first return. But within a
        periodic canopy light could fly on almost for ever: under a beam of more than 64 degrees the length is
        at most ten times the sum of `longest` and the height of the canopy, and no flight crosses more than
        `MOST_VOXELS` voxels.
        """
        if self.scene.canopy is None or self.scene.canopy.sides == "open":
            return FAR
        # A flight of s m within the canopy lengthens the way by at least s (1 - sin) - height cos.
        height, cos = self.size[2] * self.shape[2], float(np.abs(self.rays[:, 2]).min())
        flight = (longest + height * cos) / max(1.0 - math.sqrt(1.0 - cos * cos), 0.1)
        return float(min(flight, self.longest_march))

    @property
    def longest_march(self) -> float:
        """Length, m, of the longest flight through a periodic canopy that crosses `MOST_VOXELS` at most."""
        return float(max(MOST_VOXELS - self.shape[2], 1) / np.sum(1.0 / self.size[:2]))

    def march_steps(self, longest: float) -> int:
        """Bound on the voxels that a flight of `longest_flight` crosses."""
        if self.scene.canopy is None:
            return 0
        if self.scene.canopy.sides == "open":
            return int(self.shape.sum()) + 3
        return self.voxels_along(self.longest_flight(longest))

    def voxels_along(self, flight: float) -> int:
        """Bound on the voxels of a periodic canopy that a flight of some length, m, crosses."""
        return int(self.shape[2] + sum(math.ceil(flight / s) for s in self.size[:2])) + 3


def stretch(chord: float, bin_length: float, max_step: float | None) -> tuple[float, int]:
    """Longest stretch, m, of order one, and bins that it spans with its margins.

    `chord` is the longest piece within one voxel. Where nothing is asked for, the row is on the ladder, and
    the stretch somewhat longer than the chord, so that one plan serves other directions, too.
    """
    if max_step is not None:
        step = min(max_step, chord)
        return step, max(math.ceil(step / bin_length - 1e-6) + _MARGINS, KERNEL)
    bins = min(math.ceil(1.02 * chord / bin_length), _LONGEST)
    row = max(rung(bins + _MARGINS, 4), KERNEL)
    return (row - _MARGINS) * bin_length, row
