"""AGENTS.md and the skill tell coding agents the truth: their commands run, and end as they say."""

from __future__ import annotations

import json
import re

import pytest

from rigs.files.command_line import COMMANDS
from rigs.files.pages import blocks, command_lines, commands
from rigs.files.places import ROOT
from robot_sysid.cli import main
from robot_sysid.errors import EXIT_CODES

SKILL = ROOT / "skills" / "robot-sysid" / "SKILL.md"
PAGE = (ROOT / "AGENTS.md").read_text(encoding="utf-8")
FIVE = command_lines(re.search(r"<!-- commands -->\n```bash\n(.*?)```", PAGE, re.S)[1])
ROWS = re.findall(r"^\| (\d+) \|.*\| (?:`(robot-sysid .*)`)? ?\|$", PAGE, re.M)
EXAMPLES = {
    int(code): command_lines(line)[0] for code, line in ROWS if line.startswith("robot")
}


def test_every_exit_code_is_listed_and_every_option_exists():
    assert [int(code) for code, _ in ROWS] == list(EXIT_CODES)
    assert (len(FIVE), list(EXAMPLES)) == (5, [1, 2])
    for program, name, *arguments in (*FIVE, *EXAMPLES.values()):
        assert program == "robot-sysid"
        COMMANDS[name].parse(arguments)


@pytest.mark.slow
def test_the_commands_end_as_the_page_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in FIVE:
        assert main(words[1:]) == 0, words
        printed = capsys.readouterr().out
        if "--json" in words:
            json.loads(printed)
    for code, words in EXAMPLES.items():
        assert main(words[1:]) == code, words


def test_the_skill_is_one():
    """Agents choose a skill by its front matter, and read all of it."""
    text = SKILL.read_text(encoding="utf-8")
    _, front, body = text.split("---\n", 2)
    assert front.startswith("name: robot-sysid\ndescription: ")
    assert len(front) < 1000 and len(text.splitlines()) < 120
    listed = re.findall(r"^\| (\d+) \|", body, re.M)
    assert [int(code) for code in listed] == list(EXIT_CODES)
    assert all(len(line) <= 140 or "robot-sysid" in line for line in body.splitlines())


@pytest.mark.slow
def test_the_commands_of_the_skill_end_as_it_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = [line for _, block in blocks(SKILL) for line in commands(block)]
    assert len(lines) == 6
    for words, code in lines:
        assert main(words[1:]) == code, words
        printed = capsys.readouterr().out
        if "--json" in words:
            json.loads(printed)


@pytest.mark.slow
def test_its_example_of_params_has_the_keys_of_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words in (FIVE[0], FIVE[2]):
        assert main(words[1:]) == 0
    content = json.loads((tmp_path / "found/params.json").read_text())
    example = json.loads(re.search(r"```json\n(.*?)```", PAGE, re.S)[1])
    mass, row = content["quantities"][0], example["quantities"][0]
    assert set(example) <= set(content) and set(row) == set(mass)
    assert set(example["remarks"][0]) == set(content["remarks"][0])
    for key in ("status", "failure", "valid"):
        assert example[key] == content[key]
    for test in ("before", "after"):
        error = content["file"][test]["relative_error"]
        assert example["file"][test]["relative_error"] == pytest.approx(error, rel=0.05)


def test_the_citation_is_that_of_the_readme():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8").partition("@software")[2]
    title = re.search(r"title = \{(.*)\}", readme)[1]
    address = re.search(r"url = \{(.*)\}", readme)[1]
    assert f'title: "{title}"' in citation
    assert f"repository-code: {address}\n" in citation
