"""Recorded scenes of arms as people have them, and the causes that spoil a log or a model.

A cause is a function from a right scene to a spoiled one. Many are those of
``benchmarks.wrong_logs``, which spoil logs of any arm whose truth is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks import wrong_logs
from benchmarks.real_arms import SENSOR_ARMS, RealArm, draw_arm
from benchmarks.wrong_logs import carrying_joint
from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    LinkDynamics,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.records import Array, Measurement, RobotModel
from tests.support.wrong_logs import Truth

RIGHT = "right"
"""The cause that changes nothing."""
PAYLOAD_SHARE = 0.08
"""Mass of what is carried, as a part of the arm's."""
GRAVITY = 9.81
"""[m/s^2]"""
_CAUSE_STREAM = 77


@dataclass(frozen=True)
class Scene(Truth):
    """A recorded motion of an arm that is not as its model, and something may be wrong with it.

    Attributes:
        arm: the arm as it was drawn, with its motion and its right log.
        last_masses: of the last link, all that are true at some time of the log [kg].
    """

    arm: RealArm
    last_masses: tuple[float, ...]

    @property
    def usual_torque(self) -> Array:
        """Return the rms torque of each joint (n,), at least 2 % of the strongest joint's [N m]."""
        rms_torque = np.sqrt(np.mean(self.rigid**2, axis=0))
        return np.asarray(np.maximum(rms_torque, 0.02 * np.max(rms_torque)))

    @property
    def weight(self) -> float:
        """Return the weight of the arm [N]."""
        return float(np.sum(self.robot.thetas[:, 0])) * GRAVITY

    def with_more_torque(self, torque: Array) -> Scene:
        """Return the scene with further torque (N, n) in its log [N m]."""
        return replace(self, log=replace(self.log, tau=self.log.tau + torque))

    def with_joint_torque(self, joint: int, torque: Array) -> Scene:
        """Return the scene with further torque (N,) of one joint in its log [N m]."""
        tau = np.zeros_like(self.log.tau)
        tau[:, joint] = torque
        return self.with_more_torque(tau)

    def with_torque_times(self, factor: Array) -> Scene:
        """Return the scene with torques times a factor (n,) or (N, 1)."""
        return replace(self, log=replace(self.log, tau=self.log.tau * factor))


def resting_torque(
    robot: RobotModel, q: Array, thetas: Array, gravity_vector: Array | None = None
) -> Array:
    """Return the torque (N, n) of links (n, 10) at rest, under the model's or another gravity."""
    no_motion = np.zeros_like(q)
    return (
        LinkDynamics(robot, gravity_vector)
        .motion(q, no_motion, no_motion)
        .torque(thetas)
    )


def draw_scene(
    robot: RobotModel, arm_name: str, deviation: str, duration: float, seed: int
) -> Scene:
    """Return an arm with a right log of it; every other one has white noise."""
    arm = draw_arm(
        robot, deviation, arm_name in SENSOR_ARMS, duration, seed % 2 == 0, seed
    )
    return Scene(
        robot=robot,
        theta=arm.thetas[-1],
        log=arm.log,
        still=resting_torque(robot, arm.motion.q, arm.thetas),
        rigid=arm.rigid,
        friction=arm.log.tau - arm.rigid,
        rng=np.random.default_rng([seed, _CAUSE_STREAM]),
        arm=arm,
        last_masses=(float(arm.thetas[-1, 0]),),
    )


# ---- causes of the payload and of forces


def payload_of(scene: Scene) -> Array:
    """Return a payload (10,) in the last link's frame."""
    mass = PAYLOAD_SHARE * float(np.sum(scene.robot.thetas[:, 0]))
    return spatial.theta_from_com(
        mass, np.array([0.02, 0.01, 0.06]), 0.002 * mass * np.eye(3)
    )


def last_link_alone(scene: Scene, theta: Array) -> Array:
    """Return links (n, 10) that have no mass but for the last one (10,)."""
    thetas = np.zeros_like(scene.robot.thetas)
    thetas[-1] = theta
    return thetas


def torque_of_payload(scene: Scene, theta: Array) -> Array:
    """Return the torque (N, n) of a body (10,) that moves with the last link [N m]."""
    motion = scene.arm.motion
    links = LinkDynamics(scene.robot).motion(motion.q, motion.qd, motion.qdd)
    return links.torque(last_link_alone(scene, theta))


def torque_of_force(scene: Scene, force: Array) -> Array:
    """Return the torque (N, n) that holds a force (3,) at the last link's origin [N, N m]."""
    unit_mass = np.eye(10)[0]
    thetas = last_link_alone(scene, unit_mass)
    return resting_torque(scene.robot, scene.arm.motion.q, thetas, force)


