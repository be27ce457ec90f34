"""A judge of model files that is MuJoCo alone: their torque errors on logs and on true motions.

It shares no code with what estimates, not even the filter, so that a mistake there is not forgiven
here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[np.floating[Any]]
WRITTEN = ("updated_model_curved.xml", "updated_model.xml", "updated_model.urdf")
"""Model files that ``identify`` writes, the one it recommends first."""
STILL = 0.05
"""Speed, over the highest of a joint, below which its dry friction may be of either sign."""
NO_CONTROL = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
NO_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)


def written_model(folder: Path) -> Path | None:
    """Return the model file that ``identify`` recommends in a folder; None where it wrote none."""
    paths = (folder / name for name in WRITTEN)
    return next((path for path in paths if path.exists()), None)


class FileTorque:
    """Torques of a model file by ``mj_inverse``.

    Args:
        path: of the model.
        joint_names: (n,) those of the torques; () for the model's first joints.
        n_joints: their number, where no names are given.
    """

    def __init__(
        self, path: Path, joint_names: Sequence[str] = (), n_joints: int = 0
    ) -> None:
        model = mujoco.MjModel.from_xml_path(str(path))
        model.opt.disableflags |= NO_CONSTRAINT | NO_CONTROL
        joints = range(n_joints)
        ids = [model.joint(name).id for name in joint_names] or [*joints]
        self._model = model
        self._home = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
        self._qpos = model.jnt_qposadr[ids]
        self._dofs = model.jnt_dofadr[ids]

    def __call__(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque (N, n) of a motion [N m]."""
        data = mujoco.MjData(self._model)
        data.qpos[:] = self._home
        torque = np.empty_like(q)
        for row, (position, speed, acceleration) in enumerate(zip(q, qd, qdd)):
            data.qpos[self._qpos] = position
            data.qvel[self._dofs] = speed
            data.qacc[self._dofs] = acceleration
            mujoco.mj_inverse(self._model, data)
            torque[row] = data.qfrc_inverse[self._dofs]
        # Dry friction is a constraint of MuJoCo's, which would need a friction cone to be solved.
        torque += self._model.dof_frictionloss[self._dofs] * np.sign(qd)
        for coefficients, friction in self._friction_of_tendons():
            direction = np.sign(qd @ coefficients)
            torque += friction * direction[:, None] * coefficients
        return np.where(np.isfinite(torque), torque, 0.0)

    def _friction_of_tendons(self) -> Iterator[tuple[Array, float]]:
        """Yield coefficients (n,) and dry friction of fixed tendons: motors that turn with several
        joints."""
        model = self._model
        for tendon in range(model.ntendon):
            start = model.tendon_adr[tendon]
            wraps = range(start, start + model.tendon_num[tendon])
            kinds = {int(model.wrap_type[wrap]) for wrap in wraps}
            friction = float(model.tendon_frictionloss[tendon])
            if friction > 0.0 and kinds == {int(mujoco.mjtWrap.mjWRAP_JOINT)}:
                coefficients = np.zeros(model.nv)
                for wrap in wraps:
                    dof = model.jnt_dofadr[model.wrap_objid[wrap]]
                    coefficients[dof] += model.wrap_prm[wrap]
                yield coefficients[self._dofs], friction


def share_of_error(measured: Array, predicted: Array) -> float:
    """Return the torque error of all joints over their torque, each joint's mean error taken out.

    Rows of a joint that are NaN in ``measured`` (N, n) do not count.
    """
    off = measured - predicted
    off -= np.nanmean(off, axis=0)
    return float(np.sqrt(np.nansum(off**2) / np.nansum(measured**2)))


def error_on_log(
    path: Path, time: Array, q: Array, tau: Array, cut: float
) -> float | None:
    """Return the torque error of a model file on a log, see ``share_of_error``.

    Positions and torques are low-passed both ways; left out are the ends of the log, and where a
    joint turns round under the filter. None where nothing is left.

    Args:
        path: of the model, whose first joints the log has.
        time: (N,) [s].
        q: (N, n) positions [rad].
        tau: (N, n) torques [N m].
        cut: frequency of the low-pass [Hz].
    """
    step = float(np.median(np.diff(time)))
    edge = int(2.0 / cut / step)
    if len(time) <= 3 * edge or 2.0 * cut * step >= 1.0:
        return None
    sections = signal.butter(4, cut, fs=1.0 / step, output="sos")
    smooth = signal.sosfiltfilt(sections, q, axis=0)
    qd = np.gradient(smooth, step, axis=0)
    qdd = np.gradient(qd, step, axis=0)
    measured = signal.sosfiltfilt(sections, tau, axis=0)
    predicted = FileTorque(path, (), q.shape[1])(smooth, qd, qdd)
    peak = np.max(np.abs(qd[edge:-edge]), axis=0)
    reach = int(0.5 / cut / step)
    for joint in range(q.shape[1]):
        is_slow = np.abs(qd[:, joint]) <= STILL * peak[joint]
        near_turns = np.convolve(is_slow, np.ones(2 * reach + 1), "same") > 0.5
        measured[near_turns, joint] = np.nan
    measured[:edge] = np.nan
    measured[-edge:] = np.nan
    is_moving = np.isfinite(measured).any(axis=0)
    if not is_moving.any():
        return None
    return share_of_error(measured[:, is_moving], predicted[:, is_moving])
