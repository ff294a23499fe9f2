"""Executables of compiled programs on disk, which later sessions load without tracing the programs again.

JAX's persistent cache leaves out compilation alone: it is asked by the traced and lowered program, and
tracing takes most of the time of a first call then. Here a program is asked for by a digest of all that it
depends on before it is traced: the code of its function, its static arguments, shapes and types, compiler
options, settings of JAX, the releases of packages, the source files of this one, and the processor.
"""

import contextlib
import hashlib
import os
import pickle
import platform
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.monitoring
from jax.experimental import serialize_executable

from jaxlidar._checks import warn_user
from jaxlidar._files import atomic_write
from jaxlidar._fingerprint import fingerprint


class StoredProgram(NamedTuple):
    """A program that was loaded: a function of arrays, and its result with shapes in place of arrays."""

    call: Callable[[list[Any]], list[Any]]
    result: Any


def processor_digest() -> str:
    """Return a hash of the kind of processor and its instruction sets."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    # "flags" on x86, "Features" on ARM.
    features = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    description = f"{platform.machine()} {platform.processor()} {features}"
    return hashlib.sha256(description.encode()).hexdigest()[:12]


class ExecutableStore:
    """Executables in a folder, one file for each program."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.machine = processor_digest(), os.environ.get("XLA_FLAGS", ""), _source_stamp()

    def path_of(self, name: str, **parts: Any) -> Path | None:
        """Return the path of a program that depends on `parts`; None where these cannot be compared."""
        devices = [(device.device_kind, device.id) for device in jax.devices()]
        try:
            digests = fingerprint({"parts": parts, "machine": self.machine, "devices": devices})
        except TypeError:
            # A function of the user's that holds an open file, for instance: the program is compiled each
            # time.
            return None
        digest = hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()
        return self.folder / f"{name}-{digest[:40]}.executable"

    def load(self, path: Path) -> StoredProgram | None:
        """Load a program; None if there is none, or if it cannot be read."""
        try:
            payload, arguments, results, result = pickle.loads(path.read_bytes())
            call = serialize_executable.deserialize_and_load(payload, arguments, results)
        except FileNotFoundError:
            return None
        except Exception:
            # Whatever is wrong with a file, the program can be compiled, which replaces it.
            return None
        return StoredProgram(call, result)

    def save(self, path: Path, compiled: Any, result: Any) -> None:
        """Store a compiled program; warn if it cannot be written.

        `result`: with shapes in place of arrays. Programs that JAX or pickle cannot serialise are left out.
        """
        try:
            content = pickle.dumps((*serialize_executable.serialize(compiled), result))
        except Exception:
            # Classes that a function defines, and executables of some backends.
            return
        try:
            with atomic_write(path) as draft:
                draft.write_bytes(content)
        except OSError as error:
            warn_user(f"{path}: a compiled program is not kept: {error}")


@contextlib.contextmanager
def noting_cache_hits() -> Iterator[list[str]]:
    """Note whether JAX takes executables from its own persistent cache, in this thread.

    **Returns:** a context, with a list that is empty as long as it does not.
    """
    thread, hits = threading.get_ident(), []

    def listen(event: str, **_: Any) -> None:
        if event == "/jax/compilation_cache/cache_hits" and threading.get_ident() == thread:
            hits.append(event)

    jax.monitoring.register_event_listener(listen)
    try:
        yield hits
    finally:
        jax.monitoring.unregister_event_listener(listen)


def _source_stamp() -> list[tuple[str, int, int]]:
    """Return names, sizes and times of the source files of this package, which may be edited in place."""
    folder = Path(__file__).parent
    files = [(path, path.stat()) for path in sorted(folder.rglob("*.py"))]
    return [(str(path.relative_to(folder)), stat.st_size, stat.st_mtime_ns) for path, stat in files]
