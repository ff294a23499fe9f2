"""Readers of GEDI's level 2A and 2B products: ground, relative heights, cover and plant area of each shot.

Rows belong to the shots of level 1B with the same `shot_number`, which is unique in all of the mission. What
a subset has left out is left out of the table; a fill value is NaN.
"""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxlidar._fields.checks import check_numbers, warn_user
from jaxlidar.formats.checks import FileWarning
from jaxlidar.formats.hdf5 import ProductFile, open_hdf5
from jaxlidar.formats.tables import Column, ColumnAxis, ShotTable

_FILL = -9999.0
# Numbers of algorithm setting groups.
_GROUPS = range(1, 7)
# Height of the layers of level 2B in m, where the file does not say.
_LAYER_THICKNESS = 5.0
# Largest thickness in m that a file may state: no layer is thicker than the air.
_MAX_LAYER_THICKNESS = 1e5


class _Field(NamedTuple):
    """A dataset of a product, and the column that it becomes.

    - `name`: of the column. `datasets`: of which the first that a beam has is read.
    - `unit`, `description`: of the column. `levels`: name of the second axis, if it has one.
    """

    name: str
    datasets: tuple[str, ...]
    unit: str = ""
    description: str = ""
    levels: str | None = None


_COMMON = (
    _Field("delta_time", ("delta_time",), "s", "time since the beginning of 2018"),
    _Field("latitude", ("lat_lowestmode", "geolocation/lat_lowestmode"), "degrees", "of the lowest mode"),
    _Field("longitude", ("lon_lowestmode", "geolocation/lon_lowestmode"), "degrees", "of the lowest mode"),
    _Field("elev_lowestmode", ("elev_lowestmode", "geolocation/elev_lowestmode"), "m", "of the ground"),
    _Field(
        "elev_highestreturn",
        ("elev_highestreturn", "geolocation/elev_highestreturn"),
        "m",
        "of the first return",
    ),
    _Field("sensitivity", ("sensitivity",), "", "largest cover through which the ground is detected"),
    _Field("solar_elevation", ("solar_elevation", "geolocation/solar_elevation"), "degrees", "of the sun"),
    _Field("degrade", ("degrade_flag", "geolocation/degrade_flag"), "", "flag of degraded pointing"),
)
_LEVEL_2A = (
    *_COMMON,
    _Field("quality_flag", ("quality_flag",), "", "1 where the product recommends the shot"),
    _Field("selected_algorithm", ("selected_algorithm",), "", "setting group of rh and elev_lowestmode"),
    _Field("num_detectedmodes", ("num_detectedmodes",), "", "number of modes"),
    _Field("rh", ("rh",), "m", "relative height", "percentile"),
    *(
        _Field(f"elev_lowestmode_a{n}", (f"geolocation/elev_lowestmode_a{n}",), "m", f"of setting group {n}")
        for n in _GROUPS
    ),
    *(
        _Field(
            f"rh_a{n}", (f"geolocation/rh_a{n}",), "m", f"relative height of setting group {n}", "percentile"
        )
        for n in _GROUPS
    ),
)
_LEVEL_2B = (
    *_COMMON,
    _Field("quality_flag", ("l2b_quality_flag",), "", "1 where the product recommends the shot"),
    _Field("selected_algorithm", ("selected_l2a_algorithm",), "", "setting group of the ground"),
    _Field("cover", ("cover",), "", "fraction of the ground that plants cover"),
    _Field("pai", ("pai",), "m2 m-2", "plant area index"),
    _Field("pgap_theta", ("pgap_theta",), "", "gap probability along the beam"),
    _Field("pgap_theta_error", ("pgap_theta_error",), "", "standard error of the gap probability"),
    _Field("rv", ("rv",), "counts", "energy of the canopy"),
    _Field("rg", ("rg",), "counts", "energy of the ground"),
    _Field("rhov", ("rhov",), "", "reflectance of plants"),
    _Field("rhog", ("rhog",), "", "reflectance of the ground"),
    _Field("rossg", ("rossg",), "", "projection of plant area"),
    _Field("omega", ("omega",), "", "clumping index"),
    _Field("fhd_normal", ("fhd_normal",), "", "foliage height diversity"),
    _Field("rh100", ("rh100",), "m", "height of the first return"),
    _Field("cover_z", ("cover_z",), "", "cover above the bottom of the layer", "layer_bottom"),
    _Field("pai_z", ("pai_z",), "m2 m-2", "plant area above the bottom of the layer", "layer_bottom"),
    _Field("pavd_z", ("pavd_z",), "m2 m-3", "plant area density of the layer", "layer_bottom"),
)


