"""Drafts of a process that ended go with the next one; those of a living process stay."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys

import pytest

from robot_sysid import drafts
from robot_sysid.drafts import PREFIX, Drafts, draft_folder, remove_stale
from robot_sysid.records.atomic_files import write_whole
from tests.support.places import ROOT

pytestmark = pytest.mark.skipif(os.name == "nt", reason="drafts are not locked here")
WRITER = """
import sys
from pathlib import Path
from robot_sysid.drafts import Drafts
mine = Drafts()
mine.file(Path("a.json"))
mine.folder(Path("bundle"))
mine.second_name(Path("kept.json"))
print("ready", flush=True)
sys.stdin.read()
"""


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def writer(tmp_path):
    """Another process that holds a draft of each kind."""
    (tmp_path / "kept.json").write_text("old")
    call = [sys.executable, "-c", WRITER]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    settings = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(call, cwd=tmp_path, env=settings, **pipes) as process:
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


def test_drafts_of_a_living_process_stay_and_of_a_killed_one_go(tmp_path, writer):
    before = names_in(tmp_path)
    assert len(before) == 4
    mine = Drafts()
    draft = mine.file(tmp_path / "a.json")
    assert names_in(tmp_path) == sorted([*before, draft.name])
    writer.kill()
    writer.wait()
    remove_stale(tmp_path)
    assert names_in(tmp_path) == sorted([draft.name, "kept.json"])
    mine.close()
    Drafts().file(tmp_path / "b.json")
    assert not draft.exists()
    assert (tmp_path / "kept.json").read_text() == "old"


def test_a_copy_stands_for_a_second_name_where_there_are_no_links(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path, mine = tmp_path / "a.json", Drafts()
    path.write_text("old")
    second = mine.second_name(path)
    path.write_text("new")
    remove_stale(tmp_path)
    assert second.read_text() == "old"
    mine.close()
    remove_stale(tmp_path)
    assert names_in(tmp_path) == ["a.json"]


def test_what_is_not_ours_stays(tmp_path):
    names = (".robot-sysid.lock", f"{PREFIX}mine.json", f"{PREFIX}0123abcd", ".a-0123abcd.json")
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / f"{PREFIX}0123abcd.link").symlink_to(tmp_path / names[0])
    os.mkfifo(tmp_path / f"{PREFIX}0123abcd.pipe")
    before = names_in(tmp_path)
    remove_stale(tmp_path)
    assert names_in(tmp_path) == before


def test_where_locks_are_unknown_no_draft_counts_as_stale(tmp_path, monkeypatch):
    import fcntl

    def unsupported(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    for _ in range(2):
        mine = Drafts()
        mine.file(tmp_path / "a.json")
        mine.close()
    assert len(names_in(tmp_path)) == 2


def test_a_draft_that_is_taken_for_stale_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    lock, locked = drafts.has_lock, []

    def late(handle, *rest):
        if not locked:
            locked.append(handle)
            remove_stale(tmp_path)
            assert names_in(tmp_path) == []
        return lock(handle, *rest)

    monkeypatch.setattr(drafts, "has_lock", late)
    draft = Drafts().file(tmp_path / "a.json")
    assert names_in(tmp_path) == [draft.name]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_interrupt_while_a_draft_is_made_leaves_none(tmp_path, monkeypatch, kind):
    make = getattr(Drafts, kind)

    def interrupted(*arguments):
        draft = make(*arguments)
        signal.raise_signal(signal.SIGINT)
        return draft

    monkeypatch.setattr(Drafts, kind, interrupted)
    with pytest.raises(KeyboardInterrupt):
        if kind == "file":
            write_whole(tmp_path / "a.json", "new")
        else:
            draft_folder(tmp_path / "kinova").__enter__()
    assert names_in(tmp_path) == []


def test_a_folder_is_there_in_the_block_and_may_be_renamed(tmp_path):
    with draft_folder(tmp_path / "kinova") as draft:
        (draft / "a").touch()
        remove_stale(tmp_path)
        assert (draft / "a").is_file()
        os.rename(draft, tmp_path / "kinova")
    assert names_in(tmp_path) == ["kinova"]
    with pytest.raises(ZeroDivisionError), draft_folder(tmp_path / "other") as draft:
        shutil.copy(__file__, draft)
        raise ZeroDivisionError
    assert names_in(tmp_path) == ["kinova"]
