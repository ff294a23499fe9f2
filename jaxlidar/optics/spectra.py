"""Reflectance spectra of bark, wood, litter, soil and more: measured ones that are bundled, or your own.

    jl.spectrum_names("bark")              names of the bundled ones, of one kind or of all
    jl.spectrum("bark-birch")(1064.0)      a spectrum is a function of the wavelength in nm
    jl.read_spectrum_csv("my_soil.csv")

Every reflectance of a scene may be one number, one number per wavelength, or a `Spectrum`.
`reflectance_at` turns all three into one number per wavelength.

The bundled spectra are field and laboratory measurements from 400 to 2450 nm in steps of 10 nm. The bands of
water vapour (between 1350 and 1460, and 1790 and 1960 nm) are left out and bridged by a straight line.
`data/spectra.md` lists their sources. They are bidirectional or hemispherical, as measured; the simulator
takes them as the reflectance of a Lambertian surface. Two samples of one kind easily differ by a fifth: fit
`scale` where the level matters.
"""

import codecs
import contextlib
import csv
import difflib
import functools
import os
from importlib import resources
from pathlib import Path
from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxlidar._fields.checks import as_array, as_scalar, check_choice, check_kind, check_range, concrete
from jaxlidar._fields.ranges import (
    FRACTION,
    NANOMETRES,
    NOT_NEGATIVE,
    SUM_OF_FRACTIONS,
    WAVELENGTHS,
    check_ranges,
    quantity,
)

# The largest wavelength, nm, that is finite in single precision.
_LARGEST_SINGLE = float(np.finfo(np.float32).max)


@final
class Spectrum(eqx.Module):
    """A reflectance spectrum, linear between its samples: `spectrum(wavelength)` is the reflectance.

    All fields but `name` are arrays and differentiable. The derivative with respect to the wavelength is at a
    sample the mean of those on both sides.

    **Arguments:**

    - `wavelength`: (samples,) in nm, positive, strictly increasing, at least two.
    - `reflectance`: (samples,) in [0, 1].
    - `name`: name of the spectrum. Default "".
    - `scale`: a factor on the reflectance, not negative and such that no reflectance exceeds 1. It can be
      fitted, as one unknown for the brightness of a whole spectrum. Default 1.

    **Raises:** ValueError for wavelengths that are not positive, do not increase strictly or are too few, for
    shapes that differ, for a negative scale, and for reflectances outside [0, 1], scaled or not.

    **Example:**

    >>> import jaxlidar as jl
    >>> soil = jl.Spectrum([400.0, 1000.0, 2400.0], [0.1, 0.3, 0.4], name="my soil")
    >>> print(f"{soil(1064.0):.3f}")
    0.305
    """

    wavelength: Float[Array, " samples"] = quantity(unit=NANOMETRES, range=WAVELENGTHS, converter=as_array)
    reflectance: Float[Array, " samples"] = quantity(range=FRACTION, converter=as_array)
    name: str = eqx.field(static=True, default="")
    scale: Float[Array, ""] = quantity(range=NOT_NEGATIVE, converter=as_scalar, default=1.0)

    ranges: ClassVar = {"scale * reflectance": SUM_OF_FRACTIONS}

    def __check_init__(self):
        if self.wavelength.shape != self.reflectance.shape or self.wavelength.ndim != 1:
            raise ValueError(
                f"wavelength and reflectance have shapes {self.wavelength.shape} and "
                f"{self.reflectance.shape}; admissible are equal, one-dimensional ones"
            )
        if self.wavelength.size < 2:
            raise ValueError(f"wavelength has {self.wavelength.size} samples; admissible are 2 or more")
        check_ranges(self)
        wavelength = concrete(self.wavelength)
        if wavelength is not None and np.any(np.diff(wavelength) <= 0):
            i = int(np.argmax(np.diff(wavelength) <= 0))
            raise ValueError(
                f"wavelength = {wavelength[i]:g} is followed by {wavelength[i + 1]:g}; the admissible ones "
                "increase strictly"
            )

    def __call__(self, wavelength: ArrayLike) -> Float[Array, "..."]:
        """Interpolate the reflectance at wavelengths.

        **Arguments:**

        - `wavelength`: nm, any shape, within the range of the samples.

        **Returns:** an array shaped as `wavelength`.

        **Raises:** ValueError for a wavelength outside the range of the samples. Inside a JAX transformation
        of the wavelength nothing can be raised: the end values are used there.
        """
        wavelength = as_array(wavelength, "wavelength")
        table = concrete(self.wavelength)
        if table is not None:
            field = f"wavelength of the spectrum {self.name!r}" if self.name else "wavelength"
            check_range(field, wavelength, table[0], table[-1])
        return self.scale * interpolate(wavelength, self.wavelength, self.reflectance)


