"""Writer of maps of a survey: one number for each shot on a grid, as bands of a GeoTIFF."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from jaxlidar._fields.checks import as_numpy, check_kind, check_number, check_range, check_shape
from jaxlidar._fields.crs import metric_system
from jaxlidar.formats.coordinates import import_rasterio
from jaxlidar.formats.files import atomic_write

_TIFF = (".tif", ".tiff")
# Shots lie on a grid if they are off by less than this fraction of its spacing.
_GRID_TOLERANCE = 1e-3
# Cells of a raster at most: 8 GB of each band.
_MAX_CELLS = 1e9


def write_raster(
    path: str | os.PathLike[str],
    values: Mapping[str, ArrayLike | Sequence],
    position: ArrayLike | Sequence,
    *,
    crs: str | None = None,
    spacing: float | None = None,
) -> None:
    """Write maps, such as heights, cover or ground retrieved for the shots of a survey, as a GeoTIFF.

    Shots of a grid are the centres of cells. Shots anywhere, such as the ground positions of a scanner, are
    averaged in cells of the size `spacing`, whose edges lie at multiples of it. Cells without a shot, and
    those whose number is NaN, have no data: they are NaN, which the file declares as its value of no data.
    Bands are of float64, so numbers keep their bits.

    **Arguments:**

    - `path`: the file to write, .tif or .tiff. Missing folders are created.
    - `values`: (shots,) numbers by name, NaN where there is none; each becomes a band of that name.
    - `position`: (shots, 2) x and y of the shots in m, or (shots, 3), of which z is not used, such as
      `Waveforms.ground_position`, in any order. Without `spacing` they lie on a grid along x and y, as those
      of `Survey.grid` do.
    - `crs`: the coordinate reference system of `position`, in metres, such as "EPSG:32633". Default None: not
      known.
    - `spacing`: edge of the cells in m, positive. Shots whose position is NaN, as that of a beam that meets
      no ground, are left out, and so is each band's NaN. Default None: one shot for each cell of a grid.

    **Returns:** nothing.

    **Raises:** ImportError where `rasterio`, or `pyproj` for `crs`, is not installed; the extra `io` installs
    both. ValueError for values of another number, infinite ones, shots that are not on a grid or twice in one
    cell (without `spacing`), no shot with a position, a `crs` that is not known or not in metres, and another
    kind of file. OSError for a path that cannot be written.

    **Source:** OGC GeoTIFF 1.1.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar as jl
    >>> survey = jl.Survey.grid(jl.Lidar(), low=(0, 0), high=(20, 10), spacing=10.0)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "heights.tif"
    >>> jl.io.write_raster(path, {"RH98": [18.0, 17.5, 19.0, 21.0, 20.5, 22.0]}, survey.position)
    >>> terrain, _, _ = jl.io.read_dem(path)
    >>> print(terrain.origin.tolist(), terrain.heights[:, 0].tolist())
    [0.0, 0.0] [18.0, 17.5, 19.0]
    """
    rasterio = import_rasterio("writing GeoTIFF")
    path = Path(path)
    if path.suffix.lower() not in _TIFF:
        raise ValueError(f"path = {path} ends in {path.suffix!r}; admissible are {', '.join(_TIFF)}")
    check_kind("values", values, Mapping, "a mapping of names to (shots,) numbers")
    if not values:
        raise ValueError("values is empty; admissible is one map or more")
    if spacing is not None:
        check_number("spacing", spacing, 0.0, low_open=True)
    has_place, cells, origin, cell_size, shape = (
        _grid(position) if spacing is None else _cells(position, spacing)
    )
    bands = np.full((len(values), *shape), np.nan)
    for band, (name, shot_values) in zip(bands, values.items()):
        numbers = as_numpy(shot_values, f"values of {name!r}")
        check_shape(f"values of {name!r}", numbers, (len(has_place),))
        check_range(f"values of {name!r}", np.where(np.isnan(numbers), 0.0, numbers))
        # Rows run from north to south.
        band[:] = _cell_means(numbers[has_place], cells, shape)[::-1]
    west, north = origin[0] - 0.5 * cell_size[0], origin[1] + (shape[0] - 0.5) * cell_size[1]
    transform = rasterio.Affine(cell_size[0], 0.0, west, 0.0, -cell_size[1], north)
    profile: dict[str, Any] = {"driver": "GTiff", "count": len(bands), "dtype": "float64", "nodata": np.nan}
    profile["crs"] = None if crs is None else metric_system("crs", crs).crs
    profile |= {"height": shape[0], "width": shape[1], "transform": transform}
    with atomic_write(path) as draft, rasterio.open(draft, "w", **profile) as file:
        file.write(bands)
        for number, name in enumerate(values, 1):
            file.set_band_description(number, name)


# True for shots that have a place, the column and the row of each of these, the centre of the south-west
# cell, the size of cells, and (rows, columns).
_Grid = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]


def _cell_means(numbers: np.ndarray, cells: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the mean of the numbers in each cell, from south to north; NaN where there is none."""
    is_known = ~np.isnan(numbers)
    index = (cells[:, 1] * shape[1] + cells[:, 0])[is_known]
    count, total = (np.bincount(index, w, shape[0] * shape[1]) for w in (None, numbers[is_known]))
    # One number divided by one keeps its bits.
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)


