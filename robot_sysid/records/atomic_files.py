"""Output files that appear whole or not at all, one at a time or several together.

What is written is a draft by a hidden name in the same folder: an older file stays in its place,
whole, until the very moment in which the new one takes it (the first one of several until the
others begin to). What cannot be written, or is held by
another run, raises InputError.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TextIO, TypeVar

from robot_sysid.errors import InputError
from robot_sysid.interrupts import held_back

LOCK_NAME, PREFIX = ".robot-sysid.lock", ".robot-sysid-"
STALE = 86400.0
"""Age of a draft from which whoever wrote it must have been killed [s]."""
_MOST = 25
"""Characters of stem and suffix, of four bytes at most, that a draft has in its name: names have at
most 255 bytes."""
Place = TypeVar("Place")


@contextlib.contextmanager
def whole_file(path_or_file: str | os.PathLike[str] | TextIO) -> Iterator[TextIO]:
    """Yield a text file to write; a path appears only once the block ends without an error."""
    if not isinstance(path_or_file, (str, os.PathLike)):
        yield path_or_file
        return
    with whole_files() as outputs, outputs.open(Path(path_or_file)) as file:
        yield file


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, creating its folder."""
    with whole_files() as outputs:
        outputs.write(path, content)


@contextlib.contextmanager
def whole_files() -> Iterator[WholeFiles]:
    """Yield a place to write several files; they appear when the block ends, the first one last.

    What that one says then holds for the others. An error or Ctrl-C inside the block leaves every
    path as it was before, older files included.
    """
    outputs = WholeFiles()
    try:
        yield outputs
        outputs.commit()
    finally:
        outputs.discard()


def require_writable(folder: Path) -> None:
    """Raise InputError where files could not be written to a folder, without creating it.

    Asked before a long computation whose results are to be written there.
    """
    require_utf8(folder)
    whole = _from_root(Path.absolute, folder)
    # Path.exists fails where a folder above cannot be entered, or a name is too long.
    existing = next(f for f in (whole, *whole.parents) if os.path.lexists(f))
    if not os.path.exists(existing):
        raise InputError(
            f"cannot write to {folder}: {existing} is a link that leads nowhere; remove it, or "
            "choose another folder"
        )
    if not existing.is_dir():
        raise InputError(f"cannot write to {folder}: {existing} is not a folder; choose another")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"cannot write to {folder}: no permission; choose another folder")


def refuse_overwriting(read: Iterable[Path | None], written: Iterable[tuple[str, Path]]) -> None:
    """Raise InputError where a file would be written over one that is read, or two to one place."""
    inputs = (_from_root(os.path.realpath, path) for path in read if path is not None)
    taken = dict.fromkeys(inputs, "a file that is read")
    for what, path in written:
        place = _from_root(os.path.realpath, path)
        if place in taken:
            raise InputError(f"{what} would overwrite {taken[place]}: {path}; choose another name")
        taken[place] = f"what {what} writes"


def _from_root(function: Callable[[Path], Place], path: Path) -> Place:
    try:
        return function(path)
    except FileNotFoundError:
        raise InputError("the current folder no longer exists; change to another one") from None


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a folder that is gone after the block."""
    try:
        place = tempfile.TemporaryDirectory()
    except OSError as error:
        raise InputError(
            f"no temporary folder can be made: {error.strerror or error}; set TMPDIR to a folder "
            "that can be written to"
        ) from None
    with place as name:
        yield Path(name)


@contextlib.contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside a path, to be renamed inside the block; else it is gone after it.

    Raises:
        OSError: it cannot be made.
    """
    draft = _hidden(path)
    try:
        draft.mkdir()
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _hidden(path: Path) -> Path:
    """Return a new name beside a path, with its suffix; what killed processes left there goes."""
    for left in path.parent.glob(f"{PREFIX}{'[0-9a-f]' * 8}.*"):
        with contextlib.suppress(OSError):
            status = left.lstat()
            if time.time() - status.st_ctime > STALE:
                shutil.rmtree(left) if stat.S_ISDIR(status.st_mode) else left.unlink()
    name = f"{path.stem[:_MOST]}{path.suffix[-_MOST:]}"
    return path.with_name(f"{PREFIX}{secrets.token_hex(4)}.{name}")


