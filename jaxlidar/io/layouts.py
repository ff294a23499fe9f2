"""How classes of results are written to files: `keep_as_netcdf`.

What is written of a class follows from its annotations: an array of shape "wavelengths bins" has these two
dimensions, a dict of such arrays one more, static fields are attributes, and modules in fields are groups.
A class is made known by `keep_as_netcdf` with the units and names of its fields, so that other packages can
add theirs; jaxlidar finds them by the entry points `jaxlidar.files`.
"""

from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from jaxlidar.io.tables import nearest

FILES = "jaxlidar.files"


class Layout(NamedTuple):
    """How a class is written: its title, and for its fields (units, long name).

    `dimensions` renames those of the annotations; `items` names the dimension of a dict's keys.
    `coordinates` are fields that lie along a dimension beside the coordinate of its own name. `rows` is the
    dimension along which files are written piece by piece.
    """

    kind: type
    title: str
    quantities: Mapping[str, tuple[str, str]]
    dimensions: Mapping[str, str]
    items: Mapping[str, str]
    coordinates: Mapping[str, str]
    rows: str | None


LAYOUTS: dict[str, Layout] = {}


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
    - `rows`: a dimension of the annotations, the first of many fields. Files are written and checked along it
      piece by piece, and not read into memory. Default None: none.

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
    LAYOUTS[kind.__name__] = Layout(
        kind, title, quantities, dimensions or {}, items or {}, coordinates or {}, rows
    )


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
