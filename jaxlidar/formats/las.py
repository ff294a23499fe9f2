"""Point clouds in LAS and LAZ files: reader and writer.

Source: LAS specification 1.4 (ASPRS).
"""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike, Num, UInt8

from jaxlidar._fields.checks import (
    as_numpy,
    check_kind,
    check_number,
    check_range,
    check_shape,
    required_for,
    warn_user,
)
from jaxlidar._fields.crs import CoordinateSystem, common_system, metric_system
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning, existing_file
from jaxlidar.formats.coordinates import WKT_RECORD, check_elevations
from jaxlidar.formats.files import atomic_write
from jaxlidar.formats.las_header import PROJECTION_USER, LasHeader, read_header
from jaxlidar.formats.laz import decompress_points
from jaxlidar.plants.point_cloud import PointCloud

# Classes of points that are not returns of the scene: low noise and high noise.
_NOISE_CLASSES = (7, 18)
# Scale of written coordinates: mm; 1e-8 degrees, which is about as much.
_MM, _DEGREES = (1e-3, 1e-3, 1e-3), (1e-8, 1e-8, 1e-3)
# The first point format of LAS 1.4, whose fields hold larger numbers.
_FORMAT_6 = 6
# Largest numbers by field: in point formats up to 5, and from 6 on.
_MAX_NUMBERS = {
    "return_number": (7, 15),
    "number_of_returns": (7, 15),
    "classification": (31, 255),
    "intensity": (2**16 - 1, 2**16 - 1),
    "scanner_channel": (0, 3),
    "point_source_id": (2**16 - 1, 2**16 - 1),
}
# Scan angles: steps in degrees and the largest angle, in point formats up to 5 and from 6 on.
_SCAN_ANGLE_STEPS, _MAX_SCAN_ANGLES = (1.0, 0.006), (90.0, 180.0)
# Smaller GPS times are seconds of the week, larger ones adjusted standard GPS time.
_SECONDS_OF_WEEK = 604_800
# Longest description of an extra dimension in a LAS file, and its name.
_MAX_EXTRA_TEXT = 32
# The record that describes extra bytes, and the largest type of a dimension.
_EXTRA_BYTES_RECORD, _MAX_EXTRA_TYPE = (b"LASF_Spec", 4), 30
# Largest number of single precision.
_LARGEST_SINGLE = float(np.finfo(np.float32).max)


