"""Reader of digital elevation models: GeoTIFF and ESRI ASCII grids."""

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxlidar._fields.checks import check_number, check_numbers, check_shape, warn_user
from jaxlidar._fields.crs import CoordinateSystem, system_of_crs, system_of_name, units_agree
from jaxlidar._fields.units import unit_size
from jaxlidar.formats.checks import MAX_COORDINATE, FileWarning, check_unpacked_size, existing_file
from jaxlidar.formats.coordinates import MAX_ELEVATION, MIN_ELEVATION, open_raster
from jaxlidar.formats.text import parse_integer, parse_number, read_lines
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.scenes.terrain import Terrain

_CORNERS = ("xllcorner", "yllcorner")
_CENTRES = ("xllcenter", "yllcenter")
_NO_DATA_KEY = "nodata_value"
_KEYS = ("ncols", "nrows", *_CORNERS, *_CENTRES, "cellsize", "dx", "dy", _NO_DATA_KEY)
_TIFF = (".tif", ".tiff")
# Numbers that stand for "no data" where a file does not say so, that of ESRI's own readers first, and the
# largest number of single precision, without its last digits.
_NO_DATA, _LARGEST_SINGLE = (-9999.0, -32768.0, -32767.0, -99999.0), 3.4e38
# The unit of heights in a .prj file of ArcInfo's old form; "NO" for none.
_HEIGHT_UNIT = re.compile(r"^\s*zunits\s+(\S+)", re.IGNORECASE | re.MULTILINE)
# Bounds may lie beyond the cells of a file by this fraction of a cell.
_ROUNDING_OF_BOUNDS = 1e-3
# Admissible cell sizes, m.
_MIN_CELL_SIZE = 1e-3
# Grids of unknown units are in degrees if their cells are smaller than this, m, or their mean slope is
# larger, where they lie within longitudes and latitudes.
_SMALLEST_TERRAIN_CELL, _LARGEST_MEAN_SLOPE = 0.009, 3.0


class DemRead(NamedTuple):
    """Result of `read_dem`: terrain, its coordinate reference system, and the number of nodes filled in.

    - `terrain`: a `Terrain`, one node for each sample of the file.
    - `crs`: the coordinate reference system of the terrain, or None: that which the file names, with metres
      as its unit.
    - `filled`: number of nodes without data, which have the height `fill`.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.formats.dem import DemRead
    >>> terrain, crs, filled = DemRead(jl.Terrain([[0.0, 1.0], [0.0, 1.0]], 1.0), "EPSG:32633", 0)
    >>> print(terrain.heights.shape, crs)
    (2, 2) EPSG:32633
    """

    terrain: Terrain
    crs: str | None
    filled: int


