"""Tables of shots or segments: columns with units, some of them with a second axis such as levels or layers.

Readers of level-2 products return a `ShotTable`, and so does whatever makes one row of each shot. It is
written as netCDF (CF conventions; the second axes are dimensions with coordinates), CSV, Parquet or
GeoPackage. The last three have no second axis: a column `rh` of levels 0 ... 100 becomes `rh_0` ... `rh_100`.
"""

import csv
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from jaxlidar._fields.checks import check_choice, check_kind, required_for
from jaxlidar._fingerprint import version_of
from jaxlidar.formats.files import atomic_write
from jaxlidar.formats.hdf5 import rows_in_order

# Rows and columns that are printed, and the width of a printed column.
_PRINTED_ROWS, _PRINTED_COLUMNS, _WIDTH = 8, 7, 12
# Names and units by the CF conventions of the columns that place a row on the Earth.
_COORDINATES = {"latitude": "degrees_north", "longitude": "degrees_east"}
# A point of well-known binary: little-endian, geometry type 1, longitude and latitude.
_POINT = struct.Struct("<BIdd")
_POINT_TYPE = 1


class ColumnAxis(NamedTuple):
    """The second axis of a column.

    - `name`: of the axis, such as "layer".
    - `values`: (levels,) its coordinates, such as the heights of the layers' middles.
    - `unit`: of the coordinates.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.formats.tables import ColumnAxis
    >>> ColumnAxis("layer", np.array([2.5, 7.5]), "m").name
    'layer'
    """

    name: str
    values: Float[np.ndarray, " levels"]
    unit: str = ""


class Column(NamedTuple):
    """One column of a `ShotTable`.

    - `values`: (rows,) or (rows, levels) numbers, or (rows,) texts. NaN stands for a missing number.
    - `unit`: of the numbers. Default: none.
    - `description`: what the numbers are, in a phrase. Default: none.
    - `axis`: the `ColumnAxis` of the second dimension. Default None: there is one dimension.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import Column
    >>> Column(np.array([101.2, 99.8]), "m", "elevation of the ground").unit
    'm'
    """

    values: Shaped[np.ndarray, "rows ..."]
    unit: str = ""
    description: str = ""
    axis: ColumnAxis | None = None


