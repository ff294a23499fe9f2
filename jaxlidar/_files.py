"""Atomic file writes."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, which takes its place when the block ends without an error.

    Whoever reads `path` finds the old file or the new one, never half. Missing folders are made. The block
    may also make a folder: the old one is moved aside first.

    **Arguments:** `path`: the file to write.

    **Returns:** a context manager that gives the path to write to.

    **Raises:** OSError where the folder cannot be written.

    **Example:**

    >>> import pathlib, tempfile
    >>> from jaxlidar.io import atomic_write
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "result.txt"
    >>> with atomic_write(path) as draft:
    ...     _ = draft.write_text("42")
    >>> path.read_text()
    '42'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    aside = draft.with_suffix(".old")
    try:
        yield draft
        if draft.is_dir() and path.is_dir():
            path.replace(aside)
        try:
            draft.replace(path)
        except OSError:
            if aside.exists():
                aside.replace(path)
            raise
    finally:
        for left in (draft, aside):
            if left.is_dir():
                shutil.rmtree(left)
            else:
                left.unlink(missing_ok=True)
