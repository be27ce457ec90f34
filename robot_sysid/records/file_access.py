"""Files: results are written whole or not at all, what others wrote is read with care.

A file is written as a draft, by a hidden name in the folder of its final path: an older file stays
in place until the moment in which the draft replaces it. Whatever the system refuses raises
InputError.

A run replaces and removes nothing but what a run has written. A hidden file of each folder of
results lists the names, sizes and SHA-256 hashes of the files that runs wrote there
(``RECORD_NAME``). What has no record, as a single file elsewhere or the results of versions before
1.0, is known by its own marks (``_MARKS``). These stay in a file that a person changes: what is
replaced on marks alone is kept beside it as ``NAME.old``.
"""

from __future__ import annotations

import codecs
import contextlib
import filecmp
import hashlib
import json
import math
import os
import re
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TextIO

from robot_sysid.errors import InputError, delay_signals, error_text
from robot_sysid.records.controllers import DRIVERS, SIMULATORS
from robot_sysid.records.drafts import (
    HIDDEN_PREFIX,
    locked,
    new_draft,
    remove_leftovers,
)
from robot_sysid.wording import is_for_python

MODEL_NAMES = {"mjcf": "updated_model.xml", "urdf": "updated_model.urdf"}
"""Format of the robot's model file to the name of the written model: a URDF stays one."""
CURVED_NAME = "updated_model_curved.xml"
"""Name of the written model whose friction bends with speed; the other one loads everywhere."""
PARAMS_NAME = "params.json"
"""Name of the file with all identified numbers of a run."""
PLAN_NAME = "trajectory.json"
"""Name of the file with the coefficients of a planned motion."""
GOALS_NAME = "goals.csv"
"""Name of the file with the goal positions of a motion for servos."""
SETTINGS_NAME = "trajectory.toml"
"""Settings that a plan writes beside its motion, from which it can be planned again."""
DAMIAO_NAME = "damiao_trajectory.csv"
"""Name of the file with a motion for Damiao motors."""
DAMIAO_WEIGHT_NAME = "damiao_trajectory_weight.csv"
"""Name of the file beside it with the torque that carries and accelerates the arm."""
CARD_NAME = "payload_card.txt"
"""Name of the file with a payload in the form of each controller."""
SIMULATOR_CARD_NAMES = {key: f"{key}_card.py" for key in SIMULATORS}
"""Key of a simulator to the name of the file with an arm in its form."""
ARM_CARD_NAMES = {
    **SIMULATOR_CARD_NAMES,
    **{key: file_name for key, (_, file_name) in DRIVERS.items()},
}
"""Key of a simulator, or of an arm's own software, to the name of the file with an arm in its
form."""
SERVO_NAME = "servo.json"
"""Name of the file with all numbers identified for an arm without torque measurement."""
RUN_NAME = "run.toml"
"""Name of the file with all options of a run, from which it can be repeated."""
DATA_NAME = "report_data.npz"
"""Name of the file with the signals that a report draws."""
REPORT_NAME = "report.html"
"""Name of the page of one run."""
FOLDER_OPTION = "--output-dir"
"""The option of commands that names the folder of results; Python's calls take it as they save."""
RECORD_NAME = f"{HIDDEN_PREFIX}files.json"
"""Name of the hidden file that lists what runs have written to its folder."""
RESULT_NAMES = (
    PARAMS_NAME,
    SERVO_NAME,
    *MODEL_NAMES.values(),
    CURVED_NAME,
    CARD_NAME,
    *ARM_CARD_NAMES.values(),
)
"""Names of files that any run may write to its output folder."""
_ABOUT_RECORD = "robot-sysid wrote these files here, and replaces no others"
_MARKS = re.compile(
    b"|".join(
        (
            rb"robot-sysid|<!-- System ID: ",
            # Results, torque scales, a payload's card, and the data of a report.
            rb'\A\{\s*"schema_version": \d',
            rb'\A\{\s*"version": \d,\s*"torque_scale"',
            rb"\APayload of [^\n]* identified with ",
            rb"\APK.{28}version\.npy",
            # Tables: samples of a plan, goals of servos, readings of a simulated arm, motors.
            rb"\Atime(,q_[^,\n]+)+(,qd_[^,\n]+)+(,qdd_[^,\n]+)+\n",
            rb"\Atime(,[^,\n]+ goal position \[\w+\])+\n",
            rb'\Atime,[^\n]*_(position|velocity|torque|acceleration|time)"?\n',
            rb"\A# motor_type=|\A# trajectory_sha256=",
        )
    ),
    re.DOTALL,
)
"""What a file that any version has written has within it, in its beginning or end."""
_KEPT = re.compile(r"\.old\d*\Z")
"""How the name of a file ends that was kept when a run replaced it."""
# How long to wait for another run that writes the record of a folder [s]: it takes milliseconds.
_RECORD_PATIENCE = 2.0
# Bytes of a file that are in memory at once while it is hashed.
_PIECE = 2**20
# How deep lists and tables of settings and results may lie within each other: theirs lie eight
# deep.
_MOST_NESTING = 64
_TOO_DEEP = f"lists or tables lie more than {_MOST_NESTING} deep within each other"
# What ends a key of TOML, and how many dots one may have: each begins a table within the one
# before, and reading them takes time by the square of their number.
_KEY_ENDS = re.compile(r"[=,{}\[\]\n]")
_MOST_DOTS = 4 * _MOST_NESTING
# Digits from which on an integer is larger than any number that is read, or infinite.
_MOST_DIGITS = 300
# First line of a file that Git LFS leaves in the place of a large one.
_LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"


