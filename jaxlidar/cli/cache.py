"""Cache of compiled programs in the user's cache folder, for the next calls of the command."""

import contextlib
import hashlib
import platform
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache as jax_cache

# Programs that compile faster than this, s, are not stored.
MIN_COMPILE_TIME = 0.05


def cache_folder() -> Path:
    """Return the folder of compiled programs, which is that of this kind of processor.

    Machines with different processors may share a home folder, and a program may use instructions that only
    some of them have.
    """
    return platformdirs.user_cache_path("jaxlidar") / "programs" / _processor_digest()


def _processor_digest() -> str:
    """Return a hash of the kind of processor and its instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # "flags" on x86, "Features" on ARM.
    features = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    description = f"{platform.machine()} {platform.processor()} {features}"
    return hashlib.sha256(description.encode()).hexdigest()[:12]


@contextlib.contextmanager
def compilation_cache() -> Iterator[None]:
    """Let JAX store and reuse compiled programs within this context; warn if the folder cannot be made.

    Afterwards the configuration of JAX is restored, as Python code that calls the command may need its own.
    """
    if jax.config.values.get("jax_compilation_cache_dir"):
        # The user has configured a cache.
        yield
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        yield
        return
    settings: dict[str, Any] = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": MIN_COMPILE_TIME,
    }
    if jax.__version_info__ < (0, 11) and jax.config.values.get("jax_logging_level") in (None, "NOTSET"):
        # These versions log a false error for each program that they read from the cache: XLA compares its
        # own tuning options with the features of the processor.
        settings["jax_logging_level"] = "CRITICAL"
    previous = {name: jax.config.values[name] for name in settings}
    for name, value in settings.items():
        jax.config.update(name, value)
    # JAX reads the folder from its configuration at the first compilation only.
    jax_cache.reset_cache()
    try:
        yield
    finally:
        for name, value in previous.items():
            jax.config.update(name, value)
        jax_cache.reset_cache()