def _horizontal(position: ArrayLike | Sequence, *, missing: bool) -> np.ndarray:
    """Return x and y of shots; with `missing`, NaN for those without a place."""
    xy = as_numpy(position, "position")
    if xy.ndim != 2 or xy.shape[1] not in (2, 3) or len(xy) == 0:
        raise ValueError(f"position has the shape {xy.shape}; admissible is (shots, 2), one or more")
    xy = xy[:, :2]
    check_range("position", np.where(np.isnan(xy), 0.0, xy) if missing else xy)
    return xy


def _cells(position: ArrayLike | Sequence, spacing: float) -> _Grid:
    """Return the cells of the size `spacing` in which shots lie.

    **Raises:** as `write_raster`.
    """
    xy = _horizontal(position, missing=True)
    has_place = np.asarray(~np.isnan(xy).any(axis=1))
    if not has_place.any():
        raise ValueError("position is NaN for all shots; admissible is one or more with a position")
    numbers = np.floor(xy[has_place] / spacing)
    low, high = numbers.min(axis=0), numbers.max(axis=0)
    columns, rows = (high - low + 1).tolist()
    if columns * rows > _MAX_CELLS:
        raise ValueError(
            f"spacing = {spacing:g} m makes {columns * rows:.3g} cells; admissible are {_MAX_CELLS:g}"
        )
    cells = (numbers - low).astype(int)
    return has_place, cells, spacing * (low + 0.5), np.full(2, float(spacing)), (int(rows), int(columns))


def _grid(position: ArrayLike | Sequence) -> _Grid:
    """Return the grid of shots.

    **Raises:** as `write_raster`.
    """
    xy = _horizontal(position, missing=False)
    low = xy.min(axis=0)
    spacing = np.array([_grid_spacing(xy[:, axis]) for axis in range(2)])
    # A single row or column has the spacing of the other axis.
    spacing = np.where(spacing > 0, spacing, spacing.max())
    spacing = np.where(spacing > 0, spacing, 1.0)
    cell_coordinates = (xy - low) / spacing
    cells = np.round(cell_coordinates).astype(int)
    deviation = np.abs(cell_coordinates - cells).max(axis=1)
    if np.any(deviation > _GRID_TOLERANCE):
        worst = int(np.argmax(deviation))
        raise ValueError(
            f"position: shot {worst} at {xy[worst].tolist()} m is off the grid of {spacing.tolist()} m "
            f"from {low.tolist()}; admissible are shots on a grid along x and y"
        )
    columns, rows = (int(n) + 1 for n in cells.max(axis=0))
    unique, first = np.unique(cells[:, 1] * columns + cells[:, 0], return_index=True)
    if len(unique) < len(cells):
        duplicate = int(np.setdiff1d(np.arange(len(cells)), first)[0])
        raise ValueError(
            f"position: shot {duplicate} lies where another one does; admissible is one for each cell"
        )
    return np.ones(len(xy), bool), cells, low, spacing, (rows, columns)


def _grid_spacing(x: np.ndarray) -> float:
    """Return the smallest distance between different coordinates, or 0 where all are equal."""
    extent = float(np.ptp(x))
    distances = np.diff(np.unique(x))
    # Coordinates that differ by rounding alone are equal.
    distances = distances[distances > _GRID_TOLERANCE * max(extent, 1e-9) / len(x)]
    if distances.size == 0:
        return 0.0
    # The extent over the number of steps is more exact than a single step, which is rounded.
    return extent / max(round(extent / float(distances.min())), 1)
