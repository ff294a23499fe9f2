"""Results as netCDF-4 files, by the CF conventions, and back: `save`, `open`, `repeat`.

What is written of a class follows from its annotations: an array of shape "wavelengths bins" has these two
dimensions, a dict of such arrays one more, static fields are attributes, and modules in fields are groups.
A class is made known by `keep_as_netcdf` with the units and names of its fields, so that other packages can
add theirs; jaxlidar finds them by the entry points `jaxlidar.files`.
"""

import contextlib
import datetime
import json
import os
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlidar._files import atomic_write
from jaxlidar.io.case import Case
from jaxlidar.io.case import read_case as read_case_text
from jaxlidar.io.gedi_beam import refusing
from jaxlidar.io.tables import nearest
from jaxlidar.simulate import Progress
from jaxlidar.waveform import Waveform

CONVENTIONS = "CF-1.11"
# The layout of the files. A reader refuses those that are newer.
FORMAT = 1
FILES = "jaxlidar.files"
HDF5 = b"\x89HDF\r\n\x1a\n"
# Reasons why a simulation stopped that depend on more than its arguments.
NOT_REPEATABLE = ("time spent", "interrupted")


class Layout(NamedTuple):
    """How a class is written: its title, and for its fields (units, long name).

    `dimensions` renames those of the annotations; `items` names the dimension of a dict's keys.
    `coordinates` are fields that lie along a dimension beside the coordinate of its own name.
    """

    kind: type
    title: str
    quantities: Mapping[str, tuple[str, str]]
    dimensions: Mapping[str, str]
    items: Mapping[str, str]
    coordinates: Mapping[str, str]


LAYOUTS: dict[str, Layout] = {}


def keep_as_netcdf(
    kind: type,
    title: str,
    quantities: Mapping[str, tuple[str, str]],
    *,
    dimensions: Mapping[str, str] | None = None,
    items: Mapping[str, str] | None = None,
    coordinates: Mapping[str, str] | None = None,
) -> None:
    """Let `save` and `open` know a class of results, an `equinox.Module` whose fields are annotated.

    Fields are arrays, dicts of arrays, modules that are known themselves, a `Scene` or a `Lidar`; static ones
    are what JSON holds.

    **Arguments:**

    - `kind`: the class.
    - `title`: what it is, in a few words.
    - `quantities`: (units, long name) of every field that is an array or a dict of arrays.
    - `dimensions`: by the names in annotations, those in the file, where they differ. A dimension named as a
      field of one axis makes it a coordinate. Default None: none.
    - `items`: names of the dimensions that the keys of dicts make. Default None: the fields' own, with
      "_item".
    - `coordinates`: fields that are further coordinates, each with the dimension that it lies along. Default
      None: none.

    **Returns:** nothing.

    **Example:**

    >>> import equinox as eqx, numpy as np, pathlib, tempfile
    >>> import jaxlidar as jl
    >>> from jaxtyping import Float
    >>> class Heights(eqx.Module):
    ...     top: Float[np.ndarray, " trees"]
    >>> jl.io.keep_as_netcdf(Heights, "heights of trees", {"top": ("m", "height of the highest twig")})
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "trees.nc"
    >>> jl.io.save(Heights(np.array([12.5, 20.0])), path)
    >>> jl.open(path).top
    array([12.5, 20. ])
    """
    LAYOUTS[kind.__name__] = Layout(kind, title, quantities, dimensions or {}, items or {}, coordinates or {})


def layout_of(name: str, path: Path) -> Layout:
    """How a class is written, by its name; the package that has it is asked first."""
    if name not in LAYOUTS:
        for point in metadata.entry_points(group=FILES):
            if point.name == name:
                point.load()
    if name not in LAYOUTS:
        raise ValueError(
            f"{path}: it holds a {name}, which is not known here ({nearest(name, LAYOUTS)}): import the "
            "package that has it first"
        )
    return LAYOUTS[name]


