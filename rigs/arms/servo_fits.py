"""Fits of servos with numbers that are made up, for tests of what follows from them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.estimate.links import link_factor
from robot_sysid.records import Array, DataOrigin, RobotModel
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting
from robot_sysid.servo.derived import largest_weights
from robot_sysid.servo.fit import FIRM, ServoFit, likely_gains
from robot_sysid.servo.play import DIRECTIONS, LINK_SHARE, KnownLinks
from robot_sysid.servo.result import IN_FILE, ServoIdentification
from robot_sysid.servo.unknowns import NAMES, UNKNOWNS, column
from robot_sysid.simulation.playback import ServoParameters

USUAL = {
    "gain": 20.0,
    "torque_limit": 5.0,
    "damping": 1.0,
    "frictionloss": 0.1,
    "armature": 0.01,
}
"""Numbers of a joint with which it creeps to its command: those that none is without."""
OVER_GAIN = ("torque_limit", "damping", "frictionloss", "armature", "stribeck")


def with_links(own: Array) -> Array:
    """Return the covariance of unknowns (n, u, u) and of link errors that nothing shows."""
    n, u, _ = own.shape
    whole = np.tile(np.eye(u + DIRECTIONS), (n, 1, 1))
    whole[:, :u, :u] = own
    return whole


def off_with_links(robot: RobotModel, fit: ServoFit, size: float = 0.2) -> ServoFit:
    """Return a fit whose gains are off by a share as the weights are."""
    k = column("gain")
    first = len(NAMES)
    weight, by_thetas = largest_weights(robot, robot.thetas)
    errors = np.einsum("nk,nk->n", by_thetas, fit.links.directions[:, :, 0])
    covariance = fit.covariance.copy()
    of_gain = size / UNKNOWNS["gain"].deviation
    of_links = size * weight / np.maximum(errors, 1e-12)
    covariance[:, k, k] += of_gain**2
    covariance[:, k, first] = covariance[:, first, k] = of_gain * of_links
    covariance[:, first, first] = of_links**2
    return replace(fit, covariance=covariance)


def servo_fit(
    robot: RobotModel, error: float = 0.02, **numbers: Sequence[float] | float
) -> ServoFit:
    """Return a fit of an arm's servos, whose file has the same numbers.

    Args:
        robot: the arm.
        error: standard error of each number, over what is known of it before.
        numbers: of ``unknowns``, of each joint or all [N m/rad, N m, ...], none of them over the
            gain; those of ``USUAL`` where they are left out, then zero.
    """
    n = robot.n_joints
    columns = {**dict.fromkeys(NAMES, 0.0), **USUAL, **numbers}
    values = {name: np.broadcast_to(column, n) for name, column in columns.items()}
    likely = likely_gains(robot)
    gain = values["gain"]
    x = np.empty((n, len(NAMES)))
    for k, (name, unknown) in enumerate(UNKNOWNS.items()):
        value = values[name] / gain if name in OVER_GAIN else values[name]
        value = value / likely if name == "gain" else value
        change = (
            np.log(value / unknown.mean)
            if unknown.is_logarithm
            else value - unknown.mean
        )
        x[:, k] = change / unknown.deviation
    u = len(NAMES)
    own = np.tile(error**2 * np.eye(u), (n, 1, 1))
    # The first link error is that of the joint's largest weight.
    _, by_thetas = largest_weights(robot, robot.thetas)
    factor = link_factor(robot, [*range(n)], LINK_SHARE)
    of_weight = by_thetas @ factor
    of_weight /= np.maximum(np.linalg.norm(of_weight, axis=1), 1e-12)[:, None]
    directions = np.zeros((n, 10 * n, DIRECTIONS))
    directions[:, :, 0] = of_weight @ factor.T
    delay = float(values["command_delay"][0])
    in_file = ServoParameters(
        np.stack([values[name] for name in IN_FILE]),
        delay,
        values["torque_limit"].copy(),
        np.zeros(n),
        np.full(n, FIRM),
    )
    return ServoFit(
        x=x,
        link_errors=np.zeros((n, DIRECTIONS)),
        covariance=with_links(own),
        links=KnownLinks(robot.thetas, factor, directions),
        x_given_links=x,
        given_links=own,
        likely_gain=likely,
        is_known=np.ones(n, dtype=bool),
        is_fast=np.zeros(n, dtype=bool),
        in_file=in_file,
        held_x=x,
        mean=0.0 * x,
        deviation=np.ones_like(x),
        delay=delay,
        delay_error=0.001,
    )


FOUND = {
    "gain": 50.0,
    "torque_limit": 5.0,
    "damping": 3.0,
    "frictionloss": 0.2,
    "armature": 0.1,
    "load_share": 0.1,
    "command_delay": 0.02,
}
"""Numbers of each joint of ``identification_of``."""


def new_in_file(robot: RobotModel) -> ServoParameters:
    """Return what the file gets of joints with the numbers ``FOUND``."""
    n = robot.n_joints
    column = [FOUND[name] for name in ("gain", "damping", "frictionloss", "armature")]
    return ServoParameters(
        np.repeat(np.array(column)[:, None], n, axis=1),
        FOUND["command_delay"],
        np.full(n, FOUND["torque_limit"]),
        np.zeros(n),
        np.full(n, 0.99),
    )


def found_fit(robot: RobotModel, **numbers: Sequence[float] | float) -> ServoFit:
    """Return a fit with the numbers ``FOUND``, but for some, of which the file gets its own."""
    fit = servo_fit(robot, **{**FOUND, **numbers})
    return replace(fit, in_file=new_in_file(robot))


def identification_of(
    robot: RobotModel,
    fit: ServoFit | None = None,
    error: float = 0.1,
    goal: float = 0.5,
    setting: ServoSetting = UNKNOWN,
) -> ServoIdentification:
    """Return an identification whose models before and after miss positions by 1 and an error.

    Args:
        robot: the arm.
        fit: what was found; numbers ``FOUND`` of which the file gets all that it holds if not
            given.
        error: of the model after [rad].
        goal: of the commands of some time before [rad].
        setting: of the log.
    """
    n = robot.n_joints
    fit = fit or found_fit(robot)
    return ServoIdentification(
        robot=robot,
        fit=fit,
        is_new=fit.is_known,
        data=DataOrigin("log log.csv", 10.0, 50.0),
        before=np.ones(n),
        after=np.full(n, error),
        fitted=np.full(n, error),
        goal=goal,
        window=5.0,
        setting=setting,
        notes=(),
    )
