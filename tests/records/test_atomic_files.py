"""Files appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from robot_sysid.errors import InputError
from robot_sysid.records import atomic_files as files
from robot_sysid.records.atomic_files import require_writable, whole_file, whole_files, write_whole


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


def test_a_rename_that_fails_half_way_brings_the_old_files_back(tmp_path, monkeypatch):
    (tmp_path / "a").write_text("old a")
    (tmp_path / "c").write_text("old c")
    replace = os.replace

    def refuse_c(source, target):
        if Path(target).name == "c" and not Path(source).name.endswith(".old"):
            raise PermissionError(13, "Permission denied", str(target))
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", refuse_c)
    refused = pytest.raises(InputError, match="cannot write .*c: Permission denied")
    with refused, whole_files() as outputs:
        for name in "abc":
            outputs.write(tmp_path / name, "new")
    assert everything_in(tmp_path) == {"a": "old a", "c": "old c"}


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
