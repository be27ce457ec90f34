"""A file appears complete or not at all, and the first file of a set never beside another set's."""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from rigs.files.model_files import LFS_POINTER, make_pipe
from rigs.files.places import ROOT
from rigs.files.recorded_files import as_run
from rigs.files.refusals import refused
from robot_sysid.errors import InputError
from robot_sysid.records.drafts import HIDDEN_PREFIX
from robot_sysid.records.file_access import (
    RECORD_NAME,
    atomic_files,
    is_replaceable,
    plan_settings,
    read_json,
    read_toml,
    refuse_overwriting,
    refuse_special_file,
    write_atomically,
)

NAMES = ("model.xml", "b.csv", "a.json")
"""Names of a set of files in the order of drafting: the first is moved into the folder last."""


def texts_in(folder: Path) -> dict[str, str]:
    """The text of each file of a folder by its name, but for the record of what runs wrote."""
    files = [path for path in folder.iterdir() if path.is_file()]
    return {path.name: path.read_text() for path in files if path.name != RECORD_NAME}


def write_set(folder, text):
    """Write the same text to all files of the set, all or none."""
    with atomic_files() as outputs:
        for name in NAMES:
            outputs.write(folder / name, text)


def watch_commit(observe, replace_attribute=setattr):
    """Call ``observe(count)`` before and after every step by which a commit changes a folder."""
    count = itertools.count(1)

    def wrap_step(step):
        def observed_step(*arguments, **options):
            observe(next(count))
            step(*arguments, **options)
            observe(next(count))

        return observed_step

    for name in ("replace", "unlink"):
        replace_attribute(os, name, wrap_step(getattr(os, name)))


@pytest.fixture
def old_set(tmp_path):
    """A folder with a complete set of files whose text is 'old'."""
    with as_run(tmp_path):
        write_set(tmp_path, "old")
    return tmp_path


@pytest.fixture
def instants(old_set, monkeypatch):
    """The numbers from 1 of the instants before and after each step of a commit."""
    with monkeypatch.context() as patch:
        counts = []

        def observe(count):
            assert_whole(old_set)
            counts.append(count)

        watch_commit(observe, patch.setattr)
        write_set(old_set, "new")
    assert texts_in(old_set) == dict.fromkeys(NAMES, "new")
    assert len(counts) >= 2 * len(NAMES)
    write_set(old_set, "old")
    return counts


def assert_whole(folder):
    """Every file is old or new, only the first may be missing, and it is there only where all
    files are of its set."""
    texts = {n: text for n, text in texts_in(folder).items() if n in NAMES}
    assert set(texts.values()) <= {"old", "new"} and {*NAMES[1:]} <= set(texts)
    assert NAMES[0] not in texts or len(set(texts.values())) == 1


def test_an_error_at_any_instant_leaves_whole_files_and_nothing_else(
    old_set, instants, monkeypatch
):
    full_disk = OSError(errno.ENOSPC, "No space left on device")
    for problem in (KeyboardInterrupt, full_disk):
        for instant in instants:

            def interrupt(count, instant=instant, problem=problem):
                if count == instant:
                    raise problem

            interruption = contextlib.suppress(KeyboardInterrupt, InputError)
            with monkeypatch.context() as patch, interruption:
                watch_commit(interrupt, patch.setattr)
                write_set(old_set, "new")
            assert_whole(old_set)
            left = set(texts_in(old_set)) - set(NAMES)
            # A system that removes no file leaves that of a lock which nobody holds.
            assert all(name.startswith(f"{HIDDEN_PREFIX}lock-") for name in left)
            write_set(old_set, "old")


