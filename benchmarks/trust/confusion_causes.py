"""Recorded scenes of arms as people have them, and the causes that spoil a log or a model.

A cause has a function from a right scene to a spoiled one. Many are those of
``benchmarks.trust.wrong_logs``, which spoil logs of any arm whose truth is known. Others leave the
log and spoil the model that it is identified with, or spoil several things at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust import wrong_logs
from benchmarks.trust.real_arms import SENSOR_ARMS
from benchmarks.trust.wrong_logs import carrying_joint
from rigs.arms.wrong_arms import Truth, draw_arm, link_torque, resting_torque
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    gravity_vector,
    turn_gravity,
)
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Recording

RIGHT = "right"
"""The cause that changes nothing."""
PAYLOAD_SHARE = 0.08
"""Mass of what is carried, as a part of the arm's."""
GRAVITY = 9.81
"""[m/s^2]"""
_CAUSE_STREAM = 77

Edit = Callable[[Any], None]
"""Function that changes a model's ``MjSpec``."""


@dataclass(frozen=True)
class Scene(Truth):
    """A recorded motion of an arm that is not as its model, and something may be wrong with it.

    Attributes:
        last_masses: of the last link, all that are true at some time of the log [kg].
        path: the right model's file.
        edit: changes the right model's ``MjSpec`` into the one that the log is identified with.
        urdf: text of a URDF that is used in its place; "" for none.
        other_path: a model file that is used in its place; None for none.
        culprit: name of the joint or body that is wrong; "" where none is alone.
        pieces: logs that are identified together; () for the log alone.
    """

    last_masses: tuple[float, ...]
    path: Path
    edit: Edit | None = None
    urdf: str = ""
    other_path: Path | None = None
    culprit: str = ""
    pieces: tuple[Recording, ...] = ()

    @property
    def logs(self) -> tuple[Recording, ...]:
        """Return the logs that are identified together."""
        return self.pieces or (self.log,)

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