def models_in(files: Iterable[Path]) -> list[Path]:
    """Return the updated models, MJCF or URDF, among written files; empty if there is none.

    That with friction that bends (``curved_file_in``) is beside one of them.
    """
    return [path for path in files if path.name in MODEL_NAMES.values()]


def curved_file_in(files: Iterable[Path]) -> Path | None:
    """Return the model whose friction bends among written files; None if there is none."""
    return next((path for path in files if path.name == CURVED_NAME), None)


def refuse_special_file(
    path: str | os.PathLike[str], remedy: str = "give a file"
) -> None:
    """Raise InputError where a path leads to a pipe, a device or a socket, or to a pointer of LFS.

    Reading the former may never end, and the system would miss a device that a file has replaced.
    A pointer is what Git leaves in the place of a large file until that is fetched. Folders,
    missing files and paths that cannot be looked at pass: opening them fails with the reason.
    ``remedy``: what the user should do about a pipe or a device; ends the message.
    """
    beginning = b""
    try:
        mode = os.stat(path).st_mode
        if stat.S_ISREG(mode):
            with open(path, "rb") as file:
                beginning = file.read(len(_LFS_POINTER))
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise InputError(f"{path} is a pipe or a device; {remedy}")
    if beginning == _LFS_POINTER:
        raise InputError(
            f"{path} is a pointer of Git LFS, not the file that it stands for; fetch that with "
            "git lfs pull in its repository"
        )


def begins_as_xml(path: Path) -> bool | None:
    """Return whether a file's first character is "<", as that of every model and of no log.

    None where there is no file that can be read; a folder, as of a ROS bag, is no XML.
    """
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        return False
    try:
        if not os.path.isfile(path):
            return None
        with open(path, "rb") as file:
            beginning = file.read(_PIECE)
    except (OSError, ValueError):
        return None
    # A mark of the encoding, and the zeros of one with two or four bytes to a character.
    text = beginning.lstrip(b"\xef\xbb\xbf\xfe\xff").replace(b"\0", b"")
    return text.lstrip().startswith(b"<")