def read_las(path: str | os.PathLike[str], *, scale: float | None = None) -> PointCloud:
    """Read the points of a LAS or LAZ file.

    This needs laspy, lazrs for LAZ, and pyproj for files that declare a coordinate reference system, with
    rasterio where that is by GeoTIFF keys (`pip install "jaxlidar[io]"`). Points classified as noise (classes
    7 and 18) and those flagged as withheld are dropped and counted.

    **Arguments:**

    - `path`: the file.
    - `scale`: metres per unit of length in the file, in place of what it declares. Default None: the units of
      its coordinate reference system, in which heights without a unit have that of x and y; metres in a file
      that declares none.

    **Returns:** a `PointCloud`. Its `dropped` counts points as "noise" and "withheld". Its `crs` is the
    system that the file declares, in metres; None with a `scale`. Its `extra` has the extra bytes that the
    file names.

    **Raises:** FileNotFoundError where there is no such file. ImportError without laspy, or without lazrs
    for LAZ. ValueError, naming the file and the place (for points the record), where it is damaged, cut
    short, without points, declares more than it can hold or extra bytes that its points lack, or holds
    coordinates that are not on Earth; and for coordinates in degrees, geocentric ones, and a coordinate
    reference system that is not known. ValueError for a scale that is not positive.

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
    if scale is not None:
        check_number("scale", scale, 0.0, low_open=True)
    path = existing_file(path)
    cloud, system = read_stored_points(path, skip_unknown_system=scale is not None)
    # Degrees are refused with a scale, too.
    system.horizontal_length(f"{path}: header")
    lengths = system.lengths(f"{path}: header") if scale is None else (scale, scale)
    position = cloud.position * [lengths[0], lengths[0], lengths[1]]
    check_elevations(f"{path}: points", position[:, 2])
    return cloud._replace(position=position, crs=system.map_name if scale is None else None)


def read_stored_points(
    path: Path, *, skip_unknown_system: bool = False
) -> tuple[PointCloud, CoordinateSystem]:
    """Return the points of a file in the units that it has, and its coordinate reference system.

    With `skip_unknown_system`, a declaration that cannot be read counts as none.

    **Raises:** as `read_las`.
    """
    laspy = import_laspy("reading LAS")
    with path.open("rb") as file:
        header = read_header(path, file)
        try:
            system = header.coordinate_system(path, file)
        except ValueError:
            if not skip_unknown_system:
                raise
            system = CoordinateSystem()
        declared = header.record(file, *_EXTRA_BYTES_RECORD) or b""
        if header.laszip is None:
            file.seek(header.start)
            content = file.read(header.points * header.point_size)
        else:
            content = decompress_points(path, file, header)
    cloud = laspy.PackedPointRecord.from_buffer(content, point_format_of(header))
    units = (np.asarray(cloud[name], float) for name in "XYZ")
    position = np.stack([u * s + o for u, s, o in zip(units, header.scales, header.offsets)], axis=1)
    (too_far,) = np.nonzero(~(np.abs(position) <= MAX_COORDINATE).all(axis=1))
    if too_far.size:
        raise ValueError(
            f"{path}: record {too_far[0]}: coordinates {position[too_far[0]].tolist()} lie beyond "
            f"{MAX_COORDINATE:g} m"
        )
    classes = np.asarray(cloud.classification).astype(int)
    noise = np.isin(classes, _NOISE_CLASSES)
    withheld = np.asarray(cloud.withheld).astype(bool) & ~noise
    selected = ~(noise | withheld)
    records = np.frombuffer(content, np.uint8).reshape(len(cloud), header.point_size)
    extra = _extra_numbers(path, declared, records, header.point_size - header.extra_bytes)
    points = PointCloud(
        position[selected],
        classes[selected],
        np.asarray(cloud["return_number"]).astype(int)[selected],
        np.asarray(cloud["number_of_returns"]).astype(int)[selected],
        np.asarray(cloud["intensity"]).astype(float)[selected],
        {"noise": int(noise.sum()), "withheld": int(withheld.sum())},
        scan_angle=scan_angles(cloud)[selected],
        gps_time=_gps_time(cloud, selected),
        source=np.asarray(cloud["point_source_id"]).astype(int)[selected],
        extra={name: values[selected] for name, values in extra.items()},
    )
    return points, system


def las_extent(path: Path) -> tuple[np.ndarray, np.ndarray, str | None]:
    """Return the corners (3,) of the extent that a file's header states, m, and its reference system.

    **Raises:** as `read_las`, but for what is wrong with the points; ValueError for an extent that is none.
    """
    with path.open("rb") as file:
        header = read_header(path, file)
        system = header.coordinate_system(path, file)
    system.horizontal_length(f"{path}: header")
    horizontal, vertical = system.lengths(f"{path}: header")
    low, high = (np.array(ends) * [horizontal, horizontal, vertical] for ends in (header.low, header.high))
    # Written so that NaN is refused.
    if not (np.all(low <= high) and max(np.abs(low).max(), np.abs(high).max()) <= MAX_COORDINATE):
        raise ValueError(
            f"{path}: header: the extent from {low.tolist()} to {high.tolist()} m is none; admissible are "
            f"coordinates up to {MAX_COORDINATE:g} m"
        )
    return low, high, system.map_name


def _gps_time(cloud: Any, selected: np.ndarray) -> np.ndarray | None:
    """Return the GPS times of the selected points, s; None where the point format has none."""
    if "gps_time" not in cloud.point_format.dimension_names:
        return None
    return np.asarray(cloud["gps_time"], float)[selected]


def _extra_numbers(
    path: Path, declared: bytes, records: UInt8[np.ndarray, "n bytes"], start: int
) -> dict[str, Num[np.ndarray, "n *components"]]:
    """Return the extra bytes of point records as numbers by name, without those that have no type.

    **Arguments:** `declared`: the record that describes them. `start`: their first byte in a point record.

    **Raises:** ValueError, naming the file and the dimension, for declarations that make no sense.
    """
    dimension_type = import_laspy("reading LAS").vlrs.known.ExtraBytesStruct
    size, location = dimension_type.size(), f"{path}: header: extra bytes"
    if len(declared) % size:
        raise ValueError(f"{location}: a record of {len(declared)} bytes is no multiple of {size}")
    numbers, point_size = {}, records.shape[1]
    for first in range(0, len(declared), size):
        dimension = dimension_type.from_buffer_copy(declared, first)
        name, kind = dimension.name.decode(errors="replace"), dimension.data_type
        if kind > _MAX_EXTRA_TYPE:
            raise ValueError(f"{location}: {name!r} has type {kind}; admissible is [0, {_MAX_EXTRA_TYPE}]")
        dtype = dimension.dtype()
        end = start + dtype.itemsize
        if end > point_size:
            raise ValueError(
                f"{location}: {name!r} ends at byte {end} of point records, which have {point_size}"
            )
        if name in numbers:
            raise ValueError(f"{location}: two dimensions have the name {name!r}")
        if kind:
            values = counts = np.ascontiguousarray(records[:, start:end]).view(dtype.base)
            if dimension.scale is not None:
                values = values * np.array(dimension.scale)
            if dimension.offset is not None:
                values = values + np.array(dimension.offset)
            if dimension.no_data is not None:
                values = np.where(counts == dimension.no_data, np.nan, values.astype(float))
            numbers[name] = values if dtype.shape else values[:, 0]
        start = end
    return numbers


def import_laspy(purpose: str) -> Any:
    """Return the package laspy. **Raises:** ImportError that names the purpose."""
    with required_for(purpose):
        import laspy
    return laspy


def point_format_of(header: LasHeader) -> Any:
    """Return laspy's description of the point records of a file."""
    laspy = import_laspy("reading LAS")
    point_format = laspy.PointFormat(header.point_format)
    if header.extra_bytes:
        point_format.add_extra_dimension(laspy.ExtraBytesParams("extra", f"{header.extra_bytes}u1"))
    return point_format


