"""Making a plan: what the user is told on the way."""

from __future__ import annotations

from pathlib import Path

from robot_sysid.config import SysidConfig
from robot_sysid.planning import make_plan
from robot_sysid.records.progress import Silent
from tests.support import arms


class Recorder(Silent):
    def __init__(self):
        self.steps = []

    def advance(self, label, done, total, text):
        self.steps.append((label, done, total))


def test_the_search_for_contacts_tells_how_far_it_is():
    """Every step once, the last one complete, so that the bar goes away."""
    recorder = Recorder()
    robot = arms.robot_of(arms.MODELS["three"])
    make_plan(SysidConfig(Path("arm.xml"), duration=300.0), robot, 1, recorder)
    total = len(recorder.steps)
    assert total > 1
    assert recorder.steps == [("Looking for contacts", i, total) for i in range(1, total + 1)]