def read_text(path: Path, remedy: str) -> str:
    """Return the content of a text file, or raise InputError that ends with a remedy.

    It is in UTF-8, or in UTF-16 with a mark, as Windows calls Unicode.
    """
    refuse_special_file(path, remedy)
    try:
        with open(path, "rb") as file:
            is_wide = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        return path.read_text(encoding="utf-16" if is_wide else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error_text(error)}; {remedy}") from None


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal digits, read in pieces."""
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for piece in iter(lambda: file.read(_PIECE), b""):
            digest.update(piece)
    return digest.hexdigest()


def read_json(path: Path, remedy: str) -> Any:
    """Return the content of a JSON file; an integer too large for a float becomes infinite.

    Args:
        path: the file.
        remedy: what the user should do where the file cannot be read; ends the message.

    Raises:
        InputError: the file cannot be read, or is no JSON.
    """
    text = read_text(path, remedy)
    try:
        content = json.loads(text, parse_int=number_of_digits)
        _refuse_odd(content)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"cannot read {path}: it is not JSON: {error}; {remedy}"
        ) from None
    return content


def number_of_digits(digits: str) -> int | float:
    """Return the integer that digits state, infinite where no float is that large: 1.8e308.

    Python itself refuses more than some thousand digits, with advice on its own settings.
    """
    return int(digits) if len(digits) < _MOST_DIGITS else float(digits)


def read_toml(path: Path) -> Mapping[str, Any]:
    """Return the content of a TOML file, or raise InputError that names the file."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    text = read_text(path, "give a TOML file")
    try:
        if any(part.count(".") > _MOST_DOTS for part in _KEY_ENDS.split(text)):
            raise ValueError(_TOO_DEEP)
        content = tomllib.loads(text)
        _refuse_odd(content)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"cannot read {path}: {error_text(error)}") from None
    except (ValueError, RecursionError) as error:
        fault = error_text(error)
        # Python's own message of it has advice on Python.
        longest = max(map(len, re.findall(r"[\d_]+", text)), default=0)
        if longest >= _MOST_DIGITS and "digits" in fault:
            fault = f"an integer has {longest} digits; correct it"
        raise InputError(f"cannot read {path}: {fault}") from None
    return content


def _refuse_odd(content: Any) -> None:
    """Raise ValueError where a content lies too deep, an integer is larger than any float, or a
    text has a character zero.

    No path and no name has one; the system ends a text there, and shows another one.
    """
    level = [content]
    for _ in range(_MOST_NESTING):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += [*value, *value.values()]
            elif isinstance(value, list):
                below += value
            elif isinstance(value, str) and "\0" in value:
                raise ValueError(f"the text {value!r:.60} holds a character zero")
            elif isinstance(value, int) and abs(value) >= 10**_MOST_DIGITS:
                raise ValueError(f"an integer has more than {_MOST_DIGITS} digits")
        if not below:
            return
        level = below
    raise ValueError(_TOO_DEEP)


def plan_settings(folder: Path) -> Mapping[str, Any]:
    """Return the content of the settings file of the plan in a folder.

    Empty where there is no such file or it cannot be read: the settings only serve to suggest the
    next command.
    """
    with contextlib.suppress(InputError):
        return read_toml(folder / SETTINGS_NAME)
    return {}


