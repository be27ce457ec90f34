"""Hidden files and folders of a run, those that a killed run left, and locks of what a run writes.

A process holds a lock on each of its own as long as it lives, and the system lets go of it however
the process ends. So whoever gets the lock knows that nobody is left who needs the file; a number of
a process would tell no such thing of another container or computer.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import stat
import time
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:
    # Windows: what a killed run left stays.
    fcntl = None  # type: ignore[assignment]

HIDDEN_PREFIX = ".robot-sysid-"
"""Beginning of the names of all hidden files and folders of runs: nobody else's is called so."""
_OWN_NAME = re.compile(rf"{re.escape(HIDDEN_PREFIX)}[0-9a-f]{{16}}(\..*)?", re.DOTALL)
# Where on Windows a lock file is locked: behind the number of the process, which others may read.
_LOCKED_BYTE = 2**20
# Pause between two attempts to get a lock, or to read who has it [s].
_PAUSE = 0.01
# Attempts to read the number of a process that has just got its lock and is about to write it.
_ATTEMPTS = 20
# Characters of a path's suffix, the dot first, that the name of its draft ends in.
_MOST_OF_SUFFIX = 25


def new_draft(path: Path) -> tuple[Path, int]:
    """Create an empty hidden file beside a path, with its suffix; return it and its lock.

    ``os.close`` lets go of the lock.
    """
    while True:
        suffix = path.suffix[:_MOST_OF_SUFFIX]
        draft = path.with_name(f"{HIDDEN_PREFIX}{os.urandom(8).hex()}{suffix}")
        # touch() and not a temporary file of tempfile: the user's umask decides who may read.
        draft.touch(exist_ok=False)
        lock = _lock_of(draft)
        if lock is not None:
            return draft, lock


@contextlib.contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Yield a new folder that is removed after the block, in ``parent`` or the system's place.

    What killed runs left beside it is removed first.
    """
    import tempfile

    place = parent or Path(tempfile.gettempdir())
    remove_leftovers(place)
    lock = None
    while lock is None:
        folder = place / f"{HIDDEN_PREFIX}{os.urandom(8).hex()}"
        folder.mkdir(mode=stat.S_IRWXU)
        lock = _lock_of(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def remove_leftovers(folder: Path) -> None:
    """Remove from a folder the hidden files and folders of this user's runs that were killed.

    Those of a run that goes on stay, and so do all where the system knows no locks.
    """
    names: list[str] = []
    # A folder that cannot be read is told of when it is written to.
    with contextlib.suppress(OSError):
        names = os.listdir(folder) if fcntl else []
    for name in filter(_OWN_NAME.fullmatch, names):
        with contextlib.suppress(OSError):
            _remove_leftover(folder / name)


def _remove_leftover(path: Path) -> None:
    """Remove a file or folder that nobody holds a lock on; OSError where somebody does."""
    info = os.lstat(path)
    is_folder = stat.S_ISDIR(info.st_mode)
    if info.st_uid != os.geteuid() or not (is_folder or stat.S_ISREG(info.st_mode)):
        return
    lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if is_folder:
            shutil.rmtree(path)
        else:
            os.unlink(path)
    finally:
        os.close(lock)


def _lock_of(path: Path) -> int | None:
    """Return an open file that holds the lock of a new file or folder.

    None where another run has removed it before it was locked.
    """
    try:
        lock = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return None
    if fcntl is None:
        return lock
    try:
        # Without locks, as on some network drives, nothing is ever removed.
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(lock), os.stat(path)):
            return lock
    except FileNotFoundError:
        pass
    os.close(lock)
    return None


@contextlib.contextmanager
def locked(path: Path, patience: float = 0.0) -> Iterator[None]:
    """Hold the lock of a file, or of a folder that exists, while the block runs.

    A hidden file stands for the lock, and holds the number of the process that has it. Where the
    system knows no locks, as on some network drives, the block runs without.

    Args:
        path: of the file, which need not exist, or of the folder.
        patience: how long to wait for another run [s].

    Raises:
        BlockingIOError: another run has the lock; its text is the number of that process.
    """
    if os.path.isdir(path):
        lock_path = path / f"{HIDDEN_PREFIX}lock"
    else:
        # Not the name itself: with what stands before it, it might be too long.
        name = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]
        lock_path = path.with_name(f"{HIDDEN_PREFIX}lock-{name}")
    lock = _wait_for_lock(lock_path, time.monotonic() + patience)
    try:
        yield
    finally:
        if lock is not None:
            _release_lock(lock, lock_path)


def _wait_for_lock(path: Path, end: float) -> int | None:
    """Return what ``_take_lock`` does, or raise its error at the time ``end`` of the clock [s]."""
    while True:
        try:
            return _take_lock(path)
        except BlockingIOError:
            if time.monotonic() >= end:
                raise
        time.sleep(_PAUSE)


def _take_lock(path: Path) -> int | None:
    """Return an open lock file that holds its lock; None where the system knows no locks.

    BlockingIOError where another process holds it. A file that a killed run left is taken over.
    """
    # A link would lead the number of this process into somebody's file.
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
    while True:
        try:
            lock = os.open(path, flags, 0o666)
        except OSError:
            return None
        try:
            _lock_at_once(lock)
            # Whoever had it may have removed the file in the meantime.
            if os.path.samestat(os.fstat(lock), os.stat(path)):
                os.ftruncate(lock, 0)
                os.write(lock, str(os.getpid()).encode())
                return lock
        except BlockingIOError:
            process = _process_in(lock)
            os.close(lock)
            raise BlockingIOError(process) from None
        except FileNotFoundError:
            pass
        except OSError:
            os.close(lock)
            return None
        os.close(lock)


def _lock_at_once(lock: int) -> None:
    """Lock an open file; BlockingIOError where another process has locked it."""
    if fcntl is not None:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    import msvcrt

    os.lseek(lock, _LOCKED_BYTE, os.SEEK_SET)
    try:
        msvcrt.locking(lock, msvcrt.LK_NBLCK, 1)
    except PermissionError:
        raise BlockingIOError from None
    finally:
        os.lseek(lock, 0, os.SEEK_SET)


def _process_in(lock: int) -> str:
    """Return the number of the process that an open lock file holds; "?" for none."""
    for _ in range(_ATTEMPTS):
        os.lseek(lock, 0, os.SEEK_SET)
        digits = os.read(lock, 20)
        if digits.isdigit():
            return digits.decode()
        time.sleep(_PAUSE)
    return "?"


def _release_lock(lock: int, path: Path) -> None:
    """Let go of a lock and remove its file."""
    if fcntl is None:
        # Windows removes no file that is open, so that this one is nobody's.
        os.close(lock)
    try:
        with contextlib.suppress(OSError):
            path.unlink()
    finally:
        if fcntl is not None:
            os.close(lock)
