"""The pipeline as a library: what it returns, writes and says."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.files import results
from rigs.files.notes import NoteRecorder
from rigs.files.places import GUESS
from rigs.files.results import theta_in
from rigs.logs.measured_logs import plan_of, true_arm
from robot_sysid.config import IdentifyConfig, SelfTestConfig
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.motion.trajectories import load_trajectory
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.stages import run, run_self_test, step_after_run
from robot_sysid.records import ITSELF, Motion
from robot_sysid.records.quantities import BEYOND, DIFFERENCE, Quantity
from robot_sysid.results.record import NextMotion
from robot_sysid.results.verdicts import Verdict
from robot_sysid.trajectory import CHUNK

XML = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y, small_arms.X),
    joint='range="-2.5 2.5" frictionloss=".4" damping=".1"',
)


@pytest.fixture
def arm(arm_file):
    return arm_file(XML)


def config(arm, **more):
    values = {
        "duration": 3.0,
        "sample_rate": 200.0,
        "seed": 1,
        "output_dir": arm.parent / "out",
    }
    return SelfTestConfig.of(arm, **{**values, **more})


def test_a_run_returns_what_its_files_say(arm):
    plan = arm.parent / "plan.json"
    written = run(config(arm, save_trajectory=plan))
    assert written.failure is None
    assert [path.name for path in written.files] == ["updated_model.xml", "params.json"]

    params = json.loads(written.files[1].read_text(), parse_constant=pytest.fail)
    result = written.result
    np.testing.assert_array_equal(theta_in(written.files[1]), result.body.theta)
    assert params["seed"] == result.data.seed == 1
    assert load_trajectory(plan).sha256 == load_robot_model(arm).sha256
    assert plan.with_suffix(".csv").exists()


def test_what_is_identified_of_every_joint_goes_into_the_model(arm):
    """The plant's joints have half the dry friction and twice the viscous one."""
    plant = arm.with_name("plant.xml")
    plant.write_text(XML.replace('".4" damping=".1"', '".2" damping=".2"'))
    written = run(config(arm, plant_model=plant))
    (model,) = [path for path in written.files if path.suffix == ".xml"]
    friction = load_robot_model(model).friction
    np.testing.assert_allclose(friction.coulomb, 0.2, rtol=1e-3)
    np.testing.assert_allclose(friction.viscous, 0.2, rtol=1e-3)


def test_an_updated_model_moves_together_with_the_original(tmp_path):
    home = tmp_path / "home"
    shutil.copytree(GUESS.parent, home / "model")
    values = {
        "duration": 1.0,
        "sample_rate": 100.0,
        "seed": 1,
        "output_dir": home / "out",
    }
    run(SelfTestConfig.of(home / "model" / GUESS.name, **values))
    home.rename(tmp_path / "moved")
    assert (
        load_robot_model(tmp_path / "moved" / "out" / "updated_model.xml").n_joints == 7
    )


def test_a_folder_that_cannot_be_written_to_is_found_before_the_work(arm):
    (arm.parent / "out").write_text("a file")
    listener = NoteRecorder()
    with pytest.raises(InputError, match="not a folder"):
        run(config(arm), listener)
    assert listener.shares == []


def test_the_motor_trajectory_carries_the_torque_of_the_motion(arm):
    """At rest, at both ends, the feed-forward torque is what holds the arm."""
    written = run(config(arm, export_damiao=True, motor_type=("DM10010",) * 3))
    rows = np.genfromtxt(written.files[1], delimiter=",", comments="#", skip_header=4)
    assert written.files[1].name == "damiao_trajectory.csv" and len(rows) == 601
    np.testing.assert_allclose(rows[0, 1:], rows[-1, 1:], atol=1e-4)
    q = rows[:1, 1::3]
    holding = ArmDynamics(load_robot_model(arm)).torque(q, 0.0 * q, 0.0 * q)
    np.testing.assert_allclose(rows[:1, 3::3], holding, atol=1e-3)
    assert np.max(np.abs(holding)) > 0.1
    # Slower, it is what the file beside it says: no more than this arm's weight, at any time.
    trajectory = read_damiao_trajectory(written.files[1])
    arm_dynamics = ArmDynamics(load_robot_model(arm))
    still = np.zeros_like(trajectory.q)
    weight = arm_dynamics.torque(trajectory.q, still, still)
    np.testing.assert_allclose(trajectory.weight, weight, atol=2e-3)
    motion = Motion(trajectory.time, trajectory.q, trajectory.qd, trajectory.qdd)
    rigid = arm_dynamics.torque(motion.q, motion.qd, motion.qdd)
    # Accelerations from velocities with four decimals.
    np.testing.assert_allclose(trajectory.at_speed(1.0).tau, rigid, atol=0.05)