def save(result: Any, path: str | os.PathLike[str], case: Case | None = None) -> None:
    """Write a `Waveform`, or another result, as netCDF: with units, names, and where it comes from.

    The file appears when it is whole. Numbers are exact: `jaxlidar.open` gives the same bits. Any program
    that knows netCDF-4 reads it, `xarray.open_dataset` for one.

    **Arguments:**

    - `result`: a `Waveform`, or an object of any other class that `keep_as_netcdf` was told of, such as
      `inversion.Retrieval` and `inversion.Retrievals`.
    - `path`: the file to write.
    - `case`: the `Case` that a waveform was simulated from, kept with it so that `jaxlidar.repeat` can
      simulate it again. Default None: not kept.

    **Returns:** nothing.

    **Raises:** TypeError for an object that no file can hold, or whose scene has classes of one's own.
    ImportError where h5netcdf is not installed. ValueError for a case of other wavelengths. OSError for a
    path that cannot be written.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> case = jl.io.Case(jl.Lidar(), jl.Scene(ground=jl.Ground(reflectance=0.4)), jax.random.key(0))
    >>> wave = case.simulate()
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.nc"
    >>> jl.io.save(wave, path, case)
    >>> print(f"{float(jl.open(path).reflectance.sum()):.3f}")
    0.400
    """
    from jaxlidar.io.groups import Writer

    path, name = Path(path), type(result).__name__
    if name not in LAYOUTS or LAYOUTS[name].kind is not type(result):
        raise TypeError(f"result is of the class {name}; admissible are {', '.join(sorted(LAYOUTS))}")
    if case is not None and case.lidar is not None and hasattr(result, "wavelength"):
        sent, received = np.asarray(case.lidar.wavelength), np.asarray(result.wavelength)
        if not np.array_equal(sent, received):
            raise ValueError(
                f"case has a lidar of {sent.tolist()} nm, the waveform is of {received.tolist()} nm: it is "
                "not the case that it was simulated from"
            )
    netcdf = _h5netcdf()
    now = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%SZ}"
    with atomic_write(path) as draft, netcdf.File(draft, "w") as file:
        file.attrs.update(
            {
                "Conventions": CONVENTIONS,
                "title": LAYOUTS[name].title,
                "source": f"jaxlidar {version('jaxlidar')}",
                "history": f"{now}: written by jaxlidar.io.save",
                "jaxlidar_format": FORMAT,
                "jaxlidar_kind": name,
                "versions": json.dumps({p: version(p) for p in ("jaxlidar", "jax", "jaxlib", "numpy")}),
                "platform": jax.default_backend(),
                "precision": precision(),
            }
        )
        writer = Writer(LAYOUTS)
        writer.result(file, result)
        if case is not None:
            writer.case(file, "case", case)


def version(package: str) -> str:
    """The installed version of a package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def precision() -> str:
    """JAX's precision."""
    return jax.numpy.asarray(0.0).dtype.name


def _h5netcdf() -> Any:
    try:
        import h5netcdf
    except ImportError as error:
        raise ImportError("netCDF files need h5netcdf: pip install 'jaxlidar[io]'") from error
    return h5netcdf


def _with_file(path: str | os.PathLike[str], use: Callable[[Path, Any], Any]) -> Any:
    """What `use` makes of an open file of this package."""
    path, netcdf = Path(path), _h5netcdf()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    # HDF5 keeps files that it has opened by name, damaged ones too; not those that are opened for it.
    with path.open("rb") as stream, contextlib.ExitStack() as opened:
        if stream.read(len(HDF5)) != HDF5:
            raise ValueError(f"{path}: byte 0: no netCDF-4 file")
        stream.seek(0)
        with refusing(f"{path}: damaged"):
            file = opened.enter_context(netcdf.File(stream, "r"))
        with refusing(f"{path}: the attributes: damaged"):
            attributes = dict(file.attrs)
        if "jaxlidar_kind" not in attributes:
            raise ValueError(f"{path}: no attribute jaxlidar_kind: jaxlidar.io.save did not write it")
        written = attributes.get("jaxlidar_format")
        if not isinstance(written, int | np.integer) or not 1 <= written <= FORMAT:
            raise ValueError(
                f"{path}: jaxlidar_format = {written} is outside [1, {FORMAT}]: a newer jaxlidar's?"
            )
        return use(path, file)


