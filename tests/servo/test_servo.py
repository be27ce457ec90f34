"""Implausible commands are refused; what is written and said of servos that were identified."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from rigs.files import schemas, urdf
from rigs.files.model_files import write_files
from rigs.files.notes import NoteRecorder
from rigs.logs.servo_logs import XML, positions, sines_and_steps, write
from robot_sysid import servo
from robot_sysid.config import IdentifyConfig
from robot_sysid.errors import InputError
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, Recording
from robot_sysid.records.data import DataOrigin
from robot_sysid.servo.command_check import check_commands
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.loop import low_pass_motion
from robot_sysid.servo.result import ServoIdentification, servo_lines, servo_notes
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import (
    ServoParameters,
    ServoRollouts,
    servos_in_model,
)

URDF = urdf.robot(urdf.serial(dict.fromkeys(("l1", "l2"), urdf.inertial())))
GAIN = 50.0


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    folder = tmp_path_factory.mktemp("servos")
    write_files(folder, {"arm.xml": XML, "arm.urdf": URDF})
    return {name: load_robot_model(folder / f"arm.{name}") for name in ("xml", "urdf")}


def identification(robot, error=0.1):
    numbers = np.outer((GAIN, 3.0, 0.2, 0.1), np.ones(2))
    true = np.ones(2, dtype=bool)
    none = np.zeros(2)
    errors = 0.01 + 0 * numbers
    fit = ServoFit(numbers, 0.02, none, errors, ~true, true, 1e-3, none, none)
    origin = DataOrigin("log log.csv", 10.0, 50.0)
    after = np.full(2, error)
    errors = np.ones(2), after, 0.5
    return ServoIdentification(robot, fit, true, origin, *errors, ())


def run(robot, folder, error=0.1, accept=(), cards=None):
    """Write a given identification; return the outcome and the notes."""
    zero = np.zeros((3, robot.n_joints))
    poses = Motion(np.arange(3.0), zero, zero, zero)
    result = identification(robot, error)
    config = IdentifyConfig.of(
        robot.path, accept=accept, output_dir=folder, cards=cards
    )
    outcome, notes = servo.write_servos(config, result, poses)
    schemas.check(folder / "servo.json")
    return outcome, [*notes]


def test_what_was_judged_of_a_urdf_is_written_as_an_mjcf(robots, tmp_path):
    _, (note,) = run(robots["urdf"], tmp_path)
    assert "no position actuator on base_l1, l1_l2" in note
    assert json.loads((tmp_path / "servo.json").read_text())["notes"] == [note]
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert written.armature.tolist() == [0.1, 0.1]
    assert not (tmp_path / "updated_model.urdf").exists()
    assert run(robots["xml"], tmp_path / "xml")[1] == []


@pytest.mark.parametrize("name", ["xml", "urdf"])
def test_a_factor_on_all_masses_is_in_the_written_model(robots, tmp_path, name):
    robot = load_robot_model(robots[name].path, mass_scale=1.5)
    run(robot, tmp_path)
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert written.thetas == pytest.approx(1.5 * robots[name].thetas, rel=1e-9)


def test_a_card_has_the_rotors_of_the_written_model(robots, tmp_path):
    outcome, _ = run(robots["xml"], tmp_path, cards="mjlab")
    assert outcome.verdict[-1] == f"For mjlab: {tmp_path / 'mjlab_card.py'}"
    text = (tmp_path / "mjlab_card.py").read_text()
    assert text.count("'armature': 0.1,") == robots["xml"].n_joints


def test_a_gain_that_the_logs_do_not_show_is_said(robots):
    result = identification(robots["xml"])
    assert list(servo_notes(result)) == []
    errors = result.fit.errors.copy()
    errors[0, 1] = 0.5 * GAIN
    result = replace(result, fit=replace(result.fit, errors=errors))
    (note,) = servo_notes(result)
    assert "joint1" in note and "only ratios" in note
    delay, in_steps, *rows = result.quantities
    assert in_steps.value == delay.value + 0.5 * robots["xml"].mj_model.opt.timestep
    assert (delay.name, delay.value) == ("command_delay", 0.02)
    marked = [(row.name, row.of) for row in rows if row.source == "model"]
    assert marked == [("gain", "joint1")]
    (line,) = (line for line in servo_lines(result) if "joint1 gain" in line)
    assert line.endswith("prior")


def test_a_delay_that_is_not_known_is_said(robots):
    """Servos that are mostly at their torque limits show none; a number alone would be believed."""
    result = identification(robots["xml"])
    result = replace(result, fit=replace(result.fit, delay_error=np.inf))
    (note,) = servo_notes(result)
    assert note.startswith("delay of the commands") and "more gently" in note
    lines = [line for line in servo_lines(result) if "delay" in line]
    assert len(lines) == 2
    assert all(line.endswith("not identifiable") for line in lines)
    first, second, *_ = result.quantities
    assert (first.source, second.source) == ("model", "model")


def test_a_dead_zone_is_a_printed_row_of_its_joint_alone(robots, tmp_path):
    """With its ±, and how to simulate it, as the written model has none."""
    result = identification(robots["xml"])
    assert not any("dead zone" in line for line in servo_lines(result))
    fit = replace(
        result.fit,
        dead_zones=np.array([0.0, 0.0125]),
        dead_zone_errors=np.array([0.0, 0.0021]),
    )
    result = replace(result, fit=fit)
    (line,) = (line for line in servo_lines(result) if "dead zone" in line)
    words = line.split()
    assert words[0] == "joint1" and "rad" in line
    assert [word for word in words if word.startswith("0.0")] == ["0.0125", "0.0021"]
    (row,) = (row for row in result.quantities if row.name == "dead_zone")
    assert (row.of, row.value, row.error) == ("joint1", 0.0125, 0.0021)
    (note,) = servo_notes(result)
    assert "q + e - clip(e, -dead_zone, dead_zone)" in note


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (0.1, None),
        (1.1, "1.1 rad over 1 s, the model before 1"),
        (0.6, "0.6 rad over 1 s, the model before 1, the delayed commands 0.5"),
    ],
)
def test_a_model_must_beat_its_rivals(robots, tmp_path, error, fault):
    """What got worse is not called usable even if it is accepted."""
    outcome, _ = run(robots["xml"], tmp_path, error)
    is_written = (tmp_path / "updated_model.xml").exists()
    assert is_written == (fault is None)
    if fault is None:
        assert outcome.failure is None
        return
    assert fault in outcome.failure and outcome.verdict[0].startswith("Not usable")
    accepted, _ = run(robots["xml"], tmp_path, error, ("rollout",))
    assert accepted.verdict[0].startswith("Not usable, but written")
    assert accepted.failure is None and (tmp_path / "updated_model.xml").exists()


# --- whole runs ----------------------------------------------------------------------------------

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
SO_TRUTH = ServoParameters(
    np.array([[14.0] * 3, [0.5, 0.45, 0.4], [0.06, 0.08, 0.03], [0.025, 0.03, 0.035]]),
    0.02,
    np.zeros(3),
)


def data_set(folder, robot, truth, roll_shares):
    """Logs of an arm, in each of which the last joint gets a share of its motion."""
    paths = []
    for k, share in enumerate(roll_shares):
        time, two = sines_and_steps(12.0, seed=k)
        _, other = sines_and_steps(12.0, seed=k + 10)
        command = np.column_stack((two, share * other[:, 0]))
        q = positions(robot, time, command, truth)
        path = folder / f"log{k}.csv"
        paths.append(write(path, time, q, command, names=robot.joint_names))
    return tuple(paths)


@pytest.fixture
def so_arm(tmp_path):
    write_files(tmp_path, {"arm.xml": SO_ARM})
    return load_robot_model(tmp_path / "arm.xml")


def identify(robot, paths, folder, held_out=()):
    config = IdentifyConfig.of(
        robot.path,
        measurements=paths,
        validation_measurements=held_out,
        output_dir=folder,
    )
    return servo.run_servo(config, robot, NoteRecorder())


@pytest.mark.slow
def test_a_gain_that_no_link_shows_is_written_with_its_friction_and_rotor(
    so_arm, tmp_path
):
    """The last joint's numbers have the gain of its neighbours, and play its motion as they do."""
    paths = data_set(tmp_path, so_arm, SO_TRUTH, (1.0, 0.1, 1.0))
    outcome = identify(so_arm, paths, tmp_path)
    assert outcome.verdict[0].startswith("Usable")
    written = load_robot_model(tmp_path / "updated_model.xml")
    assert outcome.result.fit.is_shown[0].tolist() == [True, True, False]
    errors = np.abs(servos_in_model(written).numbers / SO_TRUTH.numbers - 1.0)
    assert np.all(errors[[0, 1, 3]] < [[0.1], [0.2], [0.2]])
    assert outcome.result.after[2] < 0.5 * outcome.result.before[2]


