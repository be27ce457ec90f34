"""Check the regressor against MuJoCo: known part + Y theta must be MuJoCo's inverse dynamics.

The arm moves at random, far wilder than any real trajectory, with the terminal link of the model
and with links made up at random. Exit code 0 when everything agrees, 1 when not.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimate.rows import Rows
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, Recording, RobotModel
from robot_sysid.solver import LastLinkTerms, exact_recording

Array = NDArray[np.float64]

MODELS = Path(__file__).resolve().parent / "model"
TOLERANCE = 1e-9
SAMPLES = 500
RANDOM_LINKS = 3


def main() -> int:
    """Print the comparison of both models, a line per terminal link; return the exit code."""
    rng = np.random.default_rng(0)
    print(
        f"{SAMPLES} random states each; torques in N m, error relative to the largest torque"
    )
    print(
        f"{'model':<32}{'terminal link':<16}{'largest torque':>16}{'largest error':>16}"
    )
    worst = 0.0
    for file in ("kinova_fullinertia_guess.xml", "kinova_fullinertia.xml"):
        robot = load_robot_model(MODELS / file)
        for name, theta in terminal_links(robot, rng):
            expected, computed = both_torques(
                robot, theta, random_motion(robot.n_joints, rng)
            )
            scale = float(np.max(np.abs(expected)))
            error = float(np.max(np.abs(computed - expected))) / scale
            worst = max(worst, error)
            print(f"{file:<32}{name:<16}{scale:>16.3f}{error:>16.1e}")
    verdict = "agrees" if worst < TOLERANCE else "DOES NOT AGREE"
    print(f"regressor {verdict} with MuJoCo: {worst:.1e} (allowed {TOLERANCE:.0e})")
    return 0 if worst < TOLERANCE else 1


def terminal_links(
    robot: RobotModel, rng: np.random.Generator
) -> Iterator[tuple[str, Array]]:
    """Yield (name, theta (10,)): the model's own link, then random ones that can exist."""
    yield "of the model", robot.prior.theta
    for number in range(1, RANDOM_LINKS + 1):
        root = rng.normal(size=(4, 4)) * np.array([[0.1], [0.1], [0.1], [1.0]])
        yield f"random {number}", spatial.theta_from_pseudo_inertia(root @ root.T)


def random_motion(joints: int, rng: np.random.Generator) -> Motion:
    """Return unrelated random positions, speeds and accelerations."""
    q, qd, qdd = (
        scale * rng.normal(size=(SAMPLES, joints)) for scale in (2.0, 3.0, 10.0)
    )
    return Motion(np.arange(SAMPLES, dtype=float), q, qd, qdd)


def both_torques(
    robot: RobotModel, theta: Array, motion: Motion
) -> tuple[Array, Array]:
    """Return torques (N, n) without friction: MuJoCo's, and known part + Y theta."""
    arm = LastLinkTerms(robot, friction=())
    still = np.zeros_like(motion.q)
    measured = Recording(motion.time, motion.q, motion.qd, still, motion.qdd)
    rows, _ = arm.equations(Rows(exact_recording(measured), slice(None)), arm.start())
    # Of a torque of zero, the right-hand side is minus the torque that is known, with friction.
    known = -rows[:, :, -1] - robot.friction.torque(motion.qd)
    ours = rows[:, :, :-1] @ theta + known
    carrying = replace(robot, mj_model=with_link(robot, theta))
    return ArmDynamics(carrying).torque(motion.q, motion.qd, motion.qdd), ours


def with_link(robot: RobotModel, theta: Array) -> Any:
    """Return a copy of the compiled model whose terminal body has the parameters theta (10,)."""
    mass, com, inertia = spatial.com_from_theta(theta)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)
    model = copy.copy(robot.mj_model)
    body = robot.body_id
    model.body_mass[body] = mass
    model.body_ipos[body] = com
    model.body_inertia[body] = moments
    mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    return model


if __name__ == "__main__":
    sys.exit(main())
