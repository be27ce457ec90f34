"""What a whole run does to the machine: files where it was told to, no network, no code of others.

Each kind of hostile file that docs/security.md lists is tested where it is read.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.arms import X, Y, Z, serial_arm
from tests.support.places import ROOT

WATCHED = """
import json, os, sys

seen = []
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = {"os.rename": 1, "os.link": 1, "os.symlink": 1, "os.mkdir": 0, "os.remove": 0}
REFUSED = ("socket.connect", "socket.bind", "socket.getaddrinfo", "urllib", "os.system", "pickle")

def watch(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)) and arguments[2] & WRITES:
        seen.append(("write", os.path.abspath(os.fsdecode(arguments[0]))))
    elif event in CHANGES:
        seen.append(("write", os.path.abspath(os.fsdecode(arguments[CHANGES[event]]))))
    elif event.startswith(REFUSED):
        seen.append((event, str(arguments)))

sys.addaudithook(watch)
from robot_sysid.cli import main

codes = [main(line.split()) for line in sys.argv[1:]]
print(json.dumps([codes, seen]))
"""
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2" actuatorfrcrange="-60 60"'
RATE = "--duration 6 --sample-rate 200 --seed 1"
LINES = (
    f"arm.xml {RATE} --plant-model arm.xml --noise-torque 0.01 --save-measurements out/log.csv "
    "--output-dir out --quiet",
    "identify arm.xml out/log.csv --bundle --report --output-dir out --quiet",
    f"plan arm.xml {RATE} --excitation sines --save-trajectory out/plan.json --output-dir out "
    "--quiet",
)


@pytest.mark.slow
def test_files_are_written_where_a_command_says_and_no_network_is_opened(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "arm.xml").write_text(serial_arm((Z, Y, X), joint=JOINT))
    home, temporary = tmp_path / "home", tmp_path / "temporary"
    home.mkdir()
    temporary.mkdir()
    cache, places = home / "cache", {"HOME": str(home), "TMPDIR": str(temporary)}
    settings = {"MPLCONFIGDIR": str(cache), "PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": str(ROOT)}
    call = [sys.executable, "-c", WATCHED, *LINES]
    done = subprocess.run(
        call, cwd=tmp_path, env={**os.environ, **places, **settings}, capture_output=True, text=True
    )
    codes, seen = json.loads(done.stdout.splitlines()[-1])
    assert set(codes) <= {0, 1}, done.stderr
    assert [event for event in seen if event[0] != "write"] == []
    written = {Path(path) for _, path in seen} - {Path(os.devnull)}
    allowed = {tmp_path / "out", cache, temporary}
    assert {path for path in written if not allowed & {path, *path.parents}} == set()
    assert tmp_path / "out" / "report.html" in written
    assert list(temporary.iterdir()) == [] and list(home.iterdir()) == [cache]
