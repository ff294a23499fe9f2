"""The error of parallel (collimated) light, for which footprints that share photons take diverging beams."""

import math

import numpy as np

from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar._fields.checks import concrete_number
from jaxlidar.sensors.survey import Survey


def parallel_light_bound(survey: Survey, start_distance: float, last_return: float) -> float:
    """Estimate from above the fraction of samples that parallel light changes, for shots of one direction.

    Let R be the distance of the reference plane, w the radius of the footprint there, and h the largest
    distance of the scene from that plane, along the beam. Relative to parallel light,

    1. at h the footprint is narrower by the fraction h / R. A Gaussian that is narrower by a fraction e has
       2 e / exp(1) = 0.74 e of its energy elsewhere; both sides of the plane are counted, 1.5 h / R, although
       a sample is on one side;
    2. the area of a field of view changes by 2 h / R;
    3. light at the rim travels farther than the mean, which is kept, by w^2 / (2 R), there and back:
       (r^2 / 2 R - w^2 / 4 R) x 2 at r = w. This counts relative to the standard deviation of a sample in
       time, from pulse, jitter and sampling interval;
    4. light at the rim is inclined by w / R, and so meets other voxels: that fraction of samples.

    The estimate is the sum of these, at most 1.

    **Arguments:**

    - `survey`: shots of one direction (`beams_are_parallel`).
    - `start_distance`: distance, m, before the reference plane at which rays start.
    - `last_return`: time of the last return of order one, ns.
    """
    lidar = survey.lidar
    slant_range, radius = float(survey.slant_range.min()), float(survey.footprint_radius.max())
    extent = max(abs(start_distance), 0.5 * SPEED_OF_LIGHT * abs(last_return))
    # Standard deviation of a uniform distribution over one interval.
    sampling_std = concrete_number(lidar.sampling_interval) / math.sqrt(12.0)
    sample_std = math.hypot(concrete_number(lidar.pulse.std), concrete_number(lidar.jitter), sampling_std)
    delay = 0.5 * radius**2 / slant_range / SPEED_OF_LIGHT / sample_std
    # Terms 1 and 2, in units of h / R.
    narrowing = 1.5 if lidar.field_of_view is None else 3.5
    return float(min(narrowing * extent / slant_range + delay + radius / slant_range, 1.0))


def beams_are_parallel(survey: Survey) -> bool:
    """Return True if all shots have the same direction."""
    # The rounding of double precision.
    return bool(np.ptp(survey.direction, axis=0).max() < 1e-9)
