"""Output files that appear whole or not at all, one at a time or several together."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from robot_sysid.errors import InputError


@contextlib.contextmanager
def whole_file(path_or_file: str | os.PathLike[str] | TextIO) -> Iterator[TextIO]:
    """Yield a text file to write; a path appears only once the block ends without an error.

    Raises:
        InputError: the folder cannot be written to.
    """
    if not isinstance(path_or_file, (str, os.PathLike)):
        yield path_or_file
        return
    with whole_files() as outputs:
        draft = outputs.draft(Path(path_or_file))
        with open(draft, "w", encoding="utf-8", newline="\n") as file:
            yield file


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, creating its folder.

    Raises:
        InputError: it cannot be written.
    """
    with whole_files() as outputs:
        outputs.write(path, content)


@contextlib.contextmanager
def whole_files() -> Iterator[WholeFiles]:
    """Yield a place to write several files; all of them appear when the block ends, or none.

    An error or Ctrl-C inside the block leaves every path as it was before, older files included.

    Raises:
        InputError: a file cannot be written.
    """
    outputs = WholeFiles()
    try:
        yield outputs
        outputs.commit()
    except BaseException:
        outputs.discard()
        raise


def require_writable(folder: Path) -> None:
    """Raise InputError where files could not be written to a folder, without creating it.

    Asked before a long computation whose results are to be written there.
    """
    require_utf8(folder)
    try:
        whole = folder.absolute()
    except FileNotFoundError:
        raise InputError("the current folder no longer exists; change to another one") from None
    existing = next(f for f in (whole, *whole.parents) if f.exists())
    if not existing.is_dir():
        raise InputError(f"cannot write to {folder}: {existing} is not a folder; choose another")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"cannot write to {folder}: no permission; choose another folder")


class WholeFiles:
    """Drafts beside their final paths, renamed together."""

    def __init__(self) -> None:
        self._drafts: dict[Path, Path] = {}
        self._created_folders: list[Path] = []

    def draft(self, path: Path) -> Path:
        """Return an empty file in the same folder that will take the place of ``path``.

        The draft keeps the suffix, so that it can be loaded and checked before it counts.

        Raises:
            InputError: the folder cannot be written to, or ``path`` is a folder.
        """
        if path.is_dir():
            raise InputError(f"cannot write {path}: it is a folder; choose another name")
        draft = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
        try:
            self._create_folder(path.parent)
            # Not a private temporary file: the result gets the permissions the user's umask says.
            os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        except OSError as error:
            raise InputError(_cannot_write(path, error)) from None
        self._drafts[path] = draft
        return draft

    def write(self, path: Path, content: str | bytes) -> Path:
        """Write the draft of ``path`` and return where it is."""
        draft = self.draft(path)
        data = content.encode("utf-8") if isinstance(content, str) else content
        try:
            draft.write_bytes(data)
        except OSError as error:
            raise InputError(_cannot_write(path, error)) from None
        return draft

    def withdraw(self, path: Path) -> None:
        """Remove the draft of ``path``, if there is one: it will not appear."""
        draft = self._drafts.pop(path, None)
        if draft is not None:
            draft.unlink(missing_ok=True)

    def commit(self) -> None:
        """Give every draft its final name; what stood there before comes back if one fails."""
        backups: dict[Path, Path | None] = {}
        try:
            for path, draft in self._drafts.items():
                backups[path] = _set_aside(path)
                os.replace(draft, path)
        except BaseException as error:
            for done, backup in backups.items():
                _restore(done, backup, self._drafts[done])
            if isinstance(error, OSError):
                raise InputError(_cannot_write(path, error)) from None
            raise
        for backup in backups.values():
            if backup is not None:
                backup.unlink()
        self._drafts.clear()
        self._created_folders.clear()

    def discard(self) -> None:
        """Remove the drafts and the folders made for them."""
        for draft in self._drafts.values():
            draft.unlink(missing_ok=True)
        for folder in reversed(self._created_folders):
            with contextlib.suppress(OSError):  # somebody else has put a file there
                folder.rmdir()
        self._drafts.clear()
        self._created_folders.clear()

    def _create_folder(self, folder: Path) -> None:
        missing = [f for f in (folder, *folder.parents) if not f.exists()]
        for new in reversed(missing):
            new.mkdir(exist_ok=True)
            self._created_folders.append(new)


def _set_aside(path: Path) -> Path | None:
    """Keep a second name for an existing file, so that it can be brought back."""
    if not path.exists():
        return None
    backup = path.with_name(f".{path.name}-{secrets.token_hex(4)}.old")
    os.replace(path, backup)
    return backup


def _restore(path: Path, backup: Path | None, draft: Path) -> None:
    if backup is not None:
        os.replace(backup, path)
    elif not draft.exists():
        path.unlink(missing_ok=True)


def _cannot_write(path: Path, error: OSError) -> str:
    return f"cannot write {path}: {error.strerror or error}; choose another folder"


def require_utf8(path: Path) -> None:
    """Raise InputError where a path has no UTF-8 form, which MuJoCo and JSON need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"the path {path} cannot be written as UTF-8; rename it, or use a UTF-8 locale"
        ) from None
