"""Instruments by name, from a table in TOML: `jaxlidar/data/instruments.toml`, or one of the user's.

    ["My scanner"]
    like = "RIEGL VQ-780 II"                                       # takes what is not given from that one
    divergence = {value = 0.3, source = "calibration sheet, 2024"}
    energy = {value = 2e-6, assumed = "not published"}

    ["My scanner".pulse]
    kind = "GaussianPulse"
    fwhm = {value = 3.5, source = "calibration sheet, 2024"}

Keys are the arguments of `Lidar`, and `pulse_rate` in 1/s; tables with a `kind` are pulses, scan patterns
and receivers. Each number has its `source`, or it is `assumed`, with the reason. A number alone, such as
`aperture = 0.05`, is admissible in tables of the user's, and marked as without a source.
"""

import difflib
import functools
import os
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from jaxlidar._fields.checks import check_kind
from jaxlidar.sensors.lidar import Lidar
from jaxlidar.sensors.photon_counter import PhotonCounter
from jaxlidar.sensors.pulse import (
    ExponentiallyModifiedGaussianPulse,
    GaussianPulse,
    RectangularPulse,
    SampledPulse,
)
from jaxlidar.sensors.receiver import Receiver
from jaxlidar.sensors.scan import Conical, Oscillating, Panorama, Risley, RotatingPolygon

# Classes of tables that have a `kind`.
_CLASSES: dict[str, Callable[..., Any]] = {
    kind.__name__: kind
    for kind in (
        *(GaussianPulse, ExponentiallyModifiedGaussianPulse, RectangularPulse, SampledPulse),
        *(Conical, Oscillating, RotatingPolygon, Panorama, Risley),
        *(Receiver, PhotonCounter),
    )
}
# Keys of an instrument that are no arguments of `Lidar`.
_DESCRIPTION, _LIKE, _PULSE_RATE = "description", "like", "pulse_rate"
# What `InstrumentValue.source` says of a number alone.
_WITHOUT_SOURCE = "without a source"


class InstrumentValue(NamedTuple):
    """A number of an instrument and its origin.

    - `value`: in the unit of the argument of `Lidar`, or of the class, that takes it.
    - `source`: where it is published; for one that is not, the reason for the value that is assumed, or
      "without a source" where a table of your own states the number alone.
    - `is_published`: True if it is published.

    **Example:**

    >>> import jaxlidar as jl
    >>> fwhm = jl.instrument_sources("GEDI coverage")["pulse.fwhm"]
    >>> print(fwhm.value, fwhm.is_published)
    15.6 True
    """

    value: Any
    source: str
    is_published: bool


def instruments(path: str | os.PathLike[str] | None = None) -> tuple[str, ...]:
    """List the names of instruments, for `instrument`.

    **Arguments:** `path`: a TOML file with instruments of your own, as `jaxlidar/data/instruments.toml`,
    whose names come in addition. Numbers that it states alone, without a source, are admissible, and
    `instrument_sources` marks them. Default None.

    **Returns:** the names.

    **Raises:** FileNotFoundError where there is no such file; ValueError, naming the file, for one that is no
    TOML.

    **Example:**

    >>> import jaxlidar as jl
    >>> print([name for name in jl.instruments() if name.startswith("GEDI")])
    ['GEDI coverage', 'GEDI coverage day', 'GEDI power', 'GEDI power day']
    """
    return tuple(_tables(path))


def instrument(name: str, path: str | os.PathLike[str] | None = None) -> Lidar:
    """Make the lidar of an instrument by its name.

    Its scan pattern is `lidar.scan` (None where its pattern is none of an airborne mirror), its receiver
    `lidar.receiver`, and the standard deviation of its noise in J per sample `lidar.noise` (None where it
    is not published). `Lidar.at` places it by its sensor, as on a drone or a tripod; other fields change with
    `dataclasses.replace`. `instrument_sources` says which numbers are published, and where; those that are
    not are assumed. Numbers of commercial scanners have not been compared with their data sheets line by line
    yet: check those of yours.

    **Arguments:**

    - `name`: one of `instruments()`.
    - `path`: a TOML file with instruments of your own, as for `instruments`. Default None.

    **Returns:** a `Lidar` that looks straight down at the origin, from the altitude of the table.

    **Raises:** ValueError for an unknown name, with the nearest ones; and, naming the place in the table,
    for what `Lidar` refuses.

    **Example:** a strip of a scanner.

    >>> import dataclasses
    >>> import jaxlidar as jl
    >>> lidar = dataclasses.replace(jl.instrument("RIEGL VQ-780 II"), altitude=700.0)
    >>> line = {"start": (0, 0), "end": (0, 1), "speed": 60.0, "pulse_rate": 1e5}
    >>> len(jl.Survey.scan(lidar, lidar.scan, **line))
    1667
    """
    table = _table(name, path)
    arguments = {
        key: _argument(entry, f"{name}.{key}")
        for key, entry in table.items()
        if key not in (_DESCRIPTION, _PULSE_RATE)
    }
    return _call(Lidar, arguments, name)


