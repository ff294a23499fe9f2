"""Names that were renamed: the old ones work for one version more and warn `DeprecationWarning`."""

import sys
import warnings
from typing import Any

# Old names of what `jaxlidar` exports, and of kinds in case files, with their new names.
RENAMED = {
    "Module": "Symbol",
    "crop": "trim_empty_layers",
    "reduce": "make_setup",
    "repeat": "rerun",
    "spectra": "spectrum_names",
    "spreading": "spreading_tree",
    "total_of": "total_reflectance",
}
# The same for methods of laws of reflection and phase functions.
RENAMED_METHODS = {
    "view_factor": "intensity_factor",
    "largest_view_factor": "largest_intensity_factor",
}
# Packages whose frames lie between a warning and the user's line: type checks and metaclasses add some.
_INTERNAL = ("jaxlidar", "inversion", "jaxtyping", "beartype", "equinox", "abc")


def warn_renamed(old: str, new: str) -> None:
    """Warn, at the user's line, that `old` is now called `new`.

    Python shows the warning by default only where it points at the user's own line.
    """
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in _INTERNAL:
        frame, level = frame.f_back, level + 1
    message = f"{old} is renamed: use {new}; the old name goes with the next version"
    warnings.warn(message, DeprecationWarning, stacklevel=level)


def renamed_property(old: str, new: str) -> property:
    """Return a property under an old name, which warns and gives the attribute under its new name."""

    def get(self: Any) -> Any:
        kind = type(self).__name__
        warn_renamed(f"{kind}.{old}", f"{kind}.{new}")
        return getattr(self, new)

    get.__doc__ = f"Return `{new}`; deprecated."
    return property(get)


class RenamedMethods:
    """Base of classes with renamed methods: old names may still be called, and defined by subclasses."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for old, new in RENAMED_METHODS.items():
            defined = vars(cls)
            if old in defined and new not in defined:
                warn_renamed(f"{cls.__name__}.{old}", f"{cls.__name__}.{new}")
                setattr(cls, new, defined[old])

    def view_factor(self, *directions: Any) -> Any:
        """Return `intensity_factor`; deprecated."""
        return self._renamed("view_factor")(*directions)

    def largest_view_factor(self, *half_angle: Any) -> float:
        """Return `largest_intensity_factor`; deprecated."""
        return self._renamed("largest_view_factor")(*half_angle)

    def _renamed(self, old: str) -> Any:
        kind, new = type(self).__name__, RENAMED_METHODS[old]
        warn_renamed(f"{kind}.{old}", f"{kind}.{new}")
        return getattr(self, new)