class AtomicFiles:
    """Drafts of several files, all of which replace their final paths in one step, ``commit``.

    A draft is known by the final path of its file. Paths appear in the reverse order in which
    their drafts were made.
    """

    def __init__(self) -> None:
        self._drafts: dict[Path, Path] = {}
        self._locks: dict[Path, int] = {}
        self._unwanted: list[Path] = []
        self._created_folders: list[Path] = []

    def draft(self, path: Path) -> Path:
        """Create an empty draft of the file ``path``, and its folder; return where the draft is.

        The draft has the suffix of ``path``, so that it can be loaded and checked before
        ``commit``. An earlier draft of ``path`` is removed, and so are those that killed runs left
        in its folder.
        """
        _refuse_no_file(path)
        self.withdraw(path)
        with _refusals_as_input_errors(path):
            self._created_folders += _create_folder(path.parent)
            remove_leftovers(path.parent)
            with delay_signals():
                self._drafts[path], self._locks[path] = new_draft(path)
        return self._drafts[path]

    @contextlib.contextmanager
    def open(self, path: Path) -> Iterator[TextIO]:
        """Yield a new draft of the file ``path`` as an open UTF-8 text file."""
        draft = self.draft(path)
        with (
            _refusals_as_input_errors(path),
            open(draft, "w", encoding="utf-8", newline="\n") as file,
        ):
            yield file

    def write(self, path: Path, content: str | bytes) -> Path:
        """Write a draft of the file ``path`` and return where the draft is."""
        draft = self.draft(path)
        with _refusals_as_input_errors(path):
            draft.write_bytes(
                content.encode("utf-8") if isinstance(content, str) else content
            )
        return draft

    def draft_of(self, path: Path) -> Path:
        """Return where the draft of the file ``path`` is."""
        return self._drafts[path]

    def withdraw(self, path: Path) -> None:
        """Remove the draft of the file ``path``, if there is one; ``commit`` then leaves it out."""
        if path in self._drafts:
            self._drafts.pop(path).unlink(missing_ok=True)
            os.close(self._locks.pop(path))

    def remove(self, path: Path) -> None:
        """Have ``commit`` remove a file of an earlier run after all drafts have their final names.

        One that is known by its marks alone is kept by another name, and one of a person stays.
        """
        self._unwanted.append(path)

    def commit(self) -> None:
        """Give every draft its final name, the first one last, and then remove unwanted files.

        With several drafts, an older file by the name of the first one is removed before the others
        change: should the system refuse to go on in between, it would describe files that are gone.

        InputError, with every file as it was, where a draft would replace a file that no run wrote.
        One that is known by its marks alone is kept by another name, unless the draft is the same.
        """
        for path, draft in self._drafts.items():
            with _refusals_as_input_errors(path), open(draft, "rb+") as file:
                os.fsync(file.fileno())
        for path in self._drafts:
            if not is_replaceable(path):
                raise InputError(
                    f"cannot replace {path}: no run wrote it, or it was changed since; move it "
                    "away, or choose another name"
                )
        with delay_signals():
            for path, draft in self._drafts.items():
                if is_marked(path) and not filecmp.cmp(path, draft, shallow=False):
                    _keep(path)
            # First of all: killed in between, both the old files and the new ones are known.
            _record_drafts(self._drafts)
            if len(self._drafts) > 1:
                first = next(iter(self._drafts))
                with _refusals_as_input_errors(first):
                    first.unlink(missing_ok=True)
            for path, draft in reversed(self._drafts.items()):
                with _refusals_as_input_errors(path):
                    os.replace(draft, path)
            for path in self._unwanted:
                _remove_result(path)

    def discard(self) -> None:
        """Remove all drafts without a final name, and the created folders that are empty."""
        for draft in self._drafts.values():
            # The draft may have its final name, or never have been made.
            with contextlib.suppress(OSError):
                draft.unlink()
        for lock in self._locks.values():
            os.close(lock)
        self._locks.clear()
        _remove_empty(self._created_folders)


@contextlib.contextmanager
def atomic_files() -> Iterator[AtomicFiles]:
    """Yield an ``AtomicFiles`` whose drafts get their final names when the block ends.

    The file of the first draft appears last, so that it may describe the others. An error or Ctrl-C
    inside the block leaves every path as it was before, older files included.
    """
    files = AtomicFiles()
    try:
        yield files
        files.commit()
    finally:
        files.discard()