def read_dem(
    path: str | os.PathLike[str],
    *,
    bounds: tuple[float, float, float, float] | None = None,
    fill: float | None = None,
    crs: str | None = None,
    reflectance: Any = 0.3,
    law: AbstractLaw = Lambertian(),  # noqa: B008
) -> DemRead:
    """Read terrain from a digital elevation model: a GeoTIFF (.tif, .tiff) or an ESRI ASCII grid.

    Samples are those at the centres of their cells, which become the nodes. Coordinates and heights become
    metres, by the units, the scale and the offset that the file declares; without units they are metres.

    **Arguments:**

    - `path`: the file. A GeoTIFF's first band is read. The coordinate reference system of an ASCII grid lies
      in a .prj file beside it. For both the packages `rasterio` and `pyproj` are needed, of the extra `io`.
    - `bounds`: (west, south, east, north) in m: only nodes within are read, and the terrain ends where the
      file does. Default None: all.
    - `fill`: height, m, of nodes without data. Default None: such nodes are refused. They are those that the
      file declares, NaN, and numbers that stand for no data by custom: -9999, -99999, -32767, -32768 and the
      largest ones of single precision.
    - `crs`: the coordinate reference system of the file, in place of what it declares, with the vertical one
      where that is not in metres, such as "EPSG:2225+6360". Default None: as declared.
    - `reflectance`: of the `Terrain`. Default 0.3.
    - `law`: of the `Terrain`. Default `Lambertian()`.

    **Returns:** a `DemRead`.

    **Warns:** `FileWarning` for `bounds` beyond the cells of the file.

    **Raises:** FileNotFoundError where there is no such file; ImportError without `rasterio` where that is
    needed, or without `pyproj` where there is a coordinate reference system. ValueError, naming the file and
    the place, for what is damaged; for nodes without data; for coordinates in degrees, or a grid that is
    turned against north; for a unit that is not known, and heights without a unit where x and y are not in
    metres; and for `bounds` with fewer than 2 x 2 nodes.

    **Source:** ESRI's ASCII raster format; OGC GeoTIFF 1.1.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar.io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "hill.asc"
    >>> head = "ncols 2\\nnrows 2\\nxllcorner 500000\\nyllcorner 5200000\\ncellsize 10\\n"
    >>> _ = path.write_text(head + "7 8\\n5 6\\n")
    >>> terrain, _, _ = jaxlidar.io.read_dem(path)
    >>> print(terrain.origin.tolist(), terrain.heights.tolist())
    [500005.0, 5200005.0] [[5.0, 7.0], [6.0, 8.0]]
    """
    if fill is not None:
        check_number("fill", fill)
    if bounds is not None:
        check_numbers("bounds", bounds)
        check_shape("bounds", bounds, (4,))
        west, south, east, north = map(float, bounds)
        if not (west < east and south < north):
            raise ValueError(f"bounds = {tuple(bounds)} is not (west, south, east, north)")
    grid = read_grid(path, bounds=bounds, crs=crs)
    missing = np.isnan(grid.heights)
    if np.any(missing) and fill is None:
        x, y = grid.origin + grid.spacing * np.argwhere(missing)[0]
        raise ValueError(
            f"{path}: {int(missing.sum())} of {missing.size} nodes have no data, the first at x = {x:.9g}, "
            f"y = {y:.9g}; give their height as fill=, or leave them out by bounds="
        )
    terrain = Terrain(
        heights=np.where(missing, fill if fill is not None else 0.0, grid.heights),
        spacing=grid.spacing,
        origin=grid.origin,
        reflectance=reflectance,
        law=law,
        crs=grid.map_name,
    )
    return DemRead(terrain, grid.crs, int(missing.sum()))


class HeightGrid(NamedTuple):
    """Heights of a digital elevation model at the centres of its cells.

    - `heights`: (nx, ny) m, NaN where the file has no data.
    - `origin`: (2,) position of the south-west node, and `spacing`: (2,) of the nodes, m.
    - `crs`: the coordinate reference system of these numbers, or None. `map_name`: the same, unless the unit
      of the file is not known.
    """

    heights: Float[np.ndarray, "nx ny"]
    origin: Float[np.ndarray, " 2"]
    spacing: Float[np.ndarray, " 2"]
    crs: str | None
    map_name: str | None


