"""Files appear whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from robot_sysid.errors import InputError
from robot_sysid.interrupts import STOPPING
from robot_sysid.records import atomic_files as files
from robot_sysid.records.atomic_files import (
    LOCK_NAME,
    PREFIX,
    STALE,
    draft_folder,
    only_run_in,
    refuse_overwriting,
    require_writable,
    temporary_folder,
    whole_file,
    whole_files,
    write_whole,
)
from tests.support import watched_writing
from tests.support.places import ROOT
from tests.support.watched_writing import LAST, NAMES, NEW, watch, write_new, write_old


def everything_in(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file()}


def test_a_file_appears_when_the_block_ends(tmp_path):
    with whole_file(tmp_path / "a.csv") as file:
        file.write("1\n")
        assert not (tmp_path / "a.csv").exists()
    assert everything_in(tmp_path) == {"a.csv": "1\n"}


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    (tmp_path / "a.csv").write_text("old")
    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / "a.csv") as file:
        file.write("half")
        raise ZeroDivisionError
    assert everything_in(tmp_path) == {"a.csv": "old"}


@pytest.mark.parametrize("problem", [KeyboardInterrupt, RuntimeError])
def test_a_failed_group_leaves_nothing_not_even_its_folder(tmp_path, problem):
    with pytest.raises(problem), whole_files() as outputs:
        outputs.write(tmp_path / "new" / "deep" / "a.txt", "a")
        outputs.write(tmp_path / "b.txt", b"b")
        raise problem
    assert list(tmp_path.iterdir()) == []


def test_a_group_appears_together_and_drafts_can_be_read_before(tmp_path):
    with whole_files() as outputs:
        draft = outputs.write(tmp_path / "out" / "model.xml", "<a/>")
        assert (draft.read_text(), draft.suffix) == ("<a/>", ".xml")
        outputs.write(tmp_path / "out" / "params.json", "{}")
    assert everything_in(tmp_path / "out") == {"model.xml": "<a/>", "params.json": "{}"}


@pytest.mark.parametrize("refused", "abc")
def test_what_cannot_be_renamed_leaves_no_first_file_beside_other_sets(
    tmp_path, monkeypatch, refused
):
    before = {name: f"old {name}" for name in "abc"}
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    replace = os.replace

    def refuse(source, target):
        if Path(target).name == refused:
            raise PermissionError(13, "Permission denied", str(target))
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", refuse)
    complaint = pytest.raises(InputError, match=f"cannot write .*{refused}: Permission denied")
    with complaint, whole_files() as outputs:
        for name in "abc":
            outputs.write(tmp_path / name, "new")
    # The last one takes its place first.
    assert everything_in(tmp_path) == {n: "new" if n > refused else before[n] for n in "bc"}


def test_a_path_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a.txt", tmp_path):
        with pytest.raises(InputError) as caught:
            write_whole(path, "x")
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_user_decides_who_may_read_the_file(tmp_path):
    mask = os.umask(0o022)
    try:
        write_whole(tmp_path / "a", "x")
    finally:
        os.umask(mask)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o644


def test_a_working_folder_that_is_gone_is_one_line(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(InputError, match="current folder no longer exists"):
        require_writable(Path("out"))


def test_paths_in_a_working_folder_that_is_gone_are_one_line(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    refuse_overwriting([tmp_path / "read"], [("--output", tmp_path / "written")])
    for read, written in ((Path("read"), tmp_path), (tmp_path, Path("written"))):
        with pytest.raises(InputError, match="current folder no longer exists"):
            refuse_overwriting([read], [("--output", written)])


@pytest.mark.parametrize("inside", ["", "sub/deep"])
def test_a_link_that_leads_nowhere_is_no_folder_to_write_to(tmp_path, inside):
    link = tmp_path / "link"
    for target in ("nowhere/at/all", "link"):
        link.symlink_to(target)
        with pytest.raises(InputError, match="link is a link that leads nowhere"):
            require_writable(link / inside)
        link.unlink()
    link.symlink_to(tmp_path)
    require_writable(link / inside)


@pytest.mark.parametrize("letter", ["n", "ö", "名", "🤖"])
@pytest.mark.parametrize("suffix", [".json", "", ".{}"])
def test_a_name_may_be_as_long_as_the_system_lets_it(tmp_path, letter, suffix):
    """The draft of a file has a name that is never too long."""
    free = 255 - len(suffix.format("")) - 2
    name = "a" + letter * (free // len(letter.encode()) // (2 if "{}" in suffix else 1))
    name += suffix.format(letter * (free // len(letter.encode()) // 2))
    for content in ("old", "new"):
        write_whole(tmp_path / name, content)
        assert everything_in(tmp_path) == {name: content}


def test_where_no_temporary_folder_can_be_made_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(InputError, match="No such file or directory; set TMPDIR") as caught:
        temporary_folder().__enter__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fails", [False, True])
def test_what_is_to_go_goes_last_and_only_where_nothing_fails(tmp_path, monkeypatch, fails):
    before = {"a": "old", "gone": "old"}
    for name, text in before.items():
        (tmp_path / name).write_text(text)
    seen, unlink = [], Path.unlink

    def watched(path, **options):
        if path.name == "gone":
            seen.append((tmp_path / "a").read_text())
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", watched)
    with contextlib.suppress(ZeroDivisionError), whole_files() as outputs:
        outputs.write(tmp_path / "a", "new")
        outputs.remove(tmp_path / "gone")
        if fails:
            raise ZeroDivisionError
    assert everything_in(tmp_path) == (before if fails else {"a": "new"})
    assert seen == [] if fails else ["new"]


@pytest.fixture
def old_set(tmp_path):
    write_old(tmp_path)
    return tmp_path


def instants(monkeypatch, folder):
    """Return how many instants there are in a commit, and leave the old set."""
    with monkeypatch.context() as patch:
        seen = watch(lambda count: None, patch.setattr)
        write_new(folder)
    write_old(folder)
    return seen[0]


def assert_whole(folder):
    """Every file is there, old or new, and the last one only where all are of its set."""
    found = {name: (folder / name).read_text() for name in NAMES if (folder / name).exists()}
    assert set(found.values()) <= {"old", "new"} and set(NAMES) - set(found) <= {LAST}
    assert LAST not in found or len(set(found.values())) == 1


def test_at_every_instant_of_a_replacement_every_file_is_whole(old_set, monkeypatch):
    watched = watch(lambda _: assert_whole(old_set), monkeypatch.setattr)
    write_new(old_set)
    assert watched[0] >= 2 * len(NAMES)
    assert everything_in(old_set) == NEW


def test_an_error_at_any_instant_leaves_whole_files_and_nothing_else(old_set, monkeypatch):
    for instant in range(1, instants(monkeypatch, old_set) + 1):

        def interrupt(count, instant=instant):
            if count == instant:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            watch(interrupt, patch.setattr)
            write_new(old_set)
        assert_whole(old_set)
        assert set(everything_in(old_set)) <= set(NAMES)
        write_old(old_set)


@pytest.mark.skipif(os.name == "nt", reason="signals cannot be held back")
@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_at_any_instant_waits_for_the_whole_new_set(old_set, monkeypatch, number):
    def stop(*_):
        raise KeyboardInterrupt

    usual = signal.signal(number, stop)
    try:
        for instant in range(1, instants(monkeypatch, old_set) + 1):

            def send(count, instant=instant):
                if count == instant:
                    signal.raise_signal(number)

            with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
                watch(send, patch.setattr)
                write_new(old_set)
            assert everything_in(old_set) == NEW
            write_old(old_set)
    finally:
        signal.signal(number, usual)


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL here")
def test_a_process_that_is_killed_leaves_whole_files(old_set, monkeypatch):
    processes, script = {}, [sys.executable, "-m", watched_writing.__name__]
    for instant in range(1, instants(monkeypatch, old_set) + 1, 2):
        folder = old_set.parent / "killed" / str(instant)
        shutil.copytree(old_set, folder)
        processes[folder] = subprocess.Popen([*script, str(folder), str(instant)], cwd=ROOT)
    for folder, process in processes.items():
        assert process.wait() == -signal.SIGKILL
        assert_whole(folder)
        write_new(folder)
        seen = everything_in(folder)
        assert {name: seen.pop(name) for name in NAMES} == NEW
        assert all(name.startswith(PREFIX) for name in seen)


def test_only_one_run_at_a_time_has_a_folder(tmp_path):
    folder = tmp_path / "new" / "out"
    with only_run_in(folder):
        assert folder.is_dir()
        with pytest.raises(InputError) as caught, only_run_in(folder):
            raise AssertionError("two at once")
        assert "another run is writing to" in str(caught.value) and "\n" not in str(caught.value)
        (folder / "result").write_text("")
    assert everything_in(folder) == {"result": ""}
    with only_run_in(folder):
        pass


@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL here")
def test_a_run_that_was_killed_does_not_keep_the_folder(tmp_path):
    code = (
        "import os, signal; from pathlib import Path\n"
        "from robot_sysid.records.atomic_files import only_run_in\n"
        "with only_run_in(Path('out')): os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False)
    assert killed.returncode == -signal.SIGKILL
    with only_run_in(tmp_path / "out"):
        pass
    assert everything_in(tmp_path / "out") == {}


def test_a_run_that_fails_leaves_no_folder(tmp_path):
    with pytest.raises(ZeroDivisionError), only_run_in(tmp_path / "new" / "out"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_was_removed_while_it_was_taken_does_not_count(tmp_path, monkeypatch):
    take, taken = files._has_lock, []

    def take_late(handle):
        """The other run ends between opening the file and locking it."""
        if not taken:
            (tmp_path / LOCK_NAME).unlink()
        taken.append(handle)
        return take(handle)

    monkeypatch.setattr(files, "_has_lock", take_late)
    with only_run_in(tmp_path):
        assert len(taken) == 2
        assert os.path.samestat(os.fstat(taken[-1]), os.stat(tmp_path / LOCK_NAME))


@pytest.mark.skipif(os.name == "nt", reason="another kind of lock")
def test_a_file_system_without_locks_is_no_obstacle(tmp_path, monkeypatch):
    import fcntl

    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    with only_run_in(tmp_path):
        pass


def test_a_disk_that_fills_up_is_one_line_and_leaves_nothing(tmp_path):
    def fill(file):
        file.write("begun")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    full = pytest.raises(InputError, match="cannot write .*: No space left on device")
    with full, whole_files() as outputs, outputs.open(tmp_path / "new" / "a.csv") as file:
        fill(file)
    assert list(tmp_path.iterdir()) == []


def test_what_killed_processes_left_goes_after_a_day(tmp_path, monkeypatch):
    draft, folder = tmp_path / f"{PREFIX}0123abcd.a.json", tmp_path / f"{PREFIX}89abcdef.bundle"
    others = (f"{PREFIX}mine.json", f"{PREFIX}0123abcd", ".a-0123abcd.json", LOCK_NAME)
    for path in (draft, *(tmp_path / name for name in others)):
        path.touch()
    (folder / "assets").mkdir(parents=True)
    now = files.time.time()
    for later, left in ((0.9 * STALE, {draft, folder}), (1.1 * STALE, set())):
        monkeypatch.setattr(files.time, "time", lambda later=later: now + later)
        write_whole(tmp_path / f"{later}.json", "new")
        assert {path for path in (draft, folder) if path.exists()} == left
    assert set(others) < set(everything_in(tmp_path))


@pytest.mark.parametrize("made", ["touch", "mkdir"])
def test_an_interrupt_while_a_draft_is_made_leaves_none(tmp_path, monkeypatch, made):
    make = getattr(Path, made)

    def interrupted(path, **options):
        make(path, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, made, interrupted)
    with pytest.raises(KeyboardInterrupt):
        if made == "touch":
            write_whole(tmp_path / "a.json", "new")
        else:
            draft_folder(tmp_path / "kinova").__enter__()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_is_there_in_the_block_and_may_be_renamed(tmp_path):
    with draft_folder(tmp_path / "kinova") as draft:
        (draft / "a").touch()
        os.rename(draft, tmp_path / "kinova")
    with pytest.raises(ZeroDivisionError), draft_folder(tmp_path / "other") as draft:
        (draft / "a").touch()
        raise ZeroDivisionError
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("a")] == [Path("kinova/a")]
    assert [path.name for path in tmp_path.iterdir()] == ["kinova"]
