"""Results as `xarray.Dataset`s, one for each group of a file, and back: `datasets_of`, `result_of`.

The annotations of a class decide what becomes of its fields:

| field | in the Dataset |
| --- | --- |
| array of shape "wavelengths bins" | a variable with these dimensions, or as a `ResultLayout` renames them |
| array of shape "*shots bins" | the same, with the dimension "shots" for results that have that axis |
| dict of such arrays | one variable with one more dimension, the first, whose coordinate has the keys |
| dict of arrays of any shape, "..." | a variable "FIELD.NUMBER.KEY" for each, with the attribute `item` |
| static field | an attribute, as JSON; a tuple of texts is a coordinate |
| array or dict that is `NotKept` | the attribute null |
| `Scene` or `Lidar` | an attribute, as TOML of a `Case`; its long arrays in the group "FIELD_arrays" |
| object of another known class | the group of the field's name |

Arrays of any shape have the leading axis of results that have one as their first dimension.

`keep_as_netcdf` makes a class known, with the units and long names of its fields, so that other packages can
add theirs. `jaxlidar.open` finds packages that are not imported yet by the entry points `jaxlidar.files`.

xarray's `DataTree` would hold all groups in one object, but it refuses groups in which a dimension has
another size than in the group above. Such results are legitimate, so groups are kept in a dict.
"""

import dataclasses
import json
import re
import typing
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jaxlidar._fields.checks import required_for
from jaxlidar._not_kept import NotKept
from jaxlidar.formats.checks import refuse_damage
from jaxlidar.results.case import Case, case_of, case_text
from jaxlidar.results.groups import StoredArray, StoredGroups
from jaxlidar.results.kinds import admits_tuple
from jaxlidar.results.toml import nearest
from jaxlidar.scenes.scene import Scene
from jaxlidar.sensors.lidar import Lidar

# The group of entry points that name the modules which call `keep_as_netcdf`, by class.
ENTRY_POINTS = "jaxlidar.files"
# Classes of fields that are written as the TOML text of a case, and the field of the case.
_CASE_FIELDS: dict[Any, str] = {Scene: "scene", Lidar: "lidar"}
# The attribute of a group with the name of the class.
KIND = "jaxlidar_kind"


class ResultLayout(NamedTuple):
    """Names and units with which a class of results is written; see `keep_as_netcdf`."""

    kind: type
    title: str
    quantities: Mapping[str, tuple[str, str]]
    dimensions: Mapping[str, str]
    items: Mapping[str, str]
    coordinates: Mapping[str, str]
    rows: str | None

    def items_of(self, field: str) -> str:
        """Dimension of the keys of a field that is a dict."""
        return self.items.get(field, f"{field}_item")


LAYOUTS: dict[str, ResultLayout] = {}