def read_grid(
    path: str | os.PathLike[str],
    *,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
) -> HeightGrid:
    """Read the heights of a digital elevation model, with NaN where it has no data. Arguments as `read_dem`.

    **Raises:** as `read_dem`, but for nodes without data.
    """
    path = existing_file(path)
    system = None if crs is None else system_of_name("crs", crs)
    with _opened(path) as stored:
        # In units of the file until here.
        system = system_of_crs(f"{path}: the header", stored.crs) if system is None else system
        horizontal = system.horizontal_length(f"{path}: the header")
        spacing, origin = horizontal * stored.spacing, horizontal * stored.origin
        if not np.all(
            (spacing >= _MIN_CELL_SIZE) & (spacing <= MAX_COORDINATE) & (np.abs(origin) <= MAX_COORDINATE)
        ):
            raise ValueError(
                f"{path}: the header: cells of {spacing.tolist()} m at {origin.tolist()}; admissible are "
                f"cells of {_MIN_CELL_SIZE:g} m or more, at places within {MAX_COORDINATE:g} m"
            )
        x, y = _within(path, bounds, origin, spacing, stored.shape)
        check_unpacked_size(path, "the header", 4 * (x.stop - x.start) * (y.stop - y.start))
        counts, missing = stored.read(x, y)
    is_largest = np.isfinite(counts) & (np.abs(counts) >= _LARGEST_SINGLE)
    missing = missing | np.isnan(counts) | np.isin(counts, _NO_DATA) | is_largest
    metres = _height_unit(path, stored.height_unit, system, crs is not None)
    heights = metres * (stored.scale * np.where(missing, np.nan, counts) + stored.offset)
    wrong = (heights < MIN_ELEVATION) | (heights > MAX_ELEVATION)
    if np.any(wrong):
        east, north = origin + spacing * (np.argwhere(wrong)[0] + (x.start, y.start))
        raise ValueError(
            f"{path}: a height of {heights[wrong][0]:g} m at x = {east:.9g}, y = {north:.9g}; admissible is "
            f"[{MIN_ELEVATION:g}, {MAX_ELEVATION:g}]"
        )
    if system.crs is None and _looks_like_degrees(origin, spacing, stored.shape, heights):
        raise ValueError(
            f"{path}: cells of {spacing.tolist()} at {origin.tolist()} have the slopes of a grid in degrees; "
            "project it to metres, or give its coordinate reference system as crs="
        )
    return HeightGrid(
        heights, origin + spacing * (x.start, y.start), spacing, system.in_metres().text, system.map_name
    )


def _height_unit(path: Path, unit: str | None, system: CoordinateSystem, is_argument: bool) -> float:
    """Return the metres per unit of height, of the band's own unit or of the coordinate reference system.

    **Raises:** ValueError where these differ, and where x and y have another unit than the metre and heights
    have none.
    """
    own = unit_size("length", f"{path}: band 1", unit)
    if own is not None and system.vertical is not None and not units_agree(own, system.vertical):
        raise ValueError(
            f"{path}: the unit of heights is {unit!r} in the band, but {system.vertical:g} m in {system.name}"
        )
    metres = own or system.vertical
    if metres is None and not units_agree(system.horizontal or 1.0, 1.0):
        name = "crs" if is_argument else f"{path}: the header"
        raise ValueError(
            f"{name}: x and y are in units of {system.horizontal:g} m ({system.name}), but heights have no "
            "unit; give the system with that of heights as crs=, such as 'EPSG:2225+6360' for feet or "
            "'EPSG:2225+5703' for metres"
        )
    return metres or 1.0


def _looks_like_degrees(
    origin: np.ndarray, spacing: np.ndarray, shape: tuple[int, int], heights: np.ndarray
) -> bool:
    """Return True if a grid lies within longitudes and latitudes and is steeper than any terrain."""
    end = origin + spacing * shape
    if not np.all((origin >= (-180.5, -90.5)) & (end <= (360.5, 90.5))):
        return False
    rises = [np.abs(np.diff(heights, axis=k)) / spacing[k] for k in range(2)]
    slopes = np.concatenate([rise[np.isfinite(rise)] for rise in rises])
    return bool(np.all(spacing < _SMALLEST_TERRAIN_CELL)) or (
        slopes.size > 0 and float(slopes.mean()) > _LARGEST_MEAN_SLOPE
    )


