"""Arms that differ from their models, as real ones do, and logs of them.

``truth_of`` draws an arm of which little is wrong, for tests of what else is wrong with a log.
``draw_arm`` draws arms as far off as real ones, or as the default priors say. ``imperfect_arm`` has
a size for each thing that is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rigs.arms.synthetic_data import autocorrelated
from robot_sysid import spatial
from robot_sysid.dynamics.friction import top_speeds
from robot_sysid.dynamics.inverse_dynamics import (
    ArmDynamics,
    LinkDynamics,
    gravity_vector,
    link_names,
    other_links,
    turn_gravity,
)
from robot_sysid.model.bodies import write_body
from robot_sysid.records import Array, Motion, MotionPlan, Recording, RobotModel
from robot_sysid.trajectory import generate_excitation_trajectory

ARMS = {
    "ur5e": "universal_robots_ur5e/ur5e.xml",
    "iiwa14": "kuka_iiwa_14/iiwa14.xml",
    "panda": "franka_panda/panda_nohand.xml",
    "gen3": "kinova_gen3/gen3.xml",
    "xarm7": "ufactory_xarm7/xarm7.xml",
    "fr3": "franka_fr3/FrankaFR3_7DoF.urdf",
}
DEVIATIONS = ("real", "priors", "exact", "bent", "presliding", "straight")
"""What arms differ in from their models, see ``draw_arm``. New ones go to the end: the random
numbers of an arm begin with the place of its deviation."""
AS_REAL = ("real", "bent", "presliding")
"""Deviations of which links, scales, zeros and dry friction are as far off as those of real arms.
"""
STRAIGHT = "straight"
"""Deviation of which links are as far off as those of real arms, with Coulomb and viscous friction
and sensors without faults."""
PRESLIDING = 1e-3
"""Travel over which dry friction turns round in the gears of real arms [rad]. With a zone of as
much left out at each turn, the rotors of arms without it are right, and real files best."""
BEND_TOP = 1.25
"""Speed at which friction that bends is flat, over the fastest of the motion: within the motion it
still rises."""
RATE = 250.0
DURATION = 12.0
STRIBECK = 0.3
NOISE = 0.08
MEMORY = -1.0 / np.log(0.95)
"""Memory of noise that is not white [samples]."""
MOVING = 0.05
"""Least speed of a sample from which a line of friction is made, over the fastest."""
FINE_STEP = 2.0 * np.pi / 2**17
"""Step of a good encoder [rad]."""


def link_torque(robot, motion, thetas, gravity=None):
    """Return the torque (N, n) of links (n, 10) alone, under the model's or another gravity."""
    links = LinkDynamics(robot, gravity).motion(motion.q, motion.qd, motion.qdd)
    return links.torque(thetas)


def resting_torque(robot, q, thetas, gravity=None):
    """Return the torque (N, n) of links (n, 10) at rest, under the model's or another gravity."""
    zero = np.zeros_like(q)
    return link_torque(robot, Motion(zero[:, 0], q, zero, zero), thetas, gravity)


