"""What a shell that asks is offered."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

ASKED = {
    "pa": {"payload "},
    "plan --excitation-t": {"--excitation-time-budget "},
    "plan --excitation ": {"sines", "optimal"},
    "motors ch": {"check "},
    "motors play t.csv --rec": {"--record "},
    "arm.xml --motor-t": {"--motor-type "},
    "arm": {"arm "},
    "identify arm.xml lo": {"log.csv "},
}


@pytest.mark.parametrize("typed", ASKED)
def test_commands_options_values_and_files_are_completed(typed, tmp_path):
    (tmp_path / "log.csv").touch()
    line, answer = f"robot-sysid {typed}", tmp_path / "answer"
    asking = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    asking.update(COMP_LINE=line, COMP_POINT=str(len(line)), _ARGCOMPLETE_IFS="\n")
    call = [sys.executable, "-m", "robot_sysid"]
    subprocess.run(call, cwd=tmp_path, env={**os.environ, **asking}, check=True)
    assert set(answer.read_text().splitlines()) == ASKED[typed]
