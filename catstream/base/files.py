"""Files: atomic writes, locks, and early checks of output paths; the folder of the user's state."""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import re
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from catstream.base.forks import after_fork, forked, generation
from catstream.errors import CatstreamError, ServiceError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

ABANDONED_SECONDS = 600.0  #: age at which an unfinished file is abandoned

#: Temporary errors of a disk, and their remedies.
REMEDIES = {
    errno.ENOSPC: "free space on the disk",
    errno.EDQUOT: "free space, or raise the quota",
    errno.EROFS: "mount it writable",
    errno.EIO: "check the disk",
}


def state_home() -> Path:
    """The folder for files of this user that outlive a process; ServiceError if the user has no home directory."""
    try:
        return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "catstream"
    except RuntimeError:
        raise ServiceError("this user has no home directory: set HOME or XDG_STATE_HOME to a folder") from None


def write_atomically(path: str | os.PathLike[str], data: bytes, mode: int = 0o666) -> None:
    """Replace a file atomically; the new content then survives a power failure. The umask applies to `mode`.

    OSError if the file cannot be written; the old content then remains.
    """
    path = Path(path)
    remove_parts(path)
    with _temporary(path, data, mode) as part:
        part.replace(path)


def create_atomically(path: str | os.PathLike[str], data: bytes) -> None:
    """Create a private file: it exists with its whole content or not at all, even after a power failure.

    FileExistsError if it exists, even if two processes create it at the same time; OSError if it cannot be written.
    """
    path = Path(path)
    with _temporary(path, data, 0o600) as part:
        os.link(part, path)  # unlike a rename, this fails if the file exists


@contextlib.contextmanager
def _temporary(path: Path, data: bytes, mode: int) -> Iterator[Path]:
    """Write a temporary file next to `path`, synced to disk; its folder is synced after the block.

    Its name is unique, so several processes may write `path` at the same time. It is removed unless the block moves it.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # the content must be on disk before the rename
        yield part
        sync(path.parent)
    finally:
        with contextlib.suppress(OSError):  # the disk may have become read-only; a later write removes the file
            part.unlink(missing_ok=True)


def remove_parts(path: Path) -> None:
    """Remove the temporary files of processes that were killed while writing `path`."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with contextlib.suppress(OSError):
            if part.stat().st_mtime < time.time() - ABANDONED_SECONDS:
                shutil.rmtree(part) if part.is_dir() else part.unlink()


@contextlib.contextmanager
def writing(path: str | os.PathLike[str], kind: type[CatstreamError] = ServiceError) -> Iterator[None]:
    """Convert an OSError while writing a file or folder to an error of this kind, with a remedy."""
    try:
        yield
    except BrokenPipeError:  # the reader of standard output has exited, for example `head`: no error
        raise
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "use another folder")
        raise kind(f"cannot write {os.fspath(path)!r} ({error.strerror}): {remedy}") from None


def check_file(
    path: Path,
    *,
    overwrite: bool = True,
    made: Path | None = None,
    kind: type[CatstreamError] = ServiceError,
    may_wait: bool = False,
) -> None:
    """Raise an error of this kind if a file exists and may not be replaced, or cannot be written.

    The folder `made` may be missing, because it is created later. If the file `may_wait`, a full disk is no error.
    """
    if path.exists() and not overwrite:
        raise kind(f"{path} exists already: replace it with --overwrite, or use another name")
    folder = path.parent.absolute()
    if made is not None and folder == made.absolute():
        folder = next(parent for parent in (folder, *folder.parents) if parent.exists())
    problem, remedy = "a folder" if path.is_dir() else "", "pass a file in an existing folder that you may write to"
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        if error.errno in REMEDIES and may_wait:
            return
        problem, remedy = error.strerror or "", REMEDIES.get(error.errno or 0, remedy)
    if problem:
        raise kind(f"cannot write {path} ({problem}): {remedy}")


@contextlib.contextmanager
def descriptor(path: Path, flags: int = os.O_RDONLY) -> Iterator[int]:
    """Open a descriptor for locking a file or folder; OSError if it cannot be opened.

    It is closed in forked processes, which would otherwise hold the lock until they exit.
    """
    handle, since = os.open(path, flags, 0o600), generation()
    _descriptors.add(handle)
    try:
        yield handle
    finally:
        if not forked(since):
            _descriptors.remove(handle)
            _flock(handle, "LOCK_UN")  # a process that was just forked may not have closed it yet
            os.close(handle)


