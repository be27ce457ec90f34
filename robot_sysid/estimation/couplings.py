"""Motors that turn with several joints: friction and rotor inertia of a combined speed.

A motor that turns at s = sum_j r_j qd_j (joint units) puts its torque tau_m on each of these joints
in the same ratio: tau_j = r_j tau_m, because power is the same on both sides. Its own friction and
rotor inertia follow s, not the joints' own speeds. A wrist whose last motor sits in the forearm is
the usual case: r = 1 on the last two joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import Coupling
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.json_files import read_json
from robot_sysid.records import Array, RobotModel


def coupling(robot: RobotModel, ratios: Array) -> Coupling:
    """Return the coupling with these ratios (n,)."""
    text = ""
    for joint, ratio in zip(robot.joint_names, ratios):
        if ratio != 0.0:
            size = "" if abs(ratio) == 1.0 else f"{abs(ratio):g}*"
            sign = "-" if ratio < 0.0 else "+" if text else ""
            text += f"{sign}{size}{joint}"
    return Coupling(np.asarray(ratios, dtype=float), text)


def neighbours(robot: RobotModel) -> Iterator[Coupling]:
    """Yield what a wrist may look like: each joint with the next one, either way round."""
    for joint in range(robot.n_joints - 1):
        for sign in (1.0, -1.0):
            ratios = np.zeros(robot.n_joints)
            ratios[joint], ratios[joint + 1] = 1.0, sign
            yield coupling(robot, ratios)


def couplings_of(
    robot: RobotModel, options: EstimationOptions
) -> tuple[tuple[Coupling, ...], tuple[Coupling, ...]]:
    """Return (the couplings that have columns, those of them that recordings decide for).

    Raises:
        InputError: the file that states them cannot be read, or does not fit the arm.
    """
    if options.coupling is not None:
        return read_couplings(options.coupling, robot), ()
    offered = tuple(neighbours(robot)) if options.torques == "chain" else ()
    return offered, offered


def read_couplings(path: Path, robot: RobotModel) -> tuple[Coupling, ...]:
    """Return the couplings that a file states.

    The file is JSON: ``{"motor": {"joint": ratio, ...}, ...}``, or a matrix with a row per motor
    and a column per joint of the chain. Ratios are motor speed, seen through its own gear, per
    joint speed. A motor that turns with one joint alone couples nothing and is left out.

    Raises:
        InputError: the file cannot be read, or does not fit the arm.
    """
    names = robot.joint_names
    content = read_json(path, '--coupling takes JSON such as {"motor": {"joint": 1.0}}')
    if isinstance(content, dict):
        rows = {f"motor {name!r}": given for name, given in content.items()}
    elif isinstance(content, list):
        rows = {f"row {place + 1}": given for place, given in enumerate(content)}
    else:
        rows = {"": content}
    found = []
    for where, row in rows.items():
        given: Any = row
        if isinstance(given, list) and len(given) == robot.n_joints:
            given = dict(zip(names, given))
        if not isinstance(given, dict) or not all(map(_is_number, given.values())):
            raise InputError(
                f'--coupling {path}: {where} must be like {{"{names[-1]}": 1.0}}, or in a matrix '
                f"{robot.n_joints} finite numbers in each row, one per joint of the chain"
            )
        unknown = [joint for joint in given if joint not in names]
        if unknown:
            raise InputError(
                f"--coupling {path}: {where} turns with {unknown[0]!r}, which is no joint of the "
                f"arm: {', '.join(names)}"
            )
        found.append(np.array([float(given.get(joint, 0.0)) for joint in names]))
    return tuple(coupling(robot, row) for row in found if np.count_nonzero(row) > 1)


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_real and bool(np.isfinite(value))
