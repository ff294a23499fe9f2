"""Names that were renamed: the old ones work for one version more and warn `DeprecationWarning`."""

import sys
import warnings
from typing import Any

# Old names of what `jaxlidar` exports, and of kinds in case files, with their new names.
RENAMED = {
    "Module": "Symbol",
    "crop": "trim_empty_layers",
    "spectra": "spectrum_names",
    "spreading": "spreading_tree",
}
# The same for methods of laws of reflection and phase functions.
RENAMED_METHODS = {
    "view_factor": "intensity_factor",
    "largest_view_factor": "largest_intensity_factor",
}


def warn_renamed(old: str, new: str, stacklevel: int = 1) -> None:
    """Warn that `old` is now called `new`.

    `stacklevel` counts frames from the function that calls this one (0) to the line that used the old name.
    """
    message = f"{old} is renamed: use {new}; the old name goes with the next version"
    warnings.warn(message, DeprecationWarning, stacklevel + 2)


class RenamedMethods:
    """Base of classes with renamed methods: old names may still be called, and defined by subclasses."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for old, new in RENAMED_METHODS.items():
            defined = vars(cls)
            if old in defined and new not in defined:
                warn_renamed(f"{cls.__name__}.{old}", f"{cls.__name__}.{new}", _frames_up_to(cls.__module__))
                setattr(cls, new, defined[old])

    def view_factor(self, *directions: Any) -> Any:
        """Return `intensity_factor`; deprecated."""
        return self._renamed("view_factor")(*directions)

    def largest_view_factor(self, *half_angle: Any) -> float:
        """Return `largest_intensity_factor`; deprecated."""
        return self._renamed("largest_view_factor")(*half_angle)

    def _renamed(self, old: str) -> Any:
        warn_renamed(f"{type(self).__name__}.{old}", RENAMED_METHODS[old], stacklevel=2)
        return getattr(self, RENAMED_METHODS[old])


def _frames_up_to(module: str) -> int:
    """Number of frames between the caller and the nearest frame of a module.

    Equinox's metaclass runs between a class statement and `__init_subclass__`, in a number of frames that
    depends on its version. Python shows the warning by default only where it points at the user's own line.
    """
    frame, depth = sys._getframe(1), 0
    while frame is not None and frame.f_globals.get("__name__") != module:
        frame, depth = frame.f_back, depth + 1
    return depth