@contextlib.contextmanager
def atomic_file(path_or_file: str | os.PathLike[str] | TextIO) -> Iterator[TextIO]:
    """Yield a text file to write, which appears at its path when the block ends without an error.

    An open file is yielded as it is.
    """
    if not isinstance(path_or_file, (str, os.PathLike)):
        yield path_or_file
        return
    with atomic_files() as files, files.open(Path(path_or_file)) as file:
        yield file


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, and create its folder where it is missing."""
    with atomic_files() as files:
        files.write(path, content)


def _refuse_no_file(path: Path) -> None:
    """Raise InputError where a path to write to leads to a folder, a pipe or a device."""
    if os.path.isdir(path):
        raise InputError(f"cannot write {path}: it is a folder; choose another name")
    refuse_special_file(path, "choose another name to write to")


def _create_folder(folder: Path) -> list[Path]:
    """Create a folder and those above it; return those that were missing, outermost first."""
    missing = [each for each in (folder, *folder.parents) if not os.path.exists(each)]
    for each in reversed(missing):
        each.mkdir(exist_ok=True)
    return missing[::-1]


def _remove_empty(folders: Sequence[Path]) -> None:
    """Remove folders, which are listed outermost first, as far as nothing is in them."""
    for folder in reversed(folders):
        with contextlib.suppress(OSError):
            folder.rmdir()


@contextlib.contextmanager
def claim(
    files: Iterable[tuple[str, Path]], say: Callable[[str], None]
) -> Iterator[None]:
    """Hold files against other runs while the block runs; refuse those that no run wrote.

    It encloses all of a run, so that a run which could not write its files does not begin. Folders
    that the files need are created, and removed again where they stay empty.

    Args:
        files: (option that has the file written, its path). Of what goes to the folder of results
            the whole folder is held, as runs remove files there, too, and what is written there is
            recorded; of others the file alone is held, and nothing is left beside it.
        say: takes a sentence on each file that was kept by another name, when the block has ended.

    Raises:
        InputError: a file cannot be written, is no run's, or another run is about to write there.
    """
    listed = [*files]
    folders = {path.parent for option, path in listed if option == FOLDER_OPTION}
    targets = dict.fromkeys(folders, FOLDER_OPTION)
    for option, path in listed:
        if path.parent not in folders:
            targets[path] = option
    created: list[Path] = []
    with contextlib.ExitStack() as stack:
        stack.callback(_remove_empty, created)
        for target, option in targets.items():
            folder = target if target in folders else target.parent
            require_writable(folder)
            with _refusals_as_input_errors(folder):
                created += _create_folder(folder)
            stack.enter_context(hold(target, option))
            stack.enter_context(_said_of_kept(folder, say))
            if target in folders:
                stack.enter_context(_recorded(folder))
        for option, path in listed:
            _refuse_no_file(path)
            if not is_replaceable(path):
                raise InputError(
                    f"{_writer(option)} would replace {path}, which no run wrote, or which was "
                    "changed since; choose another, or move that file away"
                )
        yield


@contextlib.contextmanager
def _said_of_kept(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Say which files of a folder the block has kept by other names, in one sentence."""
    before = set(os.listdir(folder))
    try:
        yield
    finally:
        kept = sorted(filter(_KEPT.search, set(os.listdir(folder)) - before))
        if kept:
            say(
                f"what was in {folder} has the marks of this program, but no record says whether "
                f"it was changed since; it was kept as {', '.join(kept)}"
            )


@contextlib.contextmanager
def _recorded(folder: Path) -> Iterator[None]:
    """Let what the block writes to a folder be recorded there; without any, no record stays."""
    record = folder / RECORD_NAME
    if not os.path.lexists(record):
        with _refusals_as_input_errors(record):
            _write_record(record, {})
    try:
        yield
    finally:
        if not _recorded_files(folder):
            with contextlib.suppress(OSError):
                record.unlink()


def _remove_result(path: Path) -> None:
    """Remove a file that a run wrote; one that is known by its marks alone gets another name."""
    if is_marked(path):
        _keep(path)
    elif is_of_run(path):
        with _refusals_as_input_errors(path):
            path.unlink(missing_ok=True)


def _keep(path: Path) -> None:
    """Give a file another name, which no file has, beside its own."""
    old = path.with_name(f"{path.name}.old")
    number = 1
    while os.path.lexists(old):
        number += 1
        old = path.with_name(f"{path.name}.old{number}")
    with _refusals_as_input_errors(path):
        os.replace(path, old)


