"""The plant, another model of the same arm that plays the real one: it follows a trajectory under a
tracking controller, and is read at the sample rate.

Every control period the drive holds the torque

    tau = tau_ff(t + h/2) + M(q) (w^2 (q_d - q) + 2 w (qd_d - qd)),

tau_ff the plant's own inverse dynamics along the trajectory and M its mass matrix, so that all
joints of any arm get the same critically damped error dynamics of bandwidth w (computed-torque
control with the feed-forward on the desired path: Siciliano, Sciavicco, Villani, Oriolo, "Robotics:
Modelling, Planning and Control", 2009, sec. 8.5.2). Torques beyond the joint's limit are cut off.

The drive reports the mean of the torques it held just before and just after a sample. The plant
answers a staircase of width h like a smooth torque h/2 later, and the mean is that smooth torque at
the sample's instant: what is reported is the effective torque up to terms of order h^2. Reporting
the new step alone would lead by h/2, which on a light wrist shows as a wrong inertia.

Sensors make noise, encoder steps and late torques of the truth. An ideal one changes nothing.
Anything that spoils the positions also removes velocities and accelerations from the record,
because an arm with only encoders would have to compute them from those same positions; torques may
be spoiled while the motion stays exactly known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.kinematics import posed
from robot_sysid.errors import InputError, SimulationError
from robot_sysid.model.chain import is_hinge_or_slide, joint_label
from robot_sysid.model.compilation import captured_warnings, compile_model
from robot_sysid.parser import robot_from_compiled
from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel
from robot_sysid.records.options import PerJoint, per_joint
from robot_sysid.simulation.forward_dynamics import ForwardPlant, RampUse
from robot_sysid.simulation.options import SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_times

BANDWIDTH = 60.0
"""Bandwidth w of the tracking controller [rad/s]; lower where the control period is long."""
BANDWIDTH_TIMES_PERIOD = 0.1
"""Largest w h: far enough below 1, where the sampled loop would become unstable."""
LOST_TRACKING = {False: 0.2, True: 0.05}
"""Position error that ends the run: hinge [rad], slide [m]."""
# Times the lost-tracking error from which on it is the simulation, not the controller; places along
# the motion where the plant's stiffness is judged.
_DIVERGED, _CONFIGURATIONS = 1e3, 33


class ClosedLoop:
    """One arm, one trajectory, one controller.

    Args:
        sample_rate: of the measurements [Hz].

    Attributes:
        period: control period [s], the plant's own time step or the next shorter one of which a
            whole number makes a sample period.
        ramp_use: how much of the plant's dry friction the motion showed.
        limited: (n,) control periods in which the torque limit cut the command off.
    """

    def __init__(self, plant: RobotModel, plan: MotionPlan, sample_rate: float) -> None:
        self._plant, self._plan, self._sample_rate = plant, plan, sample_rate
        own_step = float(plant.mj_model.opt.timestep)
        self._periods = max(1, math.ceil(1.0 / (sample_rate * own_step) - 1e-9))
        self.period = 1.0 / (sample_rate * self._periods)
        self._bandwidth = min(BANDWIDTH, BANDWIDTH_TIMES_PERIOD / self.period)
        self._lost = np.array([LOST_TRACKING[bool(slide)] for slide in plant.is_slide])
        along = np.linspace(0.0, plan.duration, _CONFIGURATIONS)
        with captured_warnings():
            self._arm = ForwardPlant(plant, self.period, plan.evaluate(along).q)
            self._reset()

    def _reset(self) -> None:
        self.ramp_use = RampUse(self._plant.joint_names, self._arm.ramp)
        self.limited = np.zeros(self._plant.n_joints, dtype=np.int64)
        self._ticks = 0
        self._held: Array | None = None
        start = self._plan.evaluate(np.zeros(1))
        self._arm.reset(start.q[0], start.qd[0])

    def run(self) -> Iterator[Measurement]:
        """Yield exact measurements of the whole motion, accelerations included.

        The accelerations are MuJoCo's at the sample's state under the reported torque. Each call
        starts anew.

        Raises:
            SimulationError: the arm left the trajectory; says when, which joint and likely why.
        """
        self._reset()
        for time in sample_times(self._plan.duration, self._sample_rate):
            ticks = time[0] + self.period * np.arange(len(time) * self._periods)
            # Half a period later for the feed-forward.
            held, ahead = (
                self._plan.evaluate(np.minimum(ticks + later, self._plan.duration))
                for later in (0.0, 0.5 * self.period)
            )
            with captured_warnings():
                feed_forward = self._arm.inverse(ahead.q, ahead.qd, ahead.qdd)
                measurement = self._chunk(time, held, feed_forward)
            yield measurement

    def notes(self) -> tuple[str, ...]:
        """Return what the run showed so far: torque limits met, dry friction that does not show."""
        limits = tuple(
            f"the plant's {self._plant.joint_names[j]} was at its torque limit of "
            f"{self._plant.limits.torque[j]:.3g} N m for "
            f"{100.0 * self.limited[j] / self._ticks:.2g} % of the time"
            for j in np.flatnonzero(self.limited)
        )
        return limits + self.ramp_use.sentences()

    def _chunk(self, time: Array, motion: Motion, feed_forward: Array) -> Measurement:
        samples = np.empty((5, len(time), self._plant.n_joints))
        for k in range(len(motion.time)):
            tau = self._command(motion, k, feed_forward[k])
            sample, between = divmod(k, self._periods)
            if between == 0:
                reported = tau if self._held is None else 0.5 * (self._held + tau)
                qdd = self._arm.acceleration(reported)
                dry = self._arm.dry_friction()
                samples[:, sample] = (*self._arm.state(), qdd, reported, dry)
            self._arm.step(tau)
            self._held = tau
        q, qd, qdd, measured, dry = samples
        self.ramp_use.add(qd, dry)
        return Measurement(time, q, qd, measured, qdd)

    def _command(self, motion: Motion, k: int, feed_forward: Array) -> Array:
        """Return the torque (n,) to hold from tick k on."""
        q, qd = self._arm.state()
        error = motion.q[k] - q
        if not np.all(np.abs(error) < self._lost):
            raise SimulationError(self._lost_message(error, float(motion.time[k])))
        wanted = self._bandwidth * (self._bandwidth * error + 2.0 * (motion.qd[k] - qd))
        tau = feed_forward + self._arm.times_mass(wanted)
        limited = np.clip(tau, -self._plant.limits.torque, self._plant.limits.torque)
        self._ticks += 1
        self.limited += limited != tau
        return limited

    def _lost_message(self, error: Array, time: float) -> str:
        relative = np.nan_to_num(np.abs(error) / self._lost, nan=np.inf)
        joint, names = int(np.argmax(relative)), self._plant.joint_names
        name, limited = names[joint], [names[j] for j in np.flatnonzero(self.limited)]
        if self._arm.has_diverged() or np.max(relative) >= _DIVERGED:
            return (
                f"the simulated plant diverged at {time:.3f} s (joint {name}): the likely cause "
                "is a spring too stiff for the time step, or a link with an impossible mass or "
                "inertia; lower the plant model's <option timestep> and check its <inertial> "
                "elements"
            )
        unit = "m" if self._plant.is_slide[joint] else "rad"
        head = f"joint {name} is {abs(error[joint]):.2g} {unit} off its trajectory at {time:.3f} s"
        if limited:
            return (
                f"{head}: the torque limit of {', '.join(limited)} is too low for this motion; "
                "lower --max-velocity or correct the limit in the plant model"
            )
        return (
            f"{head}, though no torque limit was met: the likely cause is a spring or friction "
            "that changes faster than the control period; lower the plant's <option timestep>"
        )


class PlantSimulation:
    """A run of the plant that can be read as often as wanted; every reading is the same.

    Args:
        plant: the arm that plays the real one, see ``load_plant``.
        sample_rate: of the measurements [Hz].
        rng: source of the sensor noise; drawn from once, here.

    Raises:
        InputError: options and arm do not fit together.
        SimulationError: the plant cannot be simulated.
    """

    def __init__(
        self,
        plant: RobotModel,
        plan: MotionPlan,
        options: SimulatedArmOptions,
        sample_rate: float,
        rng: np.random.Generator,
    ) -> None:
        per_joint(options.noise_torque, plant.n_joints, "--noise-torque")
        per_joint(options.noise_position, plant.n_joints, "--noise-position")
        moved = plan.evaluate(np.zeros(1)).q.shape[1]
        if moved != plant.n_joints:
            raise InputError(f"the trajectory moves {moved} joints, the plant has {plant.n_joints}")
        self._plant, self._plan, self._sample_rate = plant, plan, sample_rate
        self._sensors = Sensors(options, sample_rate, rng)
        forward = options.simulation == "forward"
        self._loop = ClosedLoop(plant, plan, sample_rate) if forward else None

    def __iter__(self) -> Iterator[Measurement]:
        """Yield what the sensors report, chunk by chunk in constant memory."""
        if self._loop is not None:
            return self._sensors.read(self._loop.run())
        motions = motion_chunks(self._plan, self._sample_rate)
        return self._sensors.read(simulate_inverse(self._plant, motions))

    def notes(self) -> tuple[str, ...]:
        """Return what the last reading showed, one sentence each; ask once it is at its end."""
        return () if self._loop is None else self._loop.notes()

    def least_deadband(self) -> tuple[float, ...]:
        """Return (n,) speeds below which MuJoCo's dry friction was not complete [rad/s].

        Zero for a joint whose friction never is: leaving out all its rows would help nobody. Empty
        where the plant's friction follows Coulomb's law. Ask once the last reading is at its end.
        """
        if self._loop is None:
            return ()
        use = self._loop.ramp_use
        return tuple(
            0.0 if joint in use.never_full else float(speed)
            for joint, speed in zip(self._plant.joint_names, use.ramp_speed)
        )


GEOMETRY_TOLERANCE = 1e-6
"""How far apart the terminal bodies of model and plant may be without a note [m]."""


def load_plant(robot: RobotModel, plant_path: Path, mesh_dir: Path | None = None) -> RobotModel:
    """Load the model that plays the real arm, matched to the arm to be identified.

    An MJCF or URDF file with the same joints; masses, friction, armature, fingers and everything
    else may differ. Its meshes are in ``mesh_dir``, or where the file says. Apart from the chain it
    is held at its own reference configuration; notes say where its geometry differs.

    Raises:
        ModelError: the file cannot be used; says why.
        InputError: its joints are others than the robot's; lists the differences.
    """
    compiled = compile_model(Path(plant_path), mesh_dir)
    terminal = robot.terminal_joint
    if terminal not in _hinges_and_slides(compiled.mj_model):
        known = ", ".join(_hinges_and_slides(compiled.mj_model)) or "none"
        raise InputError(
            f"the plant {Path(plant_path).name} has no joint {terminal}, the last joint of "
            f"{robot.path.name}; its joints are: {known}"
        )
    plant = robot_from_compiled(compiled, Path(plant_path), terminal)
    differences = joint_differences(robot, plant)
    if differences:
        raise InputError(
            f"the plant {plant.path.name} does not have the joints of {robot.path.name}: "
            f"{'; '.join(differences)}. Give a model of the same arm with the same joint names"
        )
    ours = _hinges_and_slides(robot.mj_model)
    held = [name for name in _hinges_and_slides(plant.mj_model) if name not in ours]
    note = (f"joints only the plant has are held still: {', '.join(held)}",) if held else ()
    return replace(plant, notes=plant.notes + note + _geometry_notes(robot, plant))


def _hinges_and_slides(mj_model: Any) -> list[str]:
    joints = range(mj_model.njnt)
    return [joint_label(mj_model, j) for j in joints if is_hinge_or_slide(mj_model, j)]


def joint_differences(robot: RobotModel, plant: RobotModel) -> tuple[str, ...]:
    """Return in words how the chain of a plant differs from the robot's; empty if it does not."""
    ours, theirs = robot.joint_names, plant.joint_names
    if ours != theirs:
        return (f"{', '.join(theirs)} instead of {', '.join(ours)}",)
    kinds = ("hinge", "slide")
    return tuple(
        f"{name} is a {kinds[int(slides)]} instead of a {kinds[int(own)]}"
        for name, slides, own in zip(ours, plant.is_slide, robot.is_slide)
        if slides != own
    )


