"""Old names of public objects: they work for one more version, and warn."""

import sys
import warnings
from collections.abc import Mapping
from typing import Any

_OURS = ("jaxlidar", "inversion", "jaxtyping", "beartype", "equinox")


def renamed(name: str, names: Mapping[str, str], namespace: Mapping[str, Any], module: str) -> Any:
    """Return the object that a module exported under an old name; for a module's `__getattr__`.

    **Arguments:**

    - `name`: the name that was asked for.
    - `names`: new names by old ones.
    - `namespace`: the module's objects by name.
    - `module`: the module's name.

    **Raises:** AttributeError for a name that is not among `names`.

    **Warns:** DeprecationWarning with the new name.
    """
    if name not in names:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warn_renamed(f"{module}.{name}", f"{module}.{names[name]}")
    return namespace[names[name]]


def renamed_property(old: str, new: str) -> property:
    """Return a property under an old name, which warns and gives the attribute under its new name."""

    def get(self: Any) -> Any:
        kind = type(self).__name__
        warn_renamed(f"{kind}.{old}", f"{kind}.{new}")
        return getattr(self, new)

    get.__doc__ = f"Return `{new}`; the old name of this attribute, which warns."
    return property(get)


def warn_renamed(old: str, new: str) -> None:
    """Warn, at the user's line, that a name is going to be removed."""
    # Run-time type checks put frames of their own between this one and the user's.
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in _OURS:
        frame, level = frame.f_back, level + 1
    message = f"{old} is now {new}; the old name works in this version only"
    warnings.warn(message, DeprecationWarning, stacklevel=level)
