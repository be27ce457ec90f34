"""The spatial dynamics regressor: derived with SymPy, evaluated with numpy on whole chunks.

One rigid body, frame at the body origin, body coordinates, twist V = [omega, v]:

    F = G V' - ad(V)^T G V,   F = [n, f] = Y6(V, V') theta

(Lynch and Park, "Modern Robotics", 2017, eq. 8.40). V' is the SPATIAL acceleration minus gravity:
its linear part is the classical acceleration minus omega x v minus g, so that gravity enters once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from robot_sysid.derived_regressor import PLACES, entries
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.records import Array, BodyMotion


def derive_regressor() -> tuple[Any, tuple[Any, ...]]:
    """Derive Y6 = dF / dtheta symbolically.

    F is linear in theta, so that column k of its Jacobian is F at theta = e_k.

    Returns:
        (Y6, symbols): the (6, 10) SymPy matrix in the order of ``spatial.PARAMETER_NAMES``, and the
        twelve symbols [omega, v, omega', v'] it depends on.
    """
    import sympy as sp

    motion = sp.symbols("wx wy wz vx vy vz awx awy awz avx avy avz")
    twist, acceleration = sp.Matrix(motion[:6]), sp.Matrix(motion[6:])
    omega, v = _hat(sp, twist[:3]), _hat(sp, twist[3:])
    # ad(V) = [[[omega]x, 0], [[v]x, [omega]x]].
    adjoint = omega.row_join(sp.zeros(3)).col_join(v.row_join(omega))
    columns = []
    for k in range(len(PARAMETER_NAMES)):
        m, hx, hy, hz, xx, xy, xz, yy, yz, zz = (int(i == k) for i in range(len(PARAMETER_NAMES)))
        # G = [[I, [h]x], [-[h]x, m 1]].
        inertia, h = sp.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), _hat(sp, (hx, hy, hz))
        spatial_inertia = inertia.row_join(h).col_join((-h).row_join(m * sp.eye(3)))
        columns.append(spatial_inertia * acceleration - adjoint.T * (spatial_inertia * twist))
    return sp.Matrix.hstack(*columns), motion


def _hat(sp: Any, vector: Sequence[Any]) -> Any:
    x, y, z = vector
    return sp.Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def derived_source() -> str:
    """Return the text of ``derived_regressor.py``: the non-zero entries of Y6 as plain Python.

    Importing SymPy takes longer than an identification; so the derivation is kept, and a test
    compares it with a fresh one.
    """
    import sympy as sp

    matrix, symbols = derive_regressor()
    places = [(i, j) for i in range(6) for j in range(10) if matrix[i, j] != 0]
    shared, values = sp.cse([matrix[i, j] for i, j in places])
    # The entries are polynomials: plain operators serve arrays too.
    lines = [f"    {name} = {sp.pycode(value)}" for name, value in shared]
    return "\n".join(
        (
            '"""Non-zero entries of the regressor, written by ``regressor.derived_source``."""\n',
            "from __future__ import annotations\n\nfrom typing import Any\n\n# fmt: off",
            f"PLACES = (\n{_filled(map(str, places), 4)}\n)",
            '"""Row and column of each."""\n\n',
            f"def entries(\n{_filled((f'{symbol}: Any' for symbol in symbols), 4)}",
            ") -> tuple[Any, ...]:",
            '    """Return their values for a twist [omega, v] and an acceleration."""',
            *lines,
            f"    return (\n{_filled(map(sp.pycode, values), 8)}\n    )\n",
        )
    )


def _filled(items: Iterable[str], indent: int) -> str:
    """Return items with commas in lines of at most 100 characters."""
    import textwrap

    text, margin = " ".join(f"{item}," for item in items), " " * indent
    return textwrap.fill(text, 100, initial_indent=margin, subsequent_indent=margin)


def wrench_regressor(velocity: Array, acceleration: Array) -> Array:
    """Return Y6 with wrench = Y6 theta.

    Args:
        velocity: (N, 6) twist [omega, v] in body coordinates [rad/s, m/s].
        acceleration: (N, 6) spatial acceleration minus gravity [rad/s^2, m/s^2].

    Returns:
        (6, 10, N) regressor of the wrench [n, f] at the body origin in body coordinates.
    """
    regressor = np.zeros((6, len(PARAMETER_NAMES), len(velocity)))
    values = entries(*np.ascontiguousarray(velocity.T), *np.ascontiguousarray(acceleration.T))
    for (i, j), value in zip(PLACES, values):
        regressor[i, j] = value
    return regressor


def joint_regressor(motion: BodyMotion, joints: Sequence[int]) -> Array:
    """Return the joint torque regressor J^T Y6 of the terminal link.

    Args:
        motion: body motion of N samples.
        joints: which chain joints to make rows for.

    Returns:
        (len(joints), N, 10): one block of rows per joint, tau = rows theta [N m].
    """
    wrench = wrench_regressor(motion.velocity, motion.acceleration)
    jacobian = np.ascontiguousarray(motion.jacobian.transpose(2, 1, 0))
    rows = np.empty((len(joints), len(motion.velocity), len(PARAMETER_NAMES)))
    for row, joint in zip(rows, joints):
        row[...] = np.einsum("ik,ijk->jk", jacobian[joint], wrench).T
    return rows


def joint_torque(motion: BodyMotion, theta: Array) -> Array:
    """Return tau_rest + Y theta (N, n) [N m], without friction, for a terminal link theta (10,)."""
    return motion.tau_rest + (joint_regressor(motion, range(motion.tau_rest.shape[1])) @ theta).T
