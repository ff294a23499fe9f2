"""Cases: a lidar or a survey, a scene and how they are simulated, in a TOML file that a person can write.

    [lidar]
    altitude = 500.0                                  # m; what is left out has the default of the class
    pulse = {kind = "GaussianPulse", fwhm = 4.0}

    [scene.ground]
    reflectance = {kind = "spectrum", name = "soil-medium"}

    [simulate]
    seed = 0
    rtol = 0.01

`jaxlidar/io/README.md` describes the schema.
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

from jaxlidar._checks import check_integer, check_key, check_kind
from jaxlidar._files import atomic_write
from jaxlidar._registry import simulate_survey
from jaxlidar.instrument.lidar import Lidar
from jaxlidar.instrument.survey import Survey
from jaxlidar.io.kinds import UNITS, Argument
from jaxlidar.io.npz import read_arrays
from jaxlidar.io.tables import Arrays, check_keys, table_of, value_of
from jaxlidar.io.toml import tables_of, text_of
from jaxlidar.scenes.scene import Scene
from jaxlidar.simulate import simulate

# Arguments of `simulate` that a file cannot hold, or that a case has as fields of its own.
_NOT_KEPT = ("lidar", "scene", "key", "plan", "progress")
SECTIONS = ("lidar", "survey", "scene", "simulate")
# Arguments of `simulate_many`; `simulate` has all but the last as well.
_OF_SURVEYS = ("rtol", "max_orders", "truth", "shared")


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A lidar or a survey, a scene and how they are simulated. Any of them may be missing in a file.

    **Arguments:**

    - `lidar`: a `Lidar`, or None. Default None.
    - `scene`: a `Scene`, or None. Default None.
    - `key`: a JAX random key, or None. Default None.
    - `arguments`: by name, other arguments of `jaxlidar.simulate`, such as `rtol`; all but `plan` and
      `progress`. With a survey: `rtol`, `max_orders` and `shared`. Default: none.
    - `survey`: a `Survey`, which is simulated in place of the lidar, or None. Default None.

    **Raises:** TypeError for a thing of another kind; ValueError for an unknown argument, and for one that
    `jaxlidar.simulate_many` does not have, with a survey.

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
        check_keys(self.arguments, _arguments() if self.survey is None else _OF_SURVEYS, "arguments")

    def __getstate__(self) -> dict[str, Any]:
        # A key that is pickled comes back with a generator of its own, which Poisson numbers refuse, its own
        # and those of other keys.
        return {**vars(self), "key": None if self.key is None else _key_table(self.key)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, key=None if state["key"] is None else _key_of(state["key"]))

    def simulate(
        self, progress: Callable[[Any], None] | None = None, path: str | os.PathLike[str] | None = None
    ) -> Any:
        """The waveform of this case, or those of its survey.

        **Arguments:**

        - `progress`: as for `jaxlidar.simulate`, or for `jaxlidar.simulate_many`. Default None.
        - `path`: of a survey alone, as for `jaxlidar.simulate_many`. Default None.

        **Returns:** a `Waveform`, or the `Waveforms` of a survey.

        **Raises:** ValueError where lidar, scene or key are missing, and for a `path` without a survey; what
        `jaxlidar.simulate` or `jaxlidar.simulate_many` raises.
        """
        shots = "lidar" if self.survey is None else "survey"
        missing = [name for name in (shots, "scene", "key") if getattr(self, name) is None]
        if self.scene is None or self.key is None or missing:
            raise ValueError(f"the case has no {' and no '.join(missing)}: nothing can be simulated")
        if self.survey is not None:
            given = {"key": self.key, "path": path, "progress": progress, **self.arguments}
            return simulate_survey(self.survey, self.scene, **given)
        if path is not None:
            raise ValueError(
                f"path = {os.fspath(path)!r} is given without a survey; use save on the waveform"
            )
        assert self.lidar is not None
        return simulate(self.lidar, self.scene, key=self.key, progress=progress, **self.arguments)


@functools.cache
def _arguments() -> Mapping[str, Argument]:
    """The arguments of `simulate` that are kept."""
    return {
        name: Argument(annotation, False, UNITS.get(name, ""), name)
        for name, annotation in inspect.get_annotations(simulate).items()
        if name not in (*_NOT_KEPT, "return")
    }


def case_text(case: Case, file: str | None = None) -> tuple[str, dict[str, np.ndarray]]:
    """A case as TOML, and the arrays that lie apart from it, by name; `file` is where they will lie."""
    arrays: dict[str, np.ndarray] = {}
    tables: dict[str, tuple[dict[str, Any], Callable[..., Any]]] = {}
    for name, part in (("lidar", case.lidar), ("survey", case.survey), ("scene", case.scene)):
        if part is not None:
            tables[name] = (_with_file(table_of(part, name, arrays), file), type(part))
    given = {key: table_of(value, f"simulate.{key}", arrays) for key, value in case.arguments.items()}
    if case.key is not None:
        given = {**_key_table(case.key), **given}
    if given:
        tables["simulate"] = (given, simulate)
    return text_of(tables), arrays


def _with_file(table: Any, file: str | None) -> Any:
    """The same table, with the file in which arrays lie named beside them."""
    if isinstance(table, list):
        return [_with_file(part, file) for part in table]
    if not isinstance(table, dict):
        return table
    if "array" in table:
        return table if file is None else {"file": file, **table}
    return {key: _with_file(part, file) for key, part in table.items()}


def _key_table(key: PRNGKeyArray) -> dict[str, Any]:
    if key.dtype == np.uint32:
        return {"key": np.asarray(key).tolist()}
    return {"key": jax.random.key_data(key).tolist(), "key_kind": str(jax.random.key_impl(key))}


def case_of(text: str, path: Path, arrays: Arrays) -> Case:
    """The case of a TOML text; `path` is the file that it is from, `arrays` gives those that lie apart."""
    try:
        tables = tables_of(text, path)
        check_keys(tables, SECTIONS, "")
        survey = tables.get("survey")
        if isinstance(survey, dict) and "lidar" not in survey and "lidar" in tables:
            # The lidar of the case is that of its survey.
            tables = {**tables, "survey": {**survey, "lidar": tables["lidar"]}}
        parts = {
            name: value_of(tables[name], Argument(kind, False, "", name), name, arrays, path.parent)
            for name, kind in (("lidar", Lidar), ("survey", Survey), ("scene", Scene))
            if name in tables
        }
        given = tables.get("simulate", {})
        check_kind("simulate", given, dict, "a table")
        known = _arguments()
        if survey is not None:
            known = {**known, "shared": Argument(bool | None, False, "", "shared")}
        check_keys(given, (*known, "seed", "key", "key_kind"), "simulate")
        arguments = {
            name: value_of(given[name], known[name], f"simulate.{name}", arrays, path.parent)
            for name in given
            if name in known
        }
        return Case(**parts, key=_key_of(given), arguments=arguments)
    except (ValueError, TypeError) as error:
        raise error if str(error).startswith(str(path)) else type(error)(f"{path}: {error}") from error


def _key_of(given: Mapping[str, Any]) -> PRNGKeyArray | None:
    if "seed" in given:
        if "key" in given:
            raise ValueError("simulate has both seed and key; admissible is one of them")
        return jax.random.key(check_integer("simulate.seed", given["seed"], 0, 2**31 - 1))
    if "key" not in given:
        return None
    words = given["key"]
    if not isinstance(words, list) or not all(type(w) is int and 0 <= w < 2**32 for w in words):
        raise ValueError(f"simulate.key = {words!r} is no row of whole numbers in [0, {2**32})")
    data = jax.numpy.asarray(np.array(words, np.uint32))
    kind = given.get("key_kind")
    if kind is None:
        return data
    try:
        return jax.random.wrap_key_data(data, impl=kind)
    except (ValueError, TypeError) as error:
        raise ValueError(f"simulate.key = {words} is no key of the kind {kind!r}: {error}") from error


def write_case(path: str | os.PathLike[str], case: Case) -> None:
    """Write a case as TOML, with units as comments; long arrays go to an .npz file of that name beside it.

    Numbers are exact: `read_case` gives the same bits, in the same precision of JAX.

    **Arguments:**

    - `path`: the file to write, `NAME.toml`. The arrays, if there are any, go to `NAME.npz`.
    - `case`: a `Case`.

    **Raises:** TypeError, naming the place, for classes and functions of one's own. ImportError where tomlkit
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
    beside = path.with_suffix(".npz")
    text, arrays = case_text(case, beside.name)
    # The arrays first: a text that is there has its arrays.
    if arrays:
        with atomic_write(beside) as draft, draft.open("wb") as file:
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    with atomic_write(path) as draft:
        draft.write_text(text, encoding="utf-8")


def read_case(path: Path) -> Case:
    """The case of a TOML file; see `jaxlidar.io.read_case`."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: byte {error.start}: no UTF-8 text") from error

    def arrays(file: str | None, name: str) -> np.ndarray:
        if file is None:
            raise ValueError(f"array = {name!r} has no file: which .npz file it is in")
        return read_arrays(path.parent / file, (name,))[name]

    return case_of(text, path, arrays)