def read_gedi_l2a(
    path: str | os.PathLike[str], shot_number: Sequence[int] | np.ndarray | None = None
) -> ShotTable:
    """Read the ground and the relative heights of a GEDI L2A file, or of a subset of one.

    This needs h5py (`pip install "jaxlidar[io]"`).

    **Arguments:**

    - `path`: an HDF5 file.
    - `shot_number`: (shots,) numbers of the shots to return, such as those of level 1B. Default None: all.

    **Returns:** a `ShotTable` in the order of `shot_number`, or of the file; shots that the file does not
    have are rows of NaN. Its columns, as far as the file has them: `shot_number`, `beam`, `delta_time`,
    `latitude`, `longitude`, `elev_lowestmode`, `elev_highestreturn`, `sensitivity`, `solar_elevation`,
    `degrade`, `quality_flag`, `selected_algorithm`, `num_detectedmodes`, `rh` (shots, 101), and
    `elev_lowestmode_a1` ... `_a6`, `rh_a1` ... `rh_a6` of all setting groups.

    **Warns:** `FileWarning` for beams that cannot be read.

    **Raises:** FileNotFoundError where there is no such file. ImportError without h5py. ValueError, naming
    the file and the place, for a file that is not HDF5, is damaged, or is no GEDI L2A product.

    **Source:** GEDI L2A product data dictionary (Dubayah et al. 2021, doi:10.5067/GEDI/GEDI02_A.002).

    **Example:**

    >>> import jaxlidar as jl
    >>> shots = jl.io.read_gedi_l1b("GEDI01_B.h5")  # doctest: +SKIP
    >>> product = jl.io.read_gedi_l2a("GEDI02_A.h5", [s.shot_number for s in shots])  # doctest: +SKIP
    >>> product["rh"][:, 98]  # doctest: +SKIP
    """
    return _read(path, shot_number, "GEDI L2A", _LEVEL_2A, needed=("elev_lowestmode",))


def read_gedi_l2b(
    path: str | os.PathLike[str], shot_number: Sequence[int] | np.ndarray | None = None
) -> ShotTable:
    """Read the cover, the plant area and its profile of a GEDI L2B file, or of a subset of one.

    This needs h5py (`pip install "jaxlidar[io]"`). `read_gedi_l2a(...).join(read_gedi_l2b(...))` is the table
    of both.

    **Arguments:** `path`, `shot_number`: as for `read_gedi_l2a`.

    **Returns:** a `ShotTable`. Its columns, as far as the file has them: those of level 2A's place, time and
    quality, `cover`, `pai`, `pgap_theta` and its error, `rv`, `rg`, `rhov`, `rhog`, `rossg`, `omega`,
    `fhd_normal`, `rh100`, and by layers `cover_z`, `pai_z`, `pavd_z`.

    **Warns:** as `read_gedi_l2a`.

    **Raises:** as `read_gedi_l2a`.

    **Source:** GEDI L2B product data dictionary (Dubayah et al. 2021, doi:10.5067/GEDI/GEDI02_B.002).

    **Example:**

    >>> import jaxlidar as jl
    >>> plants = jl.io.read_gedi_l2b("GEDI02_B.h5")  # doctest: +SKIP
    >>> heights = jl.io.read_gedi_l2a("GEDI02_A.h5", plants["shot_number"])  # doctest: +SKIP
    >>> both = heights.join(plants)  # doctest: +SKIP
    """
    return _read(path, shot_number, "GEDI L2B", _LEVEL_2B, needed=("pai",))


