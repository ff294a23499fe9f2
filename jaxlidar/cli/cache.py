"""Cache of compiled programs in the user's cache folder, for the next calls of the command."""

import contextlib
import warnings
from collections.abc import Iterator

from jaxlidar import _compilation_cache


@contextlib.contextmanager
def compilation_cache() -> Iterator[None]:
    """Let JAX store and reuse compiled programs within this context; warn if the folder cannot be made.

    Afterwards the configuration of JAX is restored, as Python code that calls the command may need its own.
    """
    try:
        cache = _compilation_cache.compilation_cache()
    except OSError as error:
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        yield
        return
    with cache:
        yield
