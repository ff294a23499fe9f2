"""Arrays that a result does not have, because its caller chose not to keep them."""

import dataclasses
from typing import Any, NoReturn, final

import jax


class NotKeptError(AttributeError, ValueError):
    """Raised where an array is used that was not kept."""


def check_kept(array: Any) -> None:
    """Refuse an array that was not kept. **Raises:** NotKeptError."""
    if isinstance(array, NotKept):
        array.refuse()


@final
@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class NotKept:
    """Stands in a field for the array `name`, and refuses to be used as one.

    A field that is None would leave the caller with "'NoneType' object has no attribute ...". As a pytree it
    has no leaves.
    """

    name: str

    def refuse(self, *_: Any, **__: Any) -> NoReturn:
        # Not `self.name`: it is not set yet while an object is unpickled.
        name = vars(self).get("name", "an array")
        raise NotKeptError(f"{name} was not kept: add '{name}' to keep= of simulate_many")

    # Python and NumPy look up these methods on the class, all others by `__getattr__`.
    __getattr__ = __getitem__ = __iter__ = __len__ = __array__ = __add__ = __sub__ = __mul__ = refuse
    __radd__ = __rsub__ = __rmul__ = __truediv__ = __rtruediv__ = __float__ = __bool__ = refuse

    def __str__(self) -> str:
        return f"{self.name} was not kept"