def write_las(
    path: str | os.PathLike[str],
    position: Num[ArrayLike, "..."],
    *,
    intensity: Num[ArrayLike, "..."] | None = None,
    return_number: Num[ArrayLike, "..."] | None = None,
    number_of_returns: Num[ArrayLike, "..."] | None = None,
    gps_time: Num[ArrayLike, "..."] | None = None,
    classification: Num[ArrayLike, "..."] | None = None,
    scan_angle: Num[ArrayLike, "..."] | None = None,
    point_source: Num[ArrayLike, "..."] | None = None,
    extra: Mapping[str, tuple[str, Num[ArrayLike, "..."]]] | None = None,
    crs: str | None = None,
) -> None:
    """Write points as a LAS 1.4 file (point format 6), or as LAZ.

    This needs laspy, and lazrs for LAZ (`pip install "jaxlidar[io]"`). An existing file is replaced when
    the new one is complete. The header says that the coordinate reference system, if any, is well-known
    text, as the specification asks for from point format 6 on.

    **Arguments:**

    - `path`: the file, which ends in ".las" or ".laz". Missing folders are created.
    - `position`: (n, 3) m, at least one point. They are rounded to mm.
    - `intensity`: (n,) counts from 0 to 65535, rounded to whole numbers. Default None: 0.
    - `return_number`, `number_of_returns`: (n,) whole numbers from 0 to 15. Default None: 1.
    - `gps_time`: (n,) s: of the GPS week where all are from 0 to 604,800, else adjusted standard GPS time
      (GPS time less 1e9 s); the header says which. Default None: 0.
    - `classification`: (n,) classes of the LAS specification, from 0 to 255. Default None: 0.
    - `scan_angle`: (n,) degrees from -180 to 180, rounded to 0.006. Default None: 0.
    - `point_source`: (n,) whole numbers from 0 to 65535, such as those of flight lines. Default None: 0.
    - `extra`: further numbers by name: (description, (n,) values), written in single precision as extra
      bytes. Names and descriptions have at most 32 bytes, and a name must not be that of a field of LAS
      points. Default None: none.
    - `crs`: the coordinate reference system of `position`, in metres, such as "EPSG:32633". Default None: not
      known. This needs pyproj.

    **Returns:** nothing.

    **Warns:** `FileWarning` where all intensities are positive or 0 and round to 0.

    **Raises:** ImportError without laspy, without lazrs for LAZ, or without pyproj for `crs`. ValueError
    for another ending, arrays of different lengths, numbers outside their range, inadmissible names and
    descriptions, and a `crs` that is not known or not in metres. TypeError for an `extra` of another form.
    OSError where the file cannot be written.

    **Example:**

    >>> import numpy as np, pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "echoes.las"
    >>> echoes, two = np.array([[0.0, 0.0, 12.5], [0.1, 0.0, 0.25]]), np.array([2, 2])
    >>> jaxlidar.io.write_las(path, echoes, return_number=np.array([1, 2]), number_of_returns=two)
    >>> print(jaxlidar.io.read_las(path).position[:, 2])
    [12.5   0.25]
    """
    with LasWriter(path, crs=crs) as file:
        file.write(
            position,
            intensity=intensity,
            return_number=return_number,
            number_of_returns=number_of_returns,
            gps_time=gps_time,
            classification=classification,
            scan_angle=scan_angle,
            point_source=point_source,
            extra=extra,
        )