def _geometry_notes(robot: RobotModel, plant: RobotModel) -> tuple[str, ...]:
    """Return a sentence where the same joint positions put the terminal body elsewhere."""

    def place(arm: RobotModel, q: Array) -> Array:
        qpos = arm.reference_qpos.copy()
        qpos[arm.qpos_index] = q
        return np.array(posed(arm.mj_model, qpos).xpos[arm.body_id])

    poses = robot.reference, robot.reference + 0.5
    distance = max(float(np.linalg.norm(place(robot, q) - place(plant, q))) for q in poses)
    if distance <= GEOMETRY_TOLERANCE:
        return ()
    return (
        f"the same joint positions put the terminal body of the plant {1e3 * distance:.3g} mm from "
        "where the model has it, so the identified values also carry that difference",
    )


_WHOLE = 1e-9


class Sensors:
    """Reads exact measurements the way imperfect sensors would, chunk by chunk.

    Args:
        sample_rate: of the measurements, evenly spaced [Hz].
        rng: source of randomness. Each channel gets a generator of its own from it, so that the
            readings do not depend on how the stream is cut into chunks.
    """

    def __init__(
        self, options: SimulatedArmOptions, sample_rate: float, rng: np.random.Generator
    ) -> None:
        self._options, self._sample_rate = options, sample_rate
        self._seeds = rng.integers(2**63, size=(2, 4))

    def read(self, measurements: Iterable[Measurement]) -> Iterator[Measurement]:
        """Yield what the sensors report; the same stream gives the same readings each time."""
        options = self._options
        torque, position = (np.random.default_rng(seed) for seed in self._seeds)
        delay = TorqueDelay(options.torque_delay * self._sample_rate)
        for exact in measurements:
            tau = _noisy(delay.apply(exact.tau), options.noise_torque, torque)
            spoiled = replace(exact, tau=tau)
            if not options.exact_positions:
                q = _noisy(exact.q, options.noise_position, position)
                q = quantised(q, options.encoder_resolution)
                spoiled = replace(spoiled, q=q, qd=None, qdd=None)
            yield spoiled


