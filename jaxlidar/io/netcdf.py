"""Results as netCDF-4 files or Zarr stores, by the CF conventions, and back: `save`, `open`, `rerun`."""

import contextlib
import datetime
import json
import os
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlidar._files import atomic_write
from jaxlidar._registry import save_result
from jaxlidar.instrument.photon_counter import PhotonEvents
from jaxlidar.io.case import Case
from jaxlidar.io.case import read_case as read_case_text
from jaxlidar.io.gedi_beam import refusing
from jaxlidar.io.layouts import LAYOUTS, keep_as_netcdf, layout_of
from jaxlidar.io.zarr_groups import ZarrGroup, is_zarr, opened
from jaxlidar.spectral.waveform import Waveform
from jaxlidar.truth import Truth

CONVENTIONS = "CF-1.11"
# The layout of the files. A reader refuses those that are newer.
FORMAT = 1
HDF5 = b"\x89HDF\r\n\x1a\n"
# The file that makes a folder a Zarr store of version 3.
ZARR = "zarr.json"
# Reasons why a simulation stopped that depend on more than its arguments.
NOT_REPEATABLE = ("time spent", "interrupted")


@save_result.register
def save(result: Any, path: str | os.PathLike[str], case: Case | None = None) -> None:
    """Write a `Waveform`, or another result, as netCDF or Zarr: with units, names, and where it comes from.

    The file appears when it is whole. Numbers are exact: `jaxlidar.open` gives the same bits. Any program
    that knows netCDF-4 reads it, `xarray.open_dataset` for one; or Zarr, `xarray.open_zarr`.

    **Arguments:**

    - `result`: a `Waveform`, or an object of any other class that `keep_as_netcdf` was told of, such as
      `inversion.Retrieval` and `inversion.Retrievals`.
    - `path`: the file to write, or the folder of a Zarr store, whose name ends in ".zarr".
    - `case`: the `Case` that a waveform, or those of a survey, were simulated from, kept with them so that
      `jaxlidar.rerun` can simulate them again. Default None: not kept.

    **Returns:** nothing.

    **Raises:** TypeError for an object that no file can hold, or whose scene has classes of one's own.
    ImportError where h5netcdf, or zarr, is not installed. ValueError for a case of other wavelengths or
    shots, and where a ".zarr" is there that is no Zarr store. OSError for a path that cannot be written.

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
    if case is not None:
        _check_case(result, case)
    with _new_file(result, path) as (writer, file):
        writer.result(file, result)
        if case is not None:
            writer.case(file, "case", case)


def _check_case(result: Any, case: Case) -> None:
    """**Raises:** ValueError where a result cannot be that of a case."""
    lidar = case.lidar if case.survey is None else case.survey.lidar
    if lidar is not None and hasattr(result, "wavelength"):
        sent, received = np.asarray(lidar.wavelength), np.asarray(result.wavelength)
        if not np.array_equal(sent, received):
            raise ValueError(
                f"case has a lidar of {sent.tolist()} nm, the waveform is of {received.tolist()} nm: it is "
                "not the case that it was simulated from"
            )
    place = getattr(result, "position", None)
    if (case.survey is None) != (place is None):
        raise ValueError("a case with a survey belongs to Waveforms, one without to a Waveform")
    if case.survey is not None and not np.array_equal(case.survey.position, np.asarray(place)):
        raise ValueError("the shots of the case have another position than the waveforms")


@contextlib.contextmanager
def by_rows(result: Any, path: str | os.PathLike[str], case: Case | None = None) -> Iterator[Any]:
    """Write a result whose rows are only known later: what the block is given adds them.

    The arrays of `result` with rows have the right shape and type, but their values do not count. `case` is
    kept as by `save`.
    """
    with _new_file(result, path) as (writer, file):
        if case is not None:
            writer.case(file, "case", case)
        rows = writer.frame(file, result)
        yield rows
        rows.end()


@contextlib.contextmanager
def _new_file(result: Any, path: str | os.PathLike[str]) -> Iterator[tuple[Any, Any]]:
    """A file that appears under its name when the block ends: what writes into it, and its root group."""
    from jaxlidar.io.groups import Writer

    path, name = Path(path), type(result).__name__
    if name not in LAYOUTS or LAYOUTS[name].kind is not type(result):
        raise TypeError(f"result is of the class {name}; admissible are {', '.join(sorted(LAYOUTS))}")
    if is_zarr(path) and path.exists() and not (path / ZARR).is_file():
        raise ValueError(f"{path}: it is there already and no Zarr store; nothing is overwritten")
    now = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%SZ}"
    with contextlib.ExitStack() as stack:
        draft = stack.enter_context(atomic_write(path))
        file = opened(draft, "w") if is_zarr(path) else stack.enter_context(_h5netcdf().File(draft, "w"))
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
        yield Writer(LAYOUTS), file


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
    path = Path(path)
    with contextlib.ExitStack() as stack:
        file = _zarr_store(path) if is_zarr(path) else _netcdf_file(path, stack)
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


def _netcdf_file(path: Path, stack: contextlib.ExitStack) -> Any:
    """A netCDF-4 file that is open until the stack closes. **Raises:** as `open`."""
    netcdf = _h5netcdf()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    # HDF5 keeps files that it has opened by name, damaged ones too; not those that are opened for it.
    stream = stack.enter_context(path.open("rb"))
    if stream.read(len(HDF5)) != HDF5:
        raise ValueError(f"{path}: byte 0: no netCDF-4 file")
    stream.seek(0)
    with refusing(f"{path}: damaged"):
        return stack.enter_context(netcdf.File(stream, "r"))


def _zarr_store(path: Path) -> ZarrGroup:
    """A Zarr store. **Raises:** as `open`."""
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder")
    if not (path / ZARR).is_file():
        raise ValueError(f"{path}: no Zarr store of version 3: it has no {ZARR}")
    with refusing(f"{path}: damaged"):
        return opened(path, "r")


def open(path: str | os.PathLike[str]) -> Any:
    """What `save` wrote: a `Waveform`, or another result.

    Waveforms of surveys in netCDF files are compared with their checksums, but not read into memory: their
    arrays are mapped (`numpy.memmap`), and read where they are used.

    **Arguments:** `path`: a file, or a Zarr store, of `jaxlidar.io.save`.

    **Returns:** an object of the class that was saved, with the same bits.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the place, for
    one that is damaged, or not written by `save`, or whose class is not known. ImportError where h5netcdf, or
    zarr, is not installed.

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
      that it names lie relative to it. Or a file, or Zarr store, of `jaxlidar.io.save`.

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
    kept = is_zarr(path)
    if not kept and path.is_file():
        with path.open("rb") as start:
            kept = start.read(len(HDF5)) == HDF5
    if not kept:
        return read_case_text(path)
    return _with_file(path, lambda path, file: Reader(path, layout_of).case(file, "case", ""))