class LasWriter:
    """A LAS 1.4 file (point format 6), or LAZ, that is written part by part.

    A survey of any number of shots is written with the memory of one part: simulate some shots at a time, and
    give the writer to `Waveforms.to_las` or `DiscreteReturns.to_las` in place of a path. Use it in a `with`
    statement: at its end the file is complete, and replaces an existing one. After an error nothing is left.
    It needs laspy, and lazrs for LAZ.

    - `path`, `crs`: as for `write_las`.

    **Raises:** as `write_las`; ValueError at the end where no part had a point.

    **Example:** two parts of a survey.

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(30, 0), spacing=10.0)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "strip.laz"
    >>> with jl.io.LasWriter(path) as file:
    ...     for number, part in enumerate((survey[:2], survey[2:])):
    ...         many = jl.simulate_many(part, jl.Scene(ground=jl.Ground()), key=jax.random.key(number))
    ...         _ = many.to_las(file)
    >>> print(len(jl.io.read_las(path).position))
    4
    """

    def __init__(self, path: str | os.PathLike[str], *, crs: str | None = None):
        self.path = las_path(path, (".las", ".laz"))
        self._system = None if crs is None else metric_system("crs", crs)
        self._files = contextlib.ExitStack()
        self._draft: Path | None = None
        # The header and the writer of laspy, from the first part on.
        self._header: Any = None
        self._writer: Any = None

    def __enter__(self) -> "LasWriter":
        if self._header is not None:
            raise ValueError(f"{self.path} is written; admissible is another LasWriter")
        self._draft = self._files.enter_context(atomic_write(self.path))
        return self

    def __exit__(self, *error: Any) -> None:
        self._draft = None
        if error[0] is None and self._writer is None:
            missing = ValueError(f"{self.path}: no part has a point; admissible is one point or more")
            self._files.__exit__(type(missing), missing, None)
            raise missing
        self._files.__exit__(*error)

    def write(
        self,
        position: Num[ArrayLike, "..."],
        *,
        intensity: Num[ArrayLike, "..."] | None = None,
        return_number: Num[ArrayLike, "..."] | None = None,
        number_of_returns: Num[ArrayLike, "..."] | None = None,
        gps_time: Num[ArrayLike, "..."] | None = None,
        classification: Num[ArrayLike, "..."] | None = None,
        scan_angle: Num[ArrayLike, "..."] | None = None,
        point_source: Num[ArrayLike, "..."] | None = None,
        extra: Mapping[str, tuple[str, Num[ArrayLike, "..."]]] | None = None,
        crs: str | None = None,
    ) -> None:
        """Write a part: one point or more, with the arguments of `write_las`.

        A writer without a `crs` takes that of its first part.

        **Raises:** as `write_las`; ValueError outside of a `with` statement, and for a part whose extra
        numbers, kind of GPS time or `crs` are other ones than those of the first.
        """
        if self._draft is None:
            raise ValueError(f"{self.path} is not open; admissible is with LasWriter(...) as file")
        if extra is not None:
            check_kind("extra", extra, Mapping, "a dict of (description, values) by name")
        if crs is not None:
            written = None if self._system is None else self._system.text
            if written is None and self._header is not None:
                raise ValueError(f"crs = {crs!r} of a part; the first part has none: give it to LasWriter")
            common = common_system({"LasWriter": written, "the part": crs})
            self._system = metric_system("crs", common) if common and written is None else self._system
        coordinates = as_numpy(position, "position")
        n = len(coordinates)
        if intensity is not None:
            intensity = as_numpy(intensity, "intensity")
            if 0.0 < np.max(intensity, initial=0.0) < 0.5:
                message = (
                    f"{self.path}: intensity is at most {np.max(intensity):.2g}, and 0 when it is rounded"
                )
                warn_user(f"{message}: scale it to counts from 0 to 65535", FileWarning)
            intensity = np.round(intensity)
        fields = {
            "intensity": np.zeros(n) if intensity is None else intensity,
            "return_number": np.ones(n, int) if return_number is None else return_number,
            "number_of_returns": np.ones(n, int) if number_of_returns is None else number_of_returns,
            "gps_time": np.zeros(n) if gps_time is None else gps_time,
            "classification": np.zeros(n, int) if classification is None else classification,
            "scan_angle": np.zeros(n) if scan_angle is None else scan_angle,
            "point_source_id": np.zeros(n, int) if point_source is None else point_source,
        }
        offset = None if self._header is None else self._header.offsets
        points = las_points(_FORMAT_6, coordinates, fields, self._system, extra or {}, offset=offset)
        if self._header is None:
            self._header, self._writer = points.header, self._open(self._draft, points.header)
        first, names = (list(h.point_format.extra_dimension_names) for h in (self._header, points.header))
        if first != names:
            raise ValueError(f"extra has {names}; admissible are those of the first part, {first}")
        if self._header.global_encoding.gps_time_type != points.header.global_encoding.gps_time_type:
            raise ValueError(
                f"gps_time is outside 0 to {_SECONDS_OF_WEEK} s in some parts alone; admissible is in all or "
                "in none"
            )
        self._writer.write_points(points.points)

    def _open(self, draft: Path, header: Any) -> Any:
        """Return the writer of laspy; the file is complete when `_files` is closed."""
        is_compressed = self.path.suffix.lower() == ".laz"
        if is_compressed:
            with required_for("writing LAZ"):
                import lazrs  # noqa: F401
        file = self._files.enter_context(draft.open("wb"))
        writer = import_laspy("writing LAS").LasWriter(file, header, do_compress=is_compressed, closefd=False)
        return self._files.enter_context(writer)