@dataclass(frozen=True)
class WrongArm:
    """An arm whose links, friction and sensors are not as its model says.

    Attributes:
        robot: the model as the user has it.
        thetas: (n, 10) the true links.
        tilt: (2,) angles of the base about x and y [rad].
        rotor: (n,) rotor inertia.
        coulomb, viscous, offset: (n,) friction, and the torque sensors' offsets.
        stribeck: (n,) further dry friction at rest, which fades with the speed ``fading``.
        root: (n,) dry friction per root of speed.
        loss: (n,) dry friction per load.
        bend, bend_top: (n,) friction ``bending``, and the speed at which it is flat [rad/s].
        presliding: travel over which dry friction turns round [rad]; zero where it follows the sign
            of the speed at once.
        scales, zeros: (n,) factors of the torque sensors, and errors of the encoders [rad].
        lag: of the torque behind the position [s].
        step: of the encoders [rad].
    """

    robot: RobotModel
    thetas: Array
    tilt: Array
    rotor: Array
    coulomb: Array | float = 0.0
    viscous: Array | float = 0.0
    offset: Array | float = 0.0
    stribeck: Array | float = 0.0
    fading: Array | float = 1.0
    root: Array | float = 0.0
    loss: Array | float = 0.0
    bend: Array | float = 0.0
    bend_top: Array | float = 1.0
    presliding: float = 0.0
    scales: Array | float = 1.0
    zeros: Array | float = 0.0
    lag: float = 0.0
    step: float = 1e-4

    def torques(self, motion, payload=0.0):
        """Return the torque of links, rotors and springs, and that of friction, each (N, n).

        A ``payload`` (10,) is on the last link.
        """
        robot = self.robot
        thetas = self.thetas.copy()
        thetas[-1] += payload
        load = ArmDynamics(robot).torque(motion.q, motion.qd, motion.qdd)
        load -= robot.armature * motion.qdd + link_torque(robot, motion, robot.thetas)
        gravity = turn_gravity(gravity_vector(robot), self.tilt)
        load += link_torque(robot, motion, thetas, gravity)
        speed = np.abs(motion.qd)
        dry = self.coulomb + self.stribeck * np.exp(-speed / self.fading)
        dry = dry + self.root * np.sqrt(speed) + self.loss * np.abs(load)
        friction = dry * dry_direction(motion, self.presliding)
        friction = friction + self.viscous * motion.qd
        friction = friction + self.bend * bending(motion.qd / self.bend_top)
        return load + self.rotor * motion.qdd, friction

    def friction_at(self, joint, speeds, load):
        """Return the friction (m,) of a joint at positive speeds (m,), of a load [N m]."""
        names = ("coulomb", "stribeck", "fading", "root", "loss", "viscous", "bend")
        sizes = {
            name: np.broadcast_to(getattr(self, name), len(self.thetas))[joint]
            for name in (*names, "bend_top")
        }
        dry = sizes["coulomb"] + sizes["stribeck"] * np.exp(-speeds / sizes["fading"])
        dry = dry + sizes["root"] * np.sqrt(speeds) + sizes["loss"] * load
        bend = sizes["bend"] * bending(speeds / sizes["bend_top"])
        return dry + sizes["viscous"] * speeds + bend

    def friction_line(self, motion, joint):
        """Return dry and viscous friction of the line nearest to a joint's friction in a motion.

        One that would fall with speed has no viscous friction, as in a file.
        """
        _, friction = self.torques(motion)
        qd = motion.qd[:, joint]
        is_moving = np.abs(qd) > MOVING * np.max(np.abs(qd))
        columns = np.column_stack((np.sign(qd), qd))[is_moving]
        torque = friction[is_moving, joint]
        line, *_ = np.linalg.lstsq(columns, torque, rcond=None)
        if line[1] < 0.0:
            line = np.array([np.mean(columns[:, 0] * torque), 0.0])
        return line

    def log(self, motion, noise, payload=0.0):
        """Return what the sensors say in a motion, with torque noise (N, n) [N m]."""
        rigid, friction = self.torques(motion, payload)
        tau = self.scales * rigid + friction + self.offset
        tau = delay(motion.time, tau, self.lag) + noise
        q = np.round((motion.q + self.zeros) / self.step) * self.step
        return Recording(motion.time, q, None, tau)

    def values(self, names):
        """Return the true values (p,) of parameters of an estimate; what is not wrong is zero."""
        value_of = {"delay": self.lag, "tilt_1": self.tilt[0], "tilt_2": self.tilt[1]}
        value_of.update(zip(spatial.PARAMETER_NAMES, self.thetas[-1]))
        for number, theta in enumerate(self.thetas[:-1]):
            value_of.update(zip(link_names(self.robot, number), theta))
        of_joints = {
            "coulomb": self.coulomb,
            "viscous": self.viscous,
            "offset": self.offset,
            "armature": self.rotor,
            "scale": self.scales - 1.0,
            "zero": self.zeros,
            "load": self.loss,
            "sqrt": self.root,
            "bend": self.bend,
        }
        for term, sizes in of_joints.items():
            numbers = np.broadcast_to(sizes, len(self.thetas))
            for joint, number in zip(self.robot.joint_names, numbers):
                value_of[f"{term}[{joint}]"] = number
        return np.array([float(value_of.get(name, 0.0)) for name in names])


