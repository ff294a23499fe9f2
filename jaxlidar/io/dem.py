"""Reader of digital elevation models: GeoTIFF and ESRI ASCII grids."""

import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxlidar._checks import check_range, check_shape
from jaxlidar.io.checks import MAX_COORDINATE, check_unpacked_size, existing_file
from jaxlidar.io.text import parse_integer, parse_number, read_lines
from jaxlidar.optics.laws import AbstractLaw, Lambertian
from jaxlidar.scenes.terrain import Terrain

_CORNERS = ("xllcorner", "yllcorner")
_CENTRES = ("xllcenter", "yllcenter")
_KEYS = ("ncols", "nrows", *_CORNERS, *_CENTRES, "cellsize", "dx", "dy", "nodata_value")
_TIFF = (".tif", ".tiff")
# The height that ESRI's own readers take for "no data" where a file does not say.
_DEFAULT_NO_DATA = -9999.0
# Admissible cell sizes and heights, m.
_MIN_CELL_SIZE = 1e-3
_MAX_HEIGHT = 1e5


class DemRead(NamedTuple):
    """Result of `read_dem`: terrain, its coordinate reference system, and the number of nodes filled in.

    - `terrain`: a `Terrain`, one node for each sample of the file.
    - `crs`: the coordinate reference system as the file names it, or None.
    - `filled`: number of nodes without data, which have the height `fill`.

    **Example:**

    >>> import jaxlidar as jl
    >>> from jaxlidar.io import DemRead
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
    reflectance: Any = 0.3,
    law: AbstractLaw = Lambertian(),  # noqa: B008
) -> DemRead:
    """Read terrain from a digital elevation model: a GeoTIFF (.tif, .tiff) or an ESRI ASCII grid.

    Samples are those at the centres of their cells, which become the nodes. Coordinates and heights are
    metres.

    **Arguments:**

    - `path`: the file. A GeoTIFF's first band is read; the package `rasterio` is needed, which the extra `io`
      installs.
    - `bounds`: (west, south, east, north) in m: only nodes within are read. Default None: all.
    - `fill`: height, m, of nodes without data. Default None: such nodes are refused.
    - `reflectance`: of the `Terrain`. Default 0.3.
    - `law`: of the `Terrain`. Default `Lambertian()`.

    **Returns:** a `DemRead`.

    **Raises:** FileNotFoundError where there is no such file; ImportError where a GeoTIFF is read without
    `rasterio`. ValueError, naming the file and the place, for what is damaged; for nodes without data; for
    coordinates in degrees, or a grid that is turned against north; and for `bounds` with fewer than 2 x 2
    nodes.

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
        check_range("fill", fill)
    if bounds is not None:
        check_shape("bounds", bounds, (4,))
        west, south, east, north = map(float, bounds)
        if not (west < east and south < north):
            raise ValueError(f"bounds = {tuple(bounds)} is not (west, south, east, north)")
    path = existing_file(path)
    read = _tiff if path.suffix.lower() in _TIFF else _ascii
    heights, missing, origin, spacing, crs = read(path, bounds)
    if not np.all(
        (spacing >= _MIN_CELL_SIZE) & (spacing <= MAX_COORDINATE) & (np.abs(origin) <= MAX_COORDINATE)
    ):
        raise ValueError(
            f"{path}: the header: cells of {spacing.tolist()} m at {origin.tolist()}; admissible are "
            f"cells of {_MIN_CELL_SIZE:g} m or more, at places within {MAX_COORDINATE:g} m"
        )
    if np.any(missing) and fill is None:
        x, y = origin + spacing * np.argwhere(missing)[0]
        raise ValueError(
            f"{path}: {int(missing.sum())} of {missing.size} nodes have no data, the first at x = {x:.9g}, "
            f"y = {y:.9g}; give their height as fill=, or leave them out by bounds="
        )
    inadmissible = ~missing & ~(np.abs(np.where(missing, 0.0, heights)) <= _MAX_HEIGHT)
    if np.any(inadmissible):
        x, y = origin + spacing * np.argwhere(inadmissible)[0]
        raise ValueError(
            f"{path}: a height of {heights[inadmissible][0]:g} m at x = {x:.9g}, y = {y:.9g}; admissible is "
            f"at most {_MAX_HEIGHT:g}"
        )
    heights = np.where(missing, fill if fill is not None else 0.0, heights)
    terrain = Terrain(heights=heights, spacing=spacing, origin=origin, reflectance=reflectance, law=law)
    return DemRead(terrain, crs, int(missing.sum()))


# Heights (nx, ny), True where they are missing, position of the south-west node, spacing, reference system.
_Grid = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, str | None]


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
    return slices[0], slices[1]


def _ascii(path: Path, bounds: Any) -> _Grid:
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
        if not abs(value) <= MAX_COORDINATE:
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
    x, y = _within(path, bounds, origin, spacing, (nx, ny))
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
    no_data = number("nodata_value") if "nodata_value" in head else _DEFAULT_NO_DATA
    # Rows run from north to south.
    heights = heights[::-1].T[x, y]
    missing = (heights == no_data) | np.isnan(heights)
    return heights, missing, origin + spacing * (x.start, y.start), spacing, None


def _tiff(path: Path, bounds: Any) -> _Grid:
    try:
        import rasterio
        from rasterio.errors import NotGeoreferencedWarning, RasterioError
        from rasterio.windows import Window
    except ImportError as error:
        raise ImportError("GeoTIFF needs the package rasterio: pip install 'jaxlidar[io]'") from error
    try:
        with warnings.catch_warnings():
            # A file without a position is refused below.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            dataset = rasterio.open(path, driver="GTiff")
        with dataset as file:
            # x = a column + b row + c, y = d column + e row + f.
            t, (ny, nx) = file.transform, (file.height, file.width)
            if t.is_identity or t.b != 0 or t.d != 0 or t.a <= 0 or t.e >= 0:
                raise ValueError(f"{path}: the transform {tuple(t)[:6]} is not north-up")
            if file.crs is not None and file.crs.is_geographic:
                raise ValueError(f"{path}: coordinates in degrees ({file.crs}); project the grid to metres")
            spacing = np.array([t.a, -t.e])
            origin = np.array([t.c, t.f]) + spacing * (0.5, 0.5 - ny)
            if nx < 2 or ny < 2:
                raise ValueError(f"{path}: {nx} x {ny} samples; at least 2 x 2 are needed")
            x, y = _within(path, bounds, origin, spacing, (nx, ny))
            check_unpacked_size(path, "the header", 4 * (x.stop - x.start) * (y.stop - y.start))
            window = Window.from_slices((ny - y.stop, ny - y.start), (x.start, x.stop))
            band = file.read(1, window=window, masked=True)
            crs = None if file.crs is None else file.crs.to_string()
    except RasterioError as error:
        raise ValueError(f"{path}: no GeoTIFF, or a damaged one ({error})") from error
    missing = np.ma.getmaskarray(band)
    heights = np.where(missing, np.nan, band.data.astype(float))
    missing = missing | np.isnan(heights)
    return heights[::-1].T, missing[::-1].T, origin + spacing * (x.start, y.start), spacing, crs
