"""Results as netCDF-4 files or Zarr stores, by the CF conventions, and back: `save`, `open`, `rerun`."""

import contextlib
import datetime
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlidar._fields.checks import check_kind, warn_user
from jaxlidar._fingerprint import version_of
from jaxlidar._registry import save_result
from jaxlidar.formats.files import atomic_write
from jaxlidar.progress import ProgressOption
from jaxlidar.results.case import Case
from jaxlidar.results.case import read_case as read_case_text
from jaxlidar.results.datasets import (
    KIND,
    LAYOUTS,
    case_dataset,
    case_of_group,
    datasets_of,
    keep_as_netcdf,
    result_of,
)
from jaxlidar.results.groups import StoredGroups, is_result_file, open_groups, write_groups, write_zarr_group
from jaxlidar.results.store import RESULT, ResultStore, consolidate, plain_errors, replacing
from jaxlidar.sensors.photon_counter import PhotonEvents
from jaxlidar.simulation.truth import Truth
from jaxlidar.spectral.waveform import Waveform

CONVENTIONS = "CF-1.11"
# The attribute with the number of the format of files. A reader refuses others: version 0.2 wrote format 1.
_FORMAT, FORMAT_NUMBER = "jaxlidar_format", 2
# Reasons why a simulation stopped that depend on more than its arguments.
_NOT_REPEATABLE = ("time spent", "interrupted")


@save_result.register
def save(result: Any, path: str | os.PathLike[str], case: Case | None = None) -> None:
    """Write a `Waveform`, or another result, as netCDF or Zarr, with units, names and its origin.

    The file appears when it is complete. Numbers are exact: `jaxlidar.open` returns the same bits. Any
    program that reads netCDF-4 reads the file, such as `xarray.open_dataset`; `xarray.open_zarr` reads Zarr.

    **Arguments:**

    - `result`: a `Waveform`, or an object of any other class that `keep_as_netcdf` registered, such as
      `inversion.Retrieval`.
    - `path`: the file to write, or the folder of a Zarr store, whose name ends in ".zarr". Missing folders
      are created.
    - `case`: the `Case` from which a waveform, or those of a survey, were simulated. It is written with them
      so that `jaxlidar.rerun` can simulate them again. Default None: not written.

    **Returns:** nothing.

    **Raises:** TypeError for an object that no file can hold, or whose scene has classes of your own, and for
    a `case` of another class. ImportError where xarray, and h5netcdf or zarr, are not installed. ValueError
    for a case of other wavelengths or shots, and where a folder exists whose name is that of a Zarr store,
    but which is none, or the store of a run that has not ended. OSError for a path that cannot be written, as
    that of a folder, or that a run has open.

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
    check_kind("case", case, Case | None, "the jaxlidar.io.Case of the result, or None")
    if case is not None:
        _check_case(result, case)
    with replacing(Path(path)):
        datasets = datasets_with_case(result, case)
        with atomic_write(path) as draft:
            write_groups(draft, datasets)


def _check_case(result: Any, case: Case) -> None:
    """Refuse a case from which a result cannot have been simulated. **Raises:** ValueError."""
    lidar = case.lidar if case.survey is None else case.survey.lidar
    if lidar is not None and hasattr(result, "wavelength"):
        sent, received = np.asarray(lidar.wavelength), np.asarray(result.wavelength)
        if not np.array_equal(sent, received):
            raise ValueError(
                f"case has a lidar of {sent.tolist()} nm, the waveform is of {received.tolist()} nm: it is "
                "not the case that it was simulated from"
            )
    if isinstance(result, Waveform) and result.has_scenes:
        raise ValueError(f"a case has one scene, the waveform has {len(result)}: save it without the case")
    position = getattr(result, "position", None)
    if (case.survey is None) != (position is None):
        raise ValueError("a case with a survey belongs to Waveforms, one without to a Waveform")
    if case.survey is None:
        return
    # Waveforms of a disturbed survey have the positions that it states.
    stated = case.survey.position if case.survey.stated is None else case.survey.stated[:, :3]
    if not np.array_equal(stated, np.asarray(position)):
        raise ValueError("the shots of the case have another position than the waveforms")


def datasets_with_case(result: Any, case: Case | None) -> dict[str, Any]:
    """Return the datasets of a file by the path of their group, with its case and what describes its origin.

    **Raises:** TypeError for an object that no file can hold.
    """
    name = type(result).__name__
    if name not in LAYOUTS or LAYOUTS[name].kind is not type(result):
        raise TypeError(f"result is of the class {name}; admissible are {', '.join(sorted(LAYOUTS))}")
    datasets, attributes = datasets_of(result), _file_attributes()
    if case is not None:
        case_attributes, arrays = case_dataset("case", case)
        attributes |= case_attributes
        if arrays is not None:
            datasets["/case_arrays"] = arrays
    # A static field of the result may have the same name, as the `history` of a fit: that one stays.
    datasets["/"].attrs = attributes | datasets["/"].attrs
    return datasets


def _file_attributes() -> dict[str, Any]:
    now = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%SZ}"
    return {
        "Conventions": CONVENTIONS,
        "source": f"jaxlidar {version_of('jaxlidar')}",
        "history": f"{now}: written by jaxlidar.io.save",
        _FORMAT: FORMAT_NUMBER,
        "versions": json.dumps({p: version_of(p) for p in ("jaxlidar", "jax", "jaxlib", "numpy")}),
        "platform": jax.default_backend(),
        "precision": _precision(),
    }


def _precision() -> str:
    """Return the type of JAX's numbers, "float32" or "float64"."""
    return jax.numpy.asarray(0.0).dtype.name