@pytest.mark.slow
def test_numbers_that_play_worse_than_the_models_are_all_kept(so_arm, tmp_path):
    """The last joint was not as in the logs when others were recorded: it was as in the file."""
    in_model = servos_in_model(so_arm).numbers
    numbers = SO_TRUTH.numbers.copy()
    numbers[1, 2] *= 4.0
    before_repair = replace(SO_TRUTH, numbers=numbers)
    numbers = SO_TRUTH.numbers.copy()
    numbers[:, 2] = in_model[:, 2]
    after_repair = replace(SO_TRUTH, numbers=numbers)
    folders = [tmp_path / name for name in ("fitted", "held_out")]
    for folder in folders:
        folder.mkdir()
    fitted = data_set(folders[0], so_arm, before_repair, (1.0, 1.0))
    held_out = data_set(folders[1], so_arm, after_repair, (1.0,))
    outcome = identify(so_arm, fitted, tmp_path, held_out)
    assert outcome.verdict[0].startswith("Usable")
    assert outcome.result.is_new.tolist() == [True, True, False]
    last = [row for row in outcome.result.quantities if row.of == "roll"]
    assert {row.source for row in last} == {"model"}
    assert any("roll" in note and "worse" in note for note in outcome.result.notes)
    written = load_robot_model(tmp_path / "updated_model.xml")
    np.testing.assert_array_equal(
        servos_in_model(written).numbers[:, 2], in_model[:, 2]
    )


