"""Points of a laser scan, as `jaxlidar.io.read_las` reads them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num


class PointCloud(NamedTuple):
    """Points of a laser scan.

    - `position`: (n, 3) m, as in the file times the scale, in double precision.
    - `classification`: (n,) classes of the LAS specification: 2 ground, 3 to 5 vegetation, ...
    - `return_number`, `number_of_returns`: (n,) number of the return, and of all returns of its pulse.
    - `intensity`: (n,) as recorded.
    - `dropped`: how many points of the file were left out, by reason.
    - `scan_angle`: (n,) degrees from the vertical, positive to the right of the flight line; None where it is
      not known. Default None.
    - `gps_time`: (n,) s, the same for all returns of a pulse; None where it is not known. Default None.
    - `source`: (n,) number of the flight line; None where it is not known. Default None.
    - `crs`: coordinate reference system of `position`, such as "EPSG:32633"; None where it is not known.
      Default None.
    - `extra`: the extra bytes of a file by name, (n,) or (n, 2 or 3), such as the labels that
      `DiscreteReturns.to_las` writes: in the type of the file, or where it declares a scale, an offset or a
      number for no data, in double precision with NaN for no data. Default None: not known.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import PointCloud
    >>> one, two = np.array([1, 1]), np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 9.0]])
    >>> cloud = PointCloud(two, np.array([2, 5]), one, one, np.array([40.0, 25.0]), {"noise": 0})
    >>> print(cloud.position[cloud.classification == 5])
    [[0.5 0.  9. ]]
    """

    position: Float[np.ndarray, "n 3"]
    classification: Int[np.ndarray, " n"]
    return_number: Int[np.ndarray, " n"]
    number_of_returns: Int[np.ndarray, " n"]
    intensity: Float[np.ndarray, " n"]
    dropped: dict[str, int]
    scan_angle: Float[np.ndarray, " n"] | None = None
    gps_time: Float[np.ndarray, " n"] | None = None
    source: Int[np.ndarray, " n"] | None = None
    crs: str | None = None
    extra: dict[str, Num[np.ndarray, "n *components"]] | None = None