class _StoredGrid(NamedTuple):
    """A grid as its file has it, in the file's units; `read` gives counts (nx, ny), and True for no data."""

    shape: tuple[int, int]
    origin: np.ndarray
    spacing: np.ndarray
    read: Callable[[slice, slice], tuple[np.ndarray, np.ndarray]]
    crs: Any = None
    height_unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_StoredGrid]:
    """Open a grid by the ending of its name. **Raises:** as `read_dem`."""
    if path.suffix.lower() not in _TIFF:
        yield _ascii(path)
        return
    with open_raster(path, "GTiff") as file:
        yield _tiff(path, file)


def _within(
    path: Path, bounds: Any, origin: np.ndarray, spacing: np.ndarray, shape: tuple[int, int]
) -> tuple[slice, slice]:
    """Return slices of the nodes within the bounds, along x and along y."""
    if bounds is None:
        return slice(0, shape[0]), slice(0, shape[1])
    slices = []
    for k in range(2):
        position = origin[k] + spacing[k] * np.arange(shape[k])
        inside = np.flatnonzero((position >= bounds[k]) & (position <= bounds[k + 2]))
        if inside.size < 2:
            raise ValueError(
                f"{path}: {inside.size} nodes lie between {bounds[k]:.9g} and {bounds[k + 2]:.9g} m along "
                f"{'xy'[k]}; the file has {position[0]:.9g} to {position[-1]:.9g} m, and at least 2 are "
                "needed"
            )
        slices.append(slice(int(inside[0]), int(inside[-1]) + 1))
    # Nodes are centres of cells. Bounds that are those of the file may be rounded.
    low, high = origin - 0.5 * spacing, origin + spacing * (np.array(shape) - 0.5)
    margin, limits = _ROUNDING_OF_BOUNDS * spacing, np.array(bounds, float)
    # Infinite ones ask for all that there is.
    is_beyond = np.r_[limits[:2] < low - margin, limits[2:] > high + margin] & np.isfinite(limits)
    if np.any(is_beyond):
        (west, south), (east, north) = low.tolist(), high.tolist()
        warn_user(
            f"{path}: bounds = {tuple(map(float, bounds))} reach beyond the file, from ({west:.9g}, "
            f"{south:.9g}) to ({east:.9g}, {north:.9g}) m: the terrain ends there",
            FileWarning,
        )
    return slices[0], slices[1]


