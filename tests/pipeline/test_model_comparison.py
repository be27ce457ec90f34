"""An arm that is compared with its model: what was put in is found, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of, wrong_links
from robot_sysid.config import IdentifyConfig
from robot_sysid.pipeline.changes import DIFFERS, NOT_JUDGED, Kind
from robot_sysid.pipeline.comparison import compare_with_model
from robot_sysid.records.messages import Progress

ARM = small_arms.serial_arm(small_arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')
ROBOT = small_arms.robot_of(ARM)
CONFIG = IdentifyConfig.of(path="arm.xml", measurements=("log.csv",))


def check_of(seed, change=lambda log: log):
    """Return the comparison of an arm, links 10 to 20 % off and one 40 %, whose log is changed."""
    truth = truth_of(ROBOT, seed)
    links = wrong_links(ROBOT, np.random.default_rng([seed, 1]))
    arm = replace(truth.arm, thetas=links)
    noise = 0.02 * np.random.default_rng(seed).standard_normal(truth.motion.q.shape)
    log = change(arm.log(truth.motion, noise))
    return compare_with_model(ROBOT, [log], CONFIG, Progress())


def named(check):
    """Return name and joint of what differs."""
    return {(row.name, row.of) for row in check.changes if row.reason == DIFFERS}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_an_arm_that_is_as_far_off_as_arms_are_differs_in_nothing(seed):
    check = check_of(seed)
    assert not check.has_changed and not named(check)
    assert check.verdict[0].startswith("As the model says: no difference")
    assert check.since == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "change"),
    [("zero", 9.0, {"q": np.radians(9.0)}), ("offset", 6.0, {"tau": 6.0})],
)
def test_a_difference_of_many_times_the_usual_one_is_named_with_its_value(
    name, value, change
):
    joint = np.eye(4)[1]

    def changed(log):
        fields = {key: getattr(log, key) + size * joint for key, size in change.items()}
        return replace(log, **fields)

    check = check_of(2, changed)
    assert check.has_changed
    assert named(check) == {(name, "joint1")}
    (row,) = [row for row in check.changes if row.reason == DIFFERS]
    assert abs(row.value - value) < 3.0 * row.error < 0.5 * value
    assert row.least < value


@pytest.mark.slow
@settings(max_examples=6)
@given(small_arms.SEEDS, st.floats(-10.0, 10.0), st.floats(-6.0, 6.0))
def test_what_differs_is_what_is_beyond_a_multiple_of_its_error_and_what_is_usual(
    seed, turn, pull
):
    """Of 3 errors for what each joint carries and its friction, of one more for all others."""
    joint = np.eye(4)[1]
    check = check_of(
        seed,
        lambda log: replace(
            log, q=log.q + np.radians(turn) * joint, tau=log.tau + pull * joint
        ),
    )
    # Where the torques do not fit, the verdict names no number.
    is_misfit = check.has_changed and not named(check)
    for row in check.changes:
        times = row.least / np.hypot(row.error, row.usual)
        if row.kind is Kind.FRICTION_IN_MOTION:
            # Other friction than the model's is usual, of any size.
            assert times > 3.0 - 1e-9
        elif row.kind is Kind.WEIGHT:
            assert times == pytest.approx(3.0)
        else:
            first = check.changes[0]
            of_first = first.least / np.hypot(first.error, first.usual)
            assert times == pytest.approx(of_first) and times > 3.0
        reason = NOT_JUDGED if row.kind is Kind.FRICTION_IN_MOTION else DIFFERS
        if row.reason == reason:
            assert abs(row.value) > row.least
        elif abs(row.value) > row.least and not is_misfit:
            # A wrist that carries next to nothing, whose row is not shown.
            assert row.name == "weight" and row.reason == "not shown"


@pytest.mark.slow
def test_a_difference_that_links_may_look_like_is_said_as_perhaps():
    turned = np.radians(7.0) * np.eye(4)[1]
    check = check_of(2, lambda log: replace(log, q=log.q + turned))
    assert named(check) == {("zero", "joint1")}
    assert not check.has_changed
    assert check.notes[0].startswith("perhaps, but not certain: the position of joint1")
    assert check.verdict[0].startswith("Perhaps differs from the model: the position")


@pytest.mark.slow
def test_what_nothing_explains_is_said_of_each_joint_without_a_cause():
    def changed(log):
        wave = 8.0 * np.sign(np.sin(5.0 * log.time)) * np.sin(23.0 * log.time)
        return replace(log, tau=log.tau + wave[:, None] * np.eye(4)[2])

    check = check_of(2, changed)
    assert check.has_changed and not named(check)
