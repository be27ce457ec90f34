"""The day of docs/motors.md: each command of the page runs as printed, and prints the next one."""

from __future__ import annotations

import shlex

import pytest

from rigs.arms.walk import HASTE, commands_in
from rigs.motors.clocks import heard_signals
from rigs.motors.first_day import ARMS, Day, page_commands

SHORT = (*HASTE, "--duration", "6")
"""Options of a plan: what another motion is worth is the business of other tests."""
NO_KEYFRAME = "--to home"
"""What is refused of an arm whose model has no keyframe."""
CAUGHT = 3
"""Exit code of a float test of an arm that is not its model's."""


def words_of(line):
    """The words of a command, in an order that does not depend on who wrote it."""
    return sorted(shlex.split(line))


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", ARMS)
def test_every_command_of_the_page_runs_and_prints_the_next_one(
    name, tmp_path, monkeypatch
):
    arm = ARMS[name]
    if not arm.is_there:
        pytest.skip("needs the public models")
    monkeypatch.chdir(tmp_path)
    day = Day(arm, tmp_path)
    printed = []
    for heading, line, expected_code in page_commands(arm):
        with heard_signals():
            step = day.run(line, *(SHORT if " plan " in line else ()))
        codes = [expected_code]
        if NO_KEYFRAME in line and not isinstance(arm.model, str):
            codes = [2]
        if "--float" in line:
            codes.append(CAUGHT)
        assert step.code in codes, (line, step.output)
        # From the plan on each line of the day was printed before.
        if printed and heading[0].isdigit():
            assert words_of(line) in printed, (line, printed)
        if f"--model {arm.variables['ARM']}" in line or printed:
            printed += map(words_of, sum(commands_in(step.output), []))
