"""Mistakes that people make beside the causes of ``benchmarks.trust.confusion_causes``.

They are mistakes that were found Usable and wrong, blamed on something else, or refused though
right, so that many are not named rightly yet. Each says what a roboticist would want to be told,
not what the program says today. Where there is no name of a check for that, its words decide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.trust.answers import bare_model_text
from benchmarks.trust.confusion_causes import (
    SCALE,
    Cause,
    Edit,
    Scene,
    edit_bodies,
    in_turn,
    multiply_body,
    payload_of,
    spoiler,
    torque_of_payload,
    turned_signs,
)
from benchmarks.trust.wrong_logs import carrying_joint
from rigs.arms.motions import (
    of_joints,
    one_at_a_time,
    resting,
    sampled,
    slow,
    smooth_step,
)
from rigs.arms.wrong_arms import (
    PRESLIDING,
    RATE,
    WrongArm,
    link_torque,
    noise_samples,
    resting_torque,
)
from rigs.files.urdf import urdf_of
from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.records import Array, Motion

FLANGE_MASS = 1.5
"""Mass of what hangs on the flange [kg]."""
MORE_MASS = 1.0
"""Mass that a forearm carries beside its own [kg]."""
LATE = 0.03
"""[s]"""
LATE_JOINT = 0.02
"""Time by which the torque of one joint is late, or that of all is early [s]."""
Rows = NDArray[np.integer[Any]]
"""Numbers of rows of a log (m,)."""
BACKLASH = np.radians(1.0)
"""Angle by which a gear is loose [rad]."""
HELD_TORQUE = 0.9
"""Torque of a joint that sticks, of its dry friction."""
CENTRE_OFF = np.array([0.04, 0.04, 0.02])
"""Distance of a centre of mass from where the model has it, 6 cm [m]."""
BIAS = 0.1
"""Torque of an actuator that pushes all the time, of what its joint carries."""
OBSERVER = 0.05
"""Time constant of an observer of external torque [s]."""
WEAK = 1e-3
"""Constant of a motor that brakes next to nothing by its voltage [N m/A, V s/rad]."""
SMALL_BALL: dict[str, Any] = {
    "type": mujoco.mjtGeom.mjGEOM_SPHERE,
    "size": [0.01, 0.0, 0.0],
    "mass": 1e-3,
    "contype": 0,
    "conaffinity": 0,
}
"""A body that hardly weighs anything."""
DENORMAL = 1e-308
"""Factor that makes next to nothing of a torque."""
COARSE_STEP = 2.0 * np.pi / 4096
"""Step of a coarse encoder [rad]."""
SELDOM = 50.0
"""Rate of a log with few samples [Hz]."""
TORQUE_STEP = 0.1
"""Step of a coarse torque [N m]."""


def forearm_of(scene: Scene) -> int:
    """Return the number of the link behind the elbow, the wrist being the last three joints."""
    return scene.robot.n_joints - 4


def loaded_joint(scene: Scene) -> int:
    """Return a joint, drawn from those that gravity loads."""
    weight = np.sqrt(np.mean(scene.still**2, axis=0))
    return int(scene.rng.choice(np.flatnonzero(weight >= 0.2 * weight.max())))


def light_joint(scene: Scene) -> int:
    """Return the joint of the least torque, the first one left out, which carries no weight."""
    size = np.mean(scene.log.tau[:, 1:] ** 2, axis=0)
    return int(np.argmin(size)) + 1


def blame(scene: Scene, joint: int) -> Scene:
    """Return the scene with a joint that alone is wrong."""
    return replace(scene, culprit=scene.robot.joint_names[joint])


def at_joint(scene: Scene, joint: int, value: float, others: float) -> Array:
    """Return numbers (n,), of one joint and of all others."""
    return np.where(np.arange(scene.robot.n_joints) == joint, value, others)


def with_torques(scene: Scene, tau: Array) -> Scene:
    """Return the scene with other torques (N, n) in its log [N m]."""
    return replace(scene, log=replace(scene.log, tau=tau))


def with_positions(scene: Scene, q: Array) -> Scene:
    """Return the scene with other positions (N, n) in its log [rad]."""
    return replace(scene, log=replace(scene.log, q=q))


def record(
    scene: Scene, arm: WrongArm, motion: Motion, noise_factor: float = 1.0
) -> Scene:
    """Return the scene of another arm or motion, with the noise of the scene times a factor."""
    rigid, friction = scene.arm.torques(scene.motion)
    noise = scene.log.tau - scene.arm.scales * rigid - friction - scene.arm.offset
    log = arm.log(motion, noise_factor * noise)
    rigid, _ = arm.torques(motion)
    return replace(
        scene, arm=arm, motion=motion, log=log, rigid=rigid, friction=log.tau - rigid
    )


# ---- torques


def external_with_payload(scene: Scene) -> Scene:
    """Return a log of external torque, the controller's model taken off, of what is carried."""
    payload = spatial.theta_from_com(
        FLANGE_MASS, np.array([0.02, 0.01, 0.06]), 0.002 * FLANGE_MASS * np.eye(3)
    )
    carried = torque_of_payload(scene, payload)
    masses = (float(scene.theta[0]) + FLANGE_MASS,)
    return replace(
        scene.with_more_torque(carried - scene.rigid), rigid=carried, last_masses=masses
    )


def all_times(factor: float, scene: Scene) -> Scene:
    """Return a log with all torques times a factor."""
    return scene.with_torque_times(np.full(scene.robot.n_joints, factor))


def joint_times(joint: int | None, factor: float, scene: Scene) -> Scene:
    """Return a log with the torque of one joint times a factor; None for one that gravity loads."""
    joint = loaded_joint(scene) if joint is None else joint % scene.robot.n_joints
    return blame(scene.with_torque_times(at_joint(scene, joint, factor, 1.0)), joint)