def keep_as_netcdf(
    kind: type,
    title: str,
    quantities: Mapping[str, tuple[str, str]],
    *,
    dimensions: Mapping[str, str] | None = None,
    items: Mapping[str, str] | None = None,
    coordinates: Mapping[str, str] | None = None,
    rows: str | None = None,
) -> None:
    """Let `save` and `open` know a class of results, an `equinox.Module` whose fields are annotated.

    Fields are arrays, dicts of arrays, modules that are known themselves, a `Scene` or a `Lidar`; static
    fields hold what JSON holds.

    **Arguments:**

    - `kind`: the class.
    - `title`: what it is, in a few words.
    - `quantities`: (units, long name) of every field that is an array or a dict of arrays.
    - `dimensions`: names of dimensions in the file by those in annotations, where they differ. A dimension
      with the name of a field of one axis makes that field a coordinate. Default None: none differs.
    - `items`: names of the dimensions of the keys of dicts, by field. Default None: "FIELD_item".
    - `coordinates`: further fields that are coordinates, each with the dimension that it lies along. Default
      None: none.
    - `rows`: a dimension of the annotations that is the first of some fields, which may be larger than
      memory: those of a Zarr store beyond 64 MB are read where they are used. Default None: none.

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
    LAYOUTS[kind.__name__] = ResultLayout(
        kind,
        title,
        quantities,
        dimensions or {},
        items or {},
        coordinates or {},
        rows,
    )


def layout_of(name: str, path: Path) -> ResultLayout:
    """Return the layout of a class by its name; a package that registers it is imported first.

    **Raises:** ValueError, naming the file, for a class that nobody registers.
    """
    if name not in LAYOUTS:
        for point in metadata.entry_points(group=ENTRY_POINTS):
            if point.name == name:
                point.load()
    if name not in LAYOUTS:
        raise ValueError(
            f"{path}: it holds a {name}, which is not known here ({nearest(name, LAYOUTS)}): import the "
            "package that has it first"
        )
    return LAYOUTS[name]


def _has_leading_axis(result: Any) -> bool:
    """Return True for a result whose arrays have the leading axis that annotations such as "*shots" admit."""
    for field in dataclasses.fields(result):
        dimensions, value = _dimensions(field.type) or [""], getattr(result, field.name)
        arrays = list(value.values()) if isinstance(value, dict) else [value]
        # Arrays of any shape do not tell.
        is_telling = dimensions[0].startswith("*") and "..." not in dimensions
        if is_telling and arrays and not isinstance(value, NotKept):
            return np.ndim(arrays[0]) == len(dimensions)
    return False


def _array_dimensions(annotation: Any) -> list[str] | None:
    """Dimensions of an annotated array; None where the annotation is no array."""
    shape = getattr(annotation, "dim_str", None)
    return None if shape is None else shape.split()


def _item_annotation(annotation: Any) -> Any:
    """Annotation of the values of a dict of arrays; None where the annotation is no such dict."""
    arguments = typing.get_args(annotation)
    is_dict = typing.get_origin(annotation) is dict and len(arguments) == 2
    return arguments[1] if is_dict and _array_dimensions(arguments[1]) is not None else None


def _dimensions(annotation: Any) -> list[str] | None:
    """Dimensions of an array, or of each array of a dict."""
    shape = _array_dimensions(annotation)
    return _array_dimensions(_item_annotation(annotation)) if shape is None else shape


# -- to datasets -------------------------------------------------------------------------------------------


def datasets_of(result: Any, group: str = "/") -> dict[str, Any]:
    """Return a result as `xarray.Dataset`s by the path of their group: "/", "/truth", ...

    **Arguments:**

    - `result`: an object of a class that `keep_as_netcdf` knows.
    - `group`: path of its own group; those of objects in its fields lie below. Default "/".

    **Returns:** a dict of `xarray.Dataset`.

    **Raises:** TypeError for values that no file can hold. ImportError where xarray is not installed.
    """
    with required_for("making datasets"):
        import xarray
    layout = LAYOUTS[type(result).__name__]
    builder = _DatasetBuilder(layout, _has_leading_axis(result))
    inner_datasets: dict[str, Any] = {}
    for field in dataclasses.fields(result):
        name, value = field.name, getattr(result, field.name)
        inner_group = f"{group.rstrip('/')}/{name}"
        if field.metadata.get("static"):
            builder.add_static(name, value)
        elif value is None or isinstance(value, NotKept):
            builder.add_static(name, None)
        elif (dimensions := _array_dimensions(field.type)) is not None:
            builder.add_array(name, name, dimensions, value)
        elif (annotation := _item_annotation(field.type)) is not None:
            builder.add_arrays(name, _array_dimensions(annotation) or [], value)
        elif field.type in _CASE_FIELDS:
            case = Case(**{_CASE_FIELDS[field.type]: value})
            attributes, inner_datasets[f"{inner_group}_arrays"] = case_dataset(name, case)
            builder.attributes |= attributes
        elif type(value).__name__ in LAYOUTS:
            inner_datasets |= datasets_of(value, inner_group)
        else:
            raise TypeError(f"{name} is of the class {type(value).__name__}, which no file can hold")
    dataset = xarray.Dataset(builder.variables, attrs=builder.attributes).set_coords(list(layout.coordinates))
    return {group: dataset, **{path: inner for path, inner in inner_datasets.items() if inner is not None}}


def case_dataset(name: str, case: Case) -> tuple[dict[str, str], Any]:
    """Return a case as attributes with its TOML text, and as a Dataset of its arrays; None without arrays."""
    import xarray

    text, arrays = case_text(case)
    variables = {
        key: ([f"{key}.{axis}" for axis in range(array.ndim)], array) for key, array in arrays.items()
    }
    return {name: text}, xarray.Dataset(variables) if variables else None


def variables_by_item(dataset: Any, field: str) -> dict[str, str]:
    """Return the names of the variables of a field that is a dict of arrays of any shape, by their key."""
    names = [str(name) for name in dataset.variables if str(name).startswith(f"{field}.")]
    names.sort(key=lambda name: int(name.split(".")[1]))
    return {str(dataset.variables[name].attrs["item"]): name for name in names}


class _DatasetBuilder:
    """Variables and attributes of the Dataset of one object."""

    def __init__(self, layout: ResultLayout, has_leading_axis: bool):
        self.layout, self._has_leading_axis = layout, has_leading_axis
        self.variables: dict[str, Any] = {}
        self.attributes: dict[str, Any] = {"title": layout.title, KIND: layout.kind.__name__}
        self._sizes: dict[str, int] = {}

    def add_static(self, name: str, value: Any) -> None:
        if isinstance(value, tuple) and value and all(isinstance(text, str) for text in value):
            self._add_texts(name, list(value))
        else:
            self.attributes[name] = json.dumps(value, default=_json_value)

    def add_array(self, field: str, name: str, annotated: list[str], value: Any, **attrs: str) -> None:
        """Add the variable `name` with the units of a field, and with further attributes."""
        array, dimensions = np.asarray(value), self._named(name, annotated, np.ndim(value))
        units, long_name = self.layout.quantities[field]
        self._sizes |= dict(zip(dimensions, array.shape))
        self.variables[name] = (dimensions, array, {"units": units, "long_name": long_name, **attrs})

    def add_arrays(self, field: str, annotated: list[str], arrays: Mapping[str, Any]) -> None:
        """Add a dict of arrays: one variable where all have one shape, otherwise one for each."""
        if "..." in annotated:
            for number, (key, array) in enumerate(arrays.items()):
                # Any program that reads netCDF admits such a name.
                plain_key = re.sub(r"\W+", "_", key)
                self.add_array(field, f"{field}.{number}.{plain_key}", annotated, array, item=key)
            return
        keys = self.layout.items_of(field)
        self._add_texts(keys, list(arrays))
        if not arrays:
            named = self._named(field, annotated, len(annotated))
            stacked = np.zeros((0, *(self._sizes.get(dimension, 0) for dimension in named)))
        else:
            stacked = np.stack([np.asarray(array) for array in arrays.values()])
        self.add_array(field, field, [keys, *annotated], stacked)

    def _add_texts(self, name: str, texts: list[str]) -> None:
        """Add a coordinate of texts; several dicts with the same keys share one."""
        if name in self.variables and (before := self.variables[name][1].tolist()) != texts:
            raise ValueError(f"{name} = {texts} differs from the {name} of another field, {before}")
        self.variables[name] = ([name], np.array(texts, dtype=str))

    def _named(self, name: str, annotated: list[str], ndim: int) -> list[str]:
        """Names of all dimensions of a variable, from those of its annotation."""
        if not self._has_leading_axis:
            annotated = [d for d in annotated if not d.startswith("*")]
        elif annotated[:1] == ["..."]:
            annotated = [f"*{self.layout.rows}", *annotated]
        plain = [d.removeprefix("*") for d in annotated]
        named = [self.layout.dimensions.get(d, d) for d in plain if d != "..."]
        if "..." in annotated:
            # Axes without a name of their own.
            at = annotated.index("...")
            named[at:at] = [f"{name}.{axis}" for axis in range(ndim - len(named))]
        # A dimension cannot be two axes of one variable: the second axis of a covariance is "labels_2".
        return [d if d not in named[:i] else f"{d}_{i + 1}" for i, d in enumerate(named)]


def _json_value(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    raise TypeError(f"a {type(value).__name__} is nothing that a file can hold")


# -- from datasets -----------------------------------------------------------------------------------------


def result_of(stored: StoredGroups, group: str = "/") -> Any:
    """Return the object that a group holds, the inverse of `datasets_of`.

    **Arguments:** `stored`: the open file. `group`: path of the group. Default "/".

    **Raises:** ValueError, naming the file and the place in it, for damage and for what is missing.
    """
    return _GroupReader(stored, group).result()


def case_of_group(stored: StoredGroups, name: str, group: str = "/") -> Case:
    """Return the case that is an attribute of a group. **Raises:** as `result_of`."""
    return _GroupReader(stored, group).case(name)


class _GroupReader:
    """Reads the object of one group."""

    def __init__(self, stored: StoredGroups, group: str):
        self.stored, self.group, self.path = stored, group, stored.path
        if group not in stored.datasets:
            raise ValueError(f"{self.path}: {group}: no such group")
        self.dataset = stored.datasets[group]

    def _place(self, name: str) -> str:
        return f"{self.path}: {self.group.rstrip('/')}/{name}"

    def result(self) -> Any:
        layout = layout_of(self._attribute(KIND), self.path)
        place = f"{self.path}: {self.group}"
        fields = {field.name: self._field(layout, field) for field in dataclasses.fields(layout.kind)}
        try:
            return layout.kind(**fields)
        except (ValueError, TypeError) as error:
            raise type(error)(f"{place}: {error}") from error

    def _field(self, layout: ResultLayout, field: Any) -> Any:
        name, annotation = field.name, field.type
        if field.metadata.get("static"):
            return self._static(name, annotation)
        if (
            _dimensions(annotation) is not None
            and name not in self.dataset.variables
            and self.dataset.attrs.get(name) == "null"
        ):
            return NotKept(name)
        if _array_dimensions(annotation) is not None:
            return self._array(name, annotation, layout)
        if (item_annotation := _item_annotation(annotation)) is not None:
            if "..." in (_array_dimensions(item_annotation) or []):
                return self._arrays_of_any_shape(name, item_annotation, layout)
            keys = self._texts(layout.items_of(name))
            arrays = self._array(name, item_annotation, layout)
            if len(arrays) != len(keys):
                raise ValueError(f"{self._place(name)}: {len(arrays)} rows for {len(keys)} names")
            if isinstance(arrays, StoredArray):
                return {key: arrays.of_item(item) for item, key in enumerate(keys)}
            return dict(zip(keys, arrays))
        if self.dataset.attrs.get(name) == "null":
            return None
        if annotation in _CASE_FIELDS:
            return getattr(self.case(name), _CASE_FIELDS[annotation])
        return result_of(self.stored, f"{self.group.rstrip('/')}/{name}")

    def case(self, name: str) -> Case:
        if name not in self.dataset.attrs:
            raise ValueError(f"{self._place(name)}: no such attribute: it was saved without its case")
        text = self._attribute(name)

        def read_array(file: str | None, key: str) -> np.ndarray:
            if file is not None:
                raise ValueError(f"array = {key!r} lies in {file!r}, not in this file")
            return _GroupReader(self.stored, f"{self.group.rstrip('/')}/{name}_arrays")._numbers(key)

        return case_of(text, self.path, read_array)

    def _attribute(self, name: str) -> str:
        with refuse_damage(f"{self._place(name)}: damaged"):
            if name not in self.dataset.attrs:
                raise ValueError(f"the attribute {name} is missing")
            return str(self.dataset.attrs[name])

    def _static(self, name: str, annotation: Any) -> Any:
        if name in self.dataset.variables:
            return tuple(self._texts(name))
        text = self._attribute(name)
        with refuse_damage(f"{self._place(name)}: damaged"):
            value = json.loads(text)
        return tuple(value) if admits_tuple(annotation) else value

    def _texts(self, name: str) -> list[str]:
        if name not in self.dataset.variables:
            raise ValueError(f"{self._place(name)}: no such variable")
        with refuse_damage(f"{self._place(name)}: damaged"):
            return [str(text) for text in self.stored.values(self.group, name)]

    def _arrays_of_any_shape(self, field: str, annotation: Any, layout: ResultLayout) -> dict[str, Any]:
        with refuse_damage(f"{self._place(field)}: damaged"):
            variables = variables_by_item(self.dataset, field)
        return {item: self._array(name, annotation, layout) for item, name in variables.items()}

    def _numbers(self, name: str, has_rows: bool = False) -> Any:
        if name not in self.dataset.variables:
            raise ValueError(f"{self._place(name)}: no such variable")
        with refuse_damage(f"{self._place(name)}: damaged"):
            read = self.stored.rows if has_rows else self.stored.values
            return read(self.group, name)

    def _array(self, name: str, annotation: Any, layout: ResultLayout) -> Any:
        rows = None if layout.rows is None else layout.dimensions.get(layout.rows, layout.rows)
        has_rows = name in self.dataset.variables and rows in self.dataset.variables[name].dims
        array = self._numbers(name, has_rows)
        if annotation.dtype is Bool:
            # netCDF has no such type: bytes stand for it.
            array = array.astype(bool)
        if has_rows or annotation.array_type is np.ndarray:
            return array
        # Double precision stays double, in whatever precision JAX computes now.
        with jax.enable_x64(True):
            return jnp.asarray(array)
