"""From logs of commands and positions to what is written and said of servos."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.servo_fits import found_fit, identification_of
from rigs.files import schemas, urdf
from rigs.files.model_files import write_files
from rigs.files.notes import NoteRecorder
from rigs.files.places import SHARED
from rigs.logs import servo_logs
from rigs.logs.servo_logs import XML
from robot_sysid import servo
from robot_sysid.config import IdentifyConfig
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, Recording
from robot_sysid.records.servo_setting import UNKNOWN
from robot_sysid.servo.result import servo_notes
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import servos_in_model

URDF = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2"), urdf.inertial())))


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    write_files(folder, {"arm.xml": XML, "arm.urdf": URDF})
    return {name: load_robot_model(folder / f"arm.{name}") for name in ("xml", "urdf")}


def write(robot, folder, error=0.1, accept=(), cards=None):
    """Write a given identification; return the outcome and the notes."""
    zero = np.zeros((3, robot.n_joints))
    poses = Motion(np.arange(3.0), zero, zero, zero)
    config = IdentifyConfig.of(
        robot.path, accept=accept, output_dir=folder, cards=cards
    )
    result = identification_of(robot, error=error)
    outcome, notes = servo.write_servos(config, result, poses)
    schemas.check(folder / "servo.json")
    return outcome, [*notes]


def test_what_was_judged_is_what_the_written_model_has(robots, tmp_path):
    """And a card that is read again leads to the rollouts that were judged."""
    assert write(robots["xml"], tmp_path)[1] == []
    written = load_robot_model(tmp_path / "updated_model.xml")
    servos = servos_in_model(written)
    in_file = found_fit(robots["xml"]).in_file
    np.testing.assert_allclose(servos.numbers, in_file.numbers, rtol=1e-9)
    np.testing.assert_allclose(servos.limits, in_file.limits, rtol=1e-9)
    np.testing.assert_allclose(servos.firmness, in_file.firmness, rtol=1e-9)
    assert not np.any(servos.servo_damping)


def test_what_was_judged_of_a_urdf_is_written_as_an_mjcf(robots, tmp_path):
    _, (note,) = write(robots["urdf"], tmp_path)
    assert "no position actuator on base_l1, l1_l2" in note
    assert json.loads((tmp_path / "servo.json").read_text())["notes"] == [note]
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert written.armature.tolist() == [0.1, 0.1]
    assert not (tmp_path / "updated_model.urdf").exists()


@pytest.mark.parametrize("name", ["xml", "urdf"])
def test_a_factor_on_all_masses_is_in_the_written_model(robots, tmp_path, name):
    robot = load_robot_model(robots[name].path, mass_scale=1.5)
    write(robot, tmp_path)
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert written.thetas == pytest.approx(1.5 * robots[name].thetas, rel=1e-9)


def test_a_card_has_the_rotors_of_the_written_model(robots, tmp_path):
    outcome, _ = write(robots["xml"], tmp_path, cards="mjlab")
    assert outcome.verdict[-1] == f"For mjlab: {tmp_path / 'mjlab_card.py'}"
    text = (tmp_path / "mjlab_card.py").read_text()
    # Each joint as in the file, and its servo as it was found.
    assert text.count("'armature': 0.1,") == 2 * robots["xml"].n_joints


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (0.1, None),
        (1.1, "1.1 rad over 5 s, the model before 1"),
        (0.6, "0.6 rad over 5 s, the model before 1, the delayed commands 0.5"),
    ],
)
def test_a_model_must_beat_its_rivals(robots, tmp_path, error, fault):
    """What got worse is not called usable even if it is accepted."""
    outcome, _ = write(robots["xml"], tmp_path, error)
    is_written = (tmp_path / "updated_model.xml").exists()
    assert is_written == (fault is None)
    if fault is None:
        assert outcome.failure is None
        return
    assert fault in outcome.failure and outcome.verdict[0].startswith("Not usable")
    accepted, _ = write(robots["xml"], tmp_path, error, ("rollout",))
    assert accepted.verdict[0].startswith("Not usable, but written")
    assert accepted.failure is None and (tmp_path / "updated_model.xml").exists()


# --- what is judged ------------------------------------------------------------------------------

SO_ARM = """<mujoco><worldbody><body><joint name="lift" {joint}/>
<inertial pos=".1 0 .02" mass=".4" diaginertia="2e-4 5e-4 5e-4"/>
<body pos=".15 0 0"><joint name="elbow" {joint}/>
<inertial pos=".08 0 .01" mass=".3" diaginertia="1e-4 3e-4 3e-4"/>
<body pos=".1 0 0"><joint name="roll" {joint}/>
<inertial pos=".02 0 0" mass=".01" diaginertia="1e-6 1e-6 1e-6"/></body></body></body></worldbody>
<actuator><position joint="lift" kp="17.8" forcerange="-3 3"/>
<position joint="elbow" kp="17.8" forcerange="-3 3"/>
<position joint="roll" kp="17.8" forcerange="-3 3"/></actuator></mujoco>""".format(
    joint='axis="0 1 0" range="-2 2" damping=".6" armature=".028" frictionloss=".052"'
).replace('"roll" axis="0 1 0"', '"roll" axis="1 0 0"')
"""A small arm whose file has other gains and friction than the arm of the logs."""
SO_TRUTH = servo_logs.servos(
    [[14.0] * 3, [0.5, 0.45, 0.4], [0.06, 0.08, 0.03], [0.025, 0.03, 0.035]], 0.02, 3.0
)


@pytest.fixture
def so_arm(tmp_path):
    write_files(tmp_path, {"arm.xml": SO_ARM})
    return load_robot_model(tmp_path / "arm.xml")


def log(robot, share, seed=0, truth=SO_TRUTH, seconds=12.0):
    """A log in which the last joint gets a share of its motion."""
    time, two = servo_logs.sines_and_steps(seconds, seed=seed)
    command = np.column_stack((two, share * two[:, 0]))
    q = servo_logs.positions(robot, time, command, truth, steps=40)
    return Recording(time, q, None, command - q, command=command)


def found_of(robot, in_file):
    """A fit whose numbers for the file are given."""
    return replace(found_fit(robot), in_file=in_file, delay=in_file.delay)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.0, 1.0)])
def test_numbers_are_judged_by_what_was_fitted_and_by_what_was_not(so_arm, shares):
    """What was found of the last joint is made wrong, which shows where that joint moves."""
    numbers = SO_TRUTH.numbers.copy()
    numbers[1, 2] *= 4.0
    fit = found_of(so_arm, replace(SO_TRUTH, numbers=numbers))
    problems = [
        ServoProblem(so_arm, [log(so_arm, share, seed)], UNKNOWN, fit.delay)
        for seed, share in enumerate(shares)
    ]
    is_new, before, after, fitted = servo.judged(fit, *problems)
    assert is_new.tolist() == [True, True, False]
    # Errors are those of the file as it is written.
    kept = replace(servos_in_model(so_arm), delay=fit.delay)
    chosen = servo.chosen(fit.in_file, kept, is_new)
    np.testing.assert_array_equal(chosen.numbers[:, 2], kept.numbers[:, 2])
    np.testing.assert_array_equal(chosen.numbers[:, :2], numbers[:, :2])
    played = [(problems[1], kept), (problems[1], chosen), (problems[0], chosen)]
    errors = [problem.errors(own, servo.FINE_STEP) for problem, own in played]
    expected = [np.sqrt(np.mean(one**2, axis=(0, 1))) for one in errors]
    np.testing.assert_allclose([before, after, fitted], expected, rtol=1e-9)
    assert np.all(after[:2] < 0.5 * before[:2])


def test_a_joint_that_stands_keeps_all_of_the_models_numbers(so_arm):
    fit = replace(found_of(so_arm, SO_TRUTH), is_known=np.array([True, True, False]))
    problems = [
        ServoProblem(so_arm, [log(so_arm, 0.0, seed)], UNKNOWN, fit.delay)
        for seed in range(2)
    ]
    is_new, *_ = servo.judged(fit, *problems)
    assert is_new.tolist() == [True, True, False]


def test_a_joint_at_rest_without_a_servo_spoils_no_other(tmp_path):
    """What was found holds it in the rollouts of the model before."""
    bare = SO_ARM[: SO_ARM.index("<actuator>")] + "</mujoco>"
    write_files(tmp_path, {"arm.xml": SO_ARM, "bare.xml": bare})
    arm = load_robot_model(tmp_path / "arm.xml")
    without = load_robot_model(tmp_path / "bare.xml")
    # A spring has no limit.
    truth = replace(SO_TRUTH, limits=np.full(3, np.inf))
    fit = replace(found_of(without, truth), is_known=np.array([True, True, False]))
    problems = [
        ServoProblem(without, [log(arm, 0.0, seed, truth)], UNKNOWN, fit.delay)
        for seed in range(2)
    ]
    is_new, before, after, _ = servo.judged(fit, *problems)
    assert is_new.tolist() == [True, True, False]
    assert np.all(np.isfinite(before)) and np.all(after[:2] < before[:2])


def test_chosen_numbers_are_new_ones_of_some_joints():
    new = servo_logs.servos([[1.0, 2.0]] * 4, 0.1, 3.0)
    old = replace(
        servo_logs.servos([[5.0, 6.0]] * 4, 0.2, np.inf),
        servo_damping=np.array([7.0, 8.0]),
        firmness=np.array([0.5, 0.6]),
    )
    found = servo.chosen(new, old, np.array([True, False]))
    assert found.numbers.tolist() == [[1.0, 6.0]] * 4
    assert found.limits.tolist() == [3.0, np.inf]
    assert found.servo_damping.tolist() == [0.0, 8.0]
    assert found.firmness.tolist() == [0.9, 0.6]
    assert found.delay == 0.1


# --- whole runs ----------------------------------------------------------------------------------


def identify(robot, paths, folder, held_out=()):
    config = IdentifyConfig.of(
        robot.path,
        measurements=paths,
        validation_measurements=held_out,
        output_dir=folder,
    )
    return servo.run_servo(config, robot, NoteRecorder())


def write_log(path, robot, piece):
    """Write a recording; return its path."""
    titles = robot.joint_names
    return servo_logs.write(path, piece.time, piece.q, piece.command, names=titles)


@pytest.mark.slow
def test_a_gain_that_no_link_shows_is_written_with_its_friction_and_rotor(
    so_arm, tmp_path
):
    """The last joint's numbers have the gain of its neighbours, and play its motion as they do."""
    paths = tuple(
        write_log(tmp_path / f"log{seed}.csv", so_arm, log(so_arm, 1.0, seed))
        for seed in range(2)
    )
    outcome = identify(so_arm, paths, tmp_path)
    assert outcome.verdict[0].startswith("Usable")
    schemas.check(tmp_path / "servo.json")
    result = outcome.result
    assert result.is_new.all()
    written = load_robot_model(tmp_path / "updated_model.xml")
    errors = np.abs(servos_in_model(written).numbers / SO_TRUTH.numbers - 1.0)
    assert np.all(errors[[0, 1, 3], :2] < [[0.15], [0.2], [0.2]])
    assert np.all(result.after < 0.5 * result.before)
    assert abs(result.fit.delay - SO_TRUTH.delay) < 3.0 * result.fit.delay_error