class ShotTable:
    """A table with a row for each shot, or for each segment of a track.

    `table["ground"]` is the array of a column, `len(table)` the number of rows, and `list(table)` the names.

    **Arguments:**

    - `columns`: by name, `Column`s of the same number of rows.
    - `attributes`: texts that describe the table, such as its source. Default: none.

    **Raises:** TypeError for columns of another type. ValueError for columns of different lengths, and for a
    second dimension without an axis of its size.

    **Example:**

    >>> import numpy as np
    >>> from jaxlidar.io import Column, ShotTable
    >>> ground = Column(np.array([101.25, np.nan]), "m", "elevation of the ground")
    >>> table = ShotTable({"shot_number": Column(np.array([7, 9])), "ground": ground})
    >>> print(table)
    2 rows, 2 columns
     shot_number       ground
                            m
               7       101.25
               9            -
    """

    def __init__(self, columns: Mapping[str, Column], attributes: Mapping[str, str] | None = None):
        self.columns, self.attributes = dict(columns), dict(attributes or {})
        for name, column in self.columns.items():
            check_kind(name, column, Column, "a Column")
            if len(column.values) != len(self):
                raise ValueError(
                    f"{name} has {len(column.values)} rows; admissible is {len(self)}, as of all"
                )
            levels = () if column.axis is None else (np.size(column.axis.values),)
            if np.shape(column.values)[1:] != levels:
                raise ValueError(
                    f"{name} has the shape {np.shape(column.values)}; admissible is {(len(self), *levels)}"
                )

    def __len__(self) -> int:
        first = next(iter(self.columns.values()), None)
        return 0 if first is None else len(first.values)

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def keys(self) -> Any:
        """Return the names of the columns."""
        return self.columns.keys()

    def __getitem__(self, name: str) -> np.ndarray:
        check_choice("column", name, tuple(self.columns))
        return self.columns[name].values

    def __repr__(self) -> str:
        return f"ShotTable({len(self)} rows: {', '.join(self.columns)})"

    def __str__(self) -> str:
        """Return the first rows of the first columns: a page, whatever the size of the table."""
        shown = [(n, c) for n, c in self.columns.items() if c.values.ndim == 1][:_PRINTED_COLUMNS]
        lines = [f"{len(self)} rows, {len(self.columns)} columns"]
        lines.append(" ".join(f"{name[:_WIDTH]:>{_WIDTH}}" for name, _ in shown))
        if any(column.unit for _, column in shown):
            lines.append(" ".join(f"{column.unit[:_WIDTH]:>{_WIDTH}}" for _, column in shown))
        for row in range(min(len(self), _PRINTED_ROWS)):
            lines.append(" ".join(f"{_printed(column.values[row]):>{_WIDTH}}" for _, column in shown))
        if len(self) > _PRINTED_ROWS:
            lines.append(f"... {len(self) - _PRINTED_ROWS} more rows")
        hidden = [name for name in self.columns if name not in dict(shown)]
        if hidden:
            names = ", ".join(hidden[:_PRINTED_COLUMNS])
            ellipsis = ", ..." if len(hidden) > _PRINTED_COLUMNS else ""
            lines.append(f"and {len(hidden)} more columns: {names}{ellipsis}")
        return "\n".join(line.rstrip() for line in lines)

    def select(self, rows: Any) -> "ShotTable":
        """Return the table of some rows.

        **Arguments:** `rows`: a slice, an array of booleans (rows,) or of row numbers.

        **Returns:** a `ShotTable`.
        """
        columns = {name: column._replace(values=column.values[rows]) for name, column in self.columns.items()}
        return ShotTable(columns, self.attributes)

    def join(self, table: "ShotTable", *, on: str = "shot_number", suffix: str = "_joined") -> "ShotTable":
        """Return this table with the columns of another one, row by row where a number is the same.

        Rows that the other table does not have get NaN, or the empty text. Integers with such rows become
        floating-point numbers.

        **Arguments:**

        - `table`: the other `ShotTable`, in which each number is unique.
        - `on`: the column of whole numbers that both have. Default "shot_number".
        - `suffix`: of columns of the other table whose names both have. Default "_joined".

        **Returns:** a `ShotTable`, with the rows of this one in their order.

        **Raises:** ValueError where a table lacks the column `on`, or the other has a number twice.
        """
        check_kind("table", table, ShotTable, "a ShotTable")
        rows = matching_rows(self[on], table[on], on)
        columns = dict(self.columns)
        for name, column in table.columns.items():
            if name != on:
                columns[f"{name}{suffix}" if name in columns else name] = _rows_of(column, rows)
        return ShotTable(columns, {**table.attributes, **self.attributes})

    def flat(self) -> dict[str, Column]:
        """Return columns of one dimension: of a second axis each level is a column, named by its coordinate.

        **Returns:** `Column`s by name, such as `rh_98`.
        """
        columns = {}
        for name, column in self.columns.items():
            if column.axis is None:
                columns[name] = column
                continue
            for level, coordinate in enumerate(np.asarray(column.axis.values).tolist()):
                text = f"{column.description}, {column.axis.name} {coordinate:g} {column.axis.unit}".rstrip()
                values = column.values[:, level]
                columns[f"{name}_{coordinate:g}"] = Column(values, column.unit, text)
        return columns

    def to_xarray(self) -> Any:
        """Return an `xarray.Dataset` by the CF conventions, with second axes as dimensions.

        **Raises:** ImportError without xarray, which the extra `io` installs.
        """
        with required_for("making datasets"):
            import xarray
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {}
        for name, column in self.columns.items():
            attributes = {"units": _COORDINATES.get(name, column.unit), "long_name": column.description}
            if name in _COORDINATES:
                attributes["standard_name"] = name
            attributes = {key: text for key, text in attributes.items() if text}
            values = column.values.astype(object) if column.values.dtype.kind == "U" else column.values
            if column.axis is None:
                target = coordinates if name in _COORDINATES else variables
                target[name] = ("shot", values, attributes)
                continue
            axis = column.axis
            variables[name] = (("shot", axis.name), values, attributes)
            coordinates[axis.name] = (axis.name, axis.values, {"units": axis.unit} if axis.unit else {})
        texts = {"Conventions": "CF-1.10", "source": f"jaxlidar {version_of('jaxlidar')}", **self.attributes}
        return xarray.Dataset(variables, coordinates, texts)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table, in the format that the name ends as: .nc, .csv, .parquet or .gpkg.

        GeoPackage has a point of longitude and latitude (WGS-84) for each row, and no row without.

        **Arguments:** `path`: the file to write. It appears when it is complete. Missing folders are created.

        **Raises:** ValueError for another ending, and for a GeoPackage of a table without longitude and
        latitude. ImportError without the package that writes the format: xarray and h5netcdf of the extra
        `io`, pyarrow or pyogrio of the extra `tables`. OSError for a path that cannot be written.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in TABLE_FORMATS:
            raise ValueError(f"{path}: the name ends in none of {', '.join(TABLE_FORMATS)}")
        write = TABLE_FORMATS[suffix]
        with atomic_write(path) as draft:
            write(self, draft)