def open(path: str | os.PathLike[str]) -> Any:
    """What `save` wrote: a `Waveform`, or another result.

    **Arguments:** `path`: a file of `jaxlidar.io.save`.

    **Returns:** an object of the class that was saved, with the same bits.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the place, for
    one that is damaged, or not written by `save`, or whose class is not known. ImportError where h5netcdf is
    not installed.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.nc"
    >>> wave.save(path)
    >>> jl.open(path).info["stopped"]
    'nothing is random'
    """
    from jaxlidar.io.groups import Reader

    def read(path: Path, file: Any) -> Any:
        return Reader(path, layout_of).result(file, str(file.attrs["jaxlidar_kind"]), "")

    return _with_file(path, read)


def read_case(path: str | os.PathLike[str]) -> Case:
    """The case of a TOML file, or the one that a waveform was saved with.

    **Arguments:**

    - `path`: a TOML file with the tables `lidar`, `scene` and `simulate`, any of which may be missing; files
      that it names lie relative to it. Or a netCDF file of `jaxlidar.io.save`.

    **Returns:** a `Case`.

    **Raises:** FileNotFoundError where there is no such file. ValueError or TypeError, naming the file and
    the place in it, for what is no TOML, unknown kinds and keys (with the nearest valid ones), all that the
    classes themselves refuse, and a netCDF file that was saved without a case.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar as jl
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.toml"
    >>> _ = path.write_text("[scene.ground]\\nslope = 5\\n\\n[simulate]\\nseed = 0")
    >>> case = jl.io.read_case(path)
    >>> print(float(case.scene.ground.slope), case.lidar)
    5.0 None
    """
    from jaxlidar.io.groups import Reader

    path = Path(path)
    if path.is_file():
        with path.open("rb") as start:
            if start.read(len(HDF5)) == HDF5:
                return _with_file(path, lambda path, file: Reader(path, layout_of).case(file, "case", ""))
    return read_case_text(path)


def repeat(path: str | os.PathLike[str], progress: Callable[[Progress], None] | None = None) -> Waveform:
    """Simulate again the waveform of a file that was saved with its case.

    On the same machine, with the same versions (the attribute `versions`), the waveform is the same bit for
    bit, but for `info["seconds"]`.

    **Arguments:**

    - `path`: a file of `jaxlidar.io.save`, saved with `case`.
    - `progress`: as for `jaxlidar.simulate`. Default None.

    **Returns:** a `Waveform`.

    **Raises:** ValueError for a file without a case, for a run that an interrupt or `max_seconds` ended, and
    where JAX's precision is another; and what `jaxlidar.io.read_case` raises.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> case = jl.io.Case(jl.Lidar(), jl.Scene(ground=jl.Ground()), jax.random.key(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.nc"
    >>> case.simulate().save(path, case)
    >>> bool((jl.repeat(path).reflectance == jl.open(path).reflectance).all())
    True
    """
    case, wave = read_case(path), open(path)
    stopped = wave.info.get("stopped")
    if stopped in NOT_REPEATABLE:
        raise ValueError(
            f"{path}: the run ended early ({stopped}); when that happens is no part of a case. "
            "read_case(path).simulate() runs it anew"
        )
    kept = _with_file(path, lambda _, file: str(file.attrs.get("precision")))
    if kept != precision():
        raise ValueError(f"{path}: it was simulated in {kept}; JAX is configured for {precision()} now")
    return case.simulate(progress)


keep_as_netcdf(
    Waveform,
    "simulated lidar waveform",
    {
        "time": ("ns", "time of arrival after the two-way travel time of the reference plane"),
        "height": ("m", "height above the reference plane from which light of order one arrives"),
        "reflectance": ("1", "apparent reflectance per sample"),
        "energy": ("J", "energy that the detector registers per sample"),
        "stderr": ("1", "standard error of the apparent reflectance"),
        "components": ("1", "apparent reflectance per sample by material and by order of scattering"),
        "neglected": ("1", "apparent reflectance that orders beyond the last could add"),
        "ledger": ("1", "share of the emitted energy by fate, before the atmosphere"),
        "ledger_stderr": ("1", "standard error of the share of the emitted energy"),
        "lost": ("1", "apparent reflectance that arrives before or after all fine bins of the plan"),
        "recorded": ("J", "energy that the receiver records per sample, without noise"),
        "wavelength": ("nm", "wavelength of the lidar"),
    },
    dimensions={"bins": "time", "wavelengths": "wavelength"},
    items={"components": "component", "ledger": "fate", "ledger_stderr": "fate"},
    coordinates={"height": "time"},
)