def dry_direction(motion, travel):
    """Return the direction z (N, n) of dry friction in a motion: the sign of the speed if at once.

    Teeth and balls bend before they slide, so that dry friction turns round over a travel s,

        dz/dq = (1 - z sign(qd)) / s   (Dahl, "A solid friction model", 1968),

    whose solution between two samples z -> d + (z - d) exp(-|dq| / s), d = sign(dq), is exact.
    """
    direction = np.sign(motion.qd)
    if not travel:
        return direction
    steps = np.diff(motion.q, axis=0)
    kept = np.exp(-np.abs(steps) / travel)
    gained = np.sign(steps) * (1.0 - kept)
    for before, (keep, gain) in enumerate(zip(kept, gained)):
        direction[before + 1] = keep * direction[before] + gain
    return direction


def bending(u):
    """Return friction that rises ever less with a speed u, is flat at u = 1, and never falls."""
    return 3.0 * u - 3.0 * u * np.abs(u) + u**3


def delay(time, values, lag):
    """Return columns (N, n) that are late by a time [s]."""
    if not lag:
        return values
    return np.stack([np.interp(time - lag, time, c) for c in values.T], axis=1)


@dataclass(frozen=True)
class Truth:
    """A log and what it was made from.

    Attributes:
        arm: the arm as it is.
        plan: the motion that the seed gives.
        motion: the motion of the log.
        log: a right log.
        rigid, friction: (N, n) torque without friction and noise, and friction [N m].
        rng: for what goes wrong.
    """

    arm: WrongArm
    plan: MotionPlan
    motion: Motion
    log: Recording
    rigid: Array
    friction: Array
    rng: np.random.Generator

    @property
    def robot(self):
        """Return the model as the user has it."""
        return self.arm.robot

    @property
    def theta(self):
        """Return the true terminal link (10,)."""
        return self.arm.thetas[-1]

    @cached_property
    def still(self):
        """Return the torque (N, n) at rest, by the truth [N m]."""
        return resting_torque(self.robot, self.motion.q, self.arm.thetas)


def truth_of(robot, seed, wrong_links=0.02, rate=RATE, load=0.0, played=None):
    """A right log of an arm whose links are a little off and that carries something.

    Args:
        robot, seed, wrong_links, rate: of the model, its arm and its log.
        load: mass of a weight that is bolted on beside it [kg].
        played: the motion of the log; None for the one that the seed gives.
    """
    rng = np.random.default_rng(seed)
    plan = generate_excitation_trajectory(robot, rng, DURATION)
    played = played or plan
    motion = played.evaluate(np.arange(round(rate * played.duration)) / rate)
    thetas = robot.thetas
    thetas *= 1.0 + wrong_links * rng.normal(size=(len(thetas), 1))
    total = float(np.sum(thetas[:, 0]))
    mass = float(thetas[-1, 0] + total * rng.uniform(0.04, 0.1))
    reach = 0.1 * robot.length
    com = rng.normal(size=3) * 0.3 * reach
    radius = 0.3 * reach * np.diag(rng.uniform(0.5, 1.0, 3))
    second = mass * radius @ radius
    moments = np.trace(second) * np.eye(3) - second
    thetas[-1] = (1.0 + load / mass) * spatial.theta_from_com(mass, com, moments)
    arm = WrongArm(robot, thetas, np.zeros(2), robot.armature, step=FINE_STEP)
    rigid, _ = arm.torques(motion)
    typical = typical_torque(rigid)
    coulomb = typical * rng.uniform(0.02, 0.1, len(typical))
    speed = np.maximum(np.sqrt(np.mean(motion.qd**2, axis=0)), 1e-9)
    dry = {"coulomb": coulomb, "stribeck": 0.5 * coulomb, "fading": 0.1}
    arm = replace(arm, **dry, viscous=0.05 * typical / speed)
    noise = min(0.3, 0.02 * float(np.max(np.abs(rigid))))
    log = arm.log(motion, noise * rng.normal(size=rigid.shape))
    log = replace(log, qd=motion.qd)
    return Truth(arm, plan, motion, log, rigid, arm.torques(motion)[1], rng)


