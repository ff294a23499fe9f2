"""What the annotations of fields say of arrays."""

import typing
from typing import Any


def shape_of(annotation: Any) -> list[str] | None:
    """The dimensions of an annotated array; None for what is no array."""
    shape = getattr(annotation, "dim_str", None)
    return None if shape is None else shape.split()


def values_of(annotation: Any) -> Any:
    """What the values of a dict are; None for what is no dict of arrays."""
    arguments = typing.get_args(annotation)
    is_dict = typing.get_origin(annotation) is dict and len(arguments) == 2
    return arguments[1] if is_dict and shape_of(arguments[1]) is not None else None
