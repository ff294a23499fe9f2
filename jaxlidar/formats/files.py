"""Atomic file writes. Every writer of the project goes through them."""

import contextlib
import errno
import itertools
import os
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

# Held while finished drafts are moved: of two threads that write the same pair of files, one comes last with
# both.
_COMMIT_LOCK = threading.Lock()
# Errors of a rename to a folder that is not empty.
_FOLDER_EXISTS = (errno.ENOTEMPTY, errno.EEXIST)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path, whose content replaces that of `path` when the block ends without an error.

    Readers of `path` find the old file or the new one, never an incomplete one. Missing folders are created.
    The block may also create a folder: the old one is moved aside first. Several writers of one path, also in
    threads and on other hosts, do not disturb one another: the last one's file stays.

    - *Symbolic links* stay: the file that they lead to is replaced.
    - *Permissions*, owner and extended attributes of an existing file stay, the owner as far as the system
      allows. A write-protected file is refused.
    - *Devices and pipes* such as `/dev/stdout` stay: the complete content is copied to them.
    - *Hard links:* other names of the file keep the old content.

    **Arguments:** `path`: the file to write.

    **Returns:** a context manager that gives the path to write to. It has the name of `path`, in a temporary
    folder that only this user can read.

    **Raises:** OSError where the file cannot be written or is write-protected, for a path without a name, for
    block devices and sockets, and, when the block has ended with a file, for a folder.

    **Example:**

    >>> import pathlib, tempfile
    >>> from jaxlidar.io import atomic_write
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "result.txt"
    >>> with atomic_write(path) as draft:
    ...     _ = draft.write_text("42")
    >>> path.read_text()
    '42'
    """
    with atomic_writes(path) as (draft,):
        yield draft


@contextlib.contextmanager
def atomic_writes(*paths: str | os.PathLike[str]) -> Iterator[list[Path]]:
    """Give temporary paths for files that belong together; they replace `paths` in this order.

    Threads that write the same files do not mix theirs. Otherwise as `atomic_write`.
    """
    for path in paths:
        if not Path(path).name:
            raise OSError(errno.EINVAL, "no name of a file", os.fspath(path))
    with contextlib.ExitStack() as stack:
        targets = [_target(Path(path)) for path in paths]
        drafts = [
            Path(stack.enter_context(_draft_folder(target)), Path(path).name)
            for path, target in zip(paths, targets)
        ]
        yield drafts
        is_stream = [_is_stream(target) for target in targets]
        for draft, target, stream in zip(drafts, targets, is_stream):
            # Without the lock: a pipe waits until it is read.
            if stream:
                _copy(draft, target)
        for path, draft, target in zip(paths, drafts, targets):
            # A rename would name the draft, of which the user knows nothing.
            if target.is_dir() and not draft.is_dir():
                raise IsADirectoryError(errno.EISDIR, "a folder, not a file", os.fspath(path))
        with _COMMIT_LOCK:
            for draft, target, stream in zip(drafts, targets, is_stream):
                if not stream:
                    _replace(draft, target)


def _target(path: Path) -> Path:
    """Return the path without links of the file to replace, or that of a stream as it is.

    **Raises:** OSError for what cannot be written to.
    """
    target = path if _is_stream(path) else Path(os.path.realpath(path))
    # Asked again at the end: another process that replaces a folder removes it for an instant.
    if target.exists() and not os.access(target, os.W_OK) and target.exists():
        raise PermissionError(errno.EACCES, "write-protected", str(path))
    return target


def _is_stream(path: Path) -> bool:
    """Return True for what content is copied to: devices, pipes, and open files that have no name any more.

    **Raises:** OSError for a block device and a socket.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    if stat.S_ISCHR(status.st_mode) or stat.S_ISFIFO(status.st_mode):
        return True
    if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
        raise OSError(errno.EINVAL, "no file, folder, pipe or character device", str(path))
    # Links of /proc/self/fd, to which /dev/stdout leads, need not be paths. Anything else is one, also while
    # another process replaces it.
    if not path.is_symlink():
        return False
    resolved = os.path.realpath(path)
    try:
        return not (os.path.exists(resolved) and os.path.samefile(resolved, path))
    except FileNotFoundError:
        return False


def _draft_folder(target: Path) -> tempfile.TemporaryDirectory:
    """Make a folder for a draft: beside its target, as a rename is atomic within one file system only.

    The system refuses a second folder of the same name, whichever process or host asks for it.
    """
    if _is_stream(target):
        return tempfile.TemporaryDirectory()
    target.parent.mkdir(parents=True, exist_ok=True)
    # Cut, as a name of the greatest length leaves no place for more characters.
    return tempfile.TemporaryDirectory(prefix=f".{target.name[:32]}.", suffix=".part", dir=target.parent)


def _copy(draft: Path, stream: Path) -> None:
    with draft.open("rb") as source, stream.open("wb") as destination:
        shutil.copyfileobj(source, destination)


def _replace(draft: Path, target: Path) -> None:
    """Move a draft to its place, with the permissions and the owner of what it replaces."""
    for path in (draft, *draft.rglob("*")):
        old_path = target / path.relative_to(draft)
        # Another process may replace the old one meanwhile.
        with contextlib.suppress(FileNotFoundError):
            if old_path.is_dir() == path.is_dir():
                _copy_permissions(old_path, path)
    if draft.is_dir():
        _replace_folder(draft, target)
    else:
        draft.replace(target)


def _copy_permissions(source: Path, path: Path) -> None:
    status, own_status = source.stat(), path.stat()
    if (status.st_uid, status.st_gid) != (own_status.st_uid, own_status.st_gid):
        # Only root may give files away; their group may change to another one of the user's.
        for uid in (status.st_uid, -1):
            with contextlib.suppress(PermissionError):
                os.chown(path, uid, status.st_gid)
                break
    # Lists of access rights are extended attributes, which the mode does not have.
    shutil.copystat(source, path)
    os.utime(path)


def _replace_folder(draft: Path, target: Path) -> None:
    """Move a folder to its place. A rename does not replace a folder: the old one is moved aside first.

    Another process may put its own there in between: that one is moved aside, too.
    """
    old_folder = draft.with_name("old")
    for number in itertools.count():
        try:
            draft.rename(target)
            return
        except OSError as error:
            if error.errno not in _FOLDER_EXISTS or target.is_file():
                if old_folder.exists() and not target.exists():
                    old_folder.rename(target)
                raise
        old_folder = draft.with_name(f"{number}.old")
        with contextlib.suppress(FileNotFoundError):
            target.rename(old_folder)
