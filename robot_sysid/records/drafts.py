"""Hidden files and folders of a run, and those that a run left which was killed.

A process holds a lock on each of its own as long as it lives, and the system lets go of it however
the process ends. So whoever gets the lock knows that nobody is left who needs the file; a number of
a process would tell no such thing of another container or computer.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:
    # Windows: what a killed run left stays.
    fcntl = None  # type: ignore[assignment]

# Of names of drafts and folders: nobody else's file is called so.
_PREFIX = ".robot-sysid-"
_OWN_NAME = re.compile(rf"{re.escape(_PREFIX)}[0-9a-f]{{16}}(\..*)?", re.DOTALL)
# Characters of a path's suffix, the dot first, that the name of its draft ends in.
_MOST_OF_SUFFIX = 25


def new_draft(path: Path) -> tuple[Path, int]:
    """Create an empty hidden file beside a path, with its suffix; return it and its lock.

    ``os.close`` lets go of the lock.
    """
    while True:
        suffix = path.suffix[:_MOST_OF_SUFFIX]
        draft = path.with_name(f"{_PREFIX}{os.urandom(8).hex()}{suffix}")
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
        folder = place / f"{_PREFIX}{os.urandom(8).hex()}"
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
