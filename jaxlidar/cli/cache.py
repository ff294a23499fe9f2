"""Compiled programs, kept in the user's cache folder from one call of the command to the next."""

import warnings
from pathlib import Path

import jax
import platformdirs

# Programs that compile faster are not worth a file.
SECONDS = 0.3


def cache_folder() -> Path:
    """The folder of compiled programs."""
    return platformdirs.user_cache_path("jaxlidar") / "programs"


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
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SECONDS)
