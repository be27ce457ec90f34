"""Implausible commands are refused; what is written and said of servos that were identified."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid import servo
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement, Motion
from robot_sysid.records.data import DataOrigin, Source
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import RolloutError, RolloutTest
from robot_sysid.servo.commands import commanded_pieces, is_moving
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.held_out import GoalPrediction, servo_refusal
from robot_sysid.servo.windows import smooth_states
from robot_sysid.simulation.playback import ServoParameters, servos_in_model
from tests.support import schemas, urdf
from tests.support.model_files import write_files
from tests.support.servo_logs import XML

URDF = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2"), urdf.inertial())))
GAIN = 50.0


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    write_files(folder, {"arm.xml": XML, "arm.urdf": URDF})
    return {name: load_robot_model(folder / f"arm.{name}") for name in ("xml", "urdf")}


def identification(robot):
    numbers = [np.full(2, value) for value in (GAIN, 3.0, 0.2, 0.1)]
    errors = ServoParameters(*np.full((4, 2), 0.01), 1e-3)
    horizons = (RolloutError(1.0, 3, np.ones(2), 0.1 * np.ones(2)),)
    is_identified = np.ones(9, dtype=bool)
    servos = ServoParameters(*numbers, 0.02)
    return servo.ServoIdentification(
        robot,
        ServoFit(servos, errors, is_identified, np.full(2, 1e-3)),
        np.ones(2, dtype=bool),
        np.zeros(2),
        np.full(2, np.nan),
        np.zeros(2, dtype=bool),
        DataOrigin(Source.LOG, "log.csv", 10.0, 50.0),
        RolloutTest(robot.joint_names, "the last fifth", "servos", horizons),
        GoalPrediction(0.05, (0.5,)),
    )


class NoteRecorder(Progress):
    """Keeps all notes."""

    def __init__(self):
        self.notes = []

    def note(self, *messages):
        self.notes += messages


def run(robot, folder, monkeypatch, removal_notes=0, **options):
    """Write a given identification; return the notes, of which the last are about removed files."""
    zero = np.zeros((3, robot.n_joints))
    poses = Motion(np.arange(3.0), zero, zero, zero)
    monkeypatch.setattr(
        servo, "identify_servos", lambda *_: (identification(robot), poses)
    )
    progress = NoteRecorder()
    outcome = servo.run_servo(robot, LogOptions(), folder, None, progress, **options)
    assert outcome.failure is None
    schemas.check(folder / "servo.json")
    written = json.loads((folder / "servo.json").read_text())["notes"]
    assert progress.notes[: len(progress.notes) - removal_notes] == written
    return progress.notes


def test_a_number_that_a_file_cannot_hold_is_noted_in_the_result(
    robots, tmp_path, monkeypatch
):
    (note,) = run(robots["urdf"], tmp_path, monkeypatch)
    assert "a URDF cannot hold rotor inertia" in note
    # An MJCF beside the URDF holds all that the rollouts had, but for the gain.
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert written.armature.tolist() == [0.1, 0.1]
    assert load_robot_model(tmp_path / "updated_model.urdf").armature.tolist() == [0, 0]
    assert run(robots["xml"], tmp_path / "xml", monkeypatch) == []


def test_a_number_that_the_model_does_not_have_has_no_before(robots):
    lines = servo.servo_lines(identification(robots["urdf"]))
    gain_lines = [line for line in lines if "gain" in line]
    assert len(gain_lines) == 2
    for line in gain_lines:
        assert "gain 50.000 ± 0.010 N·m/rad;" in line and "damping 0 -> 3" in line
    text = "".join(servo.servo_lines(identification(robots["xml"])))
    assert "gain 100 -> 50.000 ± 0.010 N·m/rad;" in text


def test_a_number_that_is_not_identified_is_the_models_with_a_stated_error(robots):
    result = identification(robots["xml"])
    assert not any("hides" in note for note in servo.servo_notes(result, 0.02))
    friction = servos_in_model(robots["xml"]).frictionloss
    fit = replace(
        result.fit,
        servos=replace(result.fit.servos, frictionloss=friction),
        is_identified=np.arange(9) // 2 != 2,
    )
    result = replace(result, fit=fit)
    for line in servo.servo_lines(result)[3:5]:
        assert "frictionloss 0.300 ± 0.010 N·m (not determined: the model's" in line
    notes = "".join(servo.servo_notes(result, 0.02))
    assert notes.count("hides its frictionloss:") == 2
    for name, number in result.joint_numbers["joint1"].items():
        assert (number["source"] == "from_model") == (name == "frictionloss")


def test_a_gain_that_neither_model_nor_data_has_counts_as_assumed(robots):
    result = identification(robots["urdf"])
    fit = replace(result.fit, is_identified=~result.fit.is_identified)
    for numbers in replace(result, fit=fit).joint_numbers.values():
        assert numbers["gain"]["source"] == "assumed"


@pytest.mark.parametrize(
    ("new_errors", "fault"),
    [
        ((0.1, 0.1), None),
        ((0.1, 1.1), "1.1 rad over 3 s, the model before 1"),
        ((0.1, 0.6), '0.6 rad over 3 s, "position = command of 50 ms before" 0.5'),
    ],
)
def test_a_model_must_beat_its_rivals_over_every_horizon(new_errors, fault):
    errors = []
    for horizon, new_error in zip((1.0, 3.0), new_errors):
        new = np.full(2, new_error)
        errors.append(RolloutError(horizon, 3, np.ones(2), new))
    test = RolloutTest(("a", "b"), "the last fifth", "servos", tuple(errors))
    goal = GoalPrediction(0.05, (0.5, 0.5))
    refusal = servo_refusal(test, goal, ())
    assert refusal is None if fault is None else fault in refusal
    assert servo_refusal(test, goal, ("rollout",)) is None


def test_results_of_an_earlier_run_are_removed_unless_they_are_inputs(
    robots, tmp_path, monkeypatch
):
    (tmp_path / "params.json").write_text("{}")
    config = tmp_path / "run.toml"
    config.write_text("# of the user's own")
    options = {"removal_notes": 1, "input_files": (config,)}
    notes = run(robots["xml"], tmp_path, monkeypatch, **options)
    assert any("earlier run" in note for note in notes)
    assert not (tmp_path / "params.json").exists()
    assert config.exists()
    run(robots["xml"], tmp_path, monkeypatch)
    assert not config.exists()


TIME = np.arange(500) / 50.0
SLOW_WAVES = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0]))
COMMAND = SLOW_WAVES + 0.1 * np.sin(np.outer(TIME, [7.0, 8.0]))
RNG = np.random.default_rng(0)
NOISE = 1e-4 * RNG.normal(size=COMMAND.shape)
NAMES = ("base", "tip")


def delay(values, samples):
    return np.vstack((np.repeat(values[:1], samples, axis=0), values))[: len(values)]


def log(q, command):
    piece = Measurement(TIME, q, None, command - q, command=command)
    return SimpleNamespace(path="log.csv", pieces=(piece,))


FOLLOWED = delay(COMMAND, 2) + NOISE


def test_commands_that_are_followed_are_accepted():
    (piece,) = commanded_pieces([log(FOLLOWED, COMMAND)], NAMES)
    assert is_moving([piece]).all()
    _, qd = smooth_states(piece)
    expected = np.gradient(FOLLOWED, 0.02, axis=0)
    assert qd[100] == pytest.approx(expected[100], abs=0.05)


ENCODER_STEPS = COMMAND * 4096 / (2 * np.pi) + 2048
FUTURE = np.vstack((FOLLOWED[1:], FOLLOWED[-1:]))
COPIED = ("repeat the measured", "no real commands")


@pytest.mark.parametrize(
    ("q", "command", "message_parts"),
    [
        (FOLLOWED, np.degrees(COMMAND), ("degrees", "--units", "0.01745")),
        (FOLLOWED, ENCODER_STEPS, ("steps of 4096", "--columns")),
        (FOLLOWED, FOLLOWED, COPIED),
        (FOLLOWED, FUTURE, COPIED),
        (delay(COMMAND, 14), COMMAND, ("14 samples before", "10")),
        (COMMAND + NOISE, delay(COMMAND, 3), ("exchanged",)),
        (FOLLOWED, RNG.normal(size=COMMAND.shape), ("not followed",)),
        (FOLLOWED, -COMMAND, ("sign",)),
        (FOLLOWED, COMMAND + 1.0, ("same zero",)),
    ],
)
def test_implausible_commands_are_refused(q, command, message_parts):
    # The commands of the other joint are plausible.
    commands = np.column_stack((COMMAND[:, 0], command[:, 1]))
    positions = np.column_stack((FOLLOWED[:, 0], q[:, 1]))
    with pytest.raises(InputError) as error:
        commanded_pieces([log(positions, commands)], NAMES)
    message = str(error.value)
    assert "log.csv" in message and "\n" not in message
    assert all(word in message for word in message_parts), message


def test_a_joint_that_stands_still_is_no_fault():
    standing = np.full(len(TIME), 0.3)
    q = np.column_stack((FOLLOWED[:, 0], standing))
    command = np.column_stack((COMMAND[:, 0], standing))
    pieces = commanded_pieces([log(q, command)], NAMES)
    assert is_moving(pieces).tolist() == [True, False]


def test_pieces_without_commands_are_not_played_and_not_called_short():
    time = np.arange(0.0, 60.0, 0.1)
    piece = Measurement(time, np.zeros((len(time), 1)), None, None)
    rollouts = SimpleNamespace(robot=SimpleNamespace(joint_names=("a",)))
    played, goal = servo.play_servos(rollouts, [piece], (), "the last fifth", 0.05)
    assert played.errors == goal.errors == ()
    assert "no held-out piece has commands for 1 s" in played.notes