def change_payload(
    scene: Scene, first_mass: float, second_mass: float, instant: float
) -> Scene:
    """Return the scene with parts of the payload before and after an instant [s]."""
    payload = payload_of(scene)
    share = np.where(scene.log.time < instant, first_mass, second_mass)
    changed = scene.with_more_torque(share[:, None] * torque_of_payload(scene, payload))
    link_mass = float(scene.theta[0])
    payload_mass = float(payload[0])
    masses = (
        link_mass + first_mass * payload_mass,
        link_mass + second_mass * payload_mass,
    )
    return replace(changed, last_masses=masses)


def middle_instant(scene: Scene) -> float:
    """Return an instant in the middle third of the log [s]."""
    return float(scene.rng.uniform(0.35, 0.65) * scene.log.time[-1])


def payload_drops(scene: Scene) -> Scene:
    """Return a log in which the arm loses its payload in the middle."""
    return change_payload(scene, 1.0, 0.0, middle_instant(scene))


def payload_grows(scene: Scene) -> Scene:
    """Return a log whose payload gets half as heavy again in the middle."""
    return change_payload(scene, 1.0, 1.5, middle_instant(scene))


def glued_states(scene: Scene) -> Scene:
    """Return a log whose second half was recorded a minute later and with a payload."""
    half = 0.5 * float(scene.log.time[-1])
    glued = change_payload(scene, 0.0, 1.0, half)
    seconds = scene.log.time + 60.0 * (scene.log.time >= half)
    return replace(glued, log=replace(glued.log, time=seconds))


def hand_carries(scene: Scene) -> Scene:
    """Return a log in which a hand carries 40 % of the last link with a payload."""
    loaded = change_payload(scene, 1.0, 1.0, 0.0)
    carried = last_link_alone(scene, scene.theta + payload_of(scene))
    weight_torque = resting_torque(scene.robot, scene.arm.motion.q, carried)
    return loaded.with_more_torque(-0.4 * weight_torque)


def push(scene: Scene) -> Scene:
    """Return a log with a push of 3 s at the tip, of 15 % of the arm's weight."""
    start = scene.rng.uniform(1.0, scene.log.time[-1] - 4.0)
    phase = (scene.log.time - start) / 3.0
    bump = np.where((phase > 0.0) & (phase < 1.0), np.sin(np.pi * phase), 0.0)
    direction = scene.rng.normal(size=3)
    force = 0.15 * scene.weight * direction / np.linalg.norm(direction)
    return scene.with_more_torque(bump[:, None] * torque_of_force(scene, force))


def constant_force(scene: Scene) -> Scene:
    """Return a log with a horizontal force at the tip, of 7 % of the arm's weight."""
    force = 0.05 * scene.weight * np.array([1.0, 1.0, 0.0])
    return scene.with_more_torque(torque_of_force(scene, force))


def spring(scene: Scene) -> Scene:
    """Return a log with a spring at one joint that makes 30 % of what the joint carries."""
    joint = carrying_joint(scene)
    q = scene.arm.motion.q[:, joint]
    stiffness = 0.3 * scene.usual_torque[joint] / max(float(np.std(q)), 1e-3)
    return scene.with_joint_torque(joint, stiffness * (q - np.mean(q) - 0.3))


def balancer(scene: Scene) -> Scene:
    """Return a log of an arm whose balancer carries 30 % of its weight."""
    return scene.with_more_torque(-0.3 * scene.still)


def tilt(scene: Scene) -> Scene:
    """Return a log of an arm whose base is 3.6 degrees off."""
    angles = np.radians([3.0, -2.0])
    tilted = turn_gravity(gravity_vector(scene.robot), angles)
    held = resting_torque(scene.robot, scene.arm.motion.q, scene.arm.thetas, tilted)
    return scene.with_more_torque(held - scene.still)


# ---- causes of drives


def ripple(scene: Scene) -> Scene:
    """Return a log with torque ripple of 10 % of what one joint carries."""
    joint = carrying_joint(scene)
    per_turn = float(scene.rng.choice([7, 12, 20]))
    size = 0.1 * scene.usual_torque[joint]
    return scene.with_joint_torque(
        joint, size * np.sin(per_turn * scene.arm.motion.q[:, joint])
    )


def crosstalk(scene: Scene) -> Scene:
    """Return a log in which one joint shows 5 % of its neighbour's torque."""
    joint = max(carrying_joint(scene), 1)
    neighbour = joint + 1 if joint + 1 < scene.robot.n_joints else joint - 1
    return scene.with_joint_torque(neighbour, 0.05 * scene.rigid[:, joint])


def coupling(scene: Scene) -> Scene:
    """Return a log of an arm with one motor that turns with both of its last two joints."""
    joints = [scene.robot.n_joints - 2, scene.robot.n_joints - 1]
    speed = np.sum(scene.arm.motion.qd[:, joints], axis=1)
    size = scene.usual_torque[joints[0]]
    torque = size * (0.4 * np.sign(speed) + 0.3 * speed / np.std(speed))
    return scene.with_joint_torque(joints[0], torque).with_joint_torque(
        joints[1], torque
    )


