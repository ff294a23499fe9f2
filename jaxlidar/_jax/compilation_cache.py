"""Cache of compiled programs on disk, for later sessions."""

import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache as jax_cache

# Programs that compile faster than this, s, are not stored.
MIN_COMPILE_TIME = 0.05


def default_folder() -> Path:
    """Return the folder of compiled programs in the user's cache, which is that of this kind of processor.

    Machines with different processors may share a home folder, and a program may use instructions that only
    some of them have.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # "flags" on x86, "Features" on ARM.
    features = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    processor = f"{platform.machine()} {platform.processor()} {features}"
    digest = hashlib.sha256(processor.encode()).hexdigest()[:12]
    return platformdirs.user_cache_path("jaxlidar") / "programs" / digest


class CompilationCache:
    """The result of `compilation_cache`: a cache in use until `close`, or until its `with` block ends.

    - `folder`: where programs are stored.

    **Example:**

    >>> import jaxlidar as jl
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with jl.compilation_cache(folder) as cache:
    ...         print(cache.folder.is_dir())
    True
    """

    folder: Path

    def __init__(self, folder: Path, previous: Mapping[str, Any]):
        """`previous`: settings of JAX to which `close` returns."""
        self.folder, self._previous, self._is_open = folder, dict(previous), True

    def close(self) -> None:
        """Give JAX back the settings that it had before; a second call does nothing."""
        if self._is_open:
            _configure(self._previous)
        self._is_open = False

    def __enter__(self) -> "CompilationCache":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"CompilationCache({str(self.folder)!r})"


def compilation_cache(folder: str | os.PathLike[str] | None = None) -> CompilationCache:
    """Let JAX store compiled programs in a folder, and read them from there in later sessions.

    Call it once at the start of a session, or use it as a context. It switches on JAX's own persistent cache,
    for programs of all packages; importing jaxlidar does not. Programs are asked for once they have been
    traced, so that a change of your own functions is seen. Nothing is removed from the folder.

    On a CPU, JAX before 0.11 logs an error for each program that it reads: XLA takes its own tuning options,
    "prefer-no-gather" and "prefer-no-scatter", for features that the processor lacks. It is harmless, and
    `jax.config.update("jax_logging_level", "CRITICAL")` hides it, with all others of JAX.

    **Arguments:** `folder`: is made if it does not exist; no one else should be able to write to it, as
    programs are run. Default None: the cache that JAX is configured for already, or else "jaxlidar/programs"
    in the user's cache folder.

    **Returns:** a `CompilationCache`, with the `folder`, and `close()` to return to JAX's former settings.

    **Raises:** OSError where the folder cannot be made.

    **Example:**

    >>> import tempfile
    >>> import jax, jaxlidar as jl
    >>> with tempfile.TemporaryDirectory() as folder, jl.compilation_cache(folder) as cache:
    ...     wave = jl.simulate(jl.Lidar(), jl.Scene(ground=jl.Ground()), key=jax.random.key(0))
    ...     print(cache.folder.is_dir())
    True
    """
    configured = jax.config.values.get("jax_compilation_cache_dir")
    if folder is None and configured:
        return CompilationCache(Path(configured), {})
    path = default_folder() if folder is None else Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    settings: dict[str, Any] = {
        "jax_compilation_cache_dir": str(path),
        "jax_persistent_cache_min_compile_time_secs": MIN_COMPILE_TIME,
    }
    previous = {name: jax.config.values[name] for name in settings}
    _configure(settings)
    return CompilationCache(path, previous)


def _configure(settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)
    if settings:
        # JAX reads the folder from its configuration at the first compilation only.
        jax_cache.reset_cache()
