"""Tables of leaf refractive index and specific absorption: shipped ones, and a reader for PROSPECT-PRO's."""

import functools
import hashlib
import importlib.resources
import math
import os

import numpy as np

# Traits with a specific absorption coefficient, by version, in the order of the tables' columns.
TRAITS: dict[str, tuple[str, ...]] = {
    "4": ("Cab", "Cw", "Cm"),
    "5": ("Cab", "Car", "Cbrown", "Cw", "Cm"),
    "D": ("Cab", "Car", "Cant", "Cbrown", "Cw", "Cm"),
    "PC": ("Cab", "Car", "Cant", "Cbrown", "Cw", "Cp", "Cc"),
    "PRO": ("Cab", "Car", "Cant", "Cbrown", "Cw", "Cp", "Cc"),
}

# Columns of the authors' dataSpec_PRO.txt (R package jbferet/prospect). Its column SAC_LMA, dry matter, is
# for the other versions: PRO splits dry matter into SAC_PROT and SAC_CBC.
_INDEX = "nrefrac"
_HEADER = {
    "lambda": "wavelength",
    "SAC_CHL": "Cab",
    "SAC_CAR": "Car",
    "SAC_ANT": "Cant",
    "SAC_BROWN": "Cbrown",
    "SAC_EWT": "Cw",
    "SAC_PROT": "Cp",
    "SAC_CBC": "Cc",
}
_LARGEST_SINGLE = float(np.finfo(np.float32).max)


class Coefficients:
    """A table of leaf refractive index and specific absorption coefficients against wavelength.

    Tables of equal numbers are equal and have the same hash, so that a table can be a static field. All
    arrays are read-only NumPy arrays of float64.

    **Arguments:**

    - `wavelength`: (wavelengths,) nm, increasing.
    - `index`: (wavelengths,) refractive index.
    - `absorption`: (traits, wavelengths) specific absorption coefficients, per unit of the trait.
    - `traits`: names of the traits.
    """

    def __init__(
        self, wavelength: np.ndarray, index: np.ndarray, absorption: np.ndarray, traits: tuple[str, ...]
    ):
        self.wavelength, self.index, self.absorption = (
            np.array(x, dtype=float) for x in (wavelength, index, absorption)
        )
        self.traits = traits
        # JAX compares static fields at every call of a compiled function: comparing digests is quick.
        digest = hashlib.sha256(repr(traits).encode())
        for x in (self.wavelength, self.index, self.absorption):
            x.setflags(write=False)
            digest.update(x.tobytes())
        self._digest = digest.digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Coefficients) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    def __repr__(self) -> str:
        low, high = self.wavelength[[0, -1]]
        return f"Coefficients({low:g}..{high:g} nm: {', '.join(self.traits)})"


@functools.cache
def shipped(version: str) -> Coefficients:
    """Return the shipped table of a PROSPECT version, read on first use.

    **Arguments:**

    - `version`: "4", "5", "D" or "PC".

    **Returns:** a `Coefficients`.
    """
    path = importlib.resources.files("jaxlidar") / "data" / "prospect_coefficients.npz"
    with path.open("rb") as file, np.load(file) as archive:
        wavelength, D = archive["wavelength"], archive["D"]
        if version == "D":
            table = D
        elif version == "PC":
            # Columns: refractive index, Cp, Cc. Pigments and water are PROSPECT-D's.
            index_protein_cellulose = archive["PC"]
            index, dry_matter = index_protein_cellulose[:, :1], index_protein_cellulose[:, 1:]
            table = np.concatenate([index, D[:, 1:6], dry_matter], axis=1)
        else:
            table = archive[f"version_{version}"]
    return Coefficients(wavelength, table[:, 0], table[:, 1:].T, TRAITS[version])


def load_coefficients(path: str | os.PathLike[str]) -> Coefficients:
    r"""Read the coefficients of PROSPECT-PRO from its authors' file `dataSpec_PRO.txt`.

    The file (of the R package jbferet/prospect, MIT licence) is a table of columns separated by white space,
    under a header that names them: lambda (nm), nrefrac, SAC_CHL, SAC_CAR, SAC_ANT (cm2/ug), SAC_BROWN,
    SAC_EWT (1/cm), SAC_PROT and SAC_CBC (cm2/g), in any order. Further columns are ignored.

    **Arguments:**

    - `path`: path of the file.

    **Returns:** a table of coefficients for `Prospect(version="PRO", coefficients=...)`.

    **Raises:** OSError where the file cannot be opened. ValueError, naming the file and the line, where
    columns are missing, a row is too short or too long, a value is not a finite number, a coefficient is
    negative, a refractive index is below 1, wavelengths do not increase, or there are fewer than two rows.

    **Source:** Feret et al. (2021), Remote Sens. Environ. 252, 112173.

    **Example:** a file of two wavelengths.

    >>> import jaxlidar as jl
    >>> import pathlib, tempfile
    >>> header = "lambda nrefrac SAC_CHL SAC_CAR SAC_ANT SAC_BROWN SAC_EWT SAC_PROT SAC_CBC"
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "dataSpec_PRO.txt"
    >>> _ = path.write_text(f"{header}\n1064 1.42 0 0 0 0.01 0.1 4 2\n1065 1.42 0 0 0 0.01 0.1 4 2\n")
    >>> jl.load_coefficients(path)
    Coefficients(1064..1065 nm: Cab, Car, Cant, Cbrown, Cw, Cp, Cc)
    """
    name = os.fspath(path)
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [(i, line.split()) for i, line in enumerate(file, 1) if line.strip()]
    if not lines:
        raise ValueError(f"{name}, line 1: the file is empty; a header naming the columns is expected")
    first, header = lines[0]
    names = [*_HEADER, _INDEX]
    missing = [n for n in names if n not in header]
    if missing:
        raise ValueError(f"{name}, line {first}: the header lacks {', '.join(missing)}")
    position = {n: header.index(n) for n in names}
    rows: list[dict[str, float]] = []
    for i, fields in lines[1:]:
        if len(fields) != len(header):
            raise ValueError(f"{name}, line {i}: {len(fields)} columns, where the header names {len(header)}")
        row = {n: _number(fields[position[n]], n, name, i) for n in names}
        if row[_INDEX] < 1:
            raise ValueError(
                f"{name}, line {i}: {_INDEX} = {row[_INDEX]:g} is outside the admissible range [1, inf)"
            )
        if rows and row["lambda"] <= rows[-1]["lambda"]:
            raise ValueError(f"{name}, line {i}: the wavelength {row['lambda']:g} nm does not increase")
        rows.append(row)
    if len(rows) < 2:
        raise ValueError(
            f"{name}, line {lines[-1][0]}: the table ends after {len(rows)} rows; it needs two or more"
        )
    traits = TRAITS["PRO"]
    column = {_HEADER.get(n, n): np.array([row[n] for row in rows]) for n in names}
    return Coefficients(column["wavelength"], column[_INDEX], np.stack([column[t] for t in traits]), traits)


def _number(text: str, column: str, name: str, line: int) -> float:
    """Read a cell. **Raises:** ValueError for text, negative numbers and those too large for JAX's arrays."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= _LARGEST_SINGLE:
        raise ValueError(
            f"{name}, line {line}: {column} = {text[:40]!r} is no number in the admissible range [0, inf) of "
            "single precision"
        )
    return value
