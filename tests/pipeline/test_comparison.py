"""Two runs of one arm: what has changed is found with its value, and nothing else is."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigs.arms.small_arms import SEEDS
from rigs.logs.measured_logs import XML, log_of
from rigs.logs.payload_logs import TrueArm, add_noise, four_joint_arm, wide_motion
from robot_sysid import spatial
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.terms import ArmTerms
from robot_sysid.faults.gate import judge
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_logs
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline.changes import (
    ALL_JOINTS,
    DIFFERS,
    UNKNOWN,
    WITH_ALL,
    Kind,
    change_question,
    changes,
)
from robot_sysid.pipeline.comparison import compare_runs, sentences, verdict_on
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import SCALE, joint_factors, write_torque_scale

ROBOT = four_joint_arm()
BODY = spatial.theta_from_com(0.2, np.array([0.03, -0.02, 0.1]), 1e-4 * np.eye(3))
NOTHING = np.zeros(10)
ONE = np.array([0.0, 0.0, 0.3, 0.0])


def rows_of(seed, body=NOTHING, friction=0.0, swapped=False, same_day=False, **after):
    """Return what has changed between two runs, links 10 % off the model, in either order.

    ``after`` are fields of ``WrongArm`` in the second run.
    """
    fields = {"offset": np.zeros(4)}
    recordings = []
    for is_second in (False, True):
        motion = wide_motion([seed, is_second], duration=12.0)
        name = f"log{is_second}"
        if is_second:
            fields.update(after)
        arm = TrueArm(ROBOT, seed, 0.1, body, **fields)
        log = arm.recording(motion, is_second, float(is_second), name, friction)
        log = replace(log, q=log.q + arm.zeros)
        is_later = is_second != swapped
        log = replace(log, is_loaded=is_later, order=1.0 if is_later else -1.0)
        recordings.append(add_noise(log, 0.05, [seed, is_second]))
    arm_terms = ArmTerms(ROBOT, loaded=True)
    question = change_question(arm_terms, EstimationOptions(), same_day)
    return changes(solve_question(ROBOT, recordings, question))


def named(rows):
    """Return what differs, its inertial parameters as one."""
    of_body = {row.of for row in rows if row.name == "m"}
    found = [row for row in rows if row.reason == DIFFERS]
    return {(row.name if row.of not in of_body else "m", row.of) for row in found}


def row_of(rows, name, of):
    """Return the row of a number."""
    (row,) = [row for row in rows if (row.name, row.of) == (name, of)]
    return row


@pytest.mark.slow
def test_a_body_that_came_on_is_found_and_the_order_changes_its_sign():
    rows = rows_of(0, body=BODY)
    for row, true in zip(rows[:4], BODY):
        assert abs(row.value - true) < 3.0 * row.error
    assert rows[0].error < 0.05 and rows[0].least < 0.15
    assert named(rows) == {("m", "link3")}
    assert sentences(rows)[0].endswith("came on at link3") and len(sentences(rows)) == 1
    back = rows_of(0, body=BODY, swapped=True)
    for row, other in zip(rows, back):
        assert row.reason == other.reason
        if row.name == "friction":
            assert (1.0 + row.value / 100.0) * (1.0 + other.value / 100.0) == (
                pytest.approx(1.0, abs=0.002 * row.error)
            )
        else:
            assert row.value == pytest.approx(-other.value, abs=0.1 * row.error)
    assert sentences(back)[0].endswith("came off at link3")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "joint", "value", "after", "words"),
    [
        ("zero", 1, 2.0, {"zeros": np.radians(2.0)}, "position of joint1 reads"),
        ("friction", 2, 70.0, {}, "friction of joint2 is"),
        pytest.param(
            *("scale", 2, 10.0, {"scales": 0.1}, "torque of joint2 reads"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("offset", 2, -1.5, {"offset": -1.5}, "torque of joint2 reads"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_one_joints_change_is_found_with_its_value_and_nothing_else(
    name, joint, value, after, words
):
    usual = {"zeros": 0.0, "scales": 1.0, "offset": 0.0}
    own = np.eye(4)[joint]
    fields = {key: usual[key] + size * own for key, size in after.items()}
    friction = 0.01 * value * own if name == "friction" else 0.0
    rows = rows_of(1, NOTHING, friction, False, **fields)
    assert named(rows) == {(name, f"joint{joint}")}
    row = row_of(rows, name, f"joint{joint}")
    assert abs(row.value - value) < max(4.0 * row.error, 0.1 * abs(value))
    assert row.least < abs(value)
    (sentence,) = sentences(rows)
    assert words in sentence
    assert sentence.endswith(("higher", "more") if value > 0.0 else "less")
    assert verdict_on(rows)[0] == f"Changed: {sentence}"


@pytest.mark.slow
def test_a_smaller_change_of_friction_is_named_of_one_day():
    """The measured change and its ± are the same; what is usual in a day is less."""
    change = 0.18 * np.eye(4)[2]
    other, same = (rows_of(1, friction=change, same_day=day) for day in (False, True))
    assert not named(other) and named(same) == {("friction", "joint2")}
    before, after = (row_of(rows, "friction", "joint2") for rows in (other, same))
    assert after.value == pytest.approx(18.0, abs=3.0 * after.error)
    assert after.value == pytest.approx(before.value, abs=before.error)
    assert before.usual == pytest.approx(10.0, rel=0.1)
    assert after.usual == pytest.approx(3.0, rel=0.1)


@pytest.mark.slow
def test_a_change_of_all_joints_is_said_once():
    rows = rows_of(2, friction=-0.25)
    assert named(rows) == {("friction", ALL_JOINTS)}
    row = row_of(rows, "friction", ALL_JOINTS)
    assert row.value == pytest.approx(-25.0, abs=5.0)
    assert sentences(rows)[0].endswith("lower")


def test_nothing_is_named_where_nothing_has_changed_and_what_no_torque_shows_is_said():
    rows = rows_of(0)
    assert not named(rows)
    first, second = verdict_on(rows)
    assert first.startswith("Unchanged: no difference beyond the errors")
    # Torques are the same whichever way an arm on a vertical axis has turned.
    assert row_of(rows, "zero", "joint0").reason == UNKNOWN
    assert second == "not shown by these logs: zero of joint0"


# What may have changed, by about as much as is named: a load, friction of all joints or of one,
# a zero, a torque scale, a torque offset; sizes are drawn from zero to these.
_LARGEST = {
    "body": 0.5 * BODY,
    "friction": -0.3 * np.ones(4),
    "zeros": np.radians(2.0) * np.eye(4)[1],
    "scales": 0.06 * np.eye(4)[2],
    "offset": 1.5 * np.eye(4)[2],
}


@pytest.mark.slow
@settings(max_examples=6)
@given(SEEDS, st.sets(st.sampled_from(sorted(_LARGEST)), max_size=2))
def test_what_differs_is_what_is_beyond_a_multiple_of_its_error_and_what_is_usual(
    seed, kinds
):
    """In a row as in all of a table, and what is beyond it is said."""
    share = np.random.default_rng([seed, 7]).uniform(-1.0, 1.0)
    sizes = {kind: share * _LARGEST[kind] for kind in kinds}
    if "scales" in sizes:
        sizes["scales"] = 1.0 + sizes["scales"]
    try:
        rows = rows_of(seed, **sizes)
    except SysidError:
        return
    one = rows[0].least / rows[0].error
    assert 3.0 < one < 4.0
    has_load = ("m", "link3") in named(rows)
    has_all = ("friction", ALL_JOINTS) in named(rows)
    for row in rows:
        if row.name != "friction":
            spread = np.hypot(row.error, row.usual)
            assert row.least == pytest.approx(one * spread, rel=1e-9)
        is_beyond = abs(row.value) > row.least
        assert is_beyond or row.reason not in (DIFFERS, WITH_ALL)
        if is_beyond and row.reason != DIFFERS:
            # Gears lose a part of a load, which looks like a sensor's error.
            is_like_load = has_load and row.name in ("scale", "offset")
            is_of_all = has_all and row.name == "friction"
            assert row.reason == (UNKNOWN if is_like_load else WITH_ALL)
            assert is_like_load or is_of_all


@pytest.mark.parametrize(
    ("second", "reason"),
    [
        ({"logs": []}, "identifications from logs"),
        ({"payload": {"card": None}}, "identifications from logs"),
        ({"model": {"sha256": "other"}}, "different model files"),
        ({}, "cannot read"),
    ],
)
def test_where_there_is_no_common_fit_it_is_said(second, reason, tmp_path):
    content = {"logs": ["log"], "payload": None, "model": {"sha256": "one"}}
    runs = [
        SimpleNamespace(folder=tmp_path, content={**content, **changed})
        for changed in ({}, second)
    ]
    with pytest.raises(InputError, match=reason):
        compare_runs(runs, Progress())


def runs_with(folder, robot, *options):
    """Return a run per text of options, each with a log of its own, of one model."""
    runs = []
    for number, text in enumerate(options):
        logs = [f"{folder}/log{number}.csv"]
        content = {"logs": logs, "payload": None, "model": {"sha256": robot.sha256}}
        (folder / str(number)).mkdir(exist_ok=True)
        words = f'path = "{robot.path}"\nmeasurements = ["{folder}/log{number}.csv"]\n{text}\n'
        (folder / str(number) / "run.toml").write_text(words)
        runs.append(SimpleNamespace(folder=folder / str(number), content=content))
    return runs


RUN = 'mass_scale = 1.5\ntorque_scale = "scale.json"\n'
"""Options of runs whose arm is heavier than its model, and whose torques read twice as much."""


@pytest.fixture
def heavy(arm_file, tmp_path, monkeypatch):
    """The arm of these options, with the file of its torque scales."""
    monkeypatch.chdir(tmp_path)
    arm = load_robot_model(arm_file(XML), mass_scale=1.5)
    write_torque_scale(
        tmp_path / "scale.json", dict.fromkeys(arm.joint_names, (2.0, 0.01))
    )
    return arm


def write_logs(folder, arm, later=None, factor=1.0, zero=0.0):
    """Write two logs of an arm, of which the later one may be of another arm.

    The later log's torque of the middle joint reads ``factor`` times too much, and its position
    ``zero`` [rad] too much.
    """
    middle = np.eye(3)[1]
    for number, each in enumerate((arm, later or arm)):
        log = log_of(each, seed=number + 1, noise_torque=0.05)
        log = replace(log, tau=2.0 * log.tau)
        if number:
            tau = log.tau * (1.0 + (factor - 1.0) * middle)
            log = replace(log, tau=tau, q=log.q + zero * middle)
        write_measurement_csv(folder / f"log{number}.csv", arm.joint_names, [log])


def judged_logs(arm, folder, priors):
    """Return both logs judged together, with the scales of their file."""
    paths = [folder / f"log{number}.csv" for number in range(2)]
    logs = open_logs(
        arm, paths, LogOptions(torque_scale=Path("scale.json")), Progress()
    )
    for log in logs:
        scale, _ = joint_factors(log.options["torque_scale"], arm.joint_names, SCALE)
        assert np.all(scale == 2.0)
    options = EstimationOptions(priors=priors)
    question = change_question(ArmTerms(arm, loaded=True), options)
    return judge(arm, logs, question, Progress(), [False, True], [-1.0, 1.0])


AS_SURE = Priors(scale=(0.5, 0.5, 0.5))
"""Torque scales as sure as their file says [%]."""


@pytest.mark.slow
def test_logs_are_judged_against_the_runs_own_arm_with_its_options(heavy, tmp_path):
    write_logs(tmp_path, heavy)
    found = compare_runs(runs_with(tmp_path, heavy, RUN, RUN), Progress())
    of_runs, without_file = (
        [row.error for row in changes(judged_logs(heavy, tmp_path, priors).fit)]
        for priors in (AS_SURE, Priors())
    )
    assert [row.error for row in found] == pytest.approx(of_runs, rel=1e-9)
    assert of_runs != pytest.approx(without_file, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after", "name", "kind"),
    [
        ({"factor": 1.8}, FaultName.TORQUE_SCALE, Kind.SCALE),
        ({"zero": -0.3}, FaultName.ZERO, Kind.ZERO),
    ],
)
def test_a_doubt_that_is_what_has_changed_stops_no_comparison(
    heavy, tmp_path, after, name, kind
):
    write_logs(tmp_path, heavy, **after)
    doubted = judged_logs(heavy, tmp_path, AS_SURE).findings
    assert [each.about for each in doubted] == [name]
    found = compare_runs(runs_with(tmp_path, heavy, RUN, RUN), Progress())
    assert kind in {row.kind for row in found if row.reason == DIFFERS}


@pytest.mark.slow
def test_a_doubt_stops_a_comparison_unless_a_run_has_accepted_it(heavy, tmp_path):
    angle = np.radians(8.0)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    tilted = load_robot_model(heavy.path, mass_scale=1.5, gravity=tuple(gravity))
    write_logs(tmp_path, heavy, tilted)
    with pytest.raises(SysidError, match="--accept tilt"):
        compare_runs(runs_with(tmp_path, heavy, RUN, RUN), Progress())
    runs = runs_with(tmp_path, heavy, f'{RUN}accept = ["tilt"]', RUN)
    assert compare_runs(runs, Progress())


def test_runs_with_other_masses_or_gravity_have_no_common_fit(heavy, tmp_path):
    turned = "gravity = [1.0, 0.0, 0.0]\n" + RUN
    for option, other in (("mass-scale", ""), ("gravity", turned)):
        with pytest.raises(InputError, match=f"the runs differ in --{option}"):
            compare_runs(runs_with(tmp_path, heavy, RUN, other), Progress())


@pytest.mark.slow
def test_more_than_a_few_changes_are_those_of_another_arm():
    changes = {
        "scales": 1.0 + 0.2 * np.eye(4)[1],
        "offset": np.array([2.0, 0, 3.0, 2.0]),
    }
    with pytest.raises(SysidError, match="more differs than a few changes of one arm"):
        rows_of(3, NOTHING, ONE, False, zeros=0.05 * np.eye(4)[1], **changes)
