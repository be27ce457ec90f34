"""Each target on a few hundred inputs, and the harness on a target that does everything wrong."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("resource", reason="needs a Unix system")
pytest.importorskip("can")
pytest.importorskip("rosbags")
from benchmarks.trust.fuzz import can_frames, columns, trajectories
from benchmarks.trust.fuzz.guided import BytesRandom
from benchmarks.trust.fuzz.harness import outcome
from rigs.files.places import ROOT

INPROCESS = settings(
    max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
WRONG = """
import os, socket, sys, time
from pathlib import Path
from benchmarks.trust.fuzz import harness

class Target:
    def case(self, random):
        return {"n": b""}
    def use(self, case, folder):
        acts.pop(0)(folder)

acts = [
    lambda folder: (folder / "out" / "fine").write_text("x"),
    lambda folder: 1 / 0,
    lambda folder: Path("mine").write_text("x") and Path("mine").unlink(),
    lambda folder: bytearray(2 * 10**9),
    lambda folder: socket.socket().connect(("127.0.0.1", 9)),
    lambda folder: os.abort(),
    lambda folder: time.sleep(5),
]
harness.LONGEST, harness.BATCH = 1, 1
for finding in harness.run(Target(), 1, 0):
    pass
while len(acts) > 1:
    acts.pop(0)
    findings = [item for item in harness.run(Target(), 1, 0) if not isinstance(item, str)]
    print([finding.verdict for finding in findings])
"""


def run(*arguments):
    """Run Python in the checkout; a process of its own may crash, and be limited for good."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    call = [sys.executable, *arguments]
    return subprocess.run(
        call, cwd=ROOT, env=environment, capture_output=True, text=True
    )


# A run tells the user of numerical warnings, and goes on.
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "target", [can_frames, columns, trajectories], ids=lambda t: t.__name__
)
def test_no_input_does_harm(tmp_path, target):
    ends = set()

    @INPROCESS
    @given(st.integers(0, 2**32 - 1))
    def check_seed(seed):
        verdict, text = outcome(target, target.case(Random(seed)), tmp_path)
        assert verdict in ("result", "refused"), text
        ends.add(verdict)

    check_seed()
    assert ends == {"result", "refused"}


@pytest.mark.slow
@pytest.mark.parametrize("target", ["models", "logs", "results"])
def test_no_file_does_harm(target):
    """Those whose libraries may crash: in processes of their own."""
    done = run("-m", "benchmarks.trust.fuzz", target, "--inputs", "300", "--seed", "3")
    assert done.returncode == 0, done.stdout
    results, refused = map(int, re.findall(r"(\d+) (?:results|refused)", done.stdout))
    assert results > 10 and refused > 10 and results + refused == 300


@pytest.mark.slow
def test_the_harness_sees_all_that_can_go_wrong():
    done = run("-c", WRONG)
    kinds = re.findall(r"\[(.*)\]", done.stdout)
    expected = (
        "ZeroDivisionError",
        "written outside",
        "MemoryError",
        "written outside",
        "SIGABRT",
    )
    assert len(kinds) == len(expected) + 1, done.stdout + done.stderr
    for verdict, message in zip(kinds, (*expected, "longer than 1 s")):
        assert message in verdict


def test_chosen_bytes_decide_and_run_out():
    assert BytesRandom(b"\xff\x01").getrandbits(16) == 0x1FF
    drawn = [BytesRandom(b"\x03").randint(0, 9) for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert BytesRandom(b"").random() == 0.0 and BytesRandom(b"").choice("ab") == "a"