def unsigned_current(scene: Scene) -> Scene:
    """Return a log of currents without a sign as torque."""
    return with_torques(scene, np.abs(scene.log.tau))


def with_coloured_noise(scene: Scene, torque: Array, share: float) -> Scene:
    """Return the scene with other torque (N, n) and noise that has a memory, of it, as its log."""
    noise = noise_samples(scene.rng, torque.shape, white=False)
    return with_torques(scene, torque + share * scene.usual_torque * noise)


def model_torque_with_coloured_noise(scene: Scene) -> Scene:
    """Return a log of the model's own torques with 0.8 % of noise that has a memory."""
    return with_coloured_noise(scene, ArmDynamics(scene.robot)(scene.motion), 0.008)


def commanded_torque(scene: Scene) -> Scene:
    """Return a log of commanded torques of a drive that adds the friction's itself."""
    return with_coloured_noise(scene, scene.rigid, 0.02)


def external_of_load(scene: Scene) -> Scene:
    """Return such a log without friction, of which the controller has a model, too."""
    loaded = external_with_payload(scene)
    return with_coloured_noise(loaded, loaded.rigid, 0.01)


def external_low_passed(scene: Scene) -> Scene:
    """Return a log of external torque behind a low-pass of 0.05 s, as an observer's."""
    loaded = external_with_payload(scene)
    step = float(scene.log.time[1] - scene.log.time[0])
    weights = np.exp(-np.arange(0.0, 0.5, step) / OBSERVER)
    count = len(scene.log)
    tau = [
        np.convolve(column, weights / np.sum(weights))[:count]
        for column in loaded.log.tau.T
    ]
    return with_torques(loaded, np.stack(tau, axis=1))


def compensated(share: float, is_of_model: bool, scene: Scene) -> Scene:
    """Return a log without a share of the torque of the weight, the arm's or the model's."""
    weight = scene.still
    if is_of_model:
        weight = resting_torque(scene.robot, scene.motion.q, scene.robot.thetas)
    return scene.with_more_torque(-share * weight)


def computed_of_another_load(scene: Scene) -> Scene:
    """Return a log of the torques that a model takes which has a payload more than the arm."""
    thetas = scene.robot.thetas
    thetas[-1] += payload_of(scene)
    torque = link_torque(scene.robot, scene.motion, thetas)
    return with_coloured_noise(scene, torque, 0.004)


def with_friction_times(factor: float, scene: Scene) -> Scene:
    """Return a log with friction times a factor: commanded by a model of it, or less such a model.

    The links' torque is all there, so that it is a right log of the last link.
    """
    return scene.with_more_torque((factor - 1.0) * scene.friction)


def light_sign(scene: Scene) -> Scene:
    """Return a log in which the sign of the torque of a joint that carries little is wrong."""
    joint = light_joint(scene)
    return blame(scene.with_torque_times(at_joint(scene, joint, -1.0, 1.0)), joint)


def both_signs(from_end: int, scene: Scene) -> Scene:
    """Return a log in which position and torque of one of the last joints have the wrong sign."""
    return both_signs_of(scene.robot.n_joints - from_end, scene)


def both_signs_of(joint: int, scene: Scene) -> Scene:
    """Return a log in which position and torque of a joint have the wrong sign."""
    signs = at_joint(scene, joint, -1.0, 1.0)
    turned = with_positions(scene.with_torque_times(signs), signs * scene.log.q)
    return blame(turned, joint)


def late_by(seconds: Array | float, scene: Scene) -> Scene:
    """Return a log whose torques are late, by times (n,) or one for all [s]."""
    time = scene.log.time
    lags = np.broadcast_to(seconds, scene.robot.n_joints)
    pairs = zip(scene.log.tau.T, lags)
    tau = [np.interp(time - lag, time, column) for column, lag in pairs]
    return with_torques(scene, np.stack(tau, axis=1))


def late_by_30_ms(scene: Scene) -> Scene:
    """Return a log whose torques are 30 ms late."""
    return late_by(LATE, scene)


def late_joint_by_20_ms(scene: Scene) -> Scene:
    """Return a log in which the torque of a joint that gravity loads is 20 ms late."""
    joint = loaded_joint(scene)
    return blame(late_by(at_joint(scene, joint, LATE_JOINT, 0.0), scene), joint)


def exchanged_wrists(scene: Scene) -> Scene:
    """Return a log in which two wrist joints beside one another are exchanged in the torques."""
    tau = scene.log.tau.copy()
    tau[:, [-3, -2]] = tau[:, [-2, -3]]
    return with_torques(scene, tau)


def zero_column(scene: Scene) -> Scene:
    """Return a log in which the torque of a joint that gravity loads is zero throughout."""
    joint = loaded_joint(scene)
    return blame(scene.with_torque_times(at_joint(scene, joint, 0.0, 1.0)), joint)


def denormal_torque(scene: Scene) -> Scene:
    """Return a log with torques of 1e-308, as memory that was never written has."""
    return with_torques(scene, DENORMAL * scene.log.tau)


def denormal_joint(scene: Scene) -> Scene:
    """Return a log with such torque of a joint that gravity loads."""
    return joint_times(None, DENORMAL, scene)


def constant_column(scene: Scene) -> Scene:
    """Return a log in which the torque of a joint that carries little has one value throughout."""
    joint = light_joint(scene)
    tau = scene.log.tau.copy()
    tau[:, joint] = tau[0, joint]
    return blame(with_torques(scene, tau), joint)


def signed_by_motion(scene: Scene) -> Scene:
    """Return a log of currents without a sign, to which that of the motion was given."""
    return with_torques(scene, np.abs(scene.log.tau) * np.sign(scene.motion.qd))


# ---- positions and gears


