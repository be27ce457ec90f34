"""Inertias exactly as a URDF states them.

MuJoCo before 3.14 finds the principal axes of a full inertia matrix to about six digits. A URDF
cannot state them any other way, so the compiled values are replaced by accurate ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from robot_sysid import spatial
from robot_sysid.records import Array

_SAME_TRACE = 1e-9
_ALREADY_EXACT = 1e-13


def restore_exact_inertias(
    mj_model: Any, inertias: Mapping[str, tuple[float, Array, Array]]
) -> None:
    """Give compiled bodies the inertia their links state, where MuJoCo's differs by inaccuracy.

    Values that a compiler setting changed on purpose are left alone.

    Args:
        mj_model: compiled URDF; changed in place.
        inertias: link name to (mass, centre of mass (3,), inertia about it (3, 3)).
    """
    changed = False
    for name, (_, _, inertia) in inertias.items():
        body = mujoco.mj_name2id(mj_model, int(mujoco.mjtObj.mjOBJ_BODY), name)
        if body > 0 and _is_inaccurate(mj_model, body, inertia):
            moments, axes = np.linalg.eigh(inertia)
            if np.linalg.det(axes) < 0.0:
                axes = -axes
            mj_model.body_inertia[body] = moments
            mj_model.body_iquat[body] = spatial.quaternion_from_rotation(axes)
            changed = True
    if changed:
        mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))


def _is_inaccurate(mj_model: Any, body: int, inertia: Array) -> bool:
    rotation = spatial.rotation_from_quaternion(mj_model.body_iquat[body])
    compiled = rotation @ np.diag(mj_model.body_inertia[body]) @ rotation.T
    size = float(np.trace(inertia))
    moments = np.linalg.eigvalsh(inertia)
    # Equal traces but another matrix: turned. balanceinertia keeps the trace too, and only
    # touches what breaks the triangle inequality.
    turned = abs(float(np.trace(compiled)) - size) <= _SAME_TRACE * size
    balanced = moments[0] + moments[1] < moments[2]
    return bool(
        turned and not balanced and np.max(np.abs(compiled - inertia)) > _ALREADY_EXACT * size
    )
