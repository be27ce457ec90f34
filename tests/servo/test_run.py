"""Commands that cannot be what they seem; what is written of servos that were found, and told."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, Motion
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import DataOrigin, RolloutError, RolloutTest, Source
from robot_sysid.servo import run as module
from robot_sysid.servo.run import (
    ServoIdentification,
    commanded_pieces,
    moving,
    servo_lines,
    servo_notes,
)
from robot_sysid.servo.search import ServoFit, smoothed
from robot_sysid.simulation.servos import Servos, model_servos
from tests.support import schemas, urdf
from tests.support.model_files import write_files
from tests.support.servo_logs import XML

URDF = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2"), urdf.inertial())))
GAIN = 50.0


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    write_files(folder, {"arm.xml": XML, "arm.urdf": URDF})
    return {kind: load_robot_model(folder / f"arm.{kind}") for kind in ("xml", "urdf")}


def identified(robot, delay=0.02):
    servos = Servos(*(np.full(2, value) for value in (GAIN, 3.0, 0.2, 0.1)), delay)
    wrong = Servos(*np.full((4, 2), 0.01), 1e-3)
    errors = (RolloutError("closed loop", 1.0, 3, np.ones(2), 0.1 * np.ones(2)),)
    return ServoIdentification(
        robot,
        ServoFit(servos, wrong, np.ones(9, dtype=bool), np.full(2, 1e-3)),
        np.ones(2, dtype=bool),
        np.zeros(2),
        DataOrigin(Source.LOG, "log.csv", 10.0, 50.0),
        RolloutTest(robot.joint_names, "the last fifth", "servos", errors),
    )


class Told(Progress):
    """Keeps what is told."""

    def __init__(self):
        self.notes = []

    def note(self, *messages):
        self.notes += messages


def run(robot, folder, monkeypatch, old=0, **more):
    """Run on what would have been found; return what was told."""
    rest = np.zeros((3, robot.n_joints))
    made = identified(robot), Motion(np.arange(3.0), rest, rest, rest)
    monkeypatch.setattr(module, "identify_servos", lambda *_: made)
    told = Told()
    outcome = module.run_servo(robot, LogOptions(), folder, None, told, **more)
    assert outcome.failure is None
    schemas.check(folder / "servo.json")
    notes = json.loads((folder / "servo.json").read_text())["notes"]
    assert told.notes[: len(told.notes) - old] == notes
    return told.notes


def test_what_a_file_cannot_hold_is_told_and_stands_in_the_result(
    robots, tmp_path, monkeypatch
):
    (note,) = run(robots["urdf"], tmp_path, monkeypatch)
    assert "a URDF cannot hold rotor inertia" in note
    assert run(robots["xml"], tmp_path / "xml", monkeypatch) == []


def test_what_the_model_does_not_have_has_no_before(robots):
    lines = [line for line in servo_lines(identified(robots["urdf"])) if "gain" in line]
    assert (
        all("gain 50" in line and "damping 0 -> 3" in line for line in lines) and lines
    )
    assert "gain 100 -> 50" in "".join(servo_lines(identified(robots["xml"])))


def test_what_is_not_seen_is_said_to_be_the_models_and_its_error_is_stated(robots):
    found = identified(robots["xml"])
    servos = replace(
        found.fit.servos, frictionloss=model_servos(robots["xml"]).frictionloss
    )
    assert not any("hides" in note for note in servo_notes(found, 0.02))
    seen = np.arange(9) // 2 != 2
    found = replace(found, fit=replace(found.fit, servos=servos, seen=seen))
    assert all(
        "frictionloss 0.3 ± 0.01 N·m (not seen" in line
        for line in servo_lines(found)[3:5]
    )
    assert (
        sum("hides its frictionloss:" in note for note in servo_notes(found, 0.02)) == 2
    )
    sources = {name: own["source"] for name, own in found.numbers["joint1"].items()}
    assert {name for name, source in sources.items() if source == "from_model"} == {
        "frictionloss"
    }
    bare = identified(robots["urdf"])
    nothing = replace(bare, fit=replace(bare.fit, seen=~bare.fit.seen))
    gains = [own["gain"]["source"] for own in nothing.numbers.values()]
    assert gains == ["identified", "identified"]  # The model has none to keep.


def test_what_an_earlier_run_left_does_not_stay_beside_the_result(
    robots, tmp_path, monkeypatch
):
    (tmp_path / "params.json").write_text("{}")
    config = tmp_path / "run.toml"
    config.write_text("# of the user's own")
    told = run(robots["xml"], tmp_path, monkeypatch, old=1, read=(config,))
    assert any("earlier run" in note for note in told)
    assert not (tmp_path / "params.json").exists()
    assert config.exists()
    run(robots["xml"], tmp_path, monkeypatch)
    assert not config.exists()


TIME = np.arange(500) / 50.0
COMMAND = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0])) + 0.1 * np.sin(
    np.outer(TIME, [7.0, 8.0])
)
RNG = np.random.default_rng(0)


def late(values, samples):
    return np.vstack((np.repeat(values[:1], samples, axis=0), values))[: len(values)]


def log(q, command):
    part = Measurement(TIME, q, None, command - q, command=command)
    return SimpleNamespace(path="log.csv", pieces=(part,))


def followed(samples=2):
    return late(COMMAND, samples) + 1e-4 * RNG.normal(size=COMMAND.shape)


MEASURED = followed()


def test_commands_that_are_followed_are_taken():
    pieces = commanded_pieces([log(followed(), COMMAND)], ("base", "tip"))
    assert len(pieces) == 1 and moving(pieces).all()
    _, qd = smoothed(pieces[0])
    assert qd[100] == pytest.approx(
        np.gradient(followed(), 0.02, axis=0)[100], abs=0.05
    )


@pytest.mark.parametrize(
    ("q", "command", "words"),
    [
        (followed(), np.degrees(COMMAND), ("degrees", "--units", "0.01745")),
        (
            followed(),
            COMMAND * 4096 / (2 * np.pi) + 2048,
            ("steps of 4096", "--columns"),
        ),
        (MEASURED, MEASURED, ("repeat the measured", "no real commands")),
        (
            MEASURED,
            np.vstack((MEASURED[1:], MEASURED[-1:])),
            ("repeat", "no real commands"),
        ),
        (late(COMMAND, 14), COMMAND, ("14 samples before", "10")),
        (
            COMMAND + 1e-4 * RNG.normal(size=COMMAND.shape),
            late(COMMAND, 3),
            ("exchanged",),
        ),
        (followed(), RNG.normal(size=COMMAND.shape), ("not followed",)),
        (followed(), -COMMAND, ("sign",)),
        (followed(), COMMAND + 1.0, ("same zero",)),
    ],
)
def test_what_is_wrong_with_commands_is_said(q, command, words):
    # The other joint is as it should be.
    given = COMMAND.copy()
    measured = followed()
    given[:, 1] = command[:, 1]
    measured[:, 1] = q[:, 1]
    with pytest.raises(InputError) as caught:
        commanded_pieces([log(measured, given)], ("base", "tip"))
    message = str(caught.value)
    assert "log.csv" in message and "\n" not in message
    assert all(word in message for word in words), message


def test_a_joint_that_stands_still_is_no_fault():
    q = followed()
    command = COMMAND.copy()
    q[:, 1] = command[:, 1] = 0.3
    assert moving(commanded_pieces([log(q, command)], ("base", "tip"))).tolist() == [
        True,
        False,
    ]