def _ascii(path: Path) -> _StoredGrid:
    """Read an ESRI ASCII grid, and with GDAL what files beside it declare.

    GDAL reads heights that are no numbers as 0, takes 0 for an origin that the header lacks, and skips
    heights beyond the last one.
    """
    _, lines = read_lines(path)
    # Text and line number of each entry of the header, which ends where a line begins with no keyword.
    head: dict[str, tuple[str, int]] = {}
    end = 0
    for end, line in enumerate(lines):
        cells = line.split()
        if not cells or cells[0].lower() not in _KEYS:
            break
        key = cells[0].lower()
        if len(cells) != 2 or key in head:
            raise ValueError(f"{path}: line {end + 1}: {line.strip()[:40]!r} is no line of a header")
        head[key] = (cells[1], end + 1)

    def number(key: str) -> float:
        if key not in head:
            raise ValueError(f"{path}: line {end + 1}: the header has no {key}: no ESRI ASCII grid")
        text, line = head[key]
        value = parse_number(path, line, key, text)
        if not abs(value) <= MAX_COORDINATE and key != _NO_DATA_KEY:
            raise ValueError(f"{path}: line {line}: {key} = {text} lies beyond {MAX_COORDINATE:g}")
        return value

    nx, ny = (int(number(key)) for key in ("ncols", "nrows"))
    for key, count in (("ncols", nx), ("nrows", ny)):
        if parse_integer(path, head[key][1], key, head[key][0]) < 2:
            raise ValueError(f"{path}: line {head[key][1]}: {key} = {count}; at least 2 are needed")
    size_keys = ("dx", "dy") if "dx" in head else ("cellsize",) * 2
    spacing = np.array([number(key) for key in size_keys])
    for key, size in zip(size_keys, spacing):
        if not size > 0:
            raise ValueError(f"{path}: line {head[key][1]}: {key} = {size:g}; admissible is above 0")
    is_centred = _CENTRES[0] in head
    corner = np.array([number(key) for key in (_CENTRES if is_centred else _CORNERS)])
    origin = corner if is_centred else corner + 0.5 * spacing
    check_unpacked_size(path, "the header", 2 * nx * ny)
    heights = np.empty((ny, nx))
    # Rows of the grid need not be lines of the file, so values are counted.
    count, flat = 0, heights.reshape(-1)
    for number_of_line, line in enumerate(lines[end:], end + 1):
        cells = line.split()
        if count + len(cells) > flat.size:
            raise ValueError(f"{path}: line {number_of_line}: more than {nx} x {ny} heights")
        try:
            flat[count : count + len(cells)] = cells
        except ValueError:
            # One by one, for an error that names the cell.
            for cell in cells:
                parse_number(path, number_of_line, "height", cell)
        count += len(cells)
    if count < flat.size:
        raise ValueError(f"{path}: line {len(lines)}: {flat.size - count} of {flat.size} heights are missing")
    no_data = number(_NO_DATA_KEY) if _NO_DATA_KEY in head else _NO_DATA[0]
    # Rows run from north to south. Digits may be those of single precision, as of -3.4028235e38.
    heights = heights[::-1].T
    with np.errstate(over="ignore"):
        missing = (heights == no_data) | (heights.astype(np.float32) == np.float32(no_data))

    def read(x: slice, y: slice) -> tuple[np.ndarray, np.ndarray]:
        return heights[x, y], missing[x, y]

    stored = _StoredGrid((nx, ny), origin, spacing, read)
    declarations = (f"{path.stem}.prj".lower(), f"{path.name}.aux.xml".lower())
    if not any(sibling.name.lower() in declarations for sibling in path.parent.iterdir()):
        return stored
    with open_raster(path, "AAIGrid") as file:
        stored = _with_declarations(stored, file)
    projections = [s for s in path.parent.iterdir() if s.name.lower() == f"{path.stem}.prj".lower()]
    for projection in projections:
        if stored.crs is None:
            raise ValueError(f"{projection}: the coordinate reference system is not known")
        unit = _HEIGHT_UNIT.search(projection.read_text("utf-8", "replace"))
        if unit and unit[1].lower() != "no":
            stored = stored._replace(height_unit=unit[1])
    return stored


def _with_declarations(stored: _StoredGrid, file: Any) -> _StoredGrid:
    """Return a grid with the system, unit, scale and offset that an open raster file declares."""
    return stored._replace(
        crs=file.crs, height_unit=file.units[0], scale=file.scales[0], offset=file.offsets[0]
    )


def _tiff(path: Path, file: Any) -> _StoredGrid:
    # x = a column + b row + c, y = d column + e row + f.
    t, (ny, nx) = file.transform, (file.height, file.width)
    if t.is_identity or t.b != 0 or t.d != 0 or t.a <= 0 or t.e >= 0:
        raise ValueError(f"{path}: the transform {tuple(t)[:6]} is not north-up")
    if nx < 2 or ny < 2:
        raise ValueError(f"{path}: {nx} x {ny} samples; at least 2 x 2 are needed")
    if file.dtypes[0].startswith("complex"):
        raise ValueError(f"{path}: band 1 has complex numbers")
    spacing = np.array([t.a, -t.e])

    def read(x: slice, y: slice) -> tuple[np.ndarray, np.ndarray]:
        # Rows run from north to south.
        band = file.read(1, window=((ny - y.stop, ny - y.start), (x.start, x.stop)), masked=True)
        return band.data.astype(float)[::-1].T, np.ma.getmaskarray(band)[::-1].T

    origin = np.array([t.c, t.f]) + spacing * (0.5, 0.5 - ny)
    return _with_declarations(_StoredGrid((nx, ny), origin, spacing, read), file)
