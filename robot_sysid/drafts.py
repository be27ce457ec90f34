"""Hidden drafts beside what they become, locked as long as the process that writes them lives.

A process that is killed leaves its drafts but not its locks: whoever drafts next in that folder
takes away what nobody holds.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

from robot_sysid.interrupts import held_back

PREFIX = ".robot-sysid-"
_DRAFT = re.compile(rf"{re.escape(PREFIX)}[0-9a-f]{{8}}\..*", re.DOTALL)
_MOST = 25
"""Characters of stem and suffix, of four bytes at most, that a draft has in its name: names have at
most 255 bytes."""
_HAS_LOCKS = sys.platform != "win32"
"""Elsewhere an open file could not be renamed: drafts are not locked, and none counts as stale."""


class Drafts:
    """The drafts of one writer."""

    def __init__(self) -> None:
        self._handles: list[int] = []
        self._tidied: set[Path] = set()

    def file(self, path: Path, end: str = "") -> Path:
        """Return a new empty file beside a path, with its suffix and ``end``.

        It may be read by whom the user's umask says.
        """
        while True:
            draft = self._free_name(path, end)
            # Not a private temporary file: the result gets the usual permissions.
            handle = os.open(draft, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            if self._held(handle, draft):
                return draft

    def folder(self, path: Path) -> Path:
        """Return a new empty folder beside a path."""
        while True:
            draft = self._free_name(path)
            draft.mkdir()
            if not _HAS_LOCKS or self._held(os.open(draft, os.O_RDONLY), draft):
                return draft

    def second_name(self, path: Path) -> Path:
        """Return a link to a file, or a copy of it where the file system has no links."""
        draft = self._free_name(path, ".old")
        try:
            if _HAS_LOCKS:
                self._handles.append(os.open(path, os.O_RDONLY))
                # Of the file, whatever its name: it counts as soon as the second name is there.
                has_lock(self._handles[-1], shared=True)
            os.link(path, draft)
        except OSError:
            draft = self.file(path, ".old")
            try:
                shutil.copy2(path, draft)
            except OSError:
                draft.unlink()
                raise
        return draft

    def close(self) -> None:
        """Let go of all drafts; those that are still there count as stale from now on."""
        while self._handles:
            os.close(self._handles.pop())

    def _free_name(self, path: Path, end: str = "") -> Path:
        if path.parent not in self._tidied:
            self._tidied.add(path.parent)
            remove_stale(path.parent)
        name = f"{path.stem[:_MOST]}{path.suffix[-_MOST:]}{end}"
        return path.with_name(f"{PREFIX}{secrets.token_hex(4)}.{name}")

    def _held(self, handle: int, draft: Path) -> bool:
        """Lock a new draft; return whether it is still there."""
        if not _HAS_LOCKS:
            os.close(handle)
            return True
        self._handles.append(handle)
        # Another process may have taken it for stale before it was locked.
        return has_lock(handle) is not False and leads_to(draft, handle)


@contextlib.contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside a path, to be renamed inside the block; else it is gone after it.

    Raises:
        OSError: it cannot be made.
    """
    drafts, made = Drafts(), []
    try:
        with held_back():  # What is there has to be known, to be removed.
            made.append(drafts.folder(path))
        yield made[0]
    finally:
        for draft in made:
            shutil.rmtree(draft, ignore_errors=True)
        drafts.close()


def remove_stale(folder: Path) -> None:
    """Remove drafts of processes that ended; where that cannot be told, they stay."""
    if not _HAS_LOCKS:
        return
    with contextlib.suppress(OSError):
        for name in filter(_DRAFT.fullmatch, os.listdir(folder)):
            with contextlib.suppress(OSError):
                _remove_unheld(folder / name)


def _remove_unheld(draft: Path) -> None:
    kind = os.lstat(draft).st_mode
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        return
    access = os.O_RDONLY if stat.S_ISDIR(kind) else os.O_RDWR  # as some network locks need
    handle = os.open(draft, access | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        if has_lock(handle):
            shutil.rmtree(draft) if stat.S_ISDIR(kind) else draft.unlink()
    finally:
        os.close(handle)


def has_lock(handle: int, shared: bool = False) -> bool | None:
    """Lock an open file; the system lets go of it when this process ends, however it ends.

    Returns:
        False where another has it, None where the file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK) else None
    return True


def leads_to(path: Path, handle: int) -> bool:
    """Tell whether a path still leads to an open file."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(handle), os.stat(path))
    return False