def las_points(
    point_format: int,
    position: np.ndarray,
    fields: dict[str, Any],
    system: CoordinateSystem | None,
    extra: Mapping[str, tuple[str, Any]] | None = None,
    *,
    offset: np.ndarray | None = None,
) -> Any:
    """Return points as a `laspy.LasData`, which is not written yet.

    **Arguments:** `position`: (n, 3) coordinates. `fields`: (n,) numbers by laspy's names; scan angles in
    degrees. `system`: the coordinate reference system of `position`; None for none. `extra`: as for
    `write_las`. `offset`: that of coordinates in the file; None: whole metres below all of them.

    **Raises:** ValueError for numbers that the point format does not hold.
    """
    laspy = import_laspy("writing LAS")
    if len(position) == 0:
        raise ValueError("position holds no point; admissible is one or more")
    check_shape("position", position, (len(position), 3))
    check_range("position", position, -MAX_COORDINATE, MAX_COORDINATE)
    fields = {name: np.asarray(values) for name, values in fields.items()}
    is_format_6 = point_format >= _FORMAT_6

    def check_field(name: str, values: np.ndarray, limits: tuple[tuple[float, float], ...]) -> None:
        low, high = limits[is_format_6]
        try:
            check_range(name, values, low, high)
        except ValueError as error:
            lowest, highest = limits[True]
            if is_format_6 or not np.all((values >= lowest) & (values <= highest)):
                raise
            hint = f" of point format {point_format}; formats 6 to 10 hold more"
            raise ValueError(f"{error}{hint}") from None

    if "scan_angle" in fields:
        step = _SCAN_ANGLE_STEPS[is_format_6]
        check_field("scan_angle", fields["scan_angle"], tuple((-m, m) for m in _MAX_SCAN_ANGLES))
        name = "scan_angle" if is_format_6 else "scan_angle_rank"
        fields[name] = np.round(fields.pop("scan_angle") / step)
    for name, values in fields.items():
        check_shape(name, values, (len(position),))
        if name not in _MAX_NUMBERS:
            check_range(name, values)
            continue
        check_field(name, values, tuple((0, largest) for largest in _MAX_NUMBERS[name]))
        if np.any(values != np.floor(values)):
            raise ValueError(f"{name} has values that are not whole numbers")
    is_geographic = system is not None and system.kind == "geographic"
    scale = np.array(_DEGREES if is_geographic else _MM)
    corner = np.floor(position.min(axis=0)) if offset is None else offset
    counts = np.round((position - corner) / scale)
    if np.abs(counts).max() >= 2**31:
        spans = np.abs(position - corner).max(axis=0).tolist()
        raise ValueError(
            f"position spans {spans} from {corner.tolist()}; admissible is 2^31 steps of {scale.tolist()}"
        )
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.generating_software, header.scales, header.offsets = "jaxlidar", scale, corner
    # From format 6 on, the specification admits well-known text alone.
    header.global_encoding.wkt = is_format_6
    if system is not None and system.crs is not None:
        wkt = system.wkt.encode() + b"\0"
        header.vlrs.append(laspy.VLR(PROJECTION_USER.decode(), WKT_RECORD, "", wkt))
        header.global_encoding.wkt = True
    gps_time = fields.get("gps_time", np.zeros(1))
    if gps_time.min() < 0 or gps_time.max() > _SECONDS_OF_WEEK:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    extra_values = {}
    reserved_names = {*"xyz", *header.point_format.dimension_names, *header.point_format.dtype().names}
    for name, entry in (extra or {}).items():
        check_kind("name of extra", name, str, "a text")
        field = f"extra[{name!r}]"
        check_kind(field, entry, tuple, "a tuple (description, values)")
        if len(entry) != 2:
            raise TypeError(f"{field} has {len(entry)} items; admissible are two, (description, values)")
        description, values = entry
        check_kind(f"{field}[0]", description, str, "a text")
        if max(len(name.encode()), len(description.encode())) > _MAX_EXTRA_TEXT:
            raise ValueError(f"extra: {name!r}, {description!r}: admissible are {_MAX_EXTRA_TEXT} bytes each")
        if not name or "\0" in name or name in reserved_names:
            raise ValueError(f"extra: {name!r} is empty or a name that points have; admissible is another")
        check_range(field, values, -_LARGEST_SINGLE, _LARGEST_SINGLE)
        check_shape(field, values, (len(position),))
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32, description))
        extra_values[name] = np.asarray(values, np.float32)
    points = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(position), header=header))
    for axis, values in zip("XYZ", counts.T):
        points[axis] = values.astype(np.int32)
    for name, values in fields.items():
        # Formats below 6 have no scanner channels; they were checked to be zero.
        if name in points.point_format.dimension_names:
            points[name] = values
    for name, values in extra_values.items():
        points[name] = values
    return points


def scan_angles(points: Any) -> np.ndarray:
    """Return the scan angles of points of laspy, degrees."""
    if "scan_angle" in points.point_format.dimension_names:
        return _SCAN_ANGLE_STEPS[1] * np.asarray(points["scan_angle"], float)
    return np.asarray(points["scan_angle_rank"], float)


def las_path(path: str | os.PathLike[str], endings: tuple[str, ...] = (".las",)) -> Path:
    """Return a path. **Raises:** ValueError where it does not end in .las, or another of the endings."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise ValueError(f"path = {path}: its name does not end in {' or '.join(endings)}")
    return path