@pytest.mark.slow
def test_numbers_that_play_worse_than_the_models_are_all_kept(so_arm, tmp_path):
    """The last joint was not as in the logs when others were recorded: it was as in the file."""
    in_model = servos_in_model(so_arm)
    numbers = SO_TRUTH.numbers.copy()
    numbers[1, 2] *= 4.0
    before_repair = replace(SO_TRUTH, numbers=numbers)
    numbers = SO_TRUTH.numbers.copy()
    numbers[:, 2] = in_model.numbers[:, 2]
    after_repair = replace(SO_TRUTH, numbers=numbers)
    fitted = log(so_arm, 1.0, truth=before_repair)
    held_out = log(so_arm, 1.0, 1, truth=after_repair)
    paths = [
        write_log(tmp_path / f"{name}.csv", so_arm, piece)
        for name, piece in {"fitted": fitted, "held_out": held_out}.items()
    ]
    outcome = identify(so_arm, (paths[0],), tmp_path, (paths[1],))
    assert outcome.verdict[0].startswith("Usable")
    assert outcome.result.is_new.tolist() == [True, True, False]
    in_file = {row.of for row in outcome.result.quantities if row.source == "file"}
    assert in_file == {"lift", "elbow"}
    (note,) = (note for note in servo_notes(outcome.result) if "worse" in note)
    assert note.startswith("roll: ")
    written = load_robot_model(tmp_path / "updated_model.xml")
    np.testing.assert_array_equal(
        servos_in_model(written).numbers[:, 2], in_model.numbers[:, 2]
    )