def matching_rows(numbers: np.ndarray, reference: np.ndarray, name: str) -> np.ndarray:
    """Return the row of each number in a table of reference; -1 where it has none.

    **Raises:** ValueError where the reference has a number twice.
    """
    unique, counts = np.unique(reference, return_counts=True)
    if counts.max(initial=1) > 1:
        raise ValueError(
            f"{name} = {unique[counts.argmax()]} is that of {counts.max()} rows of the other table"
        )
    return rows_in_order(np.asarray(reference), numbers)


def _rows_of(column: Column, rows: np.ndarray) -> Column:
    """Return rows of a column, missing ones for -1."""
    is_missing, values = rows < 0, column.values
    if len(values) == 0:
        values = np.zeros((1, *values.shape[1:]), values.dtype)
    taken = values[np.maximum(rows, 0)]
    if is_missing.any():
        if taken.dtype.kind == "U":
            taken[is_missing] = ""
        else:
            taken = taken.astype(float)
            taken[is_missing] = np.nan
    return column._replace(values=taken)


def _printed(value: Any) -> str:
    """Return a value for the eye, short of a column's width."""
    if isinstance(value, float | np.floating):
        text = "-" if np.isnan(value) else f"{value:.6g}"
    else:
        text = str(value)
    return text if len(text) <= _WIDTH else f"{text[: _WIDTH - 1]}…"


def _write_netcdf(table: ShotTable, path: Path) -> None:
    with required_for("writing netCDF"):
        import h5netcdf  # noqa: F401
    table.to_xarray().to_netcdf(path, engine="h5netcdf")


def _write_csv(table: ShotTable, path: Path) -> None:
    columns = table.flat()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        values = [column.values.tolist() for column in columns.values()]
        # An empty cell is a missing number, for spreadsheets as for pandas.
        writer.writerows(["" if x != x else x for x in row] for row in zip(*values, strict=True))


def _write_parquet(table: ShotTable, path: Path) -> None:
    with required_for("writing Parquet", "tables"):
        import pyarrow  # pyright: ignore[reportMissingImports]
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    fields, arrays = [], []
    for name, column in table.flat().items():
        array = pyarrow.array(column.values)
        metadata = {"unit": column.unit, "description": column.description}
        fields.append(pyarrow.field(name, array.type, metadata=metadata))
        arrays.append(array)
    schema = pyarrow.schema(fields, metadata=table.attributes)
    parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=schema), path)


def _write_geopackage(table: ShotTable, path: Path) -> None:
    with required_for("writing GeoPackage", "tables"):
        import pyogrio.raw  # pyright: ignore[reportMissingImports]
    for name in _COORDINATES:
        if name not in table:
            raise ValueError(f"{path}: the table has no {name}: a GeoPackage has points")
    placed = table.select(np.isfinite(table["longitude"]) & np.isfinite(table["latitude"]))
    columns = placed.flat()
    points = [_POINT.pack(1, _POINT_TYPE, x, y) for x, y in zip(placed["longitude"], placed["latitude"])]
    # GeoPackage has signed integers only, and texts as objects.
    fields = [
        c.values.astype(object)
        if c.values.dtype.kind == "U"
        else c.values.astype(np.int64)
        if c.values.dtype.kind in "iu"
        else c.values.astype(np.float64)
        for c in columns.values()
    ]
    pyogrio.raw.write(
        path,
        np.array(points, object),
        fields,
        list(columns),
        layer=path.stem,
        driver="GPKG",
        geometry_type="Point",
        crs="EPSG:4326",
    )


# Writers by the ending of the file's name.
TABLE_FORMATS: dict[str, Callable[[ShotTable, Path], None]] = {
    ".csv": _write_csv,
    ".nc": _write_netcdf,
    ".parquet": _write_parquet,
    ".gpkg": _write_geopackage,
}
