"""What is written of servos that were found, and what is told of it."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs.options import LogOptions
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.edits import Edits
from robot_sysid.mjcf.updated_model import write_actuator
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import DataOrigin, RolloutError, RolloutTest, Source
from robot_sysid.servo import run as module
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.run import (
    SHORTEST_STEP,
    ServoIdentification,
    changes,
    delay_to_write,
    servo_lines,
)
from robot_sysid.simulation.rollout.servo import HOLDS_DELAY, Servos
from tests.support import schemas
from tests.support.model_files import urdf_inertial, urdf_joint, urdf_link, urdf_robot, write_files
from tests.support.servo_logs import XML

URDF = urdf_robot(
    urdf_link("base"),
    urdf_link("l1", urdf_inertial()),
    urdf_link("l2", urdf_inertial()),
    urdf_joint("base", "l1"),
    urdf_joint("l1", "l2"),
)
GAIN = 50.0
late = pytest.mark.skipif(not HOLDS_DELAY, reason="actuators of this MuJoCo cannot act late")


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
        ServoFit(servos, wrong, np.ones(9), np.full(2, 1e-3)),
        np.ones(2, dtype=bool),
        np.zeros(2),
        DataOrigin(Source.LOG, "log.csv", 10.0, 50.0),
        RolloutTest(robot.joint_names, "the last fifth", "servos", errors),
    )


class Told(Progress):
    """Keeps what is told."""

    def __init__(self):
        self.notes = []

    def note(self, message):
        self.notes.append(message)


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


def test_what_a_file_cannot_hold_is_told_and_stands_in_the_result(robots, tmp_path, monkeypatch):
    (note,) = run(robots["urdf"], tmp_path, monkeypatch)
    assert "a URDF cannot hold rotor inertia" in note
    assert run(robots["xml"], tmp_path / "xml", monkeypatch) == []


def test_what_the_model_does_not_have_has_no_before(robots):
    lines = [line for line in servo_lines(identified(robots["urdf"])) if "gain" in line]
    assert all("gain 50" in line and "damping 0 -> 3" in line for line in lines) and lines
    assert "gain 100 -> 50" in "".join(servo_lines(identified(robots["xml"])))


def test_what_an_earlier_run_left_does_not_stay_beside_the_result(robots, tmp_path, monkeypatch):
    (tmp_path / "params.json").write_text("{}")
    assert any("earlier run" in note for note in run(robots["xml"], tmp_path, monkeypatch, old=1))
    assert not (tmp_path / "params.json").exists()


@late
def test_the_delay_is_written_where_it_is_wanted(robots, tmp_path, monkeypatch):
    for wanted in (False, True):
        notes = run(robots["xml"], tmp_path / str(wanted), monkeypatch, write_delay=wanted)
        model = mujoco.MjModel.from_xml_path(str(tmp_path / str(wanted) / "updated_model.xml"))
        assert model.actuator_delay.tolist() == [0.02 * wanted] * 2
        assert any("also after each reset" in note for note in notes) == wanted
    notes = run(robots["urdf"], tmp_path / "urdf", monkeypatch, write_delay=True)
    assert any("no position actuator that could hold the delay" in note for note in notes)


def test_a_delay_that_is_not_proven_is_left(robots):
    delay, (note,) = delay_to_write(identified(robots["xml"], 1e-3), True)
    assert delay is None and "not proven" in note


def test_where_mujoco_cannot_act_late_it_is_refused(robots, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "HOLDS_DELAY", False)
    with pytest.raises(InputError, match="the installed MuJoCo cannot act late"):
        run(robots["xml"], tmp_path, monkeypatch, write_delay=True)
    assert list(tmp_path.iterdir()) == []


@late
@given(
    delay=st.floats(1e-3, 0.1),
    timestep=st.sampled_from([SHORTEST_STEP, 1e-3, 2e-3, 5e-3]),
    seed=st.integers(0, 99),
)
def test_a_written_delay_is_the_one_that_acts(robots, delay, timestep, seed):
    """Kp (command(t - delay) - q) - kv qd; MuJoCo's shortest delay is one time step."""
    robot = robots["xml"]
    _, servos = changes(identified(robot), delay)
    edits = Edits(read_document(robot.path))
    for change in servos:
        write_actuator(edits, change)
    text = edits.text().decode()
    model = mujoco.MjModel.from_xml_string(text.replace(' forcerange="-60 60"', ""))
    model.opt.timestep = timestep
    data, steps = mujoco.MjData(model), int(1.5 * delay / timestep) + 3
    commands = np.random.default_rng(seed).normal(size=(steps, 2))
    times = timestep * np.arange(-steps, steps)
    given_so_far = np.vstack((np.zeros((steps, 2)), commands))
    for command in commands:
        state = data.qpos.copy(), data.qvel.copy(), data.time - max(delay, timestep)
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        asked = [np.interp(state[2], times, column) for column in given_so_far.T]
        kv = -model.actuator_biasprm[:, 2]
        force = GAIN * (np.array(asked) - state[0]) - kv * state[1]
        np.testing.assert_allclose(data.actuator_force, force, atol=1e-6)