def zero_off(degrees: float, scene: Scene) -> Scene:
    """Return a log in which the zero of a joint that gravity loads is off."""
    joint = loaded_joint(scene)
    offset = at_joint(scene, joint, np.radians(degrees), 0.0)
    return blame(with_positions(scene, scene.log.q + offset), joint)


def two_zeros_off(scene: Scene) -> Scene:
    """Return a log in which the zeros of two joints that gravity loads are off by 15 degrees."""
    weight = np.sqrt(np.mean(scene.still**2, axis=0))
    offset = np.zeros(scene.robot.n_joints)
    offset[np.argsort(-weight)[:2]] = np.radians((15.0, -15.0))
    return with_positions(scene, scene.log.q + offset)


def positions_times(joint: int | None, factor: float, scene: Scene) -> Scene:
    """Return a log with the positions of one joint times a factor: its sign, or another gear's.

    None stands for a joint that gravity loads.
    """
    joint = loaded_joint(scene) if joint is None else joint
    factors = at_joint(scene, joint, factor, 1.0)
    return blame(with_positions(scene, factors * scene.log.q), joint)


def backlash(scene: Scene) -> Scene:
    """Return a log of an arm in which the gear of a joint that gravity loads is loose."""
    return backlash_of(loaded_joint(scene), scene)


def backlash_of(joint: int, scene: Scene) -> Scene:
    """Return a log of an arm with a loose gear: the motor is ahead where its torque presses."""
    joint = joint % scene.robot.n_joints
    pressed = scene.rigid[:, joint] / (0.05 * scene.usual_torque[joint])
    play = 0.5 * BACKLASH * np.tanh(pressed)
    q = scene.log.q + np.outer(play, at_joint(scene, joint, 1.0, 0.0))
    return blame(with_positions(scene, q), joint)


# ---- time and rows


def time_times(factor: float, scene: Scene) -> Scene:
    """Return a log whose time is too long by a factor."""
    return replace(scene, log=replace(scene.log, time=factor * scene.log.time))


def with_rows(scene: Scene, rows: Rows, time: Array | None = None) -> Scene:
    """Return a log of some rows of a log, with their own or other times [s]."""
    log = scene.log
    time = log.time[rows] if time is None else time
    return replace(scene, log=replace(log, time=time, q=log.q[rows], tau=log.tau[rows]))


def rows_with_gap(scene: Scene) -> Rows:
    """Return the rows of a log without one second in its middle third."""
    time = scene.log.time
    start = scene.rng.uniform(0.35, 0.65) * time[-1]
    return np.flatnonzero((time < start) | (time > start + 1.0))


def gap(scene: Scene) -> Scene:
    """Return a log without one second, of which the time stamps tell."""
    return with_rows(scene, rows_with_gap(scene))


def second_missing(scene: Scene) -> Scene:
    """Return a log without one second, its time counted from the rows."""
    rows = rows_with_gap(scene)
    return with_rows(scene, rows, scene.log.time[: len(rows)])


