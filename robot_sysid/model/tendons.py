"""Motors of a model that turn several joints: fixed tendons over them.

MuJoCo lets such a tendon have rotor inertia (``armature``), ``damping`` and dry friction
(``frictionloss``), which follow its speed sum_j coef_j qd_j and act on each joint times coef_j.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid.records import Array, JointFriction

CAN_HOLD_ROTORS = hasattr(mujoco.MjModel, "tendon_armature")
"""Whether tendons have rotor inertia: since MuJoCo 3.2.7."""


def shared_motors(mj_model: Any, dofs: NDArray[np.int64]) -> dict[int, Array]:
    """Return tendon id to its speed per joint speed (n,), of each fixed tendon over two or more
    joints of a chain with these addresses (n,) in qvel, and over no other joint.
    """
    ratios = {}
    for tendon in range(mj_model.ntendon):
        first = int(mj_model.tendon_adr[tendon])
        wraps = slice(first, first + int(mj_model.tendon_num[tendon]))
        coefficients = np.zeros(mj_model.nv)
        if np.all(mj_model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)):
            joints = mj_model.wrap_objid[wraps]
            np.add.at(
                coefficients, mj_model.jnt_dofadr[joints], mj_model.wrap_prm[wraps]
            )
        of_chain = coefficients[dofs]
        if np.count_nonzero(of_chain) == np.count_nonzero(coefficients) > 1:
            ratios[tendon] = of_chain
    return ratios


def joint_friction(mj_model: Any, dofs: NDArray[np.int64]) -> JointFriction:
    """Return the friction of a chain whose joints have these addresses (n,) in qvel."""
    motors = shared_motors(mj_model, dofs)
    shared = [
        float(mj_model.tendon_frictionloss[k]) * ratios for k, ratios in motors.items()
    ]
    return JointFriction(
        mj_model.dof_frictionloss[dofs],
        mj_model.dof_damping[dofs],
        np.array([torque for torque in shared if np.any(torque)]).reshape(
            -1, len(dofs)
        ),
    )
