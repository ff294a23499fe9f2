"""Objects as groups of a netCDF file, and back, by the annotations of their fields."""

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlidar.instrument.lidar import Lidar
from jaxlidar.io.annotations import shape_of, values_of
from jaxlidar.io.case import Case, case_of, case_text
from jaxlidar.io.gedi_beam import refusing
from jaxlidar.io.kinds import is_tuple
from jaxlidar.io.rows import BLOCK, CHECKSUMS, Rows, blank, check_rows, mapped, row_fields
from jaxlidar.io.zarr_groups import ZarrGroup
from jaxlidar.scenes.scene import Scene

# Names of fields that a case takes the place of, and which part of it they are.
PARTS: dict[Any, str] = {Scene: "scene", Lidar: "lidar"}


def spelled(name: str) -> str:
    """A name that any program that reads netCDF admits."""
    return re.sub(r"\W+", "_", name)


def text_digest(group: Any, layout: Any) -> str:
    """A checksum of the names and static fields in a group, as netCDF itself has one for numbers alone."""
    items = [(n, v.attrs["item"]) for n, v in group.variables.items() if "item" in v.attrs]
    texts = [
        (n, [t.decode() for t in v[...]])
        for n, v in group.variables.items()
        if v.dtype == str and v.ndim == 1
    ]
    static = [f.name for f in dataclasses.fields(layout.kind) if f.metadata.get("static")]
    kept = [(n, str(group.attrs[n])) for n in static if n in group.attrs]
    return hashlib.sha256(json.dumps([sorted(items), sorted(texts), kept]).encode()).hexdigest()


class Writer:
    """Writes objects into groups. `layouts` has what is known of their classes, by name."""

    def __init__(self, layouts: Mapping[str, Any]):
        self.layouts = layouts

    def result(self, group: Any, value: Any) -> None:
        """Write an object of a known class."""
        rows = self.frame(group, value)
        if rows is not None:
            values = {name: getattr(value, name) for name in (*rows.fields, *rows.inner)}
            for start in range(0, len(rows.sums), BLOCK):
                some = slice(start, start + BLOCK)
                rows.add(some, jax.tree.map(lambda a, some=some: a[some], values))
            rows.end()

    def frame(self, group: Any, value: Any) -> Rows | None:
        """Write an object of a known class but for its rows, if it has any: these are for the caller."""
        layout = self.layouts[type(value).__name__]
        inner = self._fields(group, layout, value)
        group.attrs["text_sha256"] = text_digest(group, layout)
        if layout.rows is None:
            return None
        name = layout.dimensions.get(layout.rows, layout.rows)
        group.create_variable(CHECKSUMS, (name,), dtype=np.dtype(np.uint32))
        return Rows(group, layout, group.dimensions[name].size, value, inner)

    def _fields(self, group: Any, layout: Any, value: Any) -> dict[str, Rows]:
        """Write all but rows, and give those of objects within, which have a row for each of the whole."""
        rows = {}
        for field in dataclasses.fields(value):
            part = getattr(value, field.name)
            name, shape, each = field.name, shape_of(field.type), values_of(field.type)
            if field.metadata.get("static"):
                self._static(group, name, part)
            elif shape is not None:
                self._array(group, layout, name, name, shape, part)
            elif each is not None and "..." not in (shape := shape_of(each) or []):
                keys = layout.items.get(name, f"{name}_item")
                self._names(group, keys, list(part))
                arrays = [np.asarray(a) for a in part.values()]
                if not arrays:
                    whole = _none(group, layout, shape)
                elif name in row_fields(layout):
                    # Rows follow later.
                    whole = blank(len(arrays), arrays[0][None])
                else:
                    whole = np.stack(arrays)
                self._array(group, layout, name, name, [keys, *shape], whole)
            elif each is not None:
                for number, (key, array) in enumerate(part.items()):
                    made = self._array(
                        group, layout, name, f"{name}.{number}.{spelled(key)}", shape or [], array
                    )
                    made.attrs["item"] = key
            elif field.type in PARTS:
                self.case(group, name, Case(**{PARTS[field.type]: part}))
            elif type(part).__name__ in self.layouts:
                inner = group.create_group(name)
                inner.attrs["jaxlidar_kind"] = type(part).__name__
                if layout.rows is None:
                    self.result(inner, part)
                elif (of_part := self.frame(inner, part)) is not None:
                    rows[name] = of_part
            elif part is None:
                self._static(group, name, part)
            else:
                raise TypeError(f"{name} is of the class {type(part).__name__}, which no file can hold")
        return rows

    def case(self, group: Any, name: str, case: Case) -> None:
        """Write a case as an attribute of TOML, and its arrays into a group beside."""
        text, arrays = case_text(case)
        group.attrs[name] = text
        group.attrs[f"{name}_sha256"] = hashlib.sha256(text.encode()).hexdigest()
        if arrays:
            inner = group.create_group(f"{name}_arrays")
            for place, array in arrays.items():
                dimensions = [f"{place}.{axis}" for axis in range(array.ndim)]
                _variable(inner, place, dimensions, array)

    def _static(self, group: Any, name: str, value: Any) -> None:
        if isinstance(value, tuple) and value and all(isinstance(v, str) for v in value):
            self._names(group, name, list(value))
        else:
            group.attrs[name] = json.dumps(value, default=_plain)

    def _names(self, group: Any, name: str, names: list[str]) -> None:
        """A coordinate of strings; several dicts of the same keys share one."""
        import h5py

        if name in group.variables:
            if [n.decode() for n in group[name][...]] != names:
                raise ValueError(f"{name} = {names} differs from the {name} of another field")
            return
        _dimensions(group, [name], (len(names),))
        group.create_variable(name, (name,), dtype=h5py.string_dtype(), data=np.array(names, object))

    def _array(self, group: Any, layout: Any, field: str, name: str, shape: list[str], value: Any) -> Any:
        array = np.asarray(value)
        named = [layout.dimensions.get(d, d) for d in shape if d != "..."]
        if "..." in shape:
            # Axes without a name of their own.
            at, extra = shape.index("..."), array.ndim - len(named)
            named[at:at] = [f"{name}.{axis}" for axis in range(extra)]
        # A dimension cannot be two axes of one variable.
        dimensions = [d if d not in named[:i] else f"{d}_{i + 1}" for i, d in enumerate(named)]
        if field in row_fields(layout):
            made = _row_variable(group, name, dimensions, array, shape.index(layout.rows))
        else:
            made = _variable(group, name, dimensions, array)
        units, long_name = layout.quantities[field]
        made.attrs["units"], made.attrs["long_name"] = units, long_name
        beside = [c for c, along in layout.coordinates.items() if along in dimensions and c != field]
        if beside:
            made.attrs["coordinates"] = " ".join(beside)
        return made