def interpolate(
    x: Float[Array, "..."],
    nodes: Float[Array, " nodes"],
    values: Float[Array, " nodes"],
    outside: float | None = None,
) -> Float[Array, "..."]:
    """Interpolate linearly between nodes; the derivative at a node is the mean of those on both sides.

    **Arguments:** `outside`: value outside of the nodes. Default None: those of the ends.
    """
    # At a node, `jnp.interp` has the slope to its right, and along the reversed axis that to its left. Lidar
    # wavelengths usually are nodes: one-sided slopes would not be those that differences show.
    rising = jnp.interp(x, nodes, values, left=outside, right=outside)
    falling = jnp.interp(-x, -nodes[::-1], values[::-1], left=outside, right=outside)
    return 0.5 * (rising + falling)


def reflectance_at(
    value: ArrayLike | Spectrum, wavelength: ArrayLike, field: str = "reflectance"
) -> Float[Array, " wavelengths"]:
    """Turn a reflectance in any of its three forms into one number per wavelength.

    **Arguments:**

    - `value`: one number, (wavelengths,) numbers, or a `Spectrum`.
    - `wavelength`: nm, (wavelengths,) or one number.
    - `field`: name of `value` in error messages. Default "reflectance".

    **Returns:** (wavelengths,) reflectances. That they lie in [0, 1] is checked where they are stored.

    **Raises:** ValueError where the numbers of values and wavelengths differ, and for a wavelength outside
    the range of a spectrum.
    """
    wavelength = jnp.atleast_1d(as_array(wavelength, "wavelength"))
    if isinstance(value, Spectrum):
        return value(wavelength)
    value = as_array(value, field)
    if value.shape not in ((), (1,), wavelength.shape):
        raise ValueError(
            f"{field} has shape {value.shape}; admissible is one number, or one for each of "
            f"{wavelength.size} wavelengths"
        )
    return jnp.broadcast_to(value, wavelength.shape)


@functools.cache
def _library() -> dict[str, np.ndarray]:
    with (
        (resources.files("jaxlidar") / "data" / "spectra.npz").open("rb") as file,
        np.load(file) as arrays,
    ):
        return {key: arrays[key] for key in arrays.files}


def spectrum_names(kind: str | None = None) -> dict[str, str]:
    """List the names of the bundled reflectance spectra, each with its kind.

    **Arguments:**

    - `kind`: "bark", "wood", "litter", "char", "soil" or "built". Default None: all.

    **Returns:** a dict from name to kind.

    **Raises:** ValueError for an unknown kind; TypeError for a kind that is no string.

    **Example:**

    >>> import jaxlidar as jl
    >>> sorted(jl.spectrum_names("built"))
    ['asphalt', 'concrete', 'gravel']
    """
    library = _library()
    kind_of_name = dict(zip(library["name"].tolist(), library["kind"].tolist()))
    if kind is None:
        return kind_of_name
    check_choice("kind", kind, tuple(dict.fromkeys(kind_of_name.values())))
    return {name: k for name, k in kind_of_name.items() if k == kind}