def _noisy(values: Array, sigma: PerJoint, rng: np.random.Generator) -> Array:
    """Return values (N, n) plus white noise; the generator advances whatever sigma is."""
    return values + np.asarray(sigma) * rng.standard_normal(values.shape)


def quantised(values: Array, step: float) -> Array:
    """Return the nearest multiples of ``step``; values unchanged where it is 0."""
    return values if step == 0.0 else np.round(values / step) * step


class TorqueDelay:
    """Delays a stream of evenly spaced samples by any number of sample periods.

    Whole periods are exact. In between stands the cubic through four neighbouring samples
    (Lagrange), whose error is at most 3/128 h^4 max|tau''''| for delays above one period h and
    1/24 h^4 max|tau''''| below, where only older samples are at hand: 1e-7 N m for a torque of
    10 N m at 2 Hz, sampled at 1 kHz. A jump, such as that of dry friction where a joint reverses,
    is spread over the four samples around it. Before its first sample the torque is taken to have
    been constant.
    """

    def __init__(self, periods: float) -> None:
        nearest = round(periods)
        is_whole = abs(periods - nearest) < _WHOLE
        first = max(math.floor(periods) - 1, 0)
        self._taps = np.array([nearest]) if is_whole else first + np.arange(4)
        others = [np.delete(self._taps, i) for i in range(len(self._taps))]
        pairs = zip(self._taps, others)
        self._weights = [float(np.prod((periods - o) / (tap - o))) for tap, o in pairs]
        self._history: Array | None = None

    def apply(self, values: Array) -> Array:
        """Return the delayed samples (N, n) of the next chunk (N, n)."""
        longest = int(self._taps[-1])
        if self._history is None:
            self._history = np.repeat(values[:1], longest, axis=0)
        stream = np.concatenate((self._history, values))
        size = len(values)
        self._history = stream[size:]
        delayed = np.zeros(values.shape)
        for tap, weight in zip(self._taps, self._weights):
            delayed += weight * stream[longest - tap : longest - tap + size]
        return delayed