def hot_gears(scene: Scene) -> Scene:
    """Return a log whose dry friction begins 70 % larger and falls within 10 s."""
    excess = 0.7 * np.exp(-scene.log.time / 10.0)
    return scene.with_more_torque(
        excess[:, None] * scene.arm.coulomb * np.sign(scene.arm.motion.qd)
    )


def gain_drift(scene: Scene) -> Scene:
    """Return a log whose torques grow to 115 %."""
    return scene.with_torque_times(
        (1.0 + 0.15 * scene.log.time / scene.log.time[-1])[:, None]
    )


def joint_scale(scene: Scene) -> Scene:
    """Return a log in which the torque of one joint reads 1.4 times."""
    factors = np.ones(scene.robot.n_joints)
    factors[carrying_joint(scene)] = 1.4
    return scene.with_torque_times(factors)


def uncalibrated_currents(scene: Scene) -> Scene:
    """Return a log of currents, each joint's gain 1.2 to 2.1."""
    return scene.with_torque_times(scene.rng.uniform(1.2, 2.1, scene.robot.n_joints))


# ---- causes of the recording and of the model


def long_time(scene: Scene) -> Scene:
    """Return a log whose time is 10 % too long."""
    return replace(scene, log=replace(scene.log, time=1.1 * scene.log.time))


def stale_samples(scene: Scene) -> Scene:
    """Return a log in which 0.8 % of the rows repeat the row before."""
    count = len(scene.log)
    rows = np.arange(count)
    rows -= (scene.rng.random(count) < 0.008) & (rows > 0)
    return replace(
        scene, log=replace(scene.log, q=scene.log.q[rows], tau=scene.log.tau[rows])
    )


def leave_right(scene: Scene) -> Scene:
    """Return the scene as it is."""
    return scene


Cause = Callable[[Scene], Scene]


def spoil_log(fault: Callable[[Truth], Measurement], scene: Scene) -> Scene:
    """Return the scene with its log spoiled by a function of ``benchmarks.wrong_logs``."""
    return replace(scene, log=fault(scene))


def causes_of_logs(
    names: tuple[str, ...], *faults: str
) -> dict[str, tuple[Cause, tuple[str, ...]]]:
    """Return faults of ``benchmarks.wrong_logs`` as causes with common names of checks."""
    causes = {}
    for fault in faults:
        causes[fault] = (partial(spoil_log, wrong_logs.FAULTS[fault]), names)
    return causes


SCALE = ("torque-scale",)
# Too long a time makes less of the accelerations, as if gravity were more.
CLOCK = ("clock", "gravity")
CAUSES: dict[str, tuple[Cause, tuple[str, ...]]] = {
    RIGHT: (leave_right, ()),
    "payload_drops": (payload_drops, ("payload-step",)),
    "payload_grows": (payload_grows, ("payload-step",)),
    "glued_states": (glued_states, ("payload-step",)),
    "hand_carries": (hand_carries, ("force",)),
    "push": (push, ("contact",)),
    **causes_of_logs(("contact",), "collision", "hum"),
    "constant_force": (constant_force, ("force",)),
    "spring": (spring, ("force",)),
    "balancer": (balancer, ("gravity", "clock")),
    "tilt": (tilt, ("tilt",)),
    "ripple": (ripple, ("ripple",)),
    "crosstalk": (crosstalk, ("crosstalk", "coupling")),
    "coupling": (coupling, ("coupling",)),
    "hot_gears": (hot_gears, ("friction",)),
    "gain_drift": (gain_drift, SCALE),
    "joint_scale": (joint_scale, SCALE),
    "uncalibrated": (uncalibrated_currents, SCALE),
    **causes_of_logs(SCALE, "amperes", "motor_side", "millinewtonmetres", "other_unit"),
    **causes_of_logs(SCALE, "per_cent", "one_joint_in_millinewtonmetres"),
    **causes_of_logs(("gravity",), "gravity_compensated", "external"),
    **causes_of_logs(("computed",), "computed_torque"),
    **causes_of_logs(("sign",), "torque_sign", "position_sign"),
    **causes_of_logs(("order",), "exchanged_joints", "reversed_order"),
    **causes_of_logs(("angle-unit",), "degrees_as_radians", "radians_as_degrees"),
    **causes_of_logs(("zero",), "position_offset"),
    **causes_of_logs(("delay",), "late_torque", "late_joint"),
    "long_time": (long_time, CLOCK),
    **causes_of_logs(CLOCK, "drifting_clock"),
    **causes_of_logs(("clock",), "dropped_samples", "clock_jump"),
    "stale_samples": (stale_samples, ("clock",)),
    **causes_of_logs(("saturated",), "saturated_sensor"),
    **causes_of_logs(("held",), "held"),
    **causes_of_logs(("model",), "other_arm"),
}
"""Cause to what makes it, and to the names of the checks that name it rightly."""