def spectrum(name: str) -> Spectrum:
    """Return a bundled reflectance spectrum, from 400 to 2450 nm.

    **Arguments:**

    - `name`: one of the names that `spectrum_names` lists.

    **Returns:** a `Spectrum`.

    **Raises:** ValueError for an unknown name; it lists similar names. TypeError for a name that is no
    string.

    **Example:**

    >>> import jaxlidar as jl
    >>> import numpy as np
    >>> bark = jl.spectrum("bark-birch")
    >>> print([f"{x:.2f}" for x in bark(np.array([532.0, 1064.0]))])
    ['0.33', '0.51']
    """
    library = _library()
    check_kind("name", name, str, "a name that jaxlidar.spectrum_names lists")
    names = library["name"].tolist()
    if name not in names:
        # Misspelt names; without any, the kinds. And names with that word, such as soil-red for "red".
        close = difflib.get_close_matches(name, names, n=5, cutoff=0.4) or sorted(
            set(library["kind"].tolist())
        )
        close += [n for n in names if name.lower() in n.split("-") and n not in close]
        raise ValueError(
            f"name = {name!r} is no bundled spectrum; close to it are {', '.join(map(repr, close))}; "
            "jaxlidar.spectrum_names() lists all"
        )
    return Spectrum(library["wavelength"], library["reflectance"][names.index(name)], name)


def read_spectrum_csv(path: str | os.PathLike[str], name: str | None = None) -> Spectrum:
    r"""Read a reflectance spectrum from a text file of two columns: wavelength in nm, reflectance in [0, 1].

    **Arguments:**

    - `path`: path of the file. Its lines hold two numbers, separated by a comma, a semicolon, a tab or
      blanks. Empty lines and lines that start with # are skipped, and the first other line may be a header,
      in which no cell is a number.
    - `name`: name of the spectrum. Default None: the file's name without its ending.

    **Returns:** a `Spectrum`.

    **Warns:** `UnitWarning` for a wavelength that is beyond the infrared, which is read.

    **Raises:** FileNotFoundError where there is no such file. ValueError, naming the file and the line, for a
    line that is not two numbers, for a reflectance outside [0, 1] (per cent?), for a wavelength below 100 nm
    (micrometres?) or not above the one before, for fewer than two samples, and for a file that is not UTF-8
    text.

    **Example:**

    >>> import jaxlidar as jl
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "soil.csv"
    >>> _ = path.write_text("wavelength,reflectance\n400,0.1\n1000,0.3\n2400,0.4\n")
    >>> soil = jl.read_spectrum_csv(path)
    >>> print(soil.name, f"{soil(700.0):.2f}")
    soil 0.20
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    samples: list[tuple[float, float]] = []
    header_allowed = True
    # As bytes: text would also be split at form feeds and the separators of Unicode, and lines miscounted.
    lines = path.read_bytes().removeprefix(codecs.BOM_UTF8).splitlines()
    for number, content in enumerate(lines, 1):
        try:
            line = content.decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: no text file: line {number} is not UTF-8") from error
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = _cells(line)
        position = f"{path}, line {number}"
        try:
            wavelength, reflectance = map(float, cells)
        except ValueError:
            if header_allowed and not any(map(_is_number, cells)):
                header_allowed = False
                continue
            shown = line.strip()[:40]
            raise ValueError(f"{position}: {shown!r} is not a wavelength and a reflectance") from None
        header_allowed = False
        if not 100 <= wavelength <= _LARGEST_SINGLE:
            raise ValueError(
                f"{position}: wavelength = {wavelength:g} is outside the admissible range [100, inf) nm"
                " of single precision"
            )
        # Compared in single precision, in which the spectrum is stored by default.
        if samples and np.float32(wavelength) <= np.float32(samples[-1][0]):
            raise ValueError(
                f"{position}: wavelength = {wavelength:g} follows {samples[-1][0]:g}; the admissible ones "
                "increase strictly"
            )
        if not 0 <= reflectance <= 1:
            raise ValueError(
                f"{position}: reflectance = {reflectance:g} is outside the admissible range [0, 1]"
            )
        samples.append((wavelength, reflectance))
    if len(samples) < 2:
        raise ValueError(
            f"{path}, line {len(lines)}: the file ends after {len(samples)} samples; admissible are 2"
        )
    table = np.array(samples)
    return Spectrum(table[:, 0], table[:, 1], path.stem if name is None else name)


def _cells(line: str) -> list[str]:
    """Split a line at the first separator that it has; a line of unpaired quotes is one cell."""
    for separator in ",;\t":
        if separator in line:
            with contextlib.suppress(csv.Error):
                return next(csv.reader([line.strip()], delimiter=separator, strict=True))
            return [line]
    return line.split()


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