@contextlib.contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Keep a second run out of an output folder while the block runs.

    The folder is created; an empty one goes again when the block ends with an error.
    """
    outputs, lock = WholeFiles(), folder / LOCK_NAME
    try:
        with _refusals(folder):
            outputs.create_folder(folder)
            handle = _locked(lock)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # Windows keeps what is open
                lock.unlink()
            os.close(handle)
    finally:
        outputs.discard()


def _locked(lock: Path) -> int:
    """Return the handle of a file that this process holds."""
    while True:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        taken = not _has_lock(handle)
        with contextlib.suppress(FileNotFoundError):
            # A run that ended meanwhile may have removed it.
            if not taken and os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        os.close(handle)
        if taken:
            raise InputError(
                f"another run is writing to {lock.parent}; wait until it ends, or choose another "
                "--output-dir"
            )


def _has_lock(handle: int) -> bool:
    """Lock an open file until this process ends, however it ends; False where another has it.

    A file system without locks is no obstacle.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
    return True


class WholeFiles:
    """Drafts beside their final paths, which take their places together."""

    def __init__(self) -> None:
        self._drafts: dict[Path, Path] = {}
        self._unwanted: list[Path] = []
        self._created_folders: list[Path] = []

    def draft(self, path: Path) -> Path:
        """Return an empty file in the same folder that will take the place of ``path``.

        The draft keeps the suffix, so that it can be loaded and checked before it counts.
        """
        if os.path.isdir(path):
            raise InputError(f"cannot write {path}: it is a folder; choose another name")
        self.withdraw(path)
        with _refusals(path):
            self.create_folder(path.parent)
            self._drafts[path] = _hidden(path)
            # Not a private temporary file: whom the user's umask says may read it.
            self._drafts[path].touch(exist_ok=False)
        return self._drafts[path]

    @contextlib.contextmanager
    def open(self, path: Path) -> Iterator[TextIO]:
        """Yield the draft of ``path`` as an open text file."""
        draft = self.draft(path)
        with _refusals(path), open(draft, "w", encoding="utf-8", newline="\n") as file:
            yield file

    def write(self, path: Path, content: str | bytes) -> Path:
        """Write the draft of ``path`` and return where it is."""
        draft = self.draft(path)
        with _refusals(path):
            draft.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
        return draft

    def withdraw(self, path: Path) -> None:
        """Remove the draft of ``path``, if there is one: it will not appear."""
        draft = self._drafts.pop(path, None)
        if draft is not None:
            draft.unlink(missing_ok=True)

    def remove(self, path: Path) -> None:
        """Have a file removed once all drafts have their final names."""
        self._unwanted.append(path)

    def commit(self) -> None:
        """Give every draft its final name, the first one last.

        An older file by the first one's name goes before the others change: beside them it would
        say what does not hold for them, should the system refuse to go on in between.
        """
        for path, draft in self._drafts.items():
            with _refusals(path), open(draft, "rb+") as file:
                os.fsync(file.fileno())
        with held_back():
            for path in list(self._drafts)[:1] if len(self._drafts) > 1 else ():
                with _refusals(path):
                    path.unlink(missing_ok=True)
            for path, draft in reversed(self._drafts.items()):
                with _refusals(path):
                    os.replace(draft, path)
            for path in self._unwanted:
                with _refusals(path):
                    path.unlink()

    def discard(self) -> None:
        """Remove the drafts that are left, and the folders made for them that are empty."""
        for draft in self._drafts.values():
            with contextlib.suppress(OSError):  # it has its final name, or was never made
                draft.unlink()
        for folder in reversed(self._created_folders):
            with contextlib.suppress(OSError):  # there is a file in it
                folder.rmdir()

    def create_folder(self, folder: Path) -> None:
        """Create a folder and those above it; ``discard`` removes them if they stay empty."""
        missing = [f for f in (folder, *folder.parents) if not os.path.exists(f)]
        for new in reversed(missing):
            new.mkdir(exist_ok=True)
            self._created_folders.append(new)


@contextlib.contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """Let what the system refuses be one line."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"cannot write {path}: {reason}; choose another folder") from None


def require_utf8(path: Path) -> None:
    """Raise InputError where a path has no UTF-8 form, which MuJoCo and JSON need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"the path {path} cannot be written as UTF-8; rename it, or use a UTF-8 locale"
        ) from None
