"""Compiled programs, kept in the user's cache folder from one call of the command to the next."""

import contextlib
import hashlib
import platform
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

# Programs that compile faster are not worth a file.
SECONDS = 0.05


def cache_folder() -> Path:
    """The folder of compiled programs. Each kind of processor has its own, as machines may share homes."""
    return platformdirs.user_cache_path("jaxlidar") / "programs" / _processor()


def _processor() -> str:
    """A short name for what the processor can do."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    known = f"{platform.machine()} {platform.processor()} {features}"
    return hashlib.sha256(known.encode()).hexdigest()[:12]


@contextlib.contextmanager
def kept_programs() -> Iterator[None]:
    """Within it, JAX keeps what it compiles; a warning says where the folder cannot be made.

    Afterwards JAX is configured as before: what calls the command from Python may want something else.
    """
    if jax.config.values.get("jax_compilation_cache_dir"):
        # The user's own choice.
        yield
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        yield
        return
    wanted: dict[str, Any] = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": SECONDS,
    }
    if jax.__version_info__ < (0, 11) and jax.config.values.get("jax_logging_level") in (None, "NOTSET"):
        # That XLA warns of each program that it reads, as it takes its own settings for features.
        wanted["jax_logging_level"] = "CRITICAL"
    before = {name: jax.config.values[name] for name in wanted}
    for name, value in wanted.items():
        jax.config.update(name, value)
    # JAX looks at the folder once.
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()
