"""Playing on motors from Python: the same run as that of the command."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.motors.damiao_rig import MotorBus, swing, trajectory_file
from rigs.motors.recordings import read_recording
from robot_sysid.config import MotorOptions
from robot_sysid.damiao import play_run
from robot_sysid.damiao.execution import MotorRun, RunOptions
from robot_sysid.damiao.protocol import DISABLED


@pytest.fixture
def model(arm_file):
    return arm_file(small_arms.serial_arm((small_arms.Z, small_arms.Y)))


@pytest.fixture
def trajectory(tmp_path):
    return trajectory_file(tmp_path, swing(2, duration=0.5, amplitude=0.05)).path


@pytest.mark.slow
def test_a_run_is_that_of_the_command(trajectory, model, tmp_path, capfd):
    sentences = []
    record = tmp_path / "measured.csv"
    options = {"model": model, "simulate": True, "record": record, "rate": 50}
    report = rs.motors.play(trajectory, **options, say=sentences.append)
    assert report.cycles == 26 and "enabling the motors" in sentences
    assert read_recording(record).ending == "completed"
    assert tuple(capfd.readouterr()) == ("", "")


@pytest.mark.slow
def test_a_simulated_arm_is_the_models_where_that_is_named(trajectory, model, tmp_path):
    """Without a plant it differs from the model, the same way each time."""
    recordings = []
    for number, plant in enumerate((None, None, model)):
        record = tmp_path / f"{number}.csv"
        options = {"model": model, "simulate": True, "record": record, "rate": 50}
        rs.motors.play(trajectory, plant_model=plant, **options)
        recordings.append(record.read_bytes())
    assert recordings[0] == recordings[1] != recordings[2]


@pytest.mark.slow
def test_a_plan_is_played_on_the_arm_that_it_was_made_for(model, tmp_path):
    motion = {"excitation": "sines", "duration": 0.6, "sample_rate": 250.0, "seed": 0}
    plan = rs.plan(model, **motion, motor_type=["DM4340"] * 2)
    report = rs.motors.play(plan, simulate=True, rate=50)
    assert report.cycles == 31 and np.max(report.worst_tracking) < 0.1
    files = plan.save(tmp_path / "plan.json")
    assert files[2] == tmp_path / "damiao_trajectory.csv"
    assert rs.motors.play(files[2], model=model, simulate=True, rate=50).cycles == 31
    for_none = replace(plan, config=replace(plan.config, motors=MotorOptions()))
    with pytest.raises(rs.InputError, match="give rs.plan motor_type, one per joint"):
        rs.motors.play(for_none, simulate=True)


REFUSED = {
    "unknown option 'sped'; did you mean speed?": {"sped": 0.5},
    "unknown option 'below_base'": {"below_base": True},
    'this command needs channel, for instance channel="can0"': {},
    "a simulated arm needs a model; add model": {"simulate": True},
    "plant_model is about a simulated arm": {"plant_model": "truth.xml"},
    "a model is the path of an MJCF or URDF file, or a mujoco.MjSpec": {"model": 5},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_used_is_said(trajectory, message):
    with pytest.raises(rs.InputError) as caught:
        rs.motors.play(trajectory, **REFUSED[message])
    assert str(caught.value).startswith(message)


def test_an_arm_is_moved_from_any_thread(trajectory):
    """Signals are for the main thread; a run does not need them."""
    bus = MotorBus(watchdog=0.5, echo=True)
    reports = []
    options = RunOptions.of({"trajectory": trajectory, "channel": "can0", "rate": 50.0})
    run = MotorRun(options, bus.equipment)
    play = lambda: reports.append(play_run(run, False, print))  # noqa: E731
    thread = threading.Thread(target=play)
    thread.start()
    thread.join()
    assert reports[0].cycles > 1 and bus.states() == [DISABLED] * 2
