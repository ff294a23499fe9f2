"""`Converted[T]`: the type of a field that a converter makes, for type checkers.

A constructor takes what the converter takes: `Lidar(altitude=1000.0)` stores an array. Type checkers know
this from `eqx.field(converter=...)` ("dataclass_transform" of the typing specification). mypy does not, and
would ask for an array; but it knows descriptors. For mypy such a field is a descriptor, which takes any
object and gives a T. For other checkers, and when the program runs, `Converted[T]` is T.
"""

from typing import TYPE_CHECKING, Any

# mypy takes this name for true, whatever its value.
MYPY = False
if MYPY:
    from jaxlidar._converted_types import Descriptor as Converted
elif TYPE_CHECKING:
    from jaxlidar._converted_types import Identity as Converted
else:

    class Converted:
        """`Converted[T]` is T."""

        def __class_getitem__(cls, converted: Any) -> Any:
            return converted


__all__ = ["Converted"]
