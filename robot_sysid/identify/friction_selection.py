"""Choosing the friction terms of all joints by how well they predict what was not fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import Equations, friction_per_joint
from robot_sysid.dynamics.friction import PRESETS, TERMS, FrictionModel, friction_model
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.cross_validation import ModelChoice, blocks, choose_model
from robot_sysid.estimation.information import joint_rmse, restricted
from robot_sysid.estimation.least_squares import least_squares
from robot_sysid.identify.samples import DecimatedSamples, decimated_equations, joined
from robot_sysid.records import Array, RobotModel, SquareRootInformation
from robot_sysid.signals.process import ProcessedSignals

BLOCKS = 5
"""Into how many stretches of time a log is cut for cross-validation."""


def choose_friction(
    robot: RobotModel, torques: str, signals: Sequence[ProcessedSignals], fitted: NDArray[np.bool_]
) -> tuple[FrictionModel, ModelChoice]:
    """Return the friction model that predicts held-out stretches of the log best.

    One pass over the data with the columns of all terms serves all candidates.

    Args:
        robot: the arm.
        torques: "chain" or "terminal".
        signals: the processed logs.
        fitted: (K,) which decimated rows may be used.
    """
    everything = FrictionModel(tuple(TERMS))
    equations = Equations(robot, torques, friction_per_joint(robot, torques, everything))
    samples = joined([decimated_equations(equations, log) for log in signals])
    parts = _informations(samples.deviation(equations.prior), fitted)
    candidates = {
        name: [restricted(part, _names(equations, friction_model(name))) for part in parts]
        for name in PRESETS
    }
    choice = choose_model(candidates, _solve)
    return friction_model(choice.name), choice


def _informations(
    samples: DecimatedSamples, fitted: NDArray[np.bool_]
) -> list[SquareRootInformation]:
    rows = np.flatnonzero(fitted)
    parts = []
    for block in blocks(len(rows), BLOCKS):
        used = np.zeros(len(samples), dtype=bool)
        used[rows[block]] = True
        parts.append(samples.where(used).information())
    return parts


def _names(equations: Equations, model: FrictionModel) -> Sequence[str]:
    own = [name for joint in equations.joints for name in model.parameter_names(joint)]
    return [*PARAMETER_NAMES, *(name for name in own if name in equations.names)]


def _solve(information: SquareRootInformation) -> Array:
    """Return least squares with each joint weighed by its own noise."""
    nothing = np.zeros(len(information.names))
    values = least_squares(information, nothing)
    noise = joint_rmse(information, values)
    floor = 1e-9 * float(np.max(noise, initial=0.0)) or 1.0
    return least_squares(information, nothing, 1.0 / np.maximum(noise, floor))