def draw_scene(
    path: Path,
    arm_name: str,
    deviation: str,
    duration: float,
    seed: int,
    gravity: Sequence[float] | None = None,
) -> Scene:
    """Return an arm that differs from a model file with a right log of it.

    Every other log has white noise. ``gravity`` is the direction that is stated; None for none.
    """
    robot = load_robot_model(path, gravity=gravity)
    has_sensors = arm_name in SENSOR_ARMS
    truth = draw_arm(robot, deviation, has_sensors, duration, seed % 2 == 0, seed)
    return Scene(
        truth.arm,
        truth.plan,
        truth.motion,
        truth.log,
        truth.rigid,
        friction=truth.log.tau - truth.rigid,
        rng=np.random.default_rng([seed, _CAUSE_STREAM]),
        last_masses=(float(truth.theta[0]),),
        path=path,
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
    return link_torque(scene.robot, scene.motion, last_link_alone(scene, theta))


def torque_of_force(scene: Scene, force: Array) -> Array:
    """Return the torque (N, n) that holds a force (3,) at the last link's origin [N, N m]."""
    unit_mass = np.eye(10)[0]
    thetas = last_link_alone(scene, unit_mass)
    return resting_torque(scene.robot, scene.motion.q, thetas, force)


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
    weight_torque = resting_torque(scene.robot, scene.motion.q, carried)
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
    q = scene.motion.q[:, joint]
    stiffness = 0.3 * scene.usual_torque[joint] / max(float(np.std(q)), 1e-3)
    return scene.with_joint_torque(joint, stiffness * (q - np.mean(q) - 0.3))


def balancer(scene: Scene) -> Scene:
    """Return a log of an arm whose balancer carries 30 % of its weight."""
    return scene.with_more_torque(-0.3 * scene.still)


def tilt(scene: Scene) -> Scene:
    """Return a log of an arm whose base is 3.6 degrees off."""
    return tilt_by(np.array([3.0, -2.0]), scene)


def tilt_by(degrees: Array, scene: Scene) -> Scene:
    """Return a log of an arm whose base is turned by two angles (2,) [degrees]."""
    tilted = turn_gravity(gravity_vector(scene.robot), np.radians(degrees))
    held = resting_torque(scene.robot, scene.motion.q, scene.arm.thetas, tilted)
    return scene.with_more_torque(held - scene.still)


def mount(degrees: float, scene: Scene) -> Scene:
    """Return a log of an arm whose base is mounted at an angle, in any direction."""
    direction = scene.rng.uniform(0.0, 2.0 * np.pi)
    return tilt_by(degrees * np.array([np.cos(direction), np.sin(direction)]), scene)


# ---- causes of drives


def ripple(scene: Scene) -> Scene:
    """Return a log with torque ripple of 10 % of what one joint carries."""
    joint = carrying_joint(scene)
    per_turn = float(scene.rng.choice([7, 12, 20]))
    size = 0.1 * scene.usual_torque[joint]
    return scene.with_joint_torque(
        joint, size * np.sin(per_turn * scene.motion.q[:, joint])
    )


def crosstalk(scene: Scene) -> Scene:
    """Return a log in which one joint shows 5 % of its neighbour's torque."""
    joint = max(carrying_joint(scene), 1)
    neighbour = joint + 1 if joint + 1 < scene.robot.n_joints else joint - 1
    return scene.with_joint_torque(neighbour, 0.05 * scene.rigid[:, joint])


def coupling(scene: Scene) -> Scene:
    """Return a log of an arm with one motor that turns with both of its last two joints."""
    joints = [scene.robot.n_joints - 2, scene.robot.n_joints - 1]
    speed = np.sum(scene.motion.qd[:, joints], axis=1)
    size = scene.usual_torque[joints[0]]
    torque = size * (0.4 * np.sign(speed) + 0.3 * speed / np.std(speed))
    return scene.with_joint_torque(joints[0], torque).with_joint_torque(
        joints[1], torque
    )


def hot_gears(scene: Scene) -> Scene:
    """Return a log whose dry friction begins 70 % larger and falls within 10 s."""
    excess = 0.7 * np.exp(-scene.log.time / 10.0)
    return scene.with_more_torque(
        excess[:, None] * scene.arm.coulomb * np.sign(scene.motion.qd)
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


# ---- further causes of drives and of the recording


def own_torque(noise: float, scene: Scene) -> Scene:
    """Return a log of the torques that the model itself takes, with noise [N m]."""
    tau = ArmDynamics(scene.robot)(scene.motion)
    tau = tau + noise * scene.rng.normal(size=tau.shape)
    return replace(scene, log=replace(scene.log, tau=tau))


def gear_loss(scene: Scene) -> Scene:
    """Return a log of gears that lose 15 % of what they carry."""
    motion = scene.motion
    return scene.with_more_torque(0.15 * np.abs(scene.rigid) * np.sign(motion.qd))


def friction_falls(scene: Scene) -> Scene:
    """Return a log whose friction falls by a third from its beginning to its end."""
    qd = scene.motion.qd
    friction = scene.arm.coulomb * np.sign(qd) + scene.arm.viscous * qd
    share = scene.log.time / scene.log.time[-1] / 3.0
    return scene.with_more_torque(-share[:, None] * friction)


def with_velocities(scene: Scene, factors: Array) -> Scene:
    """Return the scene with recorded velocities, times factors (n,)."""
    qd = scene.motion.qd
    noisy = qd + 1e-3 * scene.rng.normal(size=qd.shape)
    return replace(scene, log=replace(scene.log, qd=factors * noisy))


def velocities(scene: Scene) -> Scene:
    """Return a right log with velocities."""
    return with_velocities(scene, np.ones(scene.robot.n_joints))


def slow_velocities(scene: Scene) -> Scene:
    """Return a log whose velocities are 0.8 times the true ones."""
    return with_velocities(scene, np.full(scene.robot.n_joints, 0.8))


def half_slow_velocities(scene: Scene) -> Scene:
    """Return a log whose velocities are 0.8 times the true ones at every other joint."""
    factors = np.where(np.arange(scene.robot.n_joints) % 2, 0.8, 1.0)
    return with_velocities(scene, factors)


def six_logs(fault: Callable[[Recording, int], Recording], scene: Scene) -> Scene:
    """Return six logs of one arm, each with a fault of another joint."""
    rows = np.linspace(0, len(scene.log), 7).astype(int)
    pieces = []
    for joint, (start, end) in enumerate(zip(rows, rows[1:])):
        pieces.append(fault(scene.log[start:end], joint))
    return replace(scene, pieces=tuple(pieces))


def larger_torque(log: Recording, joint: int) -> Recording:
    """Return a log with the torque of one joint times 1.4."""
    factors = np.where(np.arange(log.tau.shape[1]) == joint, 1.4, 1.0)
    return replace(log, tau=factors * log.tau)


def moved_zero(log: Recording, joint: int) -> Recording:
    """Return a log with the zero of one joint off by 0.15 rad."""
    return replace(log, q=log.q + 0.15 * (np.arange(log.q.shape[1]) == joint))


def in_turn(*faults: Callable[[Scene], Scene]) -> Callable[[Scene], Scene]:
    """Return a function that spoils a scene by several faults at once."""

    def spoil(scene: Scene) -> Scene:
        for fault in faults:
            scene = fault(scene)
        return scene

    return spoil


# ---- causes of the model


def edit_bodies(scene: Scene, change: Callable[[Any], None], body: str = "") -> Scene:
    """Return the scene with a model of which one body, or each with mass, is changed."""

    def edit(spec: Any) -> None:
        for element in spec.bodies:
            if element.mass > 0.0 and body in ("", element.name):
                change(element)

    return replace(scene, edit=edit, culprit=body)


def multiply_body(mass_factor: float, inertia_factor: float, body: Any) -> None:
    """Multiply mass and inertia of a body of an ``MjSpec``."""
    body.mass = mass_factor * body.mass
    body.inertia = inertia_factor * body.inertia
    body.fullinertia = inertia_factor * body.fullinertia


def wrong_units(mass_factor: float, inertia_factor: float, scene: Scene) -> Scene:
    """Return the scene with a model whose masses and inertias have factors."""
    return edit_bodies(scene, partial(multiply_body, mass_factor, inertia_factor))


def placeholder_inertias(value: float, scene: Scene) -> Scene:
    """Return the scene with a model whose moments of inertia all have one value [kg m^2]."""

    def change(body: Any) -> None:
        body.fullinertia = np.full(6, np.nan)
        body.iquat = np.array([1.0, 0.0, 0.0, 0.0])
        body.inertia = np.full(3, value)

    return edit_bodies(scene, change)


def heavy_link(scene: Scene) -> Scene:
    """Return the scene with a model whose upper arm has twice its mass."""
    name = scene.robot.links[1].body_name
    return edit_bodies(scene, partial(multiply_body, 2.0, 2.0), name)


SIBLING_LINKS = {
    # UR5, after the maker's published model; its masses are those of the public UR5e's file.
    "ur5e": {
        "shoulder_link": ((0.0, 0.0, 0.0892), 3.7),
        "upper_arm_link": ((0.0, 0.1359, 0.0), 8.393),
        "forearm_link": ((0.0, -0.1197, 0.425), 2.275),
        "wrist_2_link": ((0.0, 0.093, 0.0), 1.219),
        "wrist_3_link": ((0.0, 0.0, 0.0947), 0.1879),
    },
    # iiwa 7, after the maker's published model.
    "iiwa14": {
        "link1": ((0.0, 0.0, 0.15), 3.4525),
        "link2": ((0.0, 0.0, 0.19), 3.4821),
        "link3": ((0.0, 0.21, 0.0), 4.0562),
        "link4": ((0.0, 0.0, 0.19), 3.4822),
        "link5": ((0.0, 0.21, 0.0), 2.1633),
        "link6": ((0.0, 0.0, 0.19), 2.3466),
        "link7": ((0.0, 0.081, 0.0), 3.129),
    },
}
"""Name of an arm to its sibling's links: origins in the frames before them [m], and masses [kg]."""
SIBLING_FILES = {"panda_nohand": "franka_fr3/FrankaFR3_7DoF.urdf"}
"""Name of an arm's model file to the file of its sibling."""


def sibling(scene: Scene) -> Scene:
    """Return the scene with the model of an arm's sibling, or of one that is 10 % larger."""
    file = SIBLING_FILES.get(scene.path.stem)
    if file is not None:
        return replace(scene, other_path=scene.path.parents[1] / file)
    links = SIBLING_LINKS.get(scene.path.stem, {})

    def change(body: Any) -> None:
        pos, mass = links.get(body.name, (1.1 * body.pos, 1.4 * float(body.mass)))
        body.pos = pos
        multiply_body(mass / float(body.mass), mass / float(body.mass), body)

    return edit_bodies(scene, change)


def leave_right(scene: Scene) -> Scene:
    """Return the scene as it is."""
    return scene


@dataclass(frozen=True)
class Cause:
    """What is wrong with a scene, and how it is named rightly.

    Attributes:
        spoil: makes the scene wrong.
        faults: for each thing that is wrong, the names of findings that name it rightly.
        words: regular expression; what is said with such words names it rightly, too; "" for none.
        duration: length of the log [s]; None for that of all causes.
    """

    spoil: Callable[[Scene], Scene]
    faults: tuple[tuple[str, ...], ...]
    words: str = ""
    duration: float | None = None


def spoil_log(fault: Callable[[Truth], Recording], scene: Scene) -> Scene:
    """Return the scene with its log spoiled by a function of ``benchmarks.trust.wrong_logs``."""
    return replace(scene, log=fault(scene))


def spoiler(name: str) -> Callable[[Scene], Scene]:
    """Return a function of ``benchmarks.trust.wrong_logs``, by its name, that spoils a scene."""
    return partial(spoil_log, wrong_logs.FAULTS[name])


def causes_of_logs(names: tuple[str, ...], *faults: str) -> dict[str, Cause]:
    """Return faults of ``benchmarks.trust.wrong_logs`` as causes with common names of checks."""
    return {fault: Cause(spoiler(fault), (names,)) for fault in faults}


def weight_alone(scene: Scene) -> Scene:
    """Return a log of the torque that holds the links at rest, as of an arm guided by hand."""
    noise = 0.01 * scene.usual_torque * scene.rng.normal(size=scene.log.tau.shape)
    return replace(scene, log=replace(scene.log, tau=scene.still + noise))


def turned_signs(count: int, scene: Scene) -> Scene:
    """Return a log with the torques of joints turned, of all where ``count`` is zero."""
    n = scene.robot.n_joints
    turned = scene.rng.choice(n, count or n, replace=False)
    return scene.with_torque_times(np.where(np.isin(np.arange(n), turned), -1.0, 1.0))


def turned_zeros(scene: Scene) -> Scene:
    """Return a log with velocities, whose zeros of two joints are off by 90 degrees."""
    scene = velocities(scene)
    weight = np.sqrt(np.mean(scene.still**2, axis=0))
    loaded = np.argsort(-weight)[:2]
    offset = 0.5 * np.pi * np.isin(np.arange(scene.robot.n_joints), loaded)
    return replace(scene, log=replace(scene.log, q=scene.log.q + offset))


SCALE = ("torque-scale", "torque-unit")
# Too long a time makes less of the accelerations, as if gravity were more.
CLOCK = ("clock", "gravity")
MASSES = r"all masses|all links|masses of (the|all)|model's masses|density"
INERTIAS = r"inertias? (of|in) (the|all|model)|model's (moments|inertia)|placeholder|inertia in kg"
"""Words that blame the model's masses or inertias, not the log."""
MODEL_CAUSES = {
    "masses_too_light": Cause(
        partial(wrong_units, 1.0 / 2.7, 1.0 / 2.7), (("model",),), MASSES
    ),
    "masses_too_heavy": Cause(partial(wrong_units, 2.9, 2.9), (("model",),), MASSES),
    "masses_in_grams": Cause(
        partial(wrong_units, 1e3, 1.0), (("model",),), f"{MASSES}|masses in kg"
    ),
    "masses_in_tonnes": Cause(
        partial(wrong_units, 1e-3, 1.0), (("model",),), f"{MASSES}|tonnes|masses in kg"
    ),
    "placeholder_inertias": Cause(
        partial(placeholder_inertias, 1.0), (("model",),), INERTIAS
    ),
    "small_placeholders": Cause(
        partial(placeholder_inertias, 1e-3), (("model",),), INERTIAS
    ),
    "inertias_in_kg_cm2": Cause(
        partial(wrong_units, 1.0, 1e4), (("model",),), INERTIAS
    ),
    "inertias_in_kg_mm2": Cause(
        partial(wrong_units, 1.0, 1e6), (("model",),), INERTIAS
    ),
    "heavy_link": Cause(heavy_link, (("model", "link"),), "probably wrong|contradict"),
    # All masses 1.4 times, and all lengths 1.1: a factor on the model's masses, or another size.
    "sibling": Cause(
        sibling,
        (("model", "other arm"),),
        "those of the model's masses|(larger|smaller) than its model",
    ),
    "mounted_at_10": Cause(partial(mount, 10.0), (("tilt",),), "tilted|mounted"),
    "mounted_at_45": Cause(partial(mount, 45.0), (("tilt",),), "tilted|mounted"),
    "mounted_at_90": Cause(partial(mount, 90.0), (("tilt",),), "tilted|mounted"),
}
"""Causes of the model, or of how the arm stands; the log is right."""
COMBINED_CAUSES = {
    "six_scales": Cause(partial(six_logs, larger_torque), (SCALE,), "", 60.0),
    "six_zeros": Cause(partial(six_logs, moved_zero), (("zero",),), "", 60.0),
    "scale_and_zero": Cause(
        in_turn(joint_scale, spoiler("position_offset")), (SCALE, ("zero",))
    ),
    "sign_and_delay": Cause(
        in_turn(spoiler("torque_sign"), spoiler("late_torque")), (("sign",), ("delay",))
    ),
    "exchange_and_contact": Cause(
        in_turn(spoiler("exchanged_joints"), push), (("order",), ("contact",))
    ),
    "tilt_scale_and_push": Cause(
        in_turn(tilt, joint_scale, push), (("tilt",), SCALE, ("contact",))
    ),
    "zero_sign_and_payload": Cause(
        in_turn(payload_drops, spoiler("torque_sign"), spoiler("position_offset")),
        (("zero",), ("sign",), ("payload-step",)),
    ),
}
"""Several things wrong at once, or one after another."""
DISCRETE_CAUSES = {
    "weight_alone": Cause(weight_alone, (("computed",),)),
    "all_signs": Cause(partial(turned_signs, 0), (("sign",),)),
    "three_signs": Cause(partial(turned_signs, 3), (("sign",),)),
    "turned_zeros": Cause(turned_zeros, (("zero",),)),
}
"""Mistakes of several joints at once."""
CAUSES: dict[str, Cause] = {
    RIGHT: Cause(leave_right, ()),
    "velocities": Cause(velocities, ()),
    "payload_drops": Cause(payload_drops, (("payload-step",),)),
    "payload_grows": Cause(payload_grows, (("payload-step",),)),
    "glued_states": Cause(glued_states, (("payload-step",),)),
    "hand_carries": Cause(hand_carries, (("force",),)),
    "push": Cause(push, (("contact",),)),
    **causes_of_logs(("contact",), "collision", "hum"),
    "constant_force": Cause(constant_force, (("force",),)),
    "spring": Cause(spring, (("force",),)),
    "balancer": Cause(balancer, (("gravity", "clock"),)),
    "tilt": Cause(tilt, (("tilt",),)),
    "ripple": Cause(ripple, (("ripple",),)),
    "crosstalk": Cause(crosstalk, (("crosstalk", "coupling"),)),
    "coupling": Cause(coupling, (("coupling",),)),
    "hot_gears": Cause(hot_gears, (("friction",),)),
    "friction_falls": Cause(friction_falls, (("friction",),)),
    "gear_loss": Cause(gear_loss, (("gear",),), "gears? .*los|los.* of (its|the) load"),
    "gain_drift": Cause(gain_drift, (SCALE,)),
    "joint_scale": Cause(joint_scale, (SCALE,)),
    "uncalibrated": Cause(uncalibrated_currents, (SCALE,)),
    **causes_of_logs(SCALE, "amperes", "motor_side", "millinewtonmetres", "other_unit"),
    **causes_of_logs(SCALE, "per_cent", "one_joint_in_millinewtonmetres"),
    **causes_of_logs(("gravity",), "gravity_compensated", "external"),
    **causes_of_logs(("computed",), "computed_torque"),
    "own_torque": Cause(partial(own_torque, 0.0), (("computed",),)),
    "own_noisy_torque": Cause(partial(own_torque, 0.03), (("computed",),)),
    **causes_of_logs(("sign",), "torque_sign", "position_sign"),
    **causes_of_logs(("order",), "exchanged_joints", "reversed_order"),
    "degrees_as_radians": Cause(
        spoiler("degrees_as_radians"), (("angle-unit",),), "look like degrees"
    ),
    **causes_of_logs(("angle-unit",), "radians_as_degrees"),
    **causes_of_logs(("zero",), "position_offset"),
    **causes_of_logs(("delay",), "late_torque", "late_joint"),
    "long_time": Cause(long_time, (CLOCK,)),
    **causes_of_logs(CLOCK, "drifting_clock"),
    **causes_of_logs(("clock",), "dropped_samples", "clock_jump"),
    "stale_samples": Cause(stale_samples, (("clock",),)),
    "slow_velocities": Cause(slow_velocities, (("velocity",),), "velocities .*times"),
    "half_slow_velocities": Cause(
        half_slow_velocities, (("velocity",),), "velocities .*times"
    ),
    **causes_of_logs(("saturated",), "saturated_sensor"),
    **causes_of_logs(("held",), "held"),
    **causes_of_logs(("model", "other arm"), "other_arm"),
    **MODEL_CAUSES,
    **COMBINED_CAUSES,
    **DISCRETE_CAUSES,
}
"""Cause by its name; those without a fault are right."""
