"""The joint estimate of arm, friction and payload from all recordings, round by round.

Each round linearises around the last one (load-dependent friction, torque scales, drift), weighs
the joints by their noise, and widens each prior to what the data asks for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.estimation.information import combined
from robot_sysid.estimation.least_squares import (
    WeightedEquations,
    joint_noise,
    least_squares,
    noise_floor,
    weighted,
)
from robot_sysid.estimation.nuisances import NuisanceGroup, widened_groups, with_prior
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, PayloadEquations, Recording
from robot_sysid.identify.payload.nuisances import (
    held_at,
    no_common_scale,
    nuisance_groups,
    weight_group,
)
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.identify.traces import traced
from robot_sysid.records import Array, RobotModel, SquareRootInformation
from robot_sysid.records.traces import Traces

LARGEST_LOSS = 0.3
"""Share of its load that a gear loses at most."""
_MOST_ROUNDS, _SETTLED = 8, 1e-4
_MOST_BOUNDS = 3
_AT_FLOOR, _SHARPEST, _SHARPER = 1.01, 0.01, 2


@dataclass(frozen=True)
class Task:
    """What is to be estimated, and how.

    Attributes:
        robot: the arm as its model describes it.
        friction: friction terms of every joint.
        drifts: whether a drift of friction over the recordings is sought.
        options: how far nuisances may be off.
        known_mass: mass of the payload [kg], where it is known.
        scale_prior: how far torque scales may be off then [%].
    """

    robot: RobotModel
    friction: FrictionModel
    drifts: bool
    options: EstimationOptions
    known_mass: float | None = None
    scale_prior: float | None = None


@dataclass(frozen=True)
class JointFit:
    """All parameters of arm and payload.

    Attributes:
        equations: what the parameters are.
        values: (p,) the estimate.
        samples: per recording, its equations around the estimate.
        widened: the nuisances' priors, as wide as the data asks for.
        fixed: what is held.
        weighted: the whitened information, priors included.
    """

    equations: PayloadEquations
    values: Array
    samples: tuple[DecimatedSamples, ...]
    widened: tuple[NuisanceGroup, ...]
    fixed: tuple[NuisanceGroup, ...]
    weighted: WeightedEquations

    @property
    def groups(self) -> tuple[NuisanceGroup, ...]:
        """All that was known before the data."""
        return (*self.widened, *self.fixed)

    @property
    def payload(self) -> Array:
        """The payload (10,) in the terminal body's frame."""
        return self.values[self.equations.places(PAYLOAD_NAMES)]

    def traces(self, robot: RobotModel, recordings: Sequence[Recording]) -> Traces:
        """Return what was measured and what the fit predicts, with and without the payload."""
        after = dict(zip(self.equations.names, self.values.tolist()))
        without = {name: v for name, v in after.items() if name not in PAYLOAD_NAMES}
        motions = [each.source.motion for each in recordings]
        return traced(robot, self.samples, motions, after, without)


def fit_jointly(task: Task, recordings: Sequence[Recording]) -> JointFit:
    """Estimate arm, friction and payload together."""
    equations = PayloadEquations(task.robot, task.friction, task.drifts)
    groups = nuisance_groups(task.robot, equations, task.options, task.scale_prior)
    held = no_common_scale(equations)
    if task.known_mass is not None:
        held = weight_group(task.known_mass)
    values = equations.prior
    for _ in range(_MOST_ROUNDS):
        samples = tuple(equations.samples(recording, values) for recording in recordings)
        information = combined([part.information() for part in samples])
        fit = _solved(equations, samples, information, groups, (held,))
        before, values = values, fit.values
        places = equations.places(PAYLOAD_NAMES)
        moved = float(np.max(np.abs(values - before)[places]))
        if moved <= _SETTLED * float(np.max(np.abs(values[places]))):
            break
    return fit


def _solved(
    equations: PayloadEquations,
    samples: tuple[DecimatedSamples, ...],
    information: SquareRootInformation,
    groups: tuple[NuisanceGroup, ...],
    fixed: tuple[NuisanceGroup, ...],
) -> JointFit:
    """Solve the equations as they stand, with what gears lose kept within bounds."""
    prior = equations.prior
    noise = weighted(with_prior(information, (*groups, *fixed)), prior).noise
    wide = widened_groups(information, noise, groups)
    for _ in range(_MOST_BOUNDS):
        known = with_prior(information, (*wide, *fixed))
        crossed = _crossed(equations, least_squares(known, prior, 1.0 / noise))
        if crossed is None:
            break
        fixed = (*fixed, crossed)
    found = _sharpened(weighted(with_prior(information, (*wide, *fixed)), prior), prior)
    values = least_squares(found.information, prior, 1.0 / found.noise)
    return JointFit(equations, values, samples, wide, fixed, found)


def _sharpened(found: WeightedEquations, prior: Array) -> WeightedEquations:
    """Return the equations with less noise where there is hardly any.

    Beside priors no noise is taken to be smaller than a floor. Of exact data the priors would then
    pull on the payload more than they need to.
    """
    bare, floor = replace(found.information, prior=None), noise_floor(found.information)
    noise = found.noise
    for _ in range(_SHARPER):
        values = least_squares(found.information, prior, 1.0 / noise)
        least = np.maximum(joint_noise(bare, values, 1.0 / noise), _SHARPEST * floor)
        noise = np.where(found.noise <= _AT_FLOOR * floor, least, found.noise)
    return replace(found, noise=noise)


def _crossed(equations: PayloadEquations, values: Array) -> NuisanceGroup | None:
    """Return what keeps load-dependent friction within its bounds, or None where it is."""
    names = equations.load_names
    found = values[equations.places(names)]
    bounded = np.clip(found, 0.0, LARGEST_LOSS)
    wrong = np.abs(found - bounded) > 1e-6
    if not np.any(wrong):
        return None
    return held_at(tuple(np.array(names)[wrong].tolist()), bounded[wrong])
