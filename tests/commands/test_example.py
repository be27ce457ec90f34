"""The example is a copy that its printed commands walk through."""

from __future__ import annotations

import fnmatch
import re
import shlex
from pathlib import Path

import pytest

from rigs.files.places import EXAMPLE, ROOT
from rigs.files.refusals import refused
from robot_sysid.cli import main
from robot_sysid.commands.example import source_folder


def printed_commands(out: str) -> list[list[str]]:
    return [
        shlex.split(line)
        for line in out.splitlines()
        if line.startswith("robot-sysid ")
    ]


@pytest.mark.slow
def test_it_copies_the_example_and_names_files_that_are_there(command, tmp_path):
    out = command.run("example kinova --output-dir", Path("a/b c")).out
    commands = printed_commands(out)
    assert commands[0] == ["robot-sysid", "a/b c/model/kinova_fullinertia_guess.xml"]
    assert [arguments[1] for arguments in commands[1:]] == ["identify", "payload"]
    named = [
        word
        for arguments in commands
        for word in arguments
        if re.search(r"\.(xml|csv)$", word)
    ]
    assert len(named) == 6 and all((tmp_path / name).is_file() for name in named)
    meshes = {path.name for path in (tmp_path / "a/b c/model/meshes").iterdir()}
    assert meshes == {path.name for path in (EXAMPLE / "model/meshes").iterdir()}


@pytest.mark.slow
def test_a_copy_that_ends_early_leaves_nothing(command, tmp_path, monkeypatch):
    def fail(draft, folder):
        assert (draft / "model").is_dir() and not folder.exists()
        raise KeyboardInterrupt

    monkeypatch.setattr("os.rename", fail)
    assert "no unfinished file is left" in command.refused("example kinova", code=130)


def test_nothing_that_is_there_is_overwritten(command, tmp_path):
    (tmp_path / "kinova").mkdir()
    assert "kinova exists; choose another folder" in command.refused("example kinova")
    assert "invalid choice: 'ur5'" in command.refused("example ur5")
    with refused("is not in this installation"):
        source_folder("kinova", tmp_path / "lib" / "robot_sysid")


def test_the_wheel_carries_every_file_of_the_model():
    patterns = re.findall(
        r'"(model/[^"]+)"', (ROOT / "setup.py").read_text(encoding="utf-8")
    )
    files = [path for path in (EXAMPLE / "model").rglob("*") if path.is_file()]
    names = [path.relative_to(EXAMPLE).as_posix() for path in files]
    assert [n for n in names if not any(fnmatch.fnmatch(n, p) for p in patterns)] == []


@pytest.mark.slow
def test_the_printed_commands_work_when_pasted(command):
    outputs = []
    for arguments in printed_commands(command.run("example kinova").out):
        assert main(arguments[1:]) == 0
        outputs.append(command._capsys.readouterr().out)
    assert "Mass: 0.789 kg" in outputs[0]
    # The true arm's link weighs 1.517 kg, the block in its grip 0.306 kg.
    mass, error = map(
        float, re.findall(r"  mass +[\d.]+ +([\d.]+) +([\d.]+)", outputs[1])[0]
    )
    assert abs(mass - 1.517) < error and error < 0.15 * mass
    mass, error = map(
        float, re.findall(r"  mass +([\d.]+) +([\d.]+)  kg", outputs[2])[0]
    )
    assert abs(mass - 0.306) < 3.0 * error and error < 0.1 * mass
