"""What a killed run left is removed by the next one; nothing of a living one, nothing of others."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rigs.files.other_process import running
from rigs.files.recorded_files import as_run
from robot_sysid.records.drafts import new_draft, remove_leftovers, temporary_folder
from robot_sysid.records.file_access import RECORD_NAME, write_atomically

pytest.importorskip("fcntl", reason="needs the locks of a Unix system")
WAITING = """
import sys, time
from pathlib import Path
from robot_sysid.records.drafts import new_draft, temporary_folder

with temporary_folder(Path.cwd()) as folder:
    (folder / "inside").touch()
    new_draft(Path.cwd() / "model.xml")
    print("ready", flush=True)
    time.sleep(60)
"""
FOREIGN = (
    ".robot-sysid-notes",
    ".robot-sysid-0123456789abcdefg",
    "robot-sysid-0123456789abcdef",
    ".robot-sysid-0123456789abcdef0.xml",
    "model.xml",
)
"""Names that are no draft's."""


@pytest.fixture
def other_run(tmp_path):
    """Another run in the folder, which has a draft and a folder there."""
    with running(WAITING, folder=tmp_path) as process:
        yield process


def hidden(folder):
    """The hidden files and folders in a folder, but for the record of what runs wrote."""
    paths = [path for path in folder.iterdir() if path.name.startswith(".")]
    return [path for path in paths if path.name != RECORD_NAME]


def test_of_a_living_run_all_stays_and_of_a_killed_one_nothing(tmp_path, other_run):
    with as_run(tmp_path):
        write_atomically(tmp_path / "a", "a")
    assert len(hidden(tmp_path)) == 2
    other_run.send_signal(signal.SIGKILL)
    other_run.wait()
    assert len(hidden(tmp_path)) == 2
    write_atomically(tmp_path / "a", "a")
    assert {path.name for path in tmp_path.iterdir()} == {"a", RECORD_NAME}


def test_a_scratch_folder_removes_what_lies_beside_it(tmp_path, other_run):
    other_run.send_signal(signal.SIGKILL)
    other_run.wait()
    with temporary_folder(tmp_path) as folder:
        assert hidden(tmp_path) == [folder]
    assert hidden(tmp_path) == []


def test_own_drafts_links_and_what_others_call_alike_stay(tmp_path):
    for name in FOREIGN:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".robot-sysid-0123456789abcdef.xml").symlink_to(tmp_path / "model.xml")
    os.mkfifo(tmp_path / ".robot-sysid-0123456789abcdee")
    draft, lock = new_draft(tmp_path / f"m.{60 * 'x'}")
    before = sorted(tmp_path.iterdir())
    remove_leftovers(tmp_path)
    remove_leftovers(tmp_path / "no folder")
    assert sorted(tmp_path.iterdir()) == before
    os.close(lock)
    remove_leftovers(tmp_path)
    assert {*before} - {*tmp_path.iterdir()} == {draft}
    assert len(draft.name) < 60 and Path(draft).parent == tmp_path
