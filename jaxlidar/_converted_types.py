"""Types for which type checkers take `jaxlidar._converted.Converted`; nothing here runs."""

from typing import Annotated, Any, Generic, TypeVar

T = TypeVar("T", covariant=True)

Identity = Annotated[T, "converted"]


class Descriptor(Generic[T]):
    """A field to which any object may be assigned, and that then is a T."""

    def __get__(self, instance: Any, owner: Any) -> T:
        raise NotImplementedError

    def __set__(self, instance: Any, value: Any) -> None:
        raise NotImplementedError