def _none(group: Any, layout: Any, shape: list[str]) -> np.ndarray:
    sizes = [group.dimensions[layout.dimensions.get(d, d)].size for d in shape]
    return np.zeros((0, *sizes))


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return np.asarray(value).tolist()
    raise TypeError(f"a {type(value).__name__} is nothing that a file can hold")


def _dimensions(group: Any, names: list[str], shape: tuple[int, ...]) -> None:
    for name, size in zip(names, shape):
        if name not in group.dimensions:
            group.dimensions[name] = size


def _variable(group: Any, name: str, dimensions: list[str], array: np.ndarray) -> Any:
    """A variable with a checksum, so that damage is noticed."""
    _dimensions(group, dimensions, array.shape)
    stored = array.astype(np.int8) if array.dtype == bool else array
    checked = {"chunks": array.shape, "fletcher32": True} if array.size and array.ndim else {}
    made = group.create_variable(name, tuple(dimensions), dtype=stored.dtype, data=stored, **checked)
    if array.dtype == bool:
        # As xarray has it.
        made.attrs["dtype"] = "bool"
    return made


def _row_variable(group: Any, name: str, dimensions: list[str], array: np.ndarray, axis: int) -> Any:
    """A variable whose rows follow: in one piece, or in chunks of rows where the store has chunks."""
    _dimensions(group, dimensions, array.shape)
    chunks: dict[str, Any] = {}
    if isinstance(group, ZarrGroup):
        chunks = {"chunks": [BLOCK if i == axis else n for i, n in enumerate(array.shape)]}
    return group.create_variable(name, tuple(dimensions), dtype=array.dtype, **chunks)