def rerun(path: str | os.PathLike[str], progress: Callable[[Any], None] | None = None) -> Any:
    """Simulate again the waveform of a file that was saved with its case, or the waveforms of a survey.

    On the same machine, with the same versions (the attribute `versions`), the waveform is the same bit for
    bit, but for `info["seconds"]`. Files that `simulate_many` wrote have their case, unless the scene has
    classes of one's own.

    **Arguments:**

    - `path`: a file of `jaxlidar.io.save`, saved with `case`.
    - `progress`: as for `jaxlidar.simulate`, or `jaxlidar.simulate_many`. Default None.

    **Returns:** a `Waveform`, or the `Waveforms` of a survey, in memory.

    **Raises:** ValueError for a file without a case, for a run that an interrupt or `max_seconds` ended, and
    where JAX's precision is another; and what `jaxlidar.io.read_case` raises.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> case = jl.io.Case(jl.Lidar(), jl.Scene(ground=jl.Ground()), jax.random.key(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.nc"
    >>> case.simulate().save(path, case)
    >>> bool((jl.rerun(path).reflectance == jl.open(path).reflectance).all())
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
        "energy_budget": ("1", "share of the emitted energy by fate, before the atmosphere"),
        "energy_budget_stderr": ("1", "standard error of the share of the emitted energy"),
        "lost": ("1", "apparent reflectance that arrives before or after all fine bins of the plan"),
        "recorded": ("J", "energy that the receiver records per sample, without noise"),
        "wavelength": ("nm", "wavelength of the lidar"),
    },
    dimensions={"bins": "time", "wavelengths": "wavelength"},
    items={"components": "component", "energy_budget": "fate", "energy_budget_stderr": "fate"},
    coordinates={"height": "time"},
)

keep_as_netcdf(
    PhotonEvents,
    "photon events of a simulated lidar",
    {
        "time": ("ns", "recorded time after the two-way travel time of the reference plane"),
        "height": ("m", "height above the reference plane from which light of order one arrives"),
        "shot": ("1", "number of the shot"),
        "pulse": ("1", "number of the pulse of the shot"),
        "pixel": ("1", "number of the pixel"),
        "wavelength": ("nm", "wavelength of the lidar"),
        "signal": ("1", "whether light of the waveform made the event"),
        "lost": ("1", "photons that arrived while their pixel was blind"),
        "window": ("m", "heights between which the record lies"),
    },
    dimensions={"2": "end"},
)

# What `Truth` has, and that of many shots as well.
TRUTH = {
    "returns": ("1", "apparent reflectance of order one per sample by material, of a pulse without duration"),
    "gap_probability": ("1", "share of the beam that meets nothing down to the end of the sample"),
    "leaf_area_density": ("m2 m-3", "one-sided area of leaf per volume"),
    "bark_area_density": ("m2 m-3", "half of the surface of bark per volume"),
    "plant_area_index": ("1", "area of leaf and bark per area of ground, above the end of the sample"),
    "top_height": ("m", "height above which plants and plates intercept 1 % of the beam"),
    "surface_height": ("m", "mean height at which the beam meets the surface"),
    "surface_spread": ("m", "standard deviation of the height at which the beam meets the surface"),
}
# Its samples may be finer than those of the waveform that it belongs to.
keep_as_netcdf(
    Truth,
    "truth of a simulated lidar waveform",
    {
        "time": ("ns", "time of arrival after the two-way travel time of the reference plane"),
        "height": ("m", "height above the reference plane from which light of order one arrives"),
        **TRUTH,
    },
    dimensions={"bins": "sample", "wavelengths": "wavelength"},
    items={"returns": "material", "surface_height": "surface", "surface_spread": "surface"},
    coordinates={"time": "sample", "height": "sample"},
)
