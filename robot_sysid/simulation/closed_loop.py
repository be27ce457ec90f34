"""A plant that follows a trajectory under a tracking controller, read at the sample rate.

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
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from robot_sysid.errors import SimulationError
from robot_sysid.model.compilation import captured_warnings
from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel
from robot_sysid.records.options import PerJoint
from robot_sysid.simulation.forward_dynamics import ForwardPlant
from robot_sysid.simulation.frictionloss import RampUse
from robot_sysid.trajectory import sample_times

BANDWIDTH = 60.0
"""Bandwidth w of the tracking controller [rad/s]; lower where the control period is long."""
BANDWIDTH_TIMES_PERIOD = 0.1
"""Largest w h: far enough below 1, where the sampled loop would become unstable."""
LOST_TRACKING = {False: 0.2, True: 0.05}
"""Position error that ends the run: hinge [rad], slide [m]."""
_DIVERGED = 1e3
_CONFIGURATIONS = 33


class ClosedLoop:
    """One arm, one trajectory, one controller.

    Args:
        plant: the arm that moves.
        plan: the trajectory.
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
            with captured_warnings():
                measurement = self._chunk(time, self._desired(ticks))
            yield measurement

    def notes(self, deadband: PerJoint | None = None) -> tuple[str, ...]:
        """Return what the run showed so far: torque limits met, dry friction that does not show.

        Args:
            deadband: speed below which samples are going to be left out [rad/s].
        """
        limits = tuple(
            f"the plant's {self._plant.joint_names[j]} was at its torque limit of "
            f"{self._plant.limits.torque[j]:.3g} N m for "
            f"{100.0 * self.limited[j] / self._ticks:.2g} % of the time"
            for j in np.flatnonzero(self.limited)
        )
        return limits + self.ramp_use.sentences(deadband)

    def _desired(self, ticks: Array) -> tuple[Motion, Array]:
        """Return the desired motion at the ticks and the feed-forward half a period later."""
        held = self._plan.evaluate(np.minimum(ticks, self._plan.duration))
        ahead = np.minimum(ticks + 0.5 * self.period, self._plan.duration)
        motion = self._plan.evaluate(ahead)
        return held, self._arm.inverse(motion.q, motion.qd, motion.qdd)

    def _chunk(self, time: Array, desired: tuple[Motion, Array]) -> Measurement:
        motion, feed_forward = desired
        samples = np.empty((5, len(time), self._plant.n_joints))
        for k in range(len(motion.time)):
            tau = self._command(motion, k, feed_forward[k])
            sample, between = divmod(k, self._periods)
            if between == 0:
                samples[:, sample] = self._read(tau)
            self._arm.step(tau)
            self._held = tau
        q, qd, qdd, measured, dry = samples
        self.ramp_use.add(qd, dry)
        return Measurement(time, q, qd, measured, qdd)

    def _command(self, motion: Motion, k: int, feed_forward: Array) -> Array:
        """Return the torque (n,) to hold from tick k on."""
        q, qd = self._arm.state()
        error = motion.q[k] - q
        self._require_tracking(error, float(motion.time[k]))
        wanted = self._bandwidth * (self._bandwidth * error + 2.0 * (motion.qd[k] - qd))
        tau = feed_forward + self._arm.times_mass(wanted)
        limited = np.clip(tau, -self._plant.limits.torque, self._plant.limits.torque)
        self._ticks += 1
        self.limited += limited != tau
        return limited

    def _read(self, tau: Array) -> tuple[Array, ...]:
        """Return q, qd, qdd, reported torque and dry friction (n,) where torque ``tau`` begins."""
        reported = tau if self._held is None else 0.5 * (self._held + tau)
        qdd = self._arm.acceleration(reported)
        return (*self._arm.state(), qdd, reported, self._arm.dry_friction())

    def _require_tracking(self, error: Array, time: float) -> None:
        if np.all(np.abs(error) < self._lost):
            return
        relative = np.abs(error) / self._lost
        joint = int(np.argmax(np.where(np.isnan(relative), np.inf, relative)))
        raise SimulationError(self._lost_message(error, joint, time))

    def _lost_message(self, error: Array, joint: int, time: float) -> str:
        name = self._plant.joint_names[joint]
        limited = np.flatnonzero(self.limited)
        if self._arm.has_diverged() or not np.all(np.abs(error) < _DIVERGED * self._lost):
            return (
                f"the simulated plant diverged at {time:.3f} s (joint {name}): the likely cause "
                "is a spring too stiff for the time step, or a link with an impossible mass or "
                "inertia; lower the plant model's <option timestep> and check its <inertial> "
                "elements"
            )
        unit = "m" if self._plant.is_slide[joint] else "rad"
        head = f"joint {name} is {abs(error[joint]):.2g} {unit} off its trajectory at {time:.3f} s"
        if len(limited):
            names = ", ".join(self._plant.joint_names[j] for j in limited)
            return (
                f"{head}: the torque limit of {names} is too low for this motion; lower "
                "--max-velocity or correct the limit in the plant model"
            )
        return (
            f"{head}, though no torque limit was met: the likely cause is a spring or friction "
            "that changes faster than the control period; lower the plant's <option timestep>"
        )