def rows_twice(scene: Scene) -> Scene:
    """Return a log in which a tenth of the rows is written twice."""
    count = len(scene.log)
    twice = scene.rng.choice(count, count // 10, replace=False)
    return with_rows(scene, np.sort(np.concatenate([np.arange(count), twice])))


def swapped_rows(scene: Scene) -> Scene:
    """Return a log in which twenty rows are written after the row behind them."""
    rows = np.arange(len(scene.log))
    for place in scene.rng.integers(0, len(rows) - 1, 20):
        rows[[place, place + 1]] = rows[[place + 1, place]]
    return with_rows(scene, rows)


def late_stamps(scene: Scene) -> Scene:
    """Return a right log whose time stamps are those of arrival, up to one period late."""
    time = scene.log.time
    late = scene.rng.uniform(0.0, float(time[1] - time[0]), len(time))
    return replace(scene, log=replace(scene.log, time=time + late))


def with_stamps(scene: Scene, time: Array) -> Scene:
    """Return the scene with other time stamps (N,) in its log [s]."""
    return replace(scene, log=replace(scene.log, time=time))


def rounded_stamps(scene: Scene) -> Scene:
    """Return a right log with time stamps of two digits, two or three rows each."""
    return with_stamps(scene, np.round(scene.log.time, 2))


def stamps_of_bursts(scene: Scene) -> Scene:
    """Return a right log whose rows arrive sixteen at a time."""
    last = np.arange(len(scene.log)) // 16 * 16 + 15
    return with_stamps(scene, (last + 1.0) * float(scene.log.time[1]))


def rows_twice_later(scene: Scene) -> Scene:
    """Return a log in which a tenth of the rows is written twice, half a period later."""
    time = scene.log.time
    count = len(time)
    twice = np.sort(scene.rng.choice(count - 1, count // 10, replace=False))
    rows = np.concatenate([np.arange(count), twice])
    stamps = np.concatenate([time, time[twice] + 0.5 * float(time[1])])
    order = np.argsort(stamps, kind="stable")
    return with_rows(scene, rows[order], stamps[order])


def exchanged_stretches(scene: Scene) -> Scene:
    """Return a log in which a stretch of a second is written after the second behind it."""
    rows = np.arange(len(scene.log))
    second = round(1.0 / float(scene.log.time[1]))
    start = int(scene.rng.integers(second, len(rows) - 3 * second))
    first, then = (
        slice(start, start + second),
        slice(start + second, start + 2 * second),
    )
    rows[first], rows[then] = rows[then].copy(), rows[first].copy()
    return with_rows(scene, rows)


def shuffled_rows(scene: Scene) -> Scene:
    """Return a log that was sorted by another column than time."""
    return with_rows(scene, np.argsort(scene.log.q[:, 1]))


def clock_from_zero(scene: Scene) -> Scene:
    """Return a log whose clock starts again in the middle."""
    time = scene.log.time
    return with_stamps(scene, time - (time >= 0.5 * time[-1]) * 0.5 * time[-1])


def clock_set_back(scene: Scene) -> Scene:
    """Return a log whose clock is set back by half a second in its middle third."""
    time = scene.log.time
    start = scene.rng.uniform(0.35, 0.65) * time[-1]
    return with_stamps(scene, time - 0.5 * (time > start))


def stamp_ahead(scene: Scene) -> Scene:
    """Return a log in which one stamp is a hundred seconds ahead."""
    time = scene.log.time.copy()
    time[scene.rng.integers(100, len(time) - 100)] += 100.0
    return with_stamps(scene, time)


def rows_of_spikes(scene: Scene) -> Scene:
    """Return a log in which five single positions are off by a radian."""
    q = scene.log.q.copy()
    rows = scene.rng.choice(np.arange(10, len(q) - 10), 5, replace=False)
    q[rows, scene.rng.integers(0, q.shape[1], 5)] += 1.0
    return with_positions(scene, q)


def with_velocities(factor: float, scene: Scene) -> Scene:
    """Return a log with columns of velocities, times a factor."""
    return replace(scene, log=replace(scene.log, qd=factor * scene.motion.qd))


def time_twice_beside_velocities(scene: Scene) -> Scene:
    """Return a log whose time is twice too long, with columns of right velocities."""
    return time_times(2.0, with_velocities(1.0, scene))


# ---- right logs of other motions


def noisy(scene: Scene) -> Scene:
    """Return a right log with five times the usual noise."""
    return record(scene, scene.arm, scene.motion, 5.0)


def small_motion(size: float, scene: Scene) -> Scene:
    """Return a right log of a part of the motion, around the same posture."""
    every = range(scene.robot.n_joints)
    return record(scene, scene.arm, of_joints(every, scene.motion, size))


def moving_joints(first: int, last: int | None, scene: Scene) -> Scene:
    """Return a right log in which only joints of a slice of all move."""
    joints = range(scene.robot.n_joints)[first:last]
    return record(scene, scene.arm, of_joints(joints, scene.motion))


def one_joint(scene: Scene) -> Scene:
    """Return a right log in which a joint that gravity loads moves alone."""
    joint = loaded_joint(scene)
    return record(scene, scene.arm, of_joints([joint], scene.motion))


def slow_motion(scene: Scene) -> Scene:
    """Return a right log at a third of the speed."""
    return record(scene, scene.arm, slow(scene.plan, scene.rng))


def with_rest(first: float, last: float, scene: Scene) -> Scene:
    """Return a right log in which the arm rests from one share of the time to another one."""
    return record(scene, scene.arm, resting(first, last, scene.plan))


def coarse_encoders(scene: Scene) -> Scene:
    """Return a right log of encoders with 4096 steps a turn."""
    arm = replace(scene.arm, step=COARSE_STEP)
    return record(scene, arm, scene.motion)


def seldom(scene: Scene) -> Scene:
    """Return a right log of 50 samples a second."""
    step = round(RATE / SELDOM)
    return with_rows(scene, np.arange(0, len(scene.log), step))


def coarse_torque(scene: Scene) -> Scene:
    """Return a right log whose torques have steps of 0.1 N m."""
    return with_torques(scene, np.round(scene.log.tau / TORQUE_STEP) * TORQUE_STEP)


def joint_after_joint(scene: Scene) -> Scene:
    """Return a right log in which one joint after the other moves."""
    return record(scene, scene.arm, one_at_a_time(scene.plan, scene.rng))


def stiction(scene: Scene) -> Scene:
    """Return a right log in which friction holds a joint for the first third."""
    motion = scene.motion
    joint = carrying_joint(scene)
    share = (motion.time / motion.time[-1] - 1.0 / 3.0) / 0.2
    freed = smooth_step(share)
    q = motion.q.copy()
    q[:, joint] = q[0, joint] + freed * (q[:, joint] - q[0, joint])
    moved = sampled(motion.time, q)
    held = record(scene, scene.arm, moved)
    # What the controller asks for in vain; it would move the joint with a little more.
    holding = HELD_TORQUE * float(np.broadcast_to(scene.arm.coulomb, len(q[0]))[joint])
    torque = (freed == 0.0) * holding * np.sin(motion.time)
    return held.with_joint_torque(joint, torque)


# ---- the arm and its model


def edit_model(scene: Scene, edit: Edit) -> Scene:
    """Return the scene with a model whose ``MjSpec`` is changed."""
    return replace(scene, edit=edit)


def loaded_forearm(scene: Scene) -> Scene:
    """Return a log of an arm that has 1 kg more on its forearm, as of cables and a valve."""
    thetas = scene.arm.thetas.copy()
    index = forearm_of(scene)
    _, com, _ = spatial.com_from_theta(thetas[index])
    thetas[index] += spatial.theta_from_com(MORE_MASS, com, 1e-3 * np.eye(3))
    loaded = record(scene, replace(scene.arm, thetas=thetas), scene.motion)
    return replace(loaded, culprit=scene.robot.links[index].body_name)


def light_forearm(scene: Scene) -> Scene:
    """Return the scene with a model whose forearm has a quarter of its mass."""
    name = scene.robot.links[forearm_of(scene)].body_name
    return edit_bodies(scene, partial(multiply_body, 0.25, 0.25), name)


def centre_off(scene: Scene) -> Scene:
    """Return the scene with a model whose upper arm has its centre of mass 6 cm off."""

    def change(body: Any) -> None:
        body.ipos = body.ipos + CENTRE_OFF

    return edit_bodies(scene, change, scene.robot.links[1].body_name)


def turned_centre(scene: Scene) -> Scene:
    """Return the scene with a model whose forearm has its centre of mass with the wrong sign."""

    def change(body: Any) -> None:
        body.ipos = -body.ipos

    name = scene.robot.links[forearm_of(scene)].body_name
    return edit_bodies(scene, change, name)


def small_inertias(scene: Scene) -> Scene:
    """Return the scene with a model in which the inertias of two links are a tenth."""
    names = [scene.robot.links[index].body_name for index in (1, forearm_of(scene))]

    def edit(spec: Any) -> None:
        for body in spec.bodies:
            if body.name in names:
                multiply_body(1.0, 0.1, body)

    return replace(scene, edit=edit, culprit=names[0])


def with_passive_actuator(
    scene: Scene, joint: int, numbers: tuple[float, float, float]
) -> Scene:
    """Return a log of an arm, and its model, with an actuator that acts by itself at a joint.

    ``numbers``: its force, and that per position and speed.
    """

    def edit(spec: Any) -> None:
        actuator = spec.add_actuator(name="pusher")
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.target = scene.robot.joint_names[joint]
        actuator.gainprm[0] = 0.0
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[:3] = numbers

    motion = scene.motion
    states = np.stack(
        (np.ones(len(scene.log)), motion.q[:, joint], motion.qd[:, joint]), axis=1
    )
    return edit_model(scene.with_joint_torque(joint, -states @ numbers), edit)


def biased_actuator(scene: Scene) -> Scene:
    """Return a log of an arm, and its model, with an actuator that pushes all the time."""
    joint = loaded_joint(scene)
    bias = BIAS * float(scene.usual_torque[joint])
    return with_passive_actuator(scene, joint, (bias, 0.0, 0.0))


def bias_at_light_joint(scene: Scene) -> Scene:
    """Return a log of an arm, and its model, with one at a joint that carries little."""
    joint = light_joint(scene)
    bias = float(scene.usual_torque[joint])
    return with_passive_actuator(scene, joint, (bias, 0.0, 0.0))


def gas_spring(scene: Scene) -> Scene:
    """Return a log of an arm, and its model, with a spring that was written as an actuator."""
    joint = loaded_joint(scene)
    stiffness = 0.3 * float(scene.usual_torque[joint])
    return with_passive_actuator(scene, joint, (stiffness, -stiffness, 0.0))


def damper(scene: Scene) -> Scene:
    """Return a log of an arm, and its model, with a damper that was written as an actuator."""
    joint = loaded_joint(scene)
    fastest = float(np.max(np.abs(scene.motion.qd[:, joint])))
    size = BIAS * float(scene.usual_torque[joint])
    return with_passive_actuator(scene, joint, (0.0, 0.0, -size / fastest))


def friction_of_motors(scene: Scene) -> Scene:
    """Return the scene with a model whose dry friction is that of its motors, after LuGre."""
    coulomb = np.broadcast_to(scene.arm.coulomb, scene.robot.n_joints)

    def edit(spec: Any) -> None:
        for name, size in zip(scene.robot.joint_names, coulomb.tolist()):
            spec.joint(name).frictionloss = 0.0
            actuator = spec.add_actuator(name=f"motor_{name}")
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.target = name
            # Stiffness and damping of the bristles, friction when sliding and at rest, and the
            # speed between them.
            lugre = [size / PRESLIDING, 1e-2 * size / PRESLIDING, size, 1.3 * size, 0.1]
            actuator.set_to_dcmotor([WEAK, WEAK], 1.0, lugre=lugre)

    return edit_model(scene, edit)


def yielding_springs(scene: Scene) -> Scene:
    """Return the scene with a model whose dry friction is springs that yield, with pre-sliding."""
    coulomb = np.broadcast_to(scene.arm.coulomb, scene.robot.n_joints)

    def edit(spec: Any) -> None:
        for name, size in zip(scene.robot.joint_names, coulomb.tolist()):
            joint = spec.joint(name)
            joint.frictionloss = 0.0
            joint.stiffness[0] = size / PRESLIDING
            is_degrees = spec.compiler.degree
            joint.springyield = np.degrees(PRESLIDING) if is_degrees else PRESLIDING

    return edit_model(scene, edit)


def tied_joints(scene: Scene) -> Scene:
    """Return a log of an arm whose forearm keeps its direction by rods, as its model says.

    The shoulder's motor bears the forearm, too, and the elbow has none.
    """
    motion = scene.motion
    shoulder, elbow = 1, forearm_of(scene)
    middle = np.mean(motion.q, axis=0)
    q, qd, qdd = motion.q.copy(), motion.qd.copy(), motion.qdd.copy()
    q[:, elbow] = middle[elbow] - (q[:, shoulder] - middle[shoulder])
    qd[:, elbow] = -qd[:, shoulder]
    qdd[:, elbow] = -qdd[:, shoulder]
    tied = record(scene, scene.arm, Motion(motion.time, q, qd, qdd))
    tau = tied.log.tau.copy()
    tau[:, shoulder] -= tau[:, elbow]
    tau[:, elbow] = 0.0

    def edit(spec: Any) -> None:
        equality = spec.add_equality(name="rods")
        equality.type = mujoco.mjtEq.mjEQ_JOINT
        equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
        equality.name1 = scene.robot.joint_names[elbow]
        equality.name2 = scene.robot.joint_names[shoulder]
        equality.data[:2] = middle[elbow] + middle[shoulder], -1.0

    return edit_model(with_torques(tied, tau), edit)


def edit_inertia(scene: Scene, edit: Callable[[Array], None]) -> Scene:
    """Return the scene with a URDF in which the inertia (3, 3) of the forearm is changed."""
    mj_model = mujoco.MjModel.from_xml_string(bare_model_text(scene.path))
    name = scene.robot.links[forearm_of(scene)].body_name

    def change(body_name: str, inertia: Array) -> Array:
        if body_name == name:
            edit(inertia)
        return inertia

    return replace(scene, urdf=urdf_of(mj_model, change), culprit=name)


def impossible_inertia(scene: Scene) -> Scene:
    """Return the scene with a URDF in which a point is missing in a moment of inertia."""

    def edit(inertia: Array) -> None:
        least = int(np.argmin(np.diag(inertia)))
        inertia[least, least] *= 1e3

    return edit_inertia(scene, edit)


def negative_moment(scene: Scene) -> Scene:
    """Return the scene with a URDF in which a moment of inertia has the wrong sign."""

    def edit(inertia: Array) -> None:
        inertia[1, 1] *= -1.0

    return edit_inertia(scene, edit)


def large_product(scene: Scene) -> Scene:
    """Return the scene with a URDF in which a product of inertia is as large as a mass."""

    def edit(inertia: Array) -> None:
        inertia[0, 2] = inertia[2, 0] = 0.7

    return edit_inertia(scene, edit)


def mimic_joint(scene: Scene) -> Scene:
    """Return the log of an arm with rods whose model is a URDF that says so."""
    mj_model = mujoco.MjModel.from_xml_string(bare_model_text(scene.path))
    elbow, shoulder = (
        scene.robot.joint_names[joint] for joint in (forearm_of(scene), 1)
    )
    head, name, tail = urdf_of(mj_model).partition(f'<joint name="{elbow}"')
    tie = f'<mimic joint="{shoulder}" multiplier="-1"/></joint>'
    text = head + name + tail.replace("</joint>", tie, 1)
    return replace(tied_joints(scene), edit=None, urdf=text)


def rods(scene: Scene) -> Scene:
    """Return the log of an arm with rods whose model has one, from the base to the forearm."""

    def edit(spec: Any) -> None:
        base = spec.body(scene.robot.links[0].body_name)
        rod = base.add_body(name="rod")
        rod.add_joint(name="rod_joint", axis=[0.0, 1.0, 0.0])
        rod.add_geom(**SMALL_BALL)
        equality = spec.add_equality(name="end_of_rod")
        equality.type = mujoco.mjtEq.mjEQ_CONNECT
        equality.objtype = mujoco.mjtObj.mjOBJ_BODY
        equality.name1 = "rod"
        equality.name2 = scene.robot.links[forearm_of(scene)].body_name

    return edit_model(tied_joints(scene), edit)


def tied_fingers(scene: Scene) -> Scene:
    """Return the scene with a model that has two fingers, which are tied to each other."""

    def edit(spec: Any) -> None:
        hand = spec.body(scene.robot.body_name)
        for side in ("left", "right"):
            finger = hand.add_body(name=f"{side}_finger")
            finger.add_joint(name=f"{side}_finger_joint", axis=[1.0, 0.0, 0.0])
            finger.add_geom(**SMALL_BALL)
        equality = spec.add_equality(name="fingers")
        equality.type = mujoco.mjtEq.mjEQ_JOINT
        equality.objtype = mujoco.mjtObj.mjOBJ_JOINT
        equality.name1, equality.name2 = "left_finger_joint", "right_finger_joint"
        equality.data[:2] = 0.0, 1.0

    return edit_model(scene, edit)


def large_rotors(scene: Scene) -> Scene:
    """Return the scene with a model whose rotors have a hundred times the usual inertia."""
    usual = 0.02 * float(np.max(scene.usual_torque))

    def edit(spec: Any) -> None:
        for name in scene.robot.joint_names:
            spec.joint(name).armature = usual

    return edit_model(scene, edit)


def forearm_in(mass: float, inertia: float, scene: Scene) -> Scene:
    """Return the scene with a model in which mass and inertia of the forearm have factors."""
    name = scene.robot.links[forearm_of(scene)].body_name
    return edit_bodies(scene, partial(multiply_body, mass, inertia), name)


def centre_in_mm(scene: Scene) -> Scene:
    """Return the scene with a model whose forearm has its centre of mass in millimetres."""

    def change(body: Any) -> None:
        body.ipos = 1e3 * body.ipos

    name = scene.robot.links[forearm_of(scene)].body_name
    return edit_bodies(scene, change, name)


def cogging_motor(scene: Scene) -> Scene:
    """Return a log of an arm, and its model, with a motor whose magnets pull at its joint."""
    joint = loaded_joint(scene)
    size = BIAS * float(scene.usual_torque[joint])
    pulled = size * np.sin(4.0 * scene.motion.q[:, joint])

    def edit(spec: Any) -> None:
        # All joints get a motor: the last one has one where others have.
        for number, name in enumerate(scene.robot.joint_names):
            actuator = spec.add_actuator(name=f"motor_{name}")
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.target = name
            own = {"cogging": [size, 4.0, 0.0]} if number == joint else {}
            actuator.set_to_dcmotor([WEAK, WEAK], 1.0, **own)

    return edit_model(scene.with_joint_torque(joint, -pulled), edit)


def joint_cause(spoil: Callable[[Scene], Scene], *names: str) -> Cause:
    """Return a cause that is one fault of one joint."""
    return Cause(spoil, (names,))


CONTRADICTED = "probably wrong|contradict"
"""Words for a number of the model that the log contradicts."""
PASSIVE = "actuator.*(bias|passive|force|torque)"
"""Words for an actuator that acts by itself."""
TIED = r"\btied\b|one coordinate|loop of bodies"
"""Words for joints that are none by themselves."""
ONE_NUMBER = r"(i[xyz]{2}|inertia).*(times too (large|small)|point is missing|wrong (digit|sign))"
"""Words for one number that makes an inertia impossible."""
ODD_INERTIA = f"inertia.*({CONTRADICTED})|({CONTRADICTED}).*inertia"
"""Words for an inertia that is no link's."""
NO_TORQUE = (
    "without torque|no torque|(are|is) ((all|but|nearly|next|to) )*zero|zero throughout"
)
"""Words for a column that has no torque in it."""
TORQUE_MISTAKES = {
    "external_with_payload": Cause(
        external_with_payload, (("gravity",),), "external torque"
    ),
    "all_times_1_4": Cause(partial(all_times, 1.4), (SCALE,)),
    "all_times_0_7": Cause(partial(all_times, 0.7), (SCALE,)),
    "joint_half": joint_cause(partial(joint_times, None, 0.5), *SCALE),
    "base_joint_half": joint_cause(partial(joint_times, 0, 0.5), *SCALE),
    "base_joint_times_1_4": joint_cause(partial(joint_times, 0, 1.4), *SCALE),
    "unsigned_current": Cause(
        unsigned_current, (("unsigned",),), "without a sign|never (negative|below zero)"
    ),
    "model_torque_with_coloured_noise": Cause(
        model_torque_with_coloured_noise, (("computed",),)
    ),
    "commanded_torque": Cause(commanded_torque, (("computed",),)),
    "light_sign": joint_cause(light_sign, "sign"),
    "wrist_signs": joint_cause(partial(both_signs, 2), "sign"),
    "last_signs": joint_cause(partial(both_signs, 1), "sign"),
    "four_signs": Cause(partial(turned_signs, 4), (("sign",),)),
    "late_by_30_ms": Cause(late_by_30_ms, (("delay",),)),
    "zero_column": Cause(zero_column, (("zero torque",),), NO_TORQUE),
    "denormal_torque": Cause(denormal_torque, (("zero torque",),), NO_TORQUE),
    "denormal_joint": Cause(denormal_joint, (("zero torque",),), NO_TORQUE),
    "joint_twice": joint_cause(partial(joint_times, None, 2.0), *SCALE),
    "wrist_times_0_7": joint_cause(partial(joint_times, -2, 0.7), *SCALE),
    "last_times_1_5": joint_cause(partial(joint_times, -1, 1.5), *SCALE),
    "base_signs": joint_cause(partial(both_signs_of, 0), "sign"),
    "base_torque_sign": joint_cause(partial(joint_times, 0, -1.0), "sign"),
    "exchanged_wrists": Cause(exchanged_wrists, (("order",),)),
    "early_by_20_ms": Cause(partial(late_by, -LATE_JOINT), (("delay",),)),
    "late_joint_by_20_ms": joint_cause(late_joint_by_20_ms, "delay"),
    "constant_column": Cause(
        constant_column, (("zero torque",),), "the same in every row|constant"
    ),
    "signed_by_motion": Cause(
        signed_by_motion, (("unsigned",),), "without a sign|sign of the (motion|speed)"
    ),
}
"""Mistakes in the torque."""
TORQUE_CLASSES = {
    "all_times_1_25": Cause(partial(all_times, 1.25), (SCALE,)),
    "all_times_2": Cause(partial(all_times, 2.0), (SCALE,)),
    "all_times_0_5": Cause(partial(all_times, 0.5), (SCALE,)),
    "external_of_load": Cause(external_of_load, (("gravity",),)),
    "external_low_passed": Cause(external_low_passed, (("gravity",),)),
    "compensated_by_model": Cause(partial(compensated, 1.0, True), (("gravity",),)),
    # As for a balancer, weight that is missing looks like a time that is too long.
    "half_compensated": Cause(
        partial(compensated, 0.5, False), (("gravity", "clock"),)
    ),
    "computed_of_another_load": Cause(computed_of_another_load, (("computed",),)),
    "commanded_with_friction": Cause(partial(with_friction_times, 0.8), ()),
    "friction_taken_off": Cause(partial(with_friction_times, 0.3), ()),
}
"""Torques that are not measured in newton metres at the joints, and two that are as good."""
POSITION_MISTAKES = {
    "zero_3_degrees": joint_cause(partial(zero_off, 3.0), "zero"),
    "zero_10_degrees": joint_cause(partial(zero_off, 10.0), "zero"),
    "zero_90_degrees": joint_cause(partial(zero_off, 90.0), "zero"),
    "backlash": joint_cause(backlash, "backlash"),
    "base_position_sign": joint_cause(partial(positions_times, 0, -1.0), "sign"),
    "zero_45_degrees": joint_cause(partial(zero_off, 45.0), "zero"),
    "zero_180_degrees": joint_cause(partial(zero_off, 180.0), "zero"),
    "two_zeros_off": Cause(two_zeros_off, (("zero",),)),
    "positions_half": joint_cause(partial(positions_times, None, 0.5), "angle-unit"),
    "base_backlash": joint_cause(partial(backlash_of, 0), "backlash"),
    "wrist_backlash": joint_cause(partial(backlash_of, -2), "backlash"),
}
"""Mistakes of encoders and gears."""
TIME_MISTAKES = {
    "time_twice": Cause(partial(time_times, 2.0), (("clock",),)),
    "time_half": Cause(partial(time_times, 0.5), (("clock",),)),
    "second_missing": Cause(
        second_missing, (("clock",),), "(samples|rows|time) .*(lost|missing)"
    ),
    "rows_twice": Cause(
        rows_twice, (("clock",),), "written twice|same row|identical|duplicate"
    ),
    "swapped_rows": Cause(swapped_rows, (("clock",),), r"\bsort|out of order|swapped"),
    "rows_twice_later": Cause(rows_twice_later, (("clock",),), "written twice|repeat"),
    "exchanged_stretches": Cause(
        exchanged_stretches, (("clock",),), r"\bsort|out of order"
    ),
    "shuffled_rows": Cause(shuffled_rows, (("clock",),), r"\bsort|out of order"),
    "clock_from_zero": Cause(clock_from_zero, (("clock",),), "time starts again"),
    "clock_set_back": Cause(
        clock_set_back, (("clock",),), "backwards in time|set back"
    ),
    "stamp_ahead": Cause(
        stamp_ahead, (("clock",),), "(stamp|time|row).*(ahead|backwards|wrong|off)"
    ),
    "rows_of_spikes": Cause(rows_of_spikes, (("position",),), "position.* jumps"),
    "time_twice_beside_velocities": Cause(time_twice_beside_velocities, (("clock",),)),
}
"""Mistakes of clocks and of the rows of a file."""
MODEL_MISTAKES = {
    "loaded_forearm": Cause(loaded_forearm, (("link",),), CONTRADICTED),
    "light_forearm": Cause(light_forearm, (("model", "link"),), CONTRADICTED),
    "centre_off": Cause(centre_off, (("link",),), CONTRADICTED),
    "small_inertias": Cause(small_inertias, (("link",),), ODD_INERTIA),
    "biased_actuator": Cause(biased_actuator, (("actuator",),), PASSIVE),
    # That an equality is ignored is no answer to it.
    "tied_joints": Cause(tied_joints, (("tied",),), r"\btied\b|one coordinate"),
    "impossible_inertia": Cause(impossible_inertia, (("inertia",),), ONE_NUMBER),
    "bias_at_light_joint": Cause(bias_at_light_joint, (("actuator",),), PASSIVE),
    "gas_spring": Cause(gas_spring, (("actuator",),), PASSIVE),
    "damper": Cause(damper, (("actuator",),), PASSIVE),
    "negative_moment": Cause(negative_moment, (("inertia",),), ONE_NUMBER),
    "large_product": Cause(large_product, (("inertia",),), ONE_NUMBER),
    "mimic_joint": Cause(mimic_joint, (("tied",),), TIED),
    "rods": Cause(rods, (("tied",),), TIED),
    "forearm_ten_times": Cause(
        partial(forearm_in, 10.0, 10.0), (("model", "link"),), CONTRADICTED
    ),
    "forearm_in_g_mm2": Cause(
        partial(forearm_in, 1.0, 1e9), (("inertia",),), ODD_INERTIA
    ),
    "centre_in_mm": Cause(
        centre_in_mm, (("link",),), f"centre of mass.*({CONTRADICTED})"
    ),
    "turned_centre": Cause(
        turned_centre,
        (("link",),),
        f"({CONTRADICTED}).*centre of mass|centre of mass.*({CONTRADICTED})",
    ),
}
"""Mistakes of models, and what models say that has to be counted."""
if hasattr(mujoco.MjsActuator, "set_to_dcmotor"):  # Since MuJoCo 4.
    MODEL_MISTAKES["friction_of_motors"] = Cause(
        friction_of_motors, (("actuator",),), "actuator.*(friction|LuGre|passive)"
    )
    MODEL_MISTAKES["cogging_motor"] = Cause(cogging_motor, (("actuator",),), PASSIVE)
TWO_MISTAKES = {
    "sign_and_lost_samples": Cause(
        in_turn(spoiler("torque_sign"), spoiler("dropped_samples")), (("clock",),)
    ),
    "order_and_clock_jumps": Cause(
        in_turn(spoiler("exchanged_joints"), spoiler("clock_jump")), (("clock",),)
    ),
    "computed_and_zero": Cause(
        in_turn(spoiler("computed_torque"), spoiler("position_offset")),
        (("computed",),),
    ),
}
"""Two at once: what needs less of the log has to be named, the other may follow from it."""
RIGHT_LOGS = {
    "late_stamps": Cause(late_stamps, ()),
    "noisy": Cause(noisy, ()),
    "small_motion": Cause(partial(small_motion, 0.2), ()),
    "gap": Cause(gap, ()),
    "joint_after_joint": Cause(joint_after_joint, (), duration=30.0),
    "stiction": Cause(stiction, ()),
    "tied_fingers": Cause(tied_fingers, ()),
    "large_rotors": Cause(large_rotors, ()),
    "five_seconds": Cause(lambda scene: scene, (), duration=5.0),
    "slow_motion": Cause(slow_motion, ()),
    "one_posture": Cause(partial(small_motion, 0.07), ()),
    "one_joint": Cause(one_joint, ()),
    "last_joints": Cause(partial(moving_joints, -3, None), ()),
    "last_joint_still": Cause(partial(moving_joints, 0, -1), ()),
    "rest_in_the_middle": Cause(partial(with_rest, 0.4, 0.6), ()),
    "half_at_rest": Cause(partial(with_rest, -0.1, 0.5), ()),
    "coarse_encoders": Cause(coarse_encoders, ()),
    "fifty_hertz": Cause(seldom, ()),
    "coarse_torque": Cause(coarse_torque, ()),
    "rounded_stamps": Cause(rounded_stamps, ()),
    "stamps_of_bursts": Cause(stamps_of_bursts, ()),
    # No estimate uses recorded velocities.
    "velocities_in_degrees": Cause(partial(with_velocities, np.degrees(1.0)), ()),
    "velocities_turned": Cause(partial(with_velocities, -1.0), ()),
}
"""Right logs under odd conditions, which ``benchmarks.trust.right_logs`` looks at as well."""
if hasattr(mujoco.MjsJoint, "springyield"):  # Since MuJoCo 4.
    RIGHT_LOGS["yielding_springs"] = Cause(yielding_springs, ())
MISTAKES: dict[str, Cause] = {
    **TORQUE_MISTAKES,
    **TORQUE_CLASSES,
    **POSITION_MISTAKES,
    **TIME_MISTAKES,
    **MODEL_MISTAKES,
    **TWO_MISTAKES,
    **RIGHT_LOGS,
}
"""Cause by its name; those without a fault are right."""