@contextlib.contextmanager
def hold(path: Path, option: str) -> Iterator[None]:
    """Hold the lock of a file or folder; InputError, with its process, where another run does."""
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(path))
        except BlockingIOError as error:
            raise InputError(
                f"{_writer(option)} would write to {path}, and another run, process {error}, is "
                "writing there; wait until it has ended, or choose another"
            ) from None
        yield


def _writer(option: str) -> str:
    """Return what an error names as the writer of a file: an option, or in Python ``save``."""
    return "save" if option == FOLDER_OPTION and is_for_python() else option


def is_replaceable(path: Path) -> bool:
    """Return whether a run may write a file to a path: nothing a person has is there.

    That is no file, an empty one, or one that a run wrote; by its marks alone that is kept.
    """
    try:
        info = os.lstat(path)
    except OSError:
        return True
    is_empty = stat.S_ISREG(info.st_mode) and info.st_size == 0
    return is_empty or is_of_run(path) or is_marked(path)


def is_marked(path: Path) -> bool:
    """Return whether a file without an entry in a record has marks of this program.

    They do not show whether a person has changed it since. One that a record knows otherwise was
    changed, and a link is a person's.
    """
    try:
        is_file = stat.S_ISREG(os.lstat(path).st_mode)
        if not is_file or _recorded_files(path.parent).get(path.name):
            return False
        with open(path, "rb") as file:
            beginning = file.read(_PIECE)
            file.seek(max(file.tell(), os.fstat(file.fileno()).st_size - _PIECE))
            return any(map(_MARKS.search, (beginning, file.read())))
    except OSError:
        return False


def is_of_run(path: Path) -> bool:
    """Return whether a run wrote a file, and nobody has changed it since.

    A link is a person's, whatever it leads to.
    """
    entries = _recorded_files(path.parent).get(path.name, [])
    # Only a file of such a size is read.
    sizes = [entry.get("bytes") for entry in entries]
    try:
        info = os.lstat(path)
    except OSError:
        return False
    is_file = stat.S_ISREG(info.st_mode) and info.st_size in sizes
    return is_file and _entry_of(path) in entries


def _entry_of(path: Path) -> dict[str, Any] | None:
    """Return what a record says of a file; None where it cannot be read."""
    try:
        return {"bytes": os.stat(path).st_size, "sha256": file_sha256(path)}
    except OSError:
        return None