BAM = SHARED / "data" / "bam_xl330"


@pytest.mark.slow
@pytest.mark.skipif(not BAM.is_dir(), reason="no public logs beside the checkout")
def test_two_gains_of_a_real_servo_are_one_fit(tmp_path):
    """Its pendulum of 0.49 kg was weighed, and its files say so; the gain follows the register.

    Judged are recordings of other motions with both registers.
    """
    robot = load_robot_model(BAM / "pendulum.xml")
    fitted, held_out = (
        tuple(BAM / f"xl330_kp{kp}_{motion}.json" for kp in (400, 100))
        for motion in ("sin_sin", "sin_time_square")
    )
    outcome = identify(robot, fitted, tmp_path, held_out)
    assert outcome.verdict[0].startswith("Usable")
    result = outcome.result
    rows = {row.name: row for row in result.quantities if row.source == "data"}
    # About 0.83 N m/rad at register 400: its absolute size shows, because the link was weighed.
    gain = rows["gain"]
    assert 0.6 < gain.value < 1.4
    assert gain.error < 0.15 * gain.value
    assert 0.0 < rows["load_share"].value < 0.3
    assert result.after[0] < min(0.5 * result.before[0], result.goal)
    content = schemas.check(tmp_path / "servo.json")
    assert content["setting"].startswith("kp=400")
