"""Cases: a lidar or a survey, a scene and the arguments of a simulation, as TOML that people can write.

    [lidar]
    altitude = 500.0                                  # m; missing keys have the defaults of the class
    pulse = {kind = "GaussianPulse", fwhm = 4.0}

    [scene.ground]
    reflectance = {kind = "spectrum", name = "soil-medium"}

    [simulate]
    seed = 0
    rtol = 0.01

`jaxlidar/formats/README.md` describes the schema.
"""

import dataclasses
import functools
import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxlidar._fields.checks import check_integer, check_key, check_kind
from jaxlidar._registry import simulate_survey
from jaxlidar.formats.checks import existing_file
from jaxlidar.formats.files import atomic_writes
from jaxlidar.formats.npz import read_arrays
from jaxlidar.progress import ProgressOption
from jaxlidar.results.kinds import UNITS, Argument
from jaxlidar.results.toml import (
    ArrayReader,
    check_keys,
    table_of,
    tables_of,
    text_of,
    value_of,
    with_references,
)
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.survey import Survey
from jaxlidar.simulation.one_scene import simulate

# Arguments of `simulate` that a file cannot hold, or that a case has as fields.
_EXCLUDED_ARGUMENTS = ("lidar", "scene", "key", "plan", "progress")
_SECTIONS = ("lidar", "survey", "scene", "simulate")
# Arguments of `simulate_many`; `simulate` has all but the last three as well.
_SURVEY_ARGUMENTS = ("rtol", "max_orders", "truth", "shared", "keep", "beyond")


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A lidar or a survey, a scene and the arguments of their simulation. Any may be missing in a file.

    **Arguments:**

    - `lidar`: a `Lidar`, or None. Default None.
    - `scene`: a `Scene`, or None. Default None.
    - `key`: a JAX random key, or None. Default None.
    - `arguments`: by name, other arguments of `jaxlidar.simulate`, such as `rtol`; all but `plan` and
      `progress`. With a survey: `rtol`, `max_orders`, `truth`, `shared`, `keep` and `beyond`.
      Default: none.
    - `survey`: a `Survey`, which is simulated in place of the lidar, or None. Default None.

    **Raises:** TypeError for an object of another class; ValueError for an unknown argument, and, with a
    survey, for one that `jaxlidar.simulate_many` does not have.

    **Example:**

    >>> import jax
    >>> import jaxlidar as jl
    >>> scene = jl.Scene(ground=jl.Ground(reflectance=0.4))
    >>> case = jl.io.Case(jl.Lidar(), scene, jax.random.key(0), {"rtol": 0.02})
    >>> wave = case.simulate()  # doctest: +SKIP
    """

    lidar: Lidar | None = None
    scene: Scene | None = None
    key: PRNGKeyArray | None = None
    arguments: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    survey: Survey | None = None

    def __post_init__(self):
        check_kind("lidar", self.lidar, Lidar | None, "a Lidar or None")
        check_kind("scene", self.scene, Scene | None, "a Scene or None")
        if self.key is not None:
            check_key(self.key)
        check_kind("survey", self.survey, Survey | None, "a Survey or None")
        check_keys(
            self.arguments, _simulate_arguments() if self.survey is None else _SURVEY_ARGUMENTS, "arguments"
        )

    def __getstate__(self) -> dict[str, Any]:
        # A pickled key comes back with another object for its generator, and JAX draws Poisson numbers with
        # the one object of threefry only.
        return {**vars(self), "key": None if self.key is None else _key_table(self.key)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, key=None if state["key"] is None else _key_of(state["key"]))

    def simulate(self, progress: ProgressOption = None, path: str | os.PathLike[str] | None = None) -> Any:
        """Simulate the waveform of this case, or those of its survey.

        **Arguments:**

        - `progress`: as for `jaxlidar.simulate`, or for `jaxlidar.simulate_many`. Default None.
        - `path`: as for `jaxlidar.simulate_many`; for surveys only. Default None.

        **Returns:** a `Waveform`, or the `Waveforms` of a survey.

        **Raises:** ValueError where lidar, scene or key are missing, and for a `path` without a survey; what
        `jaxlidar.simulate` or `jaxlidar.simulate_many` raises.
        """
        shots = "lidar" if self.survey is None else "survey"
        missing = [name for name in (shots, "scene", "key") if getattr(self, name) is None]
        if self.scene is None or self.key is None or missing:
            raise ValueError(f"the case has no {' and no '.join(missing)}: nothing can be simulated")
        if self.survey is not None:
            return simulate_survey(
                self.survey, self.scene, key=self.key, path=path, progress=progress, **self.arguments
            )
        if path is not None:
            raise ValueError(
                f"path = {os.fspath(path)!r} is given without a survey; use save on the waveform"
            )
        assert self.lidar is not None
        return simulate(self.lidar, self.scene, key=self.key, progress=progress, **self.arguments)


@functools.cache
def _simulate_arguments() -> Mapping[str, Argument]:
    """Return the arguments of `simulate` that a case holds."""
    return {
        name: Argument(annotation, False, UNITS.get(name, ""), name)
        for name, annotation in inspect.get_annotations(simulate).items()
        if name not in (*_EXCLUDED_ARGUMENTS, "return")
    }


def case_text(case: Case, file: str | None = None) -> tuple[str, dict[str, np.ndarray]]:
    """Return a case as TOML, and the arrays that lie apart from the text, by name.

    `file` is the name of the file for the arrays; None where they lie in the same file as the text.
    """
    arrays: dict[str, np.ndarray] = {}
    tables: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {}
    for name, value in (("lidar", case.lidar), ("survey", case.survey), ("scene", case.scene)):
        if value is not None:
            tables[name] = (_with_array_file(table_of(value, name, arrays), file), type(value))
    arguments = {key: table_of(value, f"simulate.{key}", arrays) for key, value in case.arguments.items()}
    if case.key is not None:
        arguments = {**_key_table(case.key), **arguments}
    if arguments:
        tables["simulate"] = (arguments, simulate)
    return text_of(tables), arrays


def _with_array_file(table: Any, file: str | None) -> Any:
    """Return a table in which references to arrays name their file."""
    if isinstance(table, list):
        return [_with_array_file(item, file) for item in table]
    if not isinstance(table, dict):
        return table
    if "array" in table:
        return table if file is None else {"file": file, **table}
    return {key: _with_array_file(item, file) for key, item in table.items()}


def _key_table(key: PRNGKeyArray) -> dict[str, Any]:
    """Return the entries of a random key: its words, and its generator if it is a new-style key."""
    if key.dtype == np.uint32:
        return {"key": np.asarray(key).tolist()}
    return {"key": jax.random.key_data(key).tolist(), "key_kind": str(jax.random.key_impl(key))}


def case_of(text: str, path: Path, read_array: ArrayReader) -> Case:
    """Return the case of a TOML text; `path` is the file that it is from.

    **Raises:** ValueError or TypeError, naming the file and the path of the entry in it.
    """
    try:
        tables = tables_of(text, path)
        check_keys(tables, _SECTIONS, "")
        tables = with_references(tables)
        survey = tables.get("survey")
        if isinstance(survey, dict) and "lidar" not in survey and "lidar" in tables:
            # The lidar of the case is that of its survey.
            tables = {**tables, "survey": {**survey, "lidar": tables["lidar"]}}
        fields = {
            name: value_of(tables[name], Argument(kind, False, "", name), name, read_array, path.parent)
            for name, kind in (("lidar", Lidar), ("survey", Survey), ("scene", Scene))
            if name in tables
        }
        table = tables.get("simulate", {})
        check_kind("simulate", table, dict, "a table")
        signature = _simulate_arguments()
        if survey is not None:
            signature = {
                **signature,
                "shared": Argument(bool | None, False, "", "shared"),
                "keep": Argument(tuple[str, ...], False, "", "keep"),
                "beyond": Argument(str, False, "", "beyond"),
            }
        check_keys(table, (*signature, "seed", "key", "key_kind"), "simulate")
        arguments = {
            name: value_of(table[name], signature[name], f"simulate.{name}", read_array, path.parent)
            for name in table
            if name in signature
        }
        return Case(**fields, key=_key_of(table), arguments=arguments)
    except (ValueError, TypeError) as error:
        raise error if str(error).startswith(str(path)) else type(error)(f"{path}: {error}") from error


def _key_of(table: Mapping[str, Any]) -> PRNGKeyArray | None:
    """Return the random key of the entries of a table; None where there are none."""
    if "seed" in table:
        if "key" in table:
            raise ValueError("simulate has both seed and key; admissible is one of them")
        return jax.random.key(check_integer("simulate.seed", table["seed"], 0, 2**31 - 1))
    if "key" not in table:
        return None
    words = table["key"]
    if not isinstance(words, list) or not all(type(w) is int and 0 <= w < 2**32 for w in words):
        raise ValueError(f"simulate.key = {words!r} is no row of whole numbers in [0, {2**32})")
    data = jax.numpy.asarray(np.array(words, np.uint32))
    generator = table.get("key_kind")
    if generator is None:
        return data
    try:
        return jax.random.wrap_key_data(data, impl=generator)
    except (ValueError, TypeError) as error:
        raise ValueError(f"simulate.key = {words} is no key of the kind {generator!r}: {error}") from error


def write_case(path: str | os.PathLike[str], case: Case) -> None:
    """Write a case as TOML, with units as comments; long arrays go to an .npz file of that name beside it.

    Numbers are exact: `read_case` gives the same bits, in the same precision of JAX.

    **Arguments:**

    - `path`: the file to write, `NAME.toml`. The arrays, if there are any, go to `NAME.npz`.
      Missing folders are created.
    - `case`: a `Case`.

    **Raises:** TypeError, naming the entry, for classes and functions of your own. ImportError where tomlkit
    is not installed. ValueError for a path that does not end in .toml, OSError for one that cannot be
    written.

    **Returns:** nothing.

    **Example:**

    >>> import pathlib, tempfile
    >>> import jaxlidar as jl
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flat.toml"
    >>> jl.io.write_case(path, jl.io.Case(scene=jl.Scene(ground=jl.Ground(slope=5.0))))
    >>> print([line for line in path.read_text().splitlines() if "slope" in line])
    ['slope = 5.0 # degrees']
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise ValueError(f"path = {str(path)!r} does not end in .toml")
    array_path = path.with_suffix(".npz")
    text, arrays = case_text(case, array_path.name)
    # The arrays first: a text that exists has its arrays.
    paths = [array_path, path] if arrays else [path]
    with atomic_writes(*paths) as drafts:
        if arrays:
            np.savez_compressed(drafts[0], **arrays)  # pyright: ignore[reportArgumentType]
        drafts[-1].write_text(text, encoding="utf-8")


def read_case(path: Path) -> Case:
    """Read the case of a TOML file; see `jaxlidar.io.read_case`."""
    existing_file(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start}: no UTF-8 text") from error

    def read_array(file: str | None, name: str) -> np.ndarray:
        if file is None:
            raise ValueError(f"array = {name!r} has no file: which .npz file it is in")
        return read_arrays(path.parent / file, (name,))[name]

    return case_of(text, path, read_array)
