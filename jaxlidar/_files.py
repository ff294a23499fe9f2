"""Atomic file writes."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path`, which replaces it when the block ends without an error.

    Readers of `path` find the old file or the new one, never an incomplete one. Missing folders are created.
    The block may also create a folder: the old one is moved aside first.

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
    # In the same folder, as a rename is atomic within one file system only; hidden, and one for each process.
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    old_folder = draft.with_suffix(".old")
    try:
        yield draft
        # A folder cannot be replaced by a rename, as a file can.
        if draft.is_dir() and path.is_dir():
            path.replace(old_folder)
        try:
            draft.replace(path)
        except OSError:
            if old_folder.exists():
                old_folder.replace(path)
            raise
    finally:
        for temporary in (draft, old_folder):
            if temporary.is_dir():
                shutil.rmtree(temporary)
            else:
                temporary.unlink(missing_ok=True)