_descriptors: set[int] = set()


def _close_descriptors() -> None:
    for handle in _descriptors:
        os.close(handle)
    _descriptors.clear()


after_fork(_close_descriptors)


def lock(handle: int, seconds: float = 0.0) -> bool:
    """Lock an open file or folder until it is closed; False if another process still has it after `seconds`."""
    deadline = time.monotonic() + seconds
    while not (locked := _flock(handle, "LOCK_EX")) and time.monotonic() < deadline:
        time.sleep(0.05)
    return locked


def is_locked(handle: int) -> bool:
    """Return True if another process has locked an open file; tests with a shared lock, so tests do not conflict."""
    return not _flock(handle, "LOCK_SH")


def _flock(handle: int, kind: str) -> bool:
    """Lock an open file or folder without waiting; returns False if another process has locked it.

    Without lock support (some network drives, systems without `fcntl`) locking always succeeds.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, getattr(fcntl, kind) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            raise
    return True


def open_locked(path: Path, kind: type[CatstreamError] = ServiceError, size: int | None = 0, **options: Any) -> IO[Any]:
    """Open a file for appending, create its folder, and lock the file until it is closed.

    size     bytes to truncate the file to, 0 for a new file; None for no truncation
    options  of `open`

    An error of this kind if another process has locked it, or if it cannot be written.
    """
    with writing(path, kind), contextlib.ExitStack() as stack:
        path.parent.mkdir(parents=True, exist_ok=True)
        file: IO[Any] = stack.enter_context(path.open(**{"mode": "a", **options}))
        if not lock(file.fileno()):
            raise kind(_busy(path))
        if size is not None and stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            file.truncate(size)
        stack.pop_all()
    return file


@contextlib.contextmanager
def locked_folder(
    folder: Path,
    kind: type[CatstreamError] = ServiceError,
    seconds: float = 0.0,
    *,
    mode: int = 0o777,
    busy: str = "",
) -> Iterator[None]:
    """Create a folder if it does not exist, and lock it for a block.

    An error of this kind if it cannot be created, or, with the text `busy`, if it is still locked after `seconds`.
    """
    with contextlib.ExitStack() as stack:
        with writing(folder, kind):
            folder.mkdir(mode, parents=True, exist_ok=True)
            handle = None if fcntl is None else stack.enter_context(descriptor(folder, os.O_DIRECTORY))
        if handle is not None and not lock(handle, seconds):
            raise kind(busy or _busy(folder))
        yield


def check_unlocked(path: Path, kind: type[CatstreamError] = ServiceError) -> None:
    """Raise an error of this kind if another process has locked a file."""
    # A pipe without a writer would block.
    with contextlib.suppress(OSError), descriptor(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)) as handle:
        if is_locked(handle):
            raise kind(_busy(path))


def _busy(path: Path) -> str:
    """Error text for a locked path, with the id of the process if /proc/locks lists it."""
    holder = "another process"
    with contextlib.suppress(OSError):
        locks = Path("/proc/locks").read_text()
        if entry := re.search(rf"FLOCK +ADVISORY +WRITE +([1-9]\d*) \S+:{path.stat().st_ino} ", locks):
            holder = f"process {entry[1]}"
    return f"{path} is being written by {holder}: stop it, or pass another path"


def check_distinct(files: Iterable[tuple[str, Path]], kind: type[CatstreamError] = ServiceError) -> None:
    """Raise an error of this kind if two of the pairs (purpose, path) are the same file, even through links.

    >>> check_distinct([("the results", Path("a.csv")), ("the model of anna", Path("./a.csv"))])
    Traceback (most recent call last):
    catstream.errors.ServiceError: a.csv is both the results and the model of anna: pass different files
    """
    purposes: dict[object, str] = {}
    for purpose, path in files:
        key = (path.stat().st_dev, path.stat().st_ino) if path.exists() else path.resolve()
        if key in purposes:
            raise kind(f"{path} is both {purposes[key]} and {purpose}: pass different files")
        purposes[key] = purpose


def sync(path: Path) -> None:
    """Sync a file, or the entries of a folder, to disk; no effect on Windows, which cannot open folders."""
    if os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