def test_a_motion_keeps_the_peak_torque_of_the_motors_it_is_exported_for(arm):
    """The last joint needs 0.87 N m; its own limit is the model's, which has none."""
    weak = config(arm, export_damiao=True, motor_type=("DM10010", "DM10010", "DMH3510"))
    with pytest.raises(
        InputError, match="at joint joint2 takes .* torque limit of 0.45,"
    ):
        run(weak)


@pytest.mark.parametrize(
    ("torques", "friction"), [("chain", True), ("terminal", False)]
)
def test_the_models_own_values_come_back_with_where_they_are_from(torques, friction):
    plant = true_arm()
    options = {"torques": torques, "no_friction": not friction, "seed": 7}
    config = SelfTestConfig.of(plant.path, sample_rate=500.0, **options)
    plan = plan_of(plant, 1, 4.0)
    progress = NoteRecorder()
    result = run_self_test(config, plant, plan, progress)
    np.testing.assert_allclose(
        result.body.theta, plant.prior.theta, rtol=0.0, atol=1e-10
    )
    rows = [result.quantity(term, "joint2") for term in ("coulomb", "viscous")]
    if friction:
        assert [row.value for row in rows] == pytest.approx([0.3, 0.2], abs=1e-10)
        assert result.verdict is Verdict.OK
    else:
        assert rows == [None, None] and result.verdict is Verdict.PARTLY_FROM_MODEL
    assert result.torques == torques
    assert all(row.error is None for row in result.quantities)
    assert not result.is_measured
    assert progress.notes == [] and len(progress.shares) == int(np.ceil(2001 / CHUNK))
    data = result.data
    origin = data.description, data.duration, data.sample_rate, data.seed
    assert origin == (ITSELF, plan.duration, 500.0, 7)


def test_a_second_motion_is_proposed_where_it_makes_the_file_better():
    """Its figure stands in the sentence, and the command is that of ``plan``."""
    further = NextMotion(("--duration", "60"), 0.031)
    options = IdentifyConfig.of("arm.xml", measurements=("log.csv",), units="deg")
    proposed = results.elsewhere(0.13, next=further)
    step = step_after_run(
        options, results.found(file=results.model_file(elsewhere=proposed))
    )
    assert "13 % on other motions" in step.sentence and "3.1 %" in step.sentence
    assert step.command[1:5] == ("plan", "arm.xml", "--duration", "60")
    both = "log.csv", str(options.output.output_dir / "planned/log.csv")
    assert step.then.command[1:5] == ("identify", "arm.xml", *both)
    assert "--units" in step.then.command and step.lines()[2:] == step.then.lines()
    for nothing in (results.elsewhere(0.13), None):
        file = results.model_file(elsewhere=nothing)
        assert step_after_run(options, results.found(file=file)) is None


@pytest.mark.parametrize(
    ("mass", "error", "ratio", "beginning"),
    [
        # Its error is unknown, or it is known as well as by difference.
        (0.8, np.inf, 0.5, None),
        (0.8, 0.02, 9.0, None),
        (0.8, 0.2, 4.0, "Next, if what is bolted on can be taken off, "),
        (0.1, 0.7, 1.5, "Next, if what is bolted on can be taken off, "),
        (0.3, 0.2, 0.9, "If something is bolted on all the same, "),
        (-0.8, 0.2, 0.9, "If something is bolted on all the same, "),
    ],
)
def test_what_is_bolted_on_is_weighed_where_one_log_shows_it_roughly(
    mass, error, ratio, beginning
):
    """Also where nothing is seen; then a motion that makes the file better comes first."""
    result = results.found(results.with_value("m", 2.0, error))
    rows = [Quantity(DIFFERENCE, BEYOND, "", None, ratio, 0.0)]
    rows += [Quantity("mass", BEYOND, "kg", None, mass, error)]
    result = replace(result, quantities=(*result.quantities, *rows))
    options = IdentifyConfig.of("arm.xml", measurements=("log.csv",), units="deg")
    step = step_after_run(options, result)
    if beginning is None:
        assert step is None
        return
    assert step.sentence.startswith(beginning)
    assert step.command[1:3] == ("payload", "arm.xml")
    at = step.command.index("--loaded")
    assert step.command[at + 1 : at + 4] == ("log.csv", "--units", "deg")
    further = results.elsewhere(0.13, next=NextMotion(("--duration", "60"), 0.031))
    file = results.model_file(elsewhere=further)
    both = step_after_run(options, replace(result, file=file))
    assert (both == step) == (ratio >= 1.0)
    assert both.lines()[-2:] == step.lines()