def instrument_sources(name: str, path: str | os.PathLike[str] | None = None) -> dict[str, InstrumentValue]:
    """Return all numbers of an instrument with their sources.

    **Arguments:** `name`, `path`: as for `instrument`.

    **Returns:** an `InstrumentValue` by the argument of `Lidar`, such as "energy", and by "pulse.fwhm" for
    one of its pulse, scan or receiver; also "pulse_rate" in 1/s. Numbers that a table of your own states
    without a source are not published, and their source is "without a source". Defaults of arguments that
    the table leaves out are not listed.

    **Raises:** as `instrument`.

    **Example:**

    >>> import jaxlidar as jl
    >>> sources = jl.instrument_sources("RIEGL VZ-400")
    >>> print(sources["divergence"].value, sources["divergence"].source)
    0.3 RIEGL VZ-400 data sheet, 2014
    """
    return dict(_values(_table(name, path), name))


def _values(table: Mapping[str, Any], place: str, prefix: str = "") -> Any:
    """Yield the numbers of a table by their path."""
    for key, entry in table.items():
        if not isinstance(entry, Mapping):
            # Texts, such as the description, and switches are no numbers.
            if isinstance(entry, int | float | list) and not isinstance(entry, bool):
                yield prefix + key, InstrumentValue(entry, _WITHOUT_SOURCE, False)
            continue
        if "kind" in entry:
            yield from _values(entry, f"{place}.{key}", f"{prefix}{key}.")
            continue
        _check_entry(entry, f"{place}.{key}")
        is_published = "source" in entry
        value, source = entry["value"], entry["source" if is_published else "assumed"]
        yield prefix + key, InstrumentValue(value, source, is_published)


def _check_entry(entry: Mapping[str, Any], place: str) -> None:
    """Refuse an entry that is no number with its origin. **Raises:** ValueError."""
    if set(entry) not in ({"value", "source"}, {"value", "assumed"}):
        raise ValueError(
            f"{place} has the keys {sorted(entry)}; admissible are value and source, or value and assumed"
        )


def _argument(entry: Any, place: str) -> Any:
    """Return an entry as an argument: a number, a text, or an object of a class. **Raises:** ValueError."""
    if not isinstance(entry, Mapping):
        return entry
    if "kind" not in entry:
        _check_entry(entry, place)
        return entry["value"]
    kind = entry["kind"]
    if kind not in _CLASSES:
        raise ValueError(f"{place}.kind = {kind!r} is none of {', '.join(_CLASSES)}")
    arguments = {key: _argument(value, f"{place}.{key}") for key, value in entry.items() if key != "kind"}
    return _call(_CLASSES[kind], arguments, place)


def _call(kind: Callable[..., Any], arguments: dict[str, Any], place: str) -> Any:
    try:
        return kind(**arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{place}: {error}") from error


def _table(name: str, path: str | os.PathLike[str] | None) -> dict[str, Any]:
    """Return the table of an instrument, completed by that of the one that it is like."""
    check_kind("name", name, str, "the name of an instrument, one of jaxlidar.instruments()")
    tables, chain = _tables(path), []
    while name is not None:
        if name not in tables:
            # Without case, as "vq-780ii" is near to "RIEGL VQ-780 II".
            names = {known.casefold(): known for known in tables}
            matches = difflib.get_close_matches(name.casefold(), names, n=3, cutoff=0.4)
            nearest = [names[match] for match in matches] or list(tables)
            raise ValueError(f"instrument {name!r} is not known; the nearest are {', '.join(nearest)}")
        if name in chain:
            raise ValueError(f"instrument {name!r} is like itself, by way of {', '.join(chain)}")
        chain.append(name)
        name = tables[name].get(_LIKE)
    merged: dict[str, Any] = {}
    for ancestor in reversed(chain):
        merged |= {key: entry for key, entry in tables[ancestor].items() if key != _LIKE}
    return merged


def _tables(path: str | os.PathLike[str] | None) -> Mapping[str, Any]:
    """Return the tables of all instruments by name, those of a file in addition."""
    if path is None:
        return _bundled_tables()
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: no TOML: {error}") from error
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ValueError(f"{path}: {name} is no table; admissible are tables by the instrument's name")
    return {**_bundled_tables(), **tables}


@functools.cache
def _bundled_tables() -> Mapping[str, Any]:
    text = (resources.files("jaxlidar") / "data" / "instruments.toml").read_text("utf-8")
    return tomllib.loads(text)