def _recorded_files(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return name to entries of the files that runs wrote to a folder.

    Nothing where there is no record, or none that can be read: all files are then taken for a
    person's.
    """
    record = folder / RECORD_NAME
    if not os.path.isfile(record):  # reading a pipe would never end
        return {}
    try:
        content = json.loads(record.read_text(encoding="utf-8"))
        files = content["files"].items()
        return {
            name: [entry for entry in entries if isinstance(entry, dict)]
            for name, entries in files
        }
    except (
        OSError,
        ValueError,
        RecursionError,
        LookupError,
        TypeError,
        AttributeError,
    ):
        return {}


def _record_drafts(drafts: Mapping[Path, Path]) -> None:
    """Add drafts, by their final paths, to the records of their folders, where there are some."""
    folders: dict[Path, dict[Path, Path]] = {}
    for path, draft in drafts.items():
        folders.setdefault(path.parent, {})[path] = draft
    for folder, drafts_there in folders.items():
        record = folder / RECORD_NAME
        if not os.path.lexists(record):
            continue
        with contextlib.ExitStack() as stack, _refusals_as_input_errors(record):
            # Another run may write another file of this folder.
            with contextlib.suppress(BlockingIOError):
                stack.enter_context(locked(record, _RECORD_PATIENCE))
            _write_record(record, drafts_there)


def _write_record(record: Path, drafts: Mapping[Path, Path]) -> None:
    """Add drafts to the record of their folder; what is no longer there leaves it.

    A file that a draft is to replace stays in the record beside it.
    """
    files = {
        name: entries
        for name, entries in _recorded_files(record.parent).items()
        if os.path.lexists(record.with_name(name))
    }
    for path, draft in drafts.items():
        old = _entry_of(path)
        entries = [entry for entry in files.get(path.name, []) if entry == old]
        new = _entry_of(draft)
        if new is not None and new not in entries:
            entries.append(new)
        files[path.name] = entries
    new_record, lock = new_draft(record)
    try:
        text = json_text({"about": _ABOUT_RECORD, "files": files})
        new_record.write_text(text, encoding="utf-8")
        os.replace(new_record, record)
    finally:
        new_record.unlink(missing_ok=True)
        os.close(lock)


def require_writable(folder: Path) -> None:
    """Raise InputError where files could not be written to a folder, which is not created.

    For use before a long computation whose results are to be written there.
    """
    require_utf8(folder)
    absolute = folder.absolute()
    # Path.exists fails where a folder above cannot be entered, or a name is too long.
    existing = next(f for f in (absolute, *absolute.parents) if os.path.lexists(f))
    if not (os.path.isdir(existing) and os.access(existing, os.W_OK | os.X_OK)):
        raise InputError(
            f"cannot write to {folder}: {existing} is not a folder that may be written to; "
            "choose another folder"
        )


def refuse_overwriting(
    read_paths: Iterable[Path | None], written_paths: Iterable[tuple[str, Path]]
) -> None:
    """Raise InputError where a written file would replace a file that is read or written too.

    Args:
        read_paths: files that are read; None is skipped.
        written_paths: (option that has the file written, its path).
    """
    uses = {}
    for read_path in read_paths:
        if read_path is not None:
            uses[_real_path(read_path)] = "a file that is read"
    for option, path in written_paths:
        real_path = _real_path(path)
        if real_path in uses:
            raise InputError(
                f"{option} would overwrite {uses[real_path]}: {path}; choose another"
            )
        uses[real_path] = f"what {option} writes"


def _real_path(path: Path) -> str:
    """Return the path of a file, links followed; InputError for a text that is no path."""
    try:
        # Not every Python's realpath looks for a character zero.
        if "\0" in str(path):
            raise ValueError("embedded null character")
        return os.path.realpath(path)
    except ValueError as error:
        raise InputError(
            f"{str(path)!r:.60} is no path: {error}; give another"
        ) from None


def require_utf8(path: Path) -> None:
    """Raise InputError where a path has no UTF-8 form, which MuJoCo and JSON need."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"the path {path} cannot be written as UTF-8; rename it, or use a UTF-8 locale"
        ) from None


@contextlib.contextmanager
def _refusals_as_input_errors(path: Path) -> Iterator[None]:
    """Raise InputError, with one line on ``path``, where the system refuses to write it."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {path}: {error_text(error)}; choose another folder"
        ) from None


def json_text(content: Mapping[str, Any]) -> str:
    """Return strict JSON text: arrays as lists, numbers that are not finite as null."""
    return json.dumps(strict_json(content), indent=2, allow_nan=False) + "\n"


def strict_json(value: Any) -> Any:
    """Return a value as strict JSON can hold it: records as dicts, enumerations by their values.

    Enumerations of strings are their strings. Numbers that are not finite become None. Fields that
    do not count in comparisons are left out.
    """
    if is_dataclass(value) and not isinstance(value, type):
        names = [entry.name for entry in fields(value) if entry.compare]
        return strict_json({name: getattr(value, name) for name in names})
    if isinstance(value, Mapping):
        return dict(zip(map(str, value), map(strict_json, value.values())))
    # An array or a number of NumPy.
    if hasattr(value, "tolist"):
        return strict_json(value.tolist())
    if isinstance(value, (list, tuple)):
        return list(map(strict_json, value))
    if isinstance(value, Enum):
        return str(value) if isinstance(value, str) else value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value