def typical_torque(rigid):
    """Return what each joint carries (n,), at least 3 % of the strongest joint's [N m]."""
    typical = np.sqrt(np.mean(rigid**2, axis=0))
    return np.maximum(typical, 0.03 * np.max(typical))


# ---- arms as far off as real ones


def wrong_links(robot, rng):
    """Return links (n, 10) as far from the model's as those of real model files are."""
    thetas = robot.thetas
    count = len(thetas)
    shares = rng.uniform(0.1, 0.2, count) * rng.choice([-1.0, 1.0], count)
    movable = other_links(robot)
    shares[movable[int(rng.integers(len(movable)))]] = 0.4
    for index, theta in enumerate(thetas):
        if theta[0] <= 0.0:
            continue
        mass, com, inertia = spatial.com_from_theta(theta)
        gyration = np.sqrt(np.trace(inertia) / (2.0 * mass))
        com = com + 0.15 * gyration * rng.standard_normal(3)
        inertia = inertia * max(1.0 + 0.15 * rng.standard_normal(), 0.3)
        thetas[index] = spatial.theta_from_com(
            mass * (1.0 + shares[index]), com, inertia
        )
    return thetas


def prior_links(robot, rng):
    """Return links (n, 10) drawn with errors of 5 %, as the priors state them; the last one, too.

    Masses are off by 5 %, centres of mass by 5 % of the link's size, inertias by 10 %, and all
    masses and all distances of centres of mass by 5 % more.
    """
    thetas = robot.thetas
    lengths = [float(np.linalg.norm(link.translation)) for link in robot.links[1:]]
    common = 0.05 * rng.standard_normal(2)
    for index, length in enumerate([*lengths, 0.0]):
        theta = thetas[index]
        if theta[0] <= 0.0:
            continue
        mass, com, inertia = spatial.com_from_theta(theta)
        size = max(spatial.ROD * spatial.characteristic_length(theta), length, 0.02)
        moment = max(np.trace(inertia) / 3.0, mass * (0.1 * size) ** 2)
        outwards = com / max(float(np.linalg.norm(com)), 1e-9)
        com = com + size * (0.05 * rng.standard_normal(3) + common[1] * outwards)
        six = 0.1 * moment * rng.standard_normal(6)
        scale = 1.0 + 0.05 * rng.standard_normal() + common[0]
        inertia = scale * inertia + spatial.symmetric_from_six(six)
        thetas[index] = spatial.theta_from_com(scale * mass, com, inertia)
    return thetas


