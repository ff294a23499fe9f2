"""What parallel light in place of a beam's own would change: footprints that share light take it for such."""

import math

import numpy as np

from jaxlidar._checks import concrete_number
from jaxlidar._constants import SPEED_OF_LIGHT
from jaxlidar.instrument.survey import Survey


def parallel_light(survey: Survey, start_distance: float, last: float) -> float:
    """Bound on the share of samples that parallel light changes, for shots of one direction.

    At the height h above the reference plane, along the beam, a footprint of the radius w is narrower by the
    share h / R. A Gaussian so changed has 2 / e of that share elsewhere on either side, 1.5 h / R in all. The
    area of a field of view changes by 2 h / R. Light at the rim arrives later than the mean, which is kept,
    by w^2 / (2 R), and inclined by w / R.

    **Arguments:** `start_distance`: distance, m, before the reference plane at which rays start. `last`: time
    of the last return of order one, ns.
    """
    lidar = survey.lidar
    distance, radius = float(survey.slant_range.min()), float(survey.footprint_radius.max())
    height = max(abs(start_distance), 0.5 * SPEED_OF_LIGHT * abs(last))
    interval = concrete_number(lidar.sampling_interval) / math.sqrt(12.0)
    lasts = math.hypot(concrete_number(lidar.pulse.std), concrete_number(lidar.jitter), interval)
    late = 0.5 * radius**2 / distance / SPEED_OF_LIGHT / lasts
    narrower = 1.5 if lidar.field_of_view is None else 3.5
    return min(narrower * height / distance + late + radius / distance, 1.0)


def one_direction(survey: Survey) -> bool:
    """Whether all beams are parallel."""
    return bool(np.ptp(survey.direction, axis=0).max() < 1e-9)
