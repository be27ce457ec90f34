"""What has changed between two runs of one arm: one fit of both runs' logs.

Errors that both runs share, such as those of the other links and of torque scales, are there once.
What came on at the last link is the payload of the second run's logs, and friction drifts from one
run to the other. Shapes: J joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.config import IdentifyConfig, with_scale_prior
from robot_sysid.diagnosis.gate import judge, usable
from robot_sysid.errors import InputError
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.terms import DRIFT, PAYLOAD_NAMES
from robot_sysid.logs.reader import open_logs, refuse_repeated_logs
from robot_sysid.pipeline.stages import load_arm
from robot_sysid.records.file_access import RUN_NAME, read_toml
from robot_sysid.records.messages import Progress, with_error
from robot_sysid.records.parameters import INERTIAL
from robot_sysid.records.usual_errors import FRICTION_CHANGE
from robot_sysid.report.runs import Run
from robot_sysid.results.record import Quantity
from robot_sysid.wording import option_name

ALL_JOINTS = "all joints alike"
"""What a change of friction is of that is the same in all joints."""
DIFFERS = "differs"
"""Reason of a row in which the runs differ, beyond errors and what friction does in a day."""


def compare_runs(runs: Sequence[Run], progress: Progress) -> list[Quantity]:
    """Return what may have changed from a first run to a second: the last link, friction.

    A row is a number of the second run less that of the first, of friction in per cent of the first
    run's; its reason is ``DIFFERS`` where the runs do.

    Args:
        runs: two runs.
        progress: receives stages.

    Raises:
        InputError: there is no common fit of the two runs; the message says why.
    """
    if any(not run.content["logs"] or run.content["payload"] for run in runs):
        raise InputError("only identifications from logs have a common fit")
    if len({run.content["model"]["sha256"] for run in runs}) > 1:
        raise InputError("the runs are of different model files")
    configs = [IdentifyConfig.of(**read_toml(run.folder / RUN_NAME)) for run in runs]
    for key in ("mass_scale", "gravity"):
        if len({getattr(config.model, key) for config in configs}) > 1:
            raise InputError(f"the runs differ in {option_name(key)}")
    robot = load_arm(configs[0], Progress())
    if robot.sha256 != runs[0].content["model"]["sha256"]:
        raise InputError(f"{robot.path} has changed since the runs")
    logs = []
    orders: list[float] = []
    accepted: set[str] = set()
    for config, order in zip(configs, (-1.0, 1.0)):
        accepted |= {*config.log.accept}
        for path in config.log.measurements:
            progress.stage(f"Reading {path}...")
        of_run = open_logs(robot, config.log.measurements, config.log)
        logs += of_run
        orders += [order] * len(of_run)
    refuse_repeated_logs(logs)
    progress.stage("Fitting both runs at once...")
    first = configs[0]
    estimation = with_scale_prior(first.estimation, first.log, robot.joint_names)
    estimation = replace(estimation, torques="chain", no_friction=False)
    question = Question(estimation, loaded=True, drifts=True)
    is_loaded = [order > 0.0 for order in orders]
    judged = judge(robot, logs, question, progress, is_loaded, orders)
    fitted, _ = usable(judged, accepted, progress)
    # What came off is no possible body.
    return list(changes(replace(fitted, values=fitted.free)))


def changes(fitted: Fit) -> Iterator[Quantity]:
    """Yield what may have changed, from the fit of two runs."""
    # Standard errors beyond which two runs differ: three miss 30 % more friction of a simulated
    # joint, two name a joint between two logs of a KUKA LWR4+.
    sure = 2.5
    at = fitted.at(PAYLOAD_NAMES[:4])
    values, errors = fitted.free[at], fitted.errors[at]
    inverse = np.linalg.pinv(fitted.covariance[np.ix_(at, at)], hermitian=True)
    # All four at once, as a normal number (Fisher's approximation of chi-square).
    distance = np.sqrt(2.0 * values @ inverse @ values) - np.sqrt(2.0 * len(at) - 1.0)
    body = fitted.arm.robot.body_name
    for entry, value, error in zip(INERTIAL, values, errors):
        reason = DIFFERS if min(distance, abs(value) / error) > sure else ""
        yield Quantity(entry.name, body, entry.unit, None, value, error, reason=reason)
    joints = fitted.arm.joints
    at = fitted.at(fitted.arm.terms[DRIFT].names)
    # Friction is 1 - d in the first run and 1 + d in the second: the logarithm of their ratio.
    logarithms = 2.0 * np.arctanh(np.clip(fitted.free[at], -0.9, 0.9))
    errors = 2.0 * fitted.errors[at]
    spreads = np.hypot(errors, FRICTION_CHANGE)
    # A median, because one joint does not make a change of all.
    common = float(np.median(logarithms))
    error = float(np.sqrt(np.pi / 2.0 / np.sum(spreads**-2.0)))
    is_common = abs(common) > sure * error
    yield _friction(ALL_JOINTS, common, error, is_common)
    apart = np.abs(logarithms - common * is_common) > sure * spreads
    for joint, logarithm, error, differs in zip(joints, logarithms, errors, apart):
        yield _friction(joint, logarithm, error, differs)


def _friction(of: str, logarithm: float, error: float, differs: bool) -> Quantity:
    """Return a change of friction from the logarithm of the ratio."""
    ratio = float(np.exp(logarithm))
    change = 100.0 * (ratio - 1.0)
    reason = DIFFERS if differs else ""
    return Quantity(
        "friction", of, "%", None, change, 100.0 * ratio * error, reason=reason
    )


def sentences(rows: Sequence[Quantity]) -> list[str]:
    """Return what differs, a sentence each; or one that says how small the differences are."""
    # The first of what has changed of a body or joint: a mass that came on has first moments, too.
    found = {row.of: _sentence(row) for row in reversed(rows) if row.reason}
    if found:
        return list(found.values())[::-1]
    mass = with_error(rows[0].value, rows[0].error, rows[0].unit)
    friction = max(row.error or 0.0 for row in rows if row.name == "friction")
    return [
        f"no difference beyond the errors: mass {mass}, friction of each joint within "
        f"± {max(friction, 100.0 * FRICTION_CHANGE):.0f} %"
    ]


def _sentence(row: Quantity) -> str:
    """Return what has changed, in words."""
    size = with_error(abs(row.value), row.error, row.unit)
    if row.unit == "%":
        way = "higher" if row.value > 0.0 else "lower"
        return f"the friction of {row.of} is {size} {way}"
    if row.unit == "kg":
        return f"{size} came {'on' if row.value > 0.0 else 'off'} at {row.of}"
    moved = with_error(row.value, row.error, row.unit)
    return (
        f"mass times centre of mass of {row.of} along {row.name[1:]} changed by {moved}"
    )
