"""The result of a self-test: a model identified from its own simulation, without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.records import Array, DataOrigin, FitQuality, Motion, RobotModel
from robot_sysid.records.messages import says
from robot_sysid.records.parameters import Parameter
from robot_sysid.records.quantities import (
    BodyEstimate,
    Quantity,
    body_quantities,
    without_rounding,
)
from robot_sysid.results.record import Identification
from robot_sysid.results.verdicts import Rule, Verdict, condition_alone, judge

WELL_KNOWN_MASS = 0.5
"""Largest standard error of the mass of a self-test, over the mass."""
SMALL_MASS = 1e-6
"""Standard error of a mass that is small enough whatever the mass is [kg]."""


@dataclass(frozen=True)
class SelfTestEvidence:
    """What verdicts on the identification of a model from its own simulation follow from.

    Attributes:
        mass: of the terminal link [kg].
        mass_error: its standard error [kg].
        quality: what the equations determine.
    """

    mass: float
    mass_error: float
    quality: FitQuality

    @property
    def is_weak(self) -> bool:
        """Whether the mass hardly shows."""
        largest = max(SMALL_MASS, WELL_KNOWN_MASS * self.mass)
        return bool(largest < self.mass_error < np.inf)

    @property
    def is_whole(self) -> bool:
        """Whether all parameters show."""
        return not self.quality.unidentifiable


OF_SELF_TEST: tuple[Rule[SelfTestEvidence], ...] = (
    Rule(Verdict.TOO_WEAK, lambda e: condition_alone(e.is_weak)),
    Rule(
        Verdict.PARTLY_FROM_MODEL,
        lambda e: condition_alone(not e.is_weak and not e.is_whole),
    ),
    Rule(Verdict.OK, lambda e: condition_alone(not e.is_weak and e.is_whole)),
)
"""Rules on a self-test."""


def self_test_result(
    robot: RobotModel,
    parameters: Sequence[Parameter],
    prior: Array,
    values: Array,
    mass_error: float,
    quality: FitQuality,
    data: DataOrigin,
    checkpoints: Motion,
    torques: str,
) -> Identification:
    """Return the result for a model's terminal link from its own simulation.

    Args:
        robot: the arm.
        parameters: the p estimated ones, those of the terminal link first.
        prior: (p,) their values in the model.
        values: (p,) the identified ones.
        mass_error: standard error of the link's mass [kg].
        quality: what the equations determine.
        data: where the simulated data comes from.
        checkpoints: motion on which a written model is compared.
        torques: "chain" or "terminal": the joints whose torques were fitted.
    """
    body = BodyEstimate(values[:10], robot.body_name, prior=robot.prior)
    rows = [*body_quantities(body)]
    friction = []
    for parameter, model, identified in zip(parameters, prior, values):
        if parameter.of:
            value = float(without_rounding(identified, 1.0))
            friction.append(parameter.name)
            # Without noise, the error is one of rounding: none is stated.
            about = parameter.name, parameter.of, parameter.unit
            rows.append(Quantity(*about, float(model), value, None))
    thetas = robot.thetas
    thetas[-1] = body.theta
    verdicts = judge(OF_SELF_TEST, SelfTestEvidence(body.mass, mass_error, quality))
    return Identification(
        robot=robot,
        quality=quality,
        quantities=tuple(rows),
        remarks=(*verdicts, *says(robot.notes)),
        total=body,
        thetas=thetas,
        torques=torques,
        data=data,
        friction_model="-".join(friction) or "none",
        checkpoints=checkpoints,
    )
