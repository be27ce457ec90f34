"""From a fit of every link to a result: errors, base parameters, status."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import speed_name
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.estimation.arm.base_parameters import (
    BaseCombinations,
    base_combinations,
    essential,
)
from robot_sysid.estimation.arm.errors import correlation_stretch, covariance, link_precision
from robot_sysid.estimation.information import restricted
from robot_sysid.identify.arm.fit import ArmFit
from robot_sysid.records import Array, RobotModel, Validation
from robot_sysid.records.figures import percent
from robot_sysid.records.whole_arm import ArmEstimate, ArmStatus, BaseParameters

LARGEST_RATIO = 20.0
"""By how much a link's mass may differ from the model's."""
FARTHEST = 1.5
"""How many times the link's size its centre of mass may move, or its radius of gyration be."""
LARGEST_ERROR = 0.5
"""Relative error of held-out torque above which nothing is written."""
WORSE = 1.1
"""How much larger than the model's own that error may be."""
_RANDOM_POSES, _LEAST_SIZE, _UNIT_LENGTH = 60, 0.02, 0.3
_EASY_GAMMA = 1e9


def estimate_of(robot: RobotModel, fit: ArmFit) -> ArmEstimate:
    """Return all parameters with their errors."""
    kept = fit.kept
    information = fit.fits.whole
    names = np.array(information.names)[kept]
    residuals = _residuals(fit)
    precision = link_precision(fit.fits.problem, fit.gamma, fit.fits.prior)
    stretch = correlation_stretch(residuals)
    whole = np.zeros((len(fit.values), len(fit.values)))
    fewer = restricted(information, names.tolist())
    own = precision[np.ix_(kept, kept)]
    pull = fit.fits.noise**-2.0 @ fit.columns.filtering_pull(fit.samples, fit.values)
    whole[np.ix_(kept, kept)] = covariance(fewer, fit.fits.noise, stretch, own, pull[kept])
    errors = np.sqrt(np.maximum(np.diag(whole), 0.0))
    known = np.diag(np.linalg.pinv(precision, hermitian=True))
    share = np.where(known > 0.0, 1.0 - np.diag(whole) / np.where(known > 0.0, known, 1.0), 1.0)
    joints = information.joints
    return ArmEstimate(
        names=tuple(names.tolist()),
        values=_with_speeds(fit)[kept],
        standard_errors=errors[kept],
        data_share=np.clip(share[kept], 0.0, 1.0),
        thetas=fit.columns.thetas(fit.values),
        theta_errors=fit.columns.thetas(errors),
        friction=fit.friction,
        couplings=tuple(each.name for each in fit.couplings),
        gamma=fit.gamma,
        noise_per_joint={j.joint: float(v) for j, v in zip(joints, fit.fits.noise)},
        base=_base(robot, fit, whole),
        two_way=dict(_two_way(fit, whole)),
    )


def _two_way(fit: ArmFit, cov: Array) -> Iterator[tuple[str, tuple[tuple[float, float], ...]]]:
    """Yield each joint's Coulomb friction forward and backward with their standard errors."""
    place = {fit.columns.names[index]: index for index in fit.kept}
    for joint in fit.samples[0].joints:
        level = place.get(f"coulomb[{joint}]", place.get(f"sigmoid[{joint}]"))
        offset = place.get(f"offset[{joint}]")
        if level is None or offset is None:
            continue
        both = []
        for sign in (1.0, -1.0):
            variance = cov[level, level] + cov[offset, offset] + 2.0 * sign * cov[level, offset]
            value = fit.values[level] + sign * fit.values[offset]
            both.append((float(value), float(np.sqrt(max(variance, 0.0)))))
        yield joint, tuple(both)


def _with_speeds(fit: ArmFit) -> Array:
    """Return the values (p,) with speeds in place of their last changes."""
    values = fit.values.copy()
    joints = fit.samples[0].joints
    for term, speeds in fit.bends.speed.items():
        places = [fit.columns.names.index(speed_name(term, joint)) for joint in joints]
        values[places] = speeds
    return values


def _residuals(fit: ArmFit) -> list[Array]:
    """Return per joint the residuals of all logs, one after the other."""
    joints = []
    for index in range(len(fit.samples[0].joints)):
        parts = [
            log.tau[index] - log.rows[index] @ fit.values[log.columns[index]] for log in fit.samples
        ]
        joints.append(np.concatenate(parts))
    return joints