@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.0, 1.0)])
def test_numbers_are_judged_by_what_was_fitted_and_by_what_was_not(so_arm, shares):
    """What was found of the last joint is made wrong, which shows where that joint moves."""
    numbers = SO_TRUTH.numbers.copy()
    numbers[1, 2] *= 4.0
    is_known = np.ones(3, dtype=bool)
    none = np.zeros(3)
    found = ServoFit(
        numbers,
        SO_TRUTH.delay,
        none,
        0.1 * numbers,
        ~is_known,
        is_known,
        1e-3,
        none,
        none,
    )
    rollouts = ServoRollouts(so_arm)
    problems = []
    for seed, share in enumerate(shares):
        time, two = sines_and_steps(12.0, seed=seed)
        command = np.column_stack((two, share * two[:, 0]))
        q = positions(so_arm, time, command, SO_TRUTH)
        problems.append(ServoProblem(rollouts, [log(q, command, time)]))
    fit, is_new, *_ = servo.numbers_to_write(found, *problems)
    assert is_new.tolist() == [True, True, False]
    in_model = servos_in_model(so_arm).numbers
    np.testing.assert_array_equal(fit.numbers[:, 2], in_model[:, 2])
    np.testing.assert_array_equal(fit.numbers[:, :2], numbers[:, :2])


def test_a_joint_at_rest_without_a_servo_spoils_no_other(so_arm, tmp_path):
    """A gain like those of the other joints holds it in the rollouts."""
    paths = data_set(tmp_path, so_arm, SO_TRUTH, (0.0,))
    bare = SO_ARM[: SO_ARM.index("<actuator>")] + "</mujoco>"
    write_files(tmp_path, {"bare.xml": bare})
    outcome = identify(load_robot_model(tmp_path / "bare.xml"), paths, tmp_path)
    assert outcome.verdict[0].startswith("Usable")
    assert outcome.result.is_new.tolist() == [True, True, False]