def draw_arm(
    robot, deviation, has_sensors, duration, white, seed, move=None, friction=0.04
):
    """Return one arm with one log of it.

    ``deviation`` says what is off: "real" as of real arms, "bent" also with friction that bends and
    is at its top as large as Coulomb friction, "presliding" with dry friction that turns round over
    a travel, read by good encoders; "straight" links, rotors, Coulomb and viscous friction alone;
    "priors" what the default priors say; "exact" nothing.

    ``move`` returns the motion; None for that of an excitation. ``friction`` is the usual Coulomb
    friction over the torque.
    """
    rng = np.random.default_rng([seed, DEVIATIONS.index(deviation)])
    plan = generate_excitation_trajectory(robot, rng, duration)
    motion = plan.evaluate(np.arange(round(RATE * duration)) / RATE)
    if move is not None:
        motion = move(plan, np.random.default_rng([seed, 9]))
    is_off = deviation != "exact"
    tilt = np.radians(0.3) * rng.standard_normal(2) * is_off
    thetas = robot.thetas
    if is_off:
        is_real = deviation in (*AS_REAL, STRAIGHT)
        thetas = (wrong_links if is_real else prior_links)(robot, rng)
    arm = WrongArm(robot, thetas, tilt, robot.armature)
    rigid, _ = arm.torques(motion)
    n = robot.n_joints
    peak = np.max(np.abs(rigid), axis=0)
    fastest = np.maximum(np.max(np.abs(motion.qd), axis=0), 1e-3)
    nominal = np.maximum(friction * peak, 0.1 * friction * np.max(peak))
    nominal = nominal * rng.uniform(0.7, 1.4, n)
    visible_share = 0.1 if has_sensors else 1.0
    coulomb = visible_share * nominal
    viscous = coulomb / fastest * rng.uniform(0.5, 1.5, n)
    rms_acceleration = np.sqrt(np.mean(motion.qdd**2, axis=0))
    rms_acceleration = np.maximum(rms_acceleration, 0.1 * np.max(rms_acceleration))
    rotor = 0.02 * np.max(peak) / rms_acceleration * rng.uniform(0.3, 1.5, n)
    rotor = np.zeros(n) if has_sensors else rotor
    arm = replace(arm, coulomb=coulomb, viscous=viscous, rotor=rotor)
    if deviation in AS_REAL:
        loss = visible_share * rng.uniform(0.02, 0.06, n)
        arm = replace(arm, stribeck=STRIBECK * coulomb, fading=0.1 * fastest, loss=loss)
        if deviation == "bent":
            arm = replace(arm, bend=coulomb, bend_top=BEND_TOP * fastest)
        elif deviation == "presliding":
            # A coarse encoder's zone at each turn would hide most of it.
            arm = replace(arm, presliding=PRESLIDING, step=FINE_STEP)
    elif deviation == "priors":
        bend = 0.4 * coulomb * rng.standard_normal(n)
        top = top_speeds(fastest, np.full(n, np.inf))
        loss = 0.02 * rng.standard_normal(n)
        arm = replace(arm, bend=bend, bend_top=top, loss=loss)
    is_read_wrong = is_off and deviation != STRAIGHT
    scales = 1.0 + 0.02 * is_read_wrong * rng.standard_normal(n)
    noise = NOISE * nominal * noise_samples(rng, rigid.shape, white)
    lag = 5e-3 * rng.standard_normal() if deviation == "priors" else 0.0
    zeros = 2e-3 * is_read_wrong * rng.standard_normal(n)
    arm = replace(arm, scales=scales, lag=lag, zeros=zeros)
    # The noise passes the same line as the torque.
    log = arm.log(motion, delay(motion.time, noise, lag))
    return Truth(arm, plan, motion, log, *arm.torques(motion), rng)


def noise_samples(rng, shape, white):
    """Return noise (N, n) of unit variance, white or with a memory of 20 samples."""
    drawn = rng.standard_normal((shape[0] + 200, shape[1]))
    return autocorrelated(drawn, 0.0 if white else MEMORY)[200:]


def write_link(model, link, theta):
    """Write a link's parameters into its main body, beside which its other bodies have no mass.

    A link without mass is left as it is.
    """
    if theta[0] <= 0.0:
        return
    for body in link.bodies[1:]:
        model.body_mass[body.body_id] = 0.0
        model.body_inertia[body.body_id] = 0.0
    write_body(model, link.body_id, theta)
