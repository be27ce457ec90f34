"""Torques of the fitted base model along a log, from which explanations of faults are made.

The base model is the model of a log without faults (``log_model.LogModel`` without explanations).

Throughout, K is the number of instants, n that of joints, p that of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from robot_sysid.diagnosis.log_model import Posterior
from robot_sysid.dynamics.equations import names_of
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array, Motion
from robot_sysid.signals.process import ProcessedSignals


class BaseFit:
    """Torques of the fitted base model along a log, from which explanations make their columns.

    All torques are low-passed like the rows: an unfiltered one would explain the filter's effect.
    Do not change the arrays: explanations share them.

    Args:
        posterior: posterior of the base model.
        signals: low-passed signals of the log's pieces.
        trusted: whether the estimated last link is plausible; if not, its prior's mean is used.

    Attributes:
        log: equations of the log.
        robot: the arm of the log.
        values: (p,) parameters of the fitted base model.
        time: (K,) from -1 at the first row to 1 at the last.
        rigid: (K, n) inverse-dynamics torque of the links [N m], the last one as fitted, all others
            as in the model.
        weight: (K, n) the torque of gravity in ``rigid`` [N m].
        tip_force: (K, n, 12) joint torque of a constant force on the last link. Four columns for
            each world axis: force at the link's origin [N m per N], and the force times its offset
            along the link's x, y and z [N m per N m].
        last_weight: (K, n, 4) torque of gravity on the last link, per unit of its mass [kg] and of
            its first moments along x, y and z [kg m].
        residual: (K, n) residual torque of the base model, zero in unused rows [N m].
    """

    def __init__(
        self, posterior: Posterior, signals: Sequence[ProcessedSignals], trusted: bool
    ) -> None:
        log = posterior.model.log
        self.log = log
        self.robot = log.robot
        ends = log.motion.time[[0, -1]]
        self.time = (2.0 * log.motion.time - ends.sum()) / np.ptp(ends)
        self.values = posterior.values
        self._posterior = posterior
        self.residual = (log.right_sides - log.torque_of(self.values)) * log.used
        bodies = posterior.model.prior.mean.copy()
        if trusted:
            bodies[:10] = self.values[:10]
        self.rigid = log.links_torque(bodies)
        self._thetas = log.columns.thetas(bodies[: len(log.columns.names)])
        self._signals = tuple(signals)
        filtered = [s.filter_columns(self._of_positions, smooth=True) for s in signals]
        self.weight, self.tip_force, self.last_weight = map(
            np.concatenate, zip(*filtered)
        )

    def _of_positions(self, motion: Motion) -> tuple[Array, Array, Array]:
        """Return (weight, tip_force, last_weight) of the class, unfiltered, along a motion."""
        zero = np.zeros_like(motion.q)
        last = [self.robot.n_joints - 1]
        forces = []
        # The weight of one kilogram under a gravity of one along an axis stands for a unit force.
        # Columns of a link's mass and first moments, its first four, are torques that hold it.
        for axis in np.eye(3):
            pulled = LinkDynamics(self.robot, axis).motion(motion.q, zero, zero)
            forces.append(-pulled.columns(last)[:, :, :4])
        resting = LinkDynamics(self.robot).motion(motion.q, zero, zero)
        weight = resting.torque(self._thetas)
        last_weight = resting.columns(last)[:, :, :4]
        return weight, np.concatenate(forces, axis=-1), last_weight

    @cached_property
    def inertial(self) -> Array:
        """The torque (K, n) of the links' inertia, without gravity [N m]."""
        return self.rigid - self.weight

    @cached_property
    def last_link(self) -> Array:
        """The torque (K, n, 10) [N m] per unit of each inertial parameter (SI) of the last link."""
        return self.log.columns_of(PARAMETER_NAMES)

    @cached_property
    def scale_error(self) -> float:
        """Largest standard error of a joint's torque scale, as a share of the torque."""
        prior = self._posterior.model.prior
        scales = self.log.columns.indices(names_of("scale", self.log.columns.joints))
        positions = prior.positions(np.intersect1d(scales, prior.estimated))
        return float(np.max(self._posterior.standard_errors[positions], initial=0.0))

    def share_after(self, instant: float) -> Array:
        """Return the share (K,) of the low-pass in each row that lies after an instant [s]."""
        shares = []
        for signals in self._signals:
            is_after = signals.time >= instant
            shares.append(signals.low_pass.decimate(is_after.astype(float)))
        return np.concatenate(shares)

    def derivative(self, torque: Array) -> Array:
        """Return the time derivative (K, n) [N m/s] of a torque (K, n) [N m], window by window."""
        derivative = np.empty_like(torque)
        for window in self.log.windows:
            derivative[window] = np.gradient(
                torque[window], self.log.motion.time[window], axis=0
            )
        return derivative