class Reader:
    """Reads objects from groups. `layout_of` gives what is known of a class, by name, for a file."""

    def __init__(self, path: Path, layout_of: Callable[[str, Path], Any]):
        self.path, self.layout_of = path, layout_of

    def result(self, group: Any, kind: str, place: str) -> Any:
        """The object of a class that a group holds."""
        layout = self.layout_of(kind, self.path)
        with refusing(f"{self.path}: {place or '/'}: damaged"):
            digest, kept = text_digest(group, layout), str(group.attrs.get("text_sha256"))
        if digest != kept:
            raise ValueError(f"{self.path}: {place or '/'}: damaged (the checksum of its texts is another)")
        fields = {f.name: self._field(group, layout, f, place) for f in dataclasses.fields(layout.kind)}
        if layout.rows is not None:
            sums = self._numbers(group, CHECKSUMS, f"{place}/{CHECKSUMS}")
            check_rows(f"{self.path}: {place or '/'}", sums, {n: fields[n] for n in row_fields(layout)})
        try:
            return layout.kind(**fields)
        except (ValueError, TypeError) as error:
            raise type(error)(f"{self.path}: {place or '/'}: {error}") from error

    def _field(self, group: Any, layout: Any, field: Any, place: str) -> Any:
        name, at = field.name, f"{place}/{field.name}"
        shape, each = shape_of(field.type), values_of(field.type)
        if field.metadata.get("static"):
            return self._static(group, name, field.type, at)
        rows = name in row_fields(layout)
        if shape is not None:
            return self._array(group, name, field.type, at, rows)
        if each is not None and "..." not in (shape_of(each) or []):
            keys = self._names(group, layout.items.get(name, f"{name}_item"), place)
            arrays = self._array(group, name, each, at, rows)
            if len(arrays) != len(keys):
                raise ValueError(f"{self.path}: {at}: {len(arrays)} rows for {len(keys)} names")
            return dict(zip(keys, arrays))
        if each is not None:
            with refusing(f"{self.path}: {place or '/'}: damaged"):
                listed = [v for v in group.variables if v.startswith(f"{name}.")]
            listed.sort(key=lambda v: int(v.split(".")[1]))
            return {
                self._attribute(group.variables[v], "item", f"{at}: {v}"): self._array(
                    group, v, each, f"{place}/{v}"
                )
                for v in listed
            }
        if field.type in PARTS:
            return getattr(self.case(group, name, place), PARTS[field.type])
        if name not in group.groups:
            if name in group.attrs and self._static(group, name, field.type, at) is None:
                return None
            raise ValueError(f"{self.path}: {at}: no such group")
        inner = group.groups[name]
        return self.result(inner, self._attribute(inner, "jaxlidar_kind", at), at)

    def case(self, group: Any, name: str, place: str) -> Case:
        """The case that is an attribute of a group."""
        at = f"{place}/{name}"
        if name not in group.attrs:
            raise ValueError(f"{self.path}: {at}: no such attribute: it was saved without its case")
        text = self._attribute(group, name, at)
        if hashlib.sha256(text.encode()).hexdigest() != self._attribute(group, f"{name}_sha256", at):
            raise ValueError(f"{self.path}: {at}: damaged (its checksum is another)")

        def arrays(file: str | None, key: str) -> np.ndarray:
            if file is not None:
                raise ValueError(f"array = {key!r} lies in {file!r}, not in this file")
            inner = f"{name}_arrays"
            if inner not in group.groups:
                raise ValueError(f"no such group {inner}")
            return self._numbers(group.groups[inner], key, f"{place}/{inner}/{key}")

        return case_of(text, self.path, arrays)

    def _attribute(self, group: Any, name: str, at: str) -> str:
        with refusing(f"{self.path}: {at}: damaged"):
            if name not in group.attrs:
                raise ValueError(f"the attribute {name} is missing")
            return str(group.attrs[name])

    def _static(self, group: Any, name: str, annotation: Any, at: str) -> Any:
        if name in group.variables:
            return tuple(self._names(group, name, at.rpartition("/")[0]))
        text = self._attribute(group, name, at)
        with refusing(f"{self.path}: {at}: damaged"):
            value = json.loads(text)
        return tuple(value) if is_tuple(annotation) else value

    def _names(self, group: Any, name: str, place: str) -> list[str]:
        at = f"{place}/{name}"
        if name not in group.variables:
            raise ValueError(f"{self.path}: {at}: no such variable")
        with refusing(f"{self.path}: {at}: damaged"):
            return [n.decode() for n in group.variables[name][...]]

    def _numbers(self, group: Any, name: str, at: str, rows: bool = False) -> np.ndarray:
        if name not in group.variables:
            raise ValueError(f"{self.path}: {at}: no such variable")
        with refusing(f"{self.path}: {at}: damaged"):
            variable = group.variables[name]
            array = mapped(self.path, variable) if rows else np.asarray(variable[...])
            return array.astype(bool) if variable.attrs.get("dtype") == "bool" else array

    def _array(self, group: Any, name: str, annotation: Any, at: str, rows: bool = False) -> Any:
        array = self._numbers(group, name, at, rows)
        if annotation.array_type is np.ndarray:
            return array
        # Double precision stays so, whatever JAX's is now.
        with jax.enable_x64(True):
            return jnp.asarray(array)
