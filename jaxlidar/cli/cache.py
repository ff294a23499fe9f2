"""Cache of compiled programs in the user's cache folder, for the next calls of the command."""

import contextlib
from collections.abc import Iterator

from jaxlidar._fields.checks import warn_user
from jaxlidar._jax import compilation_cache as package_cache


@contextlib.contextmanager
def compilation_cache() -> Iterator[None]:
    """Let JAX store and reuse compiled programs within this context; warn if the folder cannot be made.

    Afterwards the configuration of JAX is restored, as Python code that calls the command may need its own.
    """
    try:
        cache = package_cache.compilation_cache()
    except OSError as error:
        warn_user(f"compiled programs are not kept: {error}")
        yield
        return
    with cache:
        yield
