"""Old public names: they stay for one version, as aliases that warn."""

import warnings
from typing import TypeVar

_Object = TypeVar("_Object")


def renamed(old_name: str, new_name: str, new_object: _Object) -> _Object:
    """Return the object that an old name stands for, and warn of its new name.

    For the `__getattr__` of a module or a class: the warning points at the line that uses the old name.

    **Warns:** DeprecationWarning, naming both names.
    """
    warnings.warn(
        f"{old_name} is renamed to {new_name}; the old name will be removed in the next version",
        DeprecationWarning,
        stacklevel=3,
    )
    return new_object
