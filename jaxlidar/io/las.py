"""Reader of point clouds in LAS and LAZ files."""

import os
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxlidar._checks import check_range
from jaxlidar.io.checks import FARTHEST, existing
from jaxlidar.io.las_header import read_header
from jaxlidar.io.laz import unpack

# Classes of the LAS 1.4 specification that are not returns of the scene: low noise and high noise.
_NOISE = (7, 18)


class PointCloud(NamedTuple):
    """Points of a laser scan.

    - `position`: (n, 3) m, as in the file times the scale, in double precision.
    - `classification`: (n,) classes of the LAS specification: 2 ground, 3 to 5 vegetation, ...
    - `return_number`, `number_of_returns`: (n,) number of the return, and of all returns of its pulse.
    - `intensity`: (n,) as recorded.
    - `dropped`: how many points of the file were left out, by reason.

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


def read_las(path: str | os.PathLike[str], *, scale: float = 1.0) -> PointCloud:
    """The points of a LAS or LAZ file.

    This needs laspy, and lazrs for LAZ (`pip install "jaxlidar[io]"`). Points classified as noise (classes 7
    and 18) and those flagged as withheld are dropped and counted.

    **Arguments:**

    - `path`: the file.
    - `scale`: metres per unit of length in the file. Default 1.

    **Returns:** a `PointCloud`. Its `dropped` counts points as "noise" and "withheld".

    **Raises:** FileNotFoundError where there is no such file. ImportError without laspy, or without lazrs
    for LAZ. ValueError, naming the file and the place (for points the record), where it is damaged, cut
    short, without points, declares more than it can hold or holds coordinates that are not on Earth.
    ValueError for a scale that is not positive.

    **Source:** LAS specification 1.4 (ASPRS).

    **Example:**

    >>> import laspy, pathlib, tempfile
    >>> import jaxlidar.io
    >>> path, file = pathlib.Path(tempfile.mkdtemp()) / "scan.las", laspy.create()
    >>> file.x, file.y, file.z, file.classification = [0.0, 1.0], [0.0, 0.0], [5.0, 90.0], [2, 18]
    >>> file.write(path)
    >>> cloud = jaxlidar.io.read_las(path)
    >>> print(cloud.position, cloud.dropped)
    [[0. 0. 5.]] {'noise': 1, 'withheld': 0}
    """
    try:
        import laspy
    except ImportError as error:
        raise ImportError('reading LAS needs laspy: pip install "jaxlidar[io]"') from error
    check_range("scale", scale, 0.0, low_open=True)
    path = existing(path)
    with path.open("rb") as file:
        header = read_header(path, file)
        if header.laszip is None:
            file.seek(header.start)
            content = file.read(header.points * header.point_size)
        else:
            content = unpack(path, file, header)
    point_format = laspy.PointFormat(header.point_format)
    if header.extra_bytes:
        point_format.add_extra_dimension(laspy.ExtraBytesParams("extra", f"{header.extra_bytes}u1"))
    cloud = laspy.PackedPointRecord.from_buffer(content, point_format)
    units = (np.asarray(cloud[name], float) for name in "XYZ")
    position = scale * np.stack([u * s + o for u, s, o in zip(units, header.scales, header.offsets)], axis=1)
    far = np.flatnonzero(~(np.abs(position) <= FARTHEST).all(axis=1))
    if far.size:
        raise ValueError(
            f"{path}: record {far[0]}: coordinates {position[far[0]].tolist()} lie beyond {FARTHEST:g} m"
        )
    classes = np.asarray(cloud.classification).astype(int)
    noise = np.isin(classes, _NOISE)
    withheld = np.asarray(cloud.withheld).astype(bool) & ~noise
    keep = ~(noise | withheld)

    def kept(name: str, kind: type) -> np.ndarray:
        return np.asarray(cloud[name]).astype(kind)[keep]

    return PointCloud(
        position[keep],
        classes[keep],
        kept("return_number", int),
        kept("number_of_returns", int),
        kept("intensity", float),
        {"noise": int(noise.sum()), "withheld": int(withheld.sum())},
    )