def _base(robot: RobotModel, fit: ArmFit, cov: Array) -> BaseParameters:
    """Return the base parameters that the data shows."""
    links = np.concatenate([place for _, place in fit.columns.links()])
    order = np.sort(links)
    matrix, right = fit.fits.whole.stacked(1.0 / fit.fits.noise)
    found = base_combinations(matrix[:, order], parameter_scale(len(order) // 10))
    base, rest = matrix[:, order[found.leading]], np.setdiff1d(fit.kept, order)
    names = [fit.columns.names[index] for index in order]
    spread = found.matrix @ cov[np.ix_(order, order)] @ found.matrix.T
    return BaseParameters(
        combinations=found.names(names),
        values=found.matrix @ fit.values[order],
        standard_errors=np.sqrt(np.maximum(np.diag(spread), 0.0)),
        structural_rank=structural_base(robot).rank,
        essential=tuple(essential(base, matrix[:, rest], right).tolist()),
    )


def parameter_scale(links: int) -> Array:
    """Return (10 links,) typical sizes of the parameters of links of 1 kg and 0.3 m."""
    return np.tile(spatial.parameter_scale(1.0, _UNIT_LENGTH), links)


def structural_base(robot: RobotModel, seed: int = 0) -> BaseCombinations:
    """Return the base parameters that any motion can show, from random motions.

    Columns are the links with mass, base to terminal, ten each.
    """
    rng = np.random.default_rng(seed)
    shape = (_RANDOM_POSES, robot.n_joints)
    q = robot.reference + rng.uniform(-np.pi, np.pi, shape)
    moves = LinkDynamics(robot).motion(q, rng.normal(0.0, 3.0, shape), rng.normal(0.0, 3.0, shape))
    links = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = moves.columns(links)
    return base_combinations(columns.reshape(-1, columns.shape[-1]), parameter_scale(len(links)))


def judge(
    robot: RobotModel, estimate: ArmEstimate, held_out: Validation, model_error: float
) -> tuple[ArmStatus, tuple[str, ...]]:
    """Return (how it ended, what is wrong, one phrase each)."""
    strange = tuple(_strange_links(robot, estimate.thetas))
    if strange:
        return ArmStatus.IMPLAUSIBLE, strange
    error = held_out.relative_error
    limit = min(LARGEST_ERROR, WORSE * model_error + 1e-9)
    if error is None or error > limit:
        said = "torque is zero" if error is None else f"error {percent(error)}"
        phrase = f"held-out {said}, the model's own {percent(model_error)}"
        return ArmStatus.UNPREDICTED, (phrase,)
    return ArmStatus.OK, ()


def _strange_links(robot: RobotModel, thetas: Array) -> Iterator[str]:
    """Yield what no link of this arm can be like."""
    for index, (link, theta) in enumerate(zip(robot.links, thetas)):
        if link.has_mass:
            yield from _strangeness(
                link.body_name, link.theta, theta, FARTHEST * _size(robot, index)
            )


def _strangeness(name: str, before: Array, theta: Array, farthest: float) -> Iterator[str]:
    if not spatial.is_consistent(theta):
        yield f"{name} is no possible rigid body"
        return
    mass, com, inertia = spatial.com_from_theta(theta)
    model_mass, centre, _ = spatial.com_from_theta(before)
    moved = float(np.linalg.norm(com - centre))
    radius = float(np.sqrt(0.5 * np.trace(inertia) / mass))
    if not 1.0 / LARGEST_RATIO <= mass / model_mass <= LARGEST_RATIO:
        yield f"{name} would weigh {mass:.3g} kg (model: {model_mass:.3g})"
    elif moved > farthest:
        yield f"the centre of mass of {name} would be {moved:.2g} m from the model's"
    elif radius > farthest:
        yield f"{name} would have a radius of gyration of {radius:.2g} m"


def _size(robot: RobotModel, index: int) -> float:
    """Return a link's size [m]: as its mass is spread, or to the next joint."""
    theta = robot.links[index].theta
    own = np.sqrt(3.0) * spatial.characteristic_length(theta)
    after = robot.links[index + 1 : index + 2]
    reach = max((float(np.linalg.norm(link.translation)) for link in after), default=0.0)
    return max(float(own), reach, _LEAST_SIZE)


def model_error(fit: ArmFit) -> float:
    """Return the relative held-out error of the model's own links, friction fitted to them."""
    squared = fit.fits.held_out(fit.kept, (_EASY_GAMMA,))[0]
    total = sum(float(np.sum(log.squared_torque())) for log in fit.samples)
    return float(np.sqrt(np.sum(squared) / total)) if total > 0.0 else float("inf")


def off_notes(estimate: ArmEstimate, joints: Sequence[str]) -> Iterator[str]:
    """Yield a sentence on zeros and tilt that the data asks for."""
    for name, value, error in zip(estimate.names, estimate.values, estimate.standard_errors):
        if name.startswith("zero[") and abs(value) > max(3.0 * error, 1e-3):
            yield (
                f"the log reads {name[5:-1]} {1e3 * value:.1f} ± {1e3 * error:.1g} mrad too large; "
                "the links are those of the true positions"
            )
    tilt = np.array([estimate.value(n) or 0.0 for n in ("tilt_1", "tilt_2")])
    errors = np.array([estimate.error(n) or 0.0 for n in ("tilt_1", "tilt_2")])
    if np.linalg.norm(tilt) > max(3.0 * float(np.max(errors)), np.radians(0.1)):
        yield (
            f"the base is tilted by {np.degrees(np.linalg.norm(tilt)):.2f} degrees against the "
            "model's gravity; the links are those of the true direction"
        )