TIME = np.arange(500) / 50.0
SLOW_WAVES = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0]))
COMMAND = SLOW_WAVES + 0.1 * np.sin(np.outer(TIME, [7.0, 8.0]))
RNG = np.random.default_rng(0)
NOISE = 1e-4 * RNG.normal(size=COMMAND.shape)
NAMES = ("base", "tip")


def delay(values, samples):
    return np.vstack((np.repeat(values[:1], samples, axis=0), values))[: len(values)]


def log(q, command, time=TIME):
    return Recording(time, q, None, command - q, command=command, name="log.csv")


FOLLOWED = delay(COMMAND, 2) + NOISE


def test_commands_that_are_followed_are_accepted():
    """A joint that stands still is no fault."""
    followed = log(FOLLOWED, COMMAND)
    check_commands([followed], NAMES)
    _, qd, _ = low_pass_motion(followed)
    expected = np.gradient(FOLLOWED, 0.02, axis=0)
    assert qd[100] == pytest.approx(expected[100], abs=0.05)
    still = np.column_stack((FOLLOWED[:, 0], np.full(len(TIME), 0.3)))
    check_commands([log(still, np.round(still, 1))], NAMES)


ENCODER_STEPS = COMMAND * 4096 / (2 * np.pi) + 2048
FUTURE = np.vstack((FOLLOWED[1:], FOLLOWED[-1:]))
COPIED = ("repeat the measured", "were sent")


@pytest.mark.parametrize("rate", [25.0, 250.0, 1000.0])
def test_the_rate_of_a_log_decides_nothing(rate):
    """Positions of a soft servo follow about 0.14 s late (kd/kp); exchanged, they lead."""
    time = np.arange(0.0, 10.0, 1.0 / rate)
    command = 0.4 * np.sin(np.outer(time, [2.0, 3.0])) + np.sin(
        np.outer(time, [0.5, 0.4])
    )
    decay = np.exp(-1.0 / (0.14 * rate))
    late = lfilter([1.0 - decay], [1.0, -decay], command, axis=0)
    check_commands([log(late, command, time)], NAMES)
    with pytest.raises(InputError, match=r"commands come -0\.1"):
        check_commands([log(command, late, time)], NAMES)


@pytest.mark.parametrize(
    ("q", "command", "message_parts"),
    [
        (
            FOLLOWED,
            np.degrees(COMMAND),
            ("57.3 times as much (deg", "--units", "0.01745"),
        ),
        (
            FOLLOWED,
            ENCODER_STEPS,
            ("652 times as much (deg", "steps of 4096", "--columns"),
        ),
        (FOLLOWED, FOLLOWED, COPIED),
        (FOLLOWED, FUTURE, COPIED),
        (delay(COMMAND, 30), COMMAND, ("0.6 s before", "0.5 s")),
        (COMMAND + NOISE, delay(COMMAND, 3), ("-0.06 s before", "exchanged")),
        (FOLLOWED, RNG.normal(size=COMMAND.shape), ("correlation of -0.0",)),
        (FOLLOWED, -COMMAND, ("change -1", "sign")),
        (FOLLOWED, COMMAND + 1.0, ("differ by 1 ", "zeros")),
    ],
)
def test_implausible_commands_are_refused(q, command, message_parts):
    # The commands of the other joint are plausible.
    commands = np.column_stack((COMMAND[:, 0], command[:, 1]))
    positions = np.column_stack((FOLLOWED[:, 0], q[:, 1]))
    with pytest.raises(InputError) as error:
        check_commands([log(positions, commands)], NAMES)
    message = str(error.value)
    assert "log.csv" in message and "\n" not in message
    assert all(word in message for word in message_parts), message


def test_a_log_that_is_too_short_to_be_judged_is_refused(robots):
    q = COMMAND[:50]
    piece = Recording(TIME[:50], q, None, q, command=q)
    with pytest.raises(InputError, match="no piece of 1 s"):
        ServoProblem(ServoRollouts(robots["xml"]), [piece])
