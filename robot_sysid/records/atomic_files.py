"""Output files that appear whole or not at all, one at a time or several together.

What is written is a draft by a hidden name in the same folder: an older file stays in its place
until the moment in which the new one takes it. What cannot be written, or is held by another run,
raises InputError.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TextIO

from robot_sysid.errors import InputError, delay_signals, error_text
from robot_sysid.special_files import refuse_special_file

MODEL_NAMES = {"mjcf": "updated_model.xml", "urdf": "updated_model.urdf"}
"""Kind of model file to the name of the written model: a URDF stays one."""
PARAMS_NAME = "params.json"
PLAN_NAME = "trajectory.json"
DAMIAO_NAME = "damiao_trajectory.csv"
CARD_NAME = "payload_card.txt"
SERVO_NAME = "servo.json"
RUN_NAME = "run.toml"
LOCK_NAME = ".robot-sysid.lock"
PREFIX = ".robot-sysid-"


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
            raise InputError(
                f"cannot write {path}: it is a folder; choose another name"
            )
        refuse_special_file(path, "choose another name to write to")
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
            draft.write_bytes(
                content.encode("utf-8") if isinstance(content, str) else content
            )
        return draft

    def withdraw(self, path: Path) -> None:
        """Remove the draft of ``path``, if there is one: it will not appear."""
        if path in self._drafts:
            self._drafts.pop(path).unlink(missing_ok=True)

    def remove(self, path: Path) -> None:
        """Have a file removed once all drafts have their final names."""
        self._unwanted.append(path)

    def commit(self) -> None:
        """Give every draft its final name, the first one last.

        Of several, an older file by the first one's name goes before the others change: beside them
        it would say what does not hold for them, should the system refuse to go on in between.
        """
        for path, draft in self._drafts.items():
            with _refusals(path), open(draft, "rb+") as file:
                os.fsync(file.fileno())
        with delay_signals():
            if len(self._drafts) > 1:
                first = next(iter(self._drafts))
                with _refusals(first):
                    first.unlink(missing_ok=True)
            for path, draft in reversed(self._drafts.items()):
                with _refusals(path):
                    os.replace(draft, path)
            for path in self._unwanted:
                with _refusals(path):
                    path.unlink()

    def discard(self) -> None:
        """Remove the drafts that are left, and the folders made for them that are empty."""
        for draft in self._drafts.values():
            with contextlib.suppress(
                OSError
            ):  # it has its final name, or was never made
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
def temporary_folder() -> Iterator[Path]:
    """Yield a folder that is gone after the block."""
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@contextlib.contextmanager
def draft_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside a path; unless it is renamed inside the block it is gone after."""
    import shutil

    draft = _hidden(path)
    try:
        draft.mkdir()
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _hidden(path: Path) -> Path:
    """Return a new name beside a path with its suffix, as much of it as a name can hold."""
    return path.with_name(f"{PREFIX}{os.urandom(4).hex()}{path.suffix[-25:]}")


@contextlib.contextmanager
def only_run_in(folder: Path) -> Iterator[None]:
    """Keep a second run out of an output folder while the block runs.

    The folder is created; an empty one goes again when the block ends with an error.
    """
    outputs = WholeFiles()
    lock = folder / LOCK_NAME
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
    """Return the handle of a file that this process holds, until it ends in whatever way."""
    while True:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        taken = not _has_lock(handle)
        with contextlib.suppress(FileNotFoundError):
            # A run that ended meanwhile may have removed it.
            if not taken and os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        os.close(handle)
        if taken:
            remedy = "wait until it ends, or choose another --output-dir"
            raise InputError(f"another run is writing to {lock.parent}; {remedy}")


def _has_lock(handle: int) -> bool:
    """Lock an open file, False where another has it; a file system without locks is no obstacle."""
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


def require_writable(folder: Path) -> None:
    """Raise InputError where files could not be written to a folder, without creating it.

    Asked before a long computation whose results are to be written there.
    """
    require_utf8(folder)
    with _gone():
        whole = folder.absolute()
    # Path.exists fails where a folder above cannot be entered, or a name is too long.
    existing = next(f for f in (whole, *whole.parents) if os.path.lexists(f))
    faults = {
        f"{existing} is a link that leads nowhere": not os.path.exists(existing),
        f"{existing} is not a folder": not existing.is_dir(),
        "no permission": not os.access(existing, os.W_OK | os.X_OK),
    }
    for fault in (fault for fault, there in faults.items() if there):
        raise InputError(f"cannot write to {folder}: {fault}; choose another folder")


def refuse_overwriting(
    read: Iterable[Path | None], written: Iterable[tuple[str, Path]]
) -> None:
    """Raise InputError where a file would be written over one that is read, or two to one place."""
    with _gone():
        taken = {
            os.path.realpath(path): "a file that is read"
            for path in read
            if path is not None
        }
        for what, path in written:
            place = os.path.realpath(path)
            if place in taken:
                raise InputError(
                    f"{what} would overwrite {taken[place]}: {path}; choose another"
                )
            taken[place] = f"what {what} writes"


def require_utf8(path: Path) -> None:
    """Raise InputError where a path has no UTF-8 form, which MuJoCo and JSON need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"the path {path} cannot be written as UTF-8; rename it, or use a UTF-8 locale"
        ) from None


@contextlib.contextmanager
def _gone() -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise InputError(
            "the current folder no longer exists; change to another one"
        ) from None


@contextlib.contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """Let what the system refuses be one line."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error_text(error)}; choose another folder"
        ) from None