def _read(
    path: str | os.PathLike[str],
    shot_number: Sequence[int] | np.ndarray | None,
    product: str,
    fields: tuple[_Field, ...],
    *,
    needed: tuple[str, ...],
) -> ShotTable:
    """Read the beams of a file one by one, and put their rows in the requested order.

    **Arguments:** `needed`: columns without which a group is no beam of the product.
    """
    if shot_number is not None:
        check_numbers("shot_number", shot_number)
        if len(shot_number) and np.asarray(shot_number).dtype.kind not in "iu":
            raise TypeError(
                f"shot_number has the type {np.asarray(shot_number).dtype}; admissible are whole numbers"
            )
    # The products' -9999 is a fill value also where no attribute says so.
    with open_hdf5(path, product, lambda values: values == _FILL) as file:
        beams, errors = file.read_groups("BEAM", lambda beam: _read_beam(file, beam, fields, needed))
    for error in errors:
        warn_user(f"{error}: the beam is skipped", FileWarning)
    # A column that one beam lacks would leave rows without a value: such columns are NaN there.
    names = [f.name for f in fields if any(f.name in beam for beam in beams)]
    columns = {name: _concatenate(beams, name) for name in ("shot_number", "beam", *names)}
    table = ShotTable(columns, {"product": product})
    if shot_number is None:
        return table
    requested = np.asarray(shot_number).astype(np.uint64)
    rows = ShotTable({"shot_number": Column(requested)})
    return rows.join(table) if len(requested) else table.select(slice(0))


def _read_beam(
    file: ProductFile, beam: str, fields: tuple[_Field, ...], needed: tuple[str, ...]
) -> dict[str, Column]:
    """Return the columns of one beam. **Raises:** ValueError for a group without what is `needed`."""
    numbers = file.integers(f"{beam}/shot_number")
    columns = {
        "shot_number": Column(numbers.astype(np.uint64), "", "unique number of the product"),
        "beam": Column(np.full(numbers.size, beam), "", "name of the beam's group"),
    }
    for field in fields:
        names = [f"{beam}/{name}" for name in field.datasets]
        name = next(filter(file.has, names), names[0] if field.name in needed else None)
        if name is None:
            continue
        unit = "s since 2018-01-01" if field.name == "delta_time" else field.unit
        values = file.numbers(name, unit, ndim=1 if field.levels is None else 2)
        if len(values) != numbers.size:
            raise ValueError(f"{file.location(name)}: {len(values)} rows, shot_number has {numbers.size}")
        columns[field.name] = Column(values, field.unit, field.description, _axis(file, beam, field, values))
    return columns


def _axis(file: ProductFile, beam: str, field: _Field, values: np.ndarray) -> ColumnAxis | None:
    """Return the second axis of a column: percentiles, or heights of layers above the ground.

    **Raises:** ValueError for a thickness of layers that is none.
    """
    if field.levels is None:
        return None
    levels = np.arange(values.shape[1], dtype=float)
    if field.levels == "percentile":
        return ColumnAxis(field.levels, levels * 100.0 / max(levels.size - 1, 1), "percent")
    thickness, name = _LAYER_THICKNESS, f"{beam}/ancillary/dz"
    if file.has(name):
        # One number is in use, however many the file has.
        stated = file.numbers(name, "m", rows=slice(1))
        # Written so that NaN is refused.
        if stated.size == 0 or not 0 < stated[0] <= _MAX_LAYER_THICKNESS:
            raise ValueError(
                f"{file.location(name)}: {stated.tolist()} is no thickness of layers; admissible is one in "
                f"(0, {_MAX_LAYER_THICKNESS:g}] m"
            )
        thickness = float(stated[0])
    return ColumnAxis(field.levels, levels * thickness, "m")


def _concatenate(beams: list[dict[str, Column]], name: str) -> Column:
    """Return one column of all beams, NaN in those that lack it."""
    model = next(beam[name] for beam in beams if name in beam)
    missing_row = np.full(model.values.shape[1:], np.nan)
    shapes = {beam[name].values.shape[1:] for beam in beams if name in beam}
    if len(shapes) > 1:
        raise ValueError(f"{name}: beams have rows of the shapes {sorted(shapes)}; admissible is one")
    rows = [
        beam[name].values
        if name in beam
        else np.broadcast_to(missing_row, (len(beam["shot_number"].values), *missing_row.shape))
        for beam in beams
    ]
    return model._replace(values=np.concatenate(rows))