@contextlib.contextmanager
def _open_file(path: str | os.PathLike[str]) -> Iterator[StoredGroups]:
    """Open a file of `save`. **Raises:** as `open`."""
    path = Path(path)
    with open_groups(path) as file:
        attributes = file.datasets["/"].attrs
        if KIND not in attributes:
            raise ValueError(f"{path}: no attribute {KIND}: jaxlidar.io.save did not write it")
        written = attributes.get(_FORMAT)
        if written != FORMAT_NUMBER:
            raise ValueError(
                f"{path}: {_FORMAT} = {written}; admissible is {FORMAT_NUMBER}: "
                f"{attributes.get('source', 'another version of jaxlidar')} wrote the file"
            )
        yield file


def open(path: str | os.PathLike[str]) -> Any:
    """Read a `Waveform`, or another result, from a file that `save` wrote.

    Waveforms of surveys in Zarr stores may be larger than memory: arrays beyond 64 MB are read where they are
    used, by rows as in `many.reflectance[:100]`, or as a whole.

    **Arguments:** `path`: a file, or a Zarr store, of `jaxlidar.io.save`.

    **Returns:** an object of the class that was saved, with the same bits.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the place, for
    one that is damaged, incomplete, or not written by `save`, or whose class is not known. ImportError where
    xarray, and h5netcdf or zarr, are not installed.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jax, jaxlidar as jl
    >>> wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.nc"
    >>> wave.save(path)
    >>> jl.open(path).info["stopped"]
    'nothing is random'
    """
    with _open_file(path) as file:
        return result_of(file)


def store_result(store: ResultStore, result: Any) -> None:
    """Write the complete result of a run beside its rows, where `open` finds it.

    **Warns:** for a result whose scene has classes of the user's own, and for a store that cannot be written,
    as on a full disk: the rows are there, and the run can be repeated.
    """
    try:
        datasets = datasets_with_case(result, None)
        with plain_errors(store.path):
            for group, dataset in datasets.items():
                write_zarr_group(store.path, f"{RESULT}{group}".rstrip("/"), dataset)
            consolidate(store.path)
    except (TypeError, OSError) as error:
        warn_user(f"path = {store.path}: jaxlidar.open will not read the result: {error}")


