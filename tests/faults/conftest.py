"""An arm with a correct log, which the tests of all checks spoil."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.logs.log_files import motion
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.faults.columns import fault_columns
from robot_sysid.faults.gate import judge
from robot_sysid.records.messages import Progress
from robot_sysid.signals.process import low_pass_recordings

FOUR_AXES = (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X)
JOINT = 'range="-2.5 2.5" frictionloss=".4" damping=".2"'
SAMPLES = motion(2000)
NOISY = replace(
    SAMPLES,
    tau=SAMPLES.tau + 0.01 * np.random.default_rng(1).normal(size=SAMPLES.tau.shape),
)


def slow(*values):
    """Return values of a parameter that repeat what others show, for the slow tests."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def read_log(robot, samples, name="log.csv", divided=1.0):
    """Return samples as a log that was read, its torques divided by a scale."""
    return replace(
        samples,
        name=name,
        joint_names=robot.joint_names,
        options={"torque_scale": divided},
    )


def judged(robot, *samples, divided=1.0, progress=None, **options):
    """Return logs of an arm that were judged together."""
    logs = [
        read_log(robot, each, f"log{k}.csv", divided) for k, each in enumerate(samples)
    ]
    question = Question(EstimationOptions(**options))
    return judge(robot, logs, question, progress or Progress())


def findings_of(robot, *samples, **options):
    """Return what is wrong with logs of an arm."""
    return judged(robot, *samples, **options).findings


def found_in(truth, **samples):
    """Return what is wrong with a log of a truth, some of whose samples are others."""
    return findings_of(truth.robot, replace(truth.log, **samples))


def fit_of(truth, **samples):
    """Return the fit of a log of a truth, some of whose samples are others, for all causes."""
    logs = [replace(truth.log, name="log", **samples)]
    recordings, _ = low_pass_recordings(truth.robot, logs, None)
    question = Question(EstimationOptions())
    return solve_question(truth.robot, recordings, question, beside=fault_columns)


@pytest.fixture(scope="session")
def right(four_joints):
    """Return the fit of a right log, with the columns of all causes."""
    return fit_of(four_joints)


@pytest.fixture(scope="session")
def four_joints():
    """Return a correct log of an arm of four joints with friction and its truth."""
    return truth_of(
        small_arms.robot_of(small_arms.serial_arm(FOUR_AXES, joint=JOINT)), seed=4
    )
