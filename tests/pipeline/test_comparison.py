"""Two runs of one arm: what has changed is found with its value, and nothing else is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rigs.core_fits import fit_recordings
from rigs.measured_logs import XML, log_of
from rigs.payload_logs import TrueArm, add_noise, four_joint_arm, wide_motion
from robot_sysid import spatial
from robot_sysid.errors import InputError
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.pipeline import comparison
from robot_sysid.pipeline.comparison import ALL_JOINTS, changes, compare_runs, sentences
from robot_sysid.records.messages import Progress
from robot_sysid.records.option_fields import SCALE, joint_factors, write_torque_scale

ROBOT = four_joint_arm()
BODY = spatial.theta_from_com(0.2, np.array([0.03, -0.02, 0.1]), 1e-4 * np.eye(3))
NOTHING = np.zeros(10)
ONE = np.array([0.0, 0.0, 0.3, 0.0])


def rows_of(seed, body=NOTHING, friction=0.0, swapped=False):
    """Return the changes between two runs, their links 10 % off the model, in either order."""
    arm = TrueArm(ROBOT, seed, model_error=0.1, payload=body)
    recordings = []
    for is_second in (False, True):
        motion = wide_motion([seed, is_second], duration=12.0)
        name = f"log{is_second}"
        log = arm.recording(motion, is_second, float(is_second), name, friction)
        is_later = is_second != swapped
        log = replace(log, is_loaded=is_later, order=1.0 if is_later else -1.0)
        recordings.append(add_noise(log, 0.05, [seed, is_second]))
    fitted = fit_recordings(ROBOT, recordings, loaded=True, drifts=True)
    return list(changes(replace(fitted, values=fitted.free)))


def test_a_body_that_came_on_is_found_and_the_order_changes_its_sign():
    rows = rows_of(0, body=BODY)
    for row, true in zip(rows, BODY):
        assert abs(row.value - true) < 3.0 * row.error
    assert rows[0].reason and rows[0].error < 0.05
    assert {row.of for row in rows if row.reason} == {"link3"}
    assert sentences(rows)[0].endswith("came on at link3") and len(sentences(rows)) == 1
    back = rows_of(0, body=BODY, swapped=True)
    for row, other in zip(rows, back):
        assert row.reason == other.reason
        if row.unit == "%":
            assert (1.0 + row.value / 100.0) * (1.0 + other.value / 100.0) == (
                pytest.approx(1.0, abs=0.002 * row.error)
            )
        else:
            assert row.value == pytest.approx(-other.value, abs=0.1 * row.error)
    assert sentences(back)[0].endswith("came off at link3")


def test_one_joints_friction_is_found():
    rows = rows_of(1, friction=ONE)
    (row,) = [row for row in rows if row.reason]
    assert row.of == "joint2" and abs(row.value - 30.0) < 3.0 * row.error < 30.0
    (sentence,) = sentences(rows)
    assert "the friction of joint2 is" in sentence and sentence.endswith("higher")


def test_a_change_of_all_joints_is_said_once():
    rows = rows_of(2, friction=-0.25)
    (row,) = [row for row in rows if row.reason]
    assert row.of == ALL_JOINTS and row.value == pytest.approx(-25.0, abs=5.0)
    assert sentences(rows)[0].endswith("lower")


@pytest.mark.parametrize("seed", [0, 1])
def test_nothing_is_named_where_nothing_has_changed(seed):
    rows = rows_of(seed)
    assert not any(row.reason for row in rows)
    (sentence,) = sentences(rows)
    assert sentence.startswith("no difference beyond the errors: mass")


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


class Checked(Exception):
    """Ends a comparison where its logs are judged."""


def runs_with(folder, robot, *options):
    """Return a run per text of options, each with a log of its own, of one model."""
    content = {"logs": ["log"], "payload": None, "model": {"sha256": robot.sha256}}
    runs = []
    for number, text in enumerate(options):
        (folder / str(number)).mkdir(exist_ok=True)
        words = f'path = "{robot.path}"\nmeasurements = ["{folder}/log{number}.csv"]\n{text}\n'
        (folder / str(number) / "run.toml").write_text(words)
        runs.append(SimpleNamespace(folder=folder / str(number), content=content))
    return runs


def test_logs_are_judged_against_the_runs_own_arm_with_its_options(
    arm_file, tmp_path, monkeypatch
):
    robot = load_robot_model(arm_file(XML))
    for number in range(2):
        log = log_of(robot, seed=number, noise_torque=0.1)
        write_measurement_csv(tmp_path / f"log{number}.csv", robot.joint_names, [log])
    write_torque_scale(
        tmp_path / "scale.json", dict.fromkeys(robot.joint_names, (2.0, 0.01))
    )

    def check(arm, logs, question, progress, is_loaded, order):
        assert arm.mass == pytest.approx(1.5 * robot.mass)
        assert question.options.priors.scale == pytest.approx((0.5, 0.5, 0.5))
        assert is_loaded == [False, True] and order == [-1.0, 1.0]
        return [
            joint_factors(log.options["torque_scale"], arm.joint_names, SCALE)[0]
            for log in logs
        ]

    def end(scales, accepted, progress):
        assert np.all(np.equal(scales, 2.0)) and accepted == {"zero"}
        raise Checked

    monkeypatch.setattr(comparison, "judge", check)
    monkeypatch.setattr(comparison, "usable", end)
    options = (
        'mass_scale = 1.5\naccept = ["zero"]\n'
        f'torque_scale = "{tmp_path / "scale.json"}"'
    )
    with pytest.raises(Checked):
        compare_runs(runs_with(tmp_path, robot, options, options), Progress())
    turned = "gravity = [1.0, 0.0, 0.0]\n" + options
    for option, other in (("mass-scale", ""), ("gravity", turned)):
        with pytest.raises(InputError, match=f"the runs differ in --{option}"):
            compare_runs(runs_with(tmp_path, robot, options, other), Progress())
