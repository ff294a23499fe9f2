"""Type checks of the packages while tests run (see conftest)."""

from collections.abc import Callable

from beartype import BeartypeConf, beartype

# In results of surveys a `NotKept` stands for an array that was not kept, and a `StoredArray` for one
# that is read where it is used. A `Recorder` has errors of its own for objects of a wrong type, which are
# tested.
_WITHOUT_CHECKS = {f"{name}.__init__" for name in ("Waveforms", "Waveform", "Truth", "Retrieval", "Recorder")}


def check_types(function: Callable) -> Callable:
    """Check what a function takes and returns; beartype refuses an int for a float unless told of PEP 484."""
    if function.__qualname__ in _WITHOUT_CHECKS:
        return function
    return beartype(conf=BeartypeConf(is_pep484_tower=True))(function)