def read_case(path: str | os.PathLike[str]) -> Case:
    """Read the case of a TOML file, or the one that a waveform was saved with.

    **Arguments:**

    - `path`: a TOML file with the tables `lidar`, `survey`, `scene` and `simulate`, any of which may be
      missing; files that it names lie relative to it. Or a file, or Zarr store, of `jaxlidar.io.save`.

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
    path = Path(path)
    if not is_result_file(path):
        return read_case_text(path)
    with _open_file(path) as file:
        return case_of_group(file, "case")


def rerun(path: str | os.PathLike[str], progress: ProgressOption = None) -> Any:
    """Simulate again the waveform of a file that was saved with its case, or the waveforms of a survey.

    On the same machine, with the same versions (the attribute `versions`), the waveform is the same bit for
    bit, but for `info["seconds"]`. Files that `simulate_many` wrote have their case, unless the scene has
    classes of your own.

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
    with _open_file(path) as file:
        case, wave = case_of_group(file, "case"), result_of(file)
        precision = str(file.datasets["/"].attrs.get("precision"))
    stopped = wave.info.get("stopped")
    if stopped in _NOT_REPEATABLE:
        raise ValueError(
            f"{path}: the run ended early ({stopped}); the time when it ended is no part of a case. "
            "read_case(path).simulate() starts it anew"
        )
    if precision != _precision():
        raise ValueError(f"{path}: it was simulated in {precision}; JAX is configured for {_precision()} now")
    return case.simulate(progress)


# Units and long names of the arrays of a `Waveform`.
WAVEFORM_QUANTITIES = {
    "time": ("ns", "time of arrival relative to the two-way travel time of the reference plane"),
    "height": ("m", "height above the reference plane from which light of order one arrives"),
    "reflectance": ("1", "apparent reflectance per sample"),
    "energy": ("J", "energy that the detector registers per sample"),
    "stderr": ("1", "standard error of the apparent reflectance"),
    "components": ("1", "apparent reflectance per sample by material and by order of scattering"),
    "neglected": ("1", "apparent reflectance of light that was not followed, or comes after the record"),
    "energy_budget": ("1", "share of the emitted energy by fate, before the atmosphere"),
    "energy_budget_stderr": ("1", "standard error of the share of the emitted energy"),
    "lost": ("1", "apparent reflectance that arrives before or after all fine bins of the plan"),
    "recorded": ("J", "energy that the receiver records per sample, without noise"),
    "wavelength": ("nm", "wavelength of the lidar"),
}
keep_as_netcdf(
    Waveform,
    "simulated lidar waveform",
    WAVEFORM_QUANTITIES,
    dimensions={"scenes": "scene", "samples": "time", "wavelengths": "wavelength"},
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

# Samples are a dimension of their own: they may be finer than those of the waveform that it belongs to.
keep_as_netcdf(
    Truth,
    "truth of simulated lidar waveforms",
    {
        "time": ("ns", "time of arrival relative to the two-way travel time of the reference plane"),
        "height": ("m", "height above the reference plane from which light of order one arrives"),
        "returns": ("1", "apparent reflectance of order one by material, of a pulse without duration"),
        "gap_probability": ("1", "share of the beam that meets nothing down to the end of the sample"),
        "leaf_area_density": ("m2 m-3", "one-sided area of leaf per volume"),
        "bark_area_density": ("m2 m-3", "half of the surface of bark per volume"),
        "plant_area_index": ("1", "area of leaf and bark per area of ground, above the end of the sample"),
        "top_height": ("m", "height above which plants and plates intercept 1 % of the beam"),
        "surface_height": ("m", "mean height at which the beam meets the surface"),
        "surface_spread": ("m", "standard deviation of the height at which the beam meets the surface"),
    },
    dimensions={"shots": "shot", "samples": "sample", "wavelengths": "wavelength"},
    items={"returns": "material", "surface_height": "surface", "surface_spread": "surface"},
    coordinates={"time": "sample", "height": "sample"},
    rows="shots",
)
