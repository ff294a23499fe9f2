"""Compiled programs, kept in the user's cache folder from one call of the command to the next."""

import hashlib
import platform
import warnings
from pathlib import Path

import jax
import platformdirs

# Programs that compile faster are not worth a file.
SECONDS = 0.3


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


def keep_programs() -> None:
    """Let JAX keep what it compiles. Where the folder cannot be made, a warning says that nothing is kept."""
    if jax.config.values.get("jax_compilation_cache_dir"):
        # The user's own choice.
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(f"compiled programs are not kept: {error}", stacklevel=2)
        return
    if jax.__version_info__ < (0, 11) and jax.config.values.get("jax_logging_level") in (None, "NOTSET"):
        # That XLA warns of each program that it reads, as it takes its own settings for features.
        jax.config.update("jax_logging_level", "CRITICAL")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SECONDS)