@pytest.mark.skipif(os.name == "nt", reason="signals cannot be held back")
def test_a_signal_at_any_instant_waits_for_the_whole_new_set(
    old_set, instants, monkeypatch
):
    for instant in instants:

        def send(count, instant=instant):
            if count == instant:
                signal.raise_signal(signal.SIGINT)

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            watch_commit(send, patch.setattr)
            write_set(old_set, "new")
        assert texts_in(old_set) == dict.fromkeys(NAMES, "new")
        write_set(old_set, "old")


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL here")
def test_a_process_that_is_killed_leaves_whole_files_and_keeps_no_folder(old_set):
    code = (
        "import os, signal; from pathlib import Path; from tests.records import test_file_access\n"
        "test_file_access.watch_commit(lambda n: n == 4 and os.kill(os.getpid(), signal.SIGKILL))\n"
        "test_file_access.write_set(Path.cwd(), 'new')"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    killed = subprocess.run([sys.executable, "-c", code], cwd=old_set, env=environment)
    assert killed.returncode == -signal.SIGKILL
    assert_whole(old_set)
    write_set(old_set, "new")
    assert {name: texts_in(old_set)[name] for name in NAMES} == dict.fromkeys(
        NAMES, "new"
    )


def test_a_failed_group_leaves_nothing_not_even_its_folder(tmp_path):
    with pytest.raises(KeyboardInterrupt), atomic_files() as outputs:
        outputs.write(tmp_path / "new" / "deep" / "a.txt", "a")
        outputs.write(tmp_path / "b.txt", b"b")
        raise KeyboardInterrupt
    full = refused("cannot write .*: No space left on device")
    with (
        full,
        atomic_files() as outputs,
        outputs.open(tmp_path / "new" / "a.csv") as file,
    ):
        file.write("begun")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_a_draft_can_be_read_before_and_withdrawn(tmp_path):
    with atomic_files() as outputs:
        draft = outputs.write(tmp_path / "out" / "model.xml", "<a/>")
        assert (draft.read_text(), draft.suffix) == ("<a/>", ".xml")
        outputs.write(tmp_path / "out" / "b", "{}")
        outputs.withdraw(tmp_path / "out" / "model.xml")
    assert texts_in(tmp_path / "out") == {"b": "{}"}


@pytest.mark.parametrize("fails", [False, True])
def test_what_is_to_go_goes_last_and_only_where_nothing_fails(
    tmp_path, monkeypatch, fails
):
    old_files = {"a": "old", "gone": "old"}
    with as_run(tmp_path):
        for name, text in old_files.items():
            write_atomically(tmp_path / name, text)
    contents = []
    unlink = Path.unlink

    def unlink_and_record(path, **options):
        if path.name == "gone":
            contents.append((tmp_path / "a").read_text())
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", unlink_and_record)
    with contextlib.suppress(ZeroDivisionError), atomic_files() as outputs:
        outputs.write(tmp_path / "a", "new")
        outputs.remove(tmp_path / "gone")
        if fails:
            raise ZeroDivisionError
    assert texts_in(tmp_path) == (old_files if fails else {"a": "new"})
    assert contents == [] if fails else ["new"]


def test_a_path_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.txt", tmp_path):
        with refused() as caught:
            write_atomically(path, "x")
        assert str(path) in str(caught.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    assert plan_settings(tmp_path) == {}
    path = tmp_path / "trajectory.toml"
    with refused("cannot read"):
        read_toml(path)
    path.write_text("path = ")
    with refused("cannot read .*trajectory.toml: "):
        read_toml(path)
    # A next step is made of it after a run, whose own words are to be read.
    assert plan_settings(tmp_path) == {}


@pytest.mark.parametrize(
    "text",
    [
        None,
        b"{",
        b"[" * 100_000,
        b"[" * 100 + b"]" * 100,
        b"\xff",
        b"",
        b"9" * 100_000 + b"x",
        b'["a\\u0000"]',
        b'{"a\\u0000": 1}',
    ],
)
def test_what_is_no_json_is_refused_in_one_line(tmp_path, text):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_bytes(text)
    with refused("cannot read .*a.json: .*; do this"):
        read_json(path, "do this")


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "a = " + "[" * 100 + "]" * 100,
        "a = " + "{a = " * 100_000,
        "a." * 100_000 + "a = 1",
        "[" + "a." * 100_000 + "a]",
        "a = {" + "a." * 100_000 + "a = 1}",
        'a = "b\\u0000"',
    ],
)
def test_toml_without_end_or_with_a_character_zero_is_refused_in_one_line(
    tmp_path, text
):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with refused("cannot read .*a.toml: "):
        read_toml(path)


def test_a_path_of_many_folders_up_is_a_text_of_toml(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(f'a = "{"../" * 60}"')
    assert read_toml(path) == {"a": "../" * 60}


def test_an_integer_beyond_all_floats_is_infinite(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("\ufeff[1" + "0" * 400 + ', 3, {"a": null}]', encoding="utf-8")
    assert read_json(path, "") == [math.inf, 3, {"a": None}]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_text_of_windows_is_read(tmp_path, encoding):
    path = tmp_path / "options.toml"
    path.write_bytes('joint = "Gelenk β"\r\n'.encode(encoding))
    assert read_toml(path) == {"joint": "Gelenk β"}


def test_a_record_that_is_a_pipe_is_not_waited_for(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("mine")
    make_pipe(tmp_path / RECORD_NAME)
    assert not is_replaceable(path)


def test_files_folders_and_what_is_not_there_are_left_alone(tmp_path):
    (tmp_path / "a").touch()
    for path in (
        tmp_path,
        tmp_path / "a",
        tmp_path / "b",
        str(tmp_path),
        "a" * 5000,
        "a\0",
    ):
        refuse_special_file(path)


def test_a_device_is_neither_read_nor_replaced(tmp_path):
    pipe = make_pipe(tmp_path / "pipe")
    (tmp_path / "null").symlink_to(os.devnull)
    for path in (pipe, tmp_path / "null"):
        with refused("is a pipe or a device; do this"):
            read_json(path, "do this")
        with refused("is a pipe or a device; choose another name"):
            write_atomically(path, "content")
    assert not (tmp_path / "null").is_file() and pipe.is_fifo()


def test_a_pointer_of_lfs_is_no_file_to_read(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(LFS_POINTER.replace("\n", "\r\n").encode())
    for read in (read_toml, partial(read_json, remedy="do this")):
        with refused("a is a pointer of Git LFS.*git lfs pull"):
            read(path)


def test_a_text_with_a_character_zero_is_no_path():
    for paths in (([Path("a\0")], []), ([], [("--output-dir", Path("a\0"))])):
        with refused("'a.x00' is no path"):
            refuse_overwriting(*paths)
