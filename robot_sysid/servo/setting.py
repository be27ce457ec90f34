"""What the setting of a recording changes: the links that a joint moves, gains and torques.

n is the number of joints.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.model.bodies import body_theta, write_body
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.simulation.playback import ServoParameters
from robot_sysid.spatial import aluminium_ball, com_from_theta, theta_from_com

LEAST_ARM = 1e-6
"""Distance of a centre of mass from a joint below which it has no direction [m]: rounding of a
file."""


def links_of(
    robot: RobotModel, setting: ServoSetting
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the thetas (n, 10) of an arm's links with the load of a setting, and which links (n,)
    are known because they were weighed.

    A load is a ball around its place. One that is the whole link has the shape of the model's.

    Raises:
        InputError: a load's distance has no direction, see ``ServoSetting``.
    """
    thetas = robot.thetas
    is_known = np.zeros(len(thetas), dtype=bool)
    if not setting.load_mass:
        return thetas, is_known
    mass, com, inertia = com_from_theta(thetas[-1])
    place = np.asarray(setting.load_position or (), dtype=float)
    if setting.load_distance is not None:
        joint = robot.mj_model.dof_jntid[robot.dof_index[-1]]
        anchor = robot.mj_model.jnt_pos[joint]
        arm = com - anchor
        length = np.linalg.norm(arm)
        if length < LEAST_ARM:
            raise InputError(
                f"{robot.path}: the model has the centre of mass of the last link at its joint, so "
                "that a distance from it is no place; give the load's position x y z in the frame "
                "of the last link"
            )
        place = anchor + setting.load_distance * arm / length
    if setting.is_whole_link:
        of_link = inertia * setting.load_mass / mass
        thetas[-1] = theta_from_com(setting.load_mass, place, of_link)
        is_known[-1] = True
    else:
        thetas[-1] += aluminium_ball(setting.load_mass, place)
    return thetas, is_known


def strength_of(setting: ServoSetting, first: ServoSetting) -> float:
    """Return the torque at a voltage over that of the first recording; 1 where one is not known."""
    if setting.voltage is None or first.voltage is None:
        return 1.0
    return setting.voltage / first.voltage


def gain_of(setting: ServoSetting, first: ServoSetting) -> float:
    """Return the gain over that of the first recording.

    A servo's register sets the share of the supply that a position error asks for.
    """
    strength = strength_of(setting, first)
    if setting.register is None or first.register is None:
        return strength
    return strength * setting.register / first.register


def loaded(robot: RobotModel, setting: ServoSetting) -> RobotModel:
    """Return an arm whose compiled model carries the load of a setting."""
    thetas, _ = links_of(robot, setting)
    more = thetas[-1] - robot.thetas[-1]
    if not np.any(more):
        return robot
    model = robot.mj_model.__copy__()
    body = robot.links[-1].body_id
    write_body(model, body, body_theta(model, body) + more)
    return replace(robot, mj_model=model)


def with_setting(
    servos: ServoParameters, setting: ServoSetting, first: ServoSetting
) -> ServoParameters:
    """Return the parameters of servos of the first recording's setting in another setting."""
    numbers = servos.numbers.copy()
    numbers[0] *= gain_of(setting, first)
    return replace(
        servos, numbers=numbers, limits=strength_of(setting, first) * servos.limits
    )
