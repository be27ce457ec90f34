"""What is not known of a real arm: the priors that the options stand for, and their columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from robot_sysid.dynamics.equations import Equations, link_names, other_links
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.gravity import gravity
from robot_sysid.dynamics.nuisances import NuisanceColumns, scale_names, zero_names
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.nuisances import NuisanceGroup, link_factor
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.signals.process import ProcessedSignals

LINKS, SCALES, ZEROS, TILT = "links", "torque scale", "joint offsets", "gravity"
FRICTION = "friction model"
"""Causes of error, as they are called in results."""
GRAVITY_NAMES = ("gravity_1", "gravity_2")
LACKING = ("load", "sqrt")
"""Friction terms that a real joint has and a simpler model of it lacks."""
CURVATURE, LEAST_COULOMB = 5.0, 0.02
"""How curved friction may be, as part of its Coulomb friction and in units of what it may grow with
the gear's torque; Coulomb friction is at least so much of the joint's usual torque."""
OWN = (SCALES, FRICTION)
"""Causes whose columns stand in their own joint's equation alone."""
PER_CENT, MILLI = 0.01, 1e-3
_CHUNK = 2048

Maker = Callable[[Motion], Array]


def sought_links(robot: RobotModel, options: EstimationOptions) -> tuple[int, ...]:
    """Return the numbers of the other links whose parameters are estimated as well."""
    known = options.link_uncertainty == 0.0 or options.torques == "terminal"
    return () if known else other_links(robot)


def nuisance_groups(
    robot: RobotModel, options: EstimationOptions, friction: FrictionModel, torque: Array
) -> tuple[NuisanceGroup, ...]:
    """Return what is known of the nuisances, one group per cause.

    Args:
        robot: the arm.
        options: what the user says of them.
        friction: terms that are estimated; what they lack is a nuisance.
        torque: (n,) root mean square of each joint's measured torque [N m].
    """
    return tuple(_groups(robot, options, friction, torque))


def _groups(
    robot: RobotModel, options: EstimationOptions, friction: FrictionModel, torque: Array
) -> Iterator[NuisanceGroup]:
    links = sought_links(robot, options)
    if links:
        yield link_group(robot, links, PER_CENT * options.link_uncertainty)
    joints = robot.joint_names if options.torques == "chain" else robot.joint_names[-1:]
    if options.scale_uncertainty > 0.0:
        names = scale_names(robot)[-len(joints) :]
        yield independent(SCALES, names, joints, PER_CENT * options.scale_uncertainty)
    if options.zero_uncertainty > 0.0:
        size = MILLI * options.zero_uncertainty
        yield independent(ZEROS, zero_names(robot), robot.joint_names, size)
    tilted = options.gravity_uncertainty > 0.0 and options.tilt == "off"
    if tilted and np.any(gravity(robot)):
        size = float(np.radians(options.gravity_uncertainty))
        yield independent(TILT, GRAVITY_NAMES, ("the base", "the base"), size)
    lacking = [term for term in LACKING if friction.terms and term not in friction.terms]
    share = PER_CENT * options.friction_uncertainty
    if lacking and share > 0.0:
        yield _friction_group(robot, joints, lacking, torque, share)


def _friction_group(
    robot: RobotModel, joints: Sequence[str], lacking: Sequence[str], torque: Array, share: float
) -> NuisanceGroup:
    size = np.maximum(robot.friction.coulomb, LEAST_COULOMB * torque)[-len(joints) :]
    sizes = {"load": np.full(len(joints), share), "sqrt": CURVATURE * share * size}
    names = tuple(f"{term}[{joint}]" for term in lacking for joint in joints)
    factor = np.diag(np.concatenate([sizes[term] for term in lacking]))
    members = (*joints,) * len(lacking)
    return NuisanceGroup(FRICTION, names, np.zeros(len(names)), factor, members, may_widen=True)


def independent(
    cause: str, names: Sequence[str], members: Sequence[str], size: float, may_widen: bool = False
) -> NuisanceGroup:
    """Return the prior of nuisances that are each off by the same size, on their own."""
    count = len(names)
    factor = size * np.eye(count)
    return NuisanceGroup(cause, tuple(names), np.zeros(count), factor, tuple(members), may_widen)


def link_group(
    robot: RobotModel, links: Sequence[int], share: float, cause: str = LINKS
) -> NuisanceGroup:
    """Return what the model knows of some links, by their numbers; the terminal one may be there.

    Args:
        robot: the arm.
        links: numbers of links with mass.
        share: how far their numbers may be off, see ``estimation.nuisances.link_factor``.
        cause: what they are called.
    """
    last = robot.n_joints - 1
    ends = [*(link.translation for link in robot.links[1:]), robot.prior.com]
    lengths = [float(np.linalg.norm(ends[link])) for link in links]
    thetas = [robot.links[link].theta for link in links]
    names: list[str] = []
    for link in links:
        names += PARAMETER_NAMES if link == last else link_names(robot, link)
    members = [robot.links[link].body_name for link in links for _ in PARAMETER_NAMES]
    factor, mean = link_factor(thetas, share, lengths), np.concatenate(thetas)
    return NuisanceGroup(cause, tuple(names), mean, factor, tuple(members), may_widen=True)


def known_links(robot: RobotModel, names: Sequence[str], values: Array | None) -> Array:
    """Return (n, 10) what is known of all links: estimated where it was, else the model's.

    Args:
        robot: the arm.
        names: (p,) parameter names of the equations.
        values: (p,) estimate; None for none yet.
    """
    thetas = np.array([link.theta for link in robot.links])
    if values is None:
        return thetas
    thetas[-1] = values[: len(PARAMETER_NAMES)]
    place = {name: index for index, name in enumerate(names)}
    for link in other_links(robot):
        if link_names(robot, link)[0] in place:
            thetas[link] = [values[place[name]] for name in link_names(robot, link)]
    return thetas


def with_nuisances(
    samples: DecimatedSamples,
    columns: NuisanceColumns,
    signals: ProcessedSignals,
    equations: Equations,
    groups: Sequence[NuisanceGroup],
) -> DecimatedSamples:
    """Return the equations of a log with the columns of scales, zeros and tilt.

    They are taken at the instants of the decimated rows, without the low-pass: motion passes it
    unchanged, and what a nuisance's column is off by counts only beside the nuisance's own size.
    """
    motion = signals.decimated_motion()
    makers: dict[str, Maker] = {
        SCALES: columns.scale,
        ZEROS: columns.zero,
        TILT: columns.tilt,
        **{term: partial(columns.friction, term=term) for term in LACKING},
    }
    rows = list(equations.rows_of)
    for group in groups:
        kinds = [group.cause] if group.cause in makers else _kinds(group.names)
        chosen = [makers[kind] for kind in kinds if kind in makers]
        if not chosen:
            continue
        count = len(group.names) // len(chosen)
        made = _made(chosen, motion)[:, rows, :, -count:].reshape(len(samples), len(rows), -1)
        places = [np.arange(len(group.names))] * len(rows)
        if group.cause in OWN:
            places = [np.arange(row, len(group.names), count) for row in range(len(rows))]
        blocks = [made[:, row, place] for row, place in enumerate(places)]
        samples = samples.with_columns(group.names, blocks, places)
    return samples


def _made(makers: Sequence[Maker], motion: Motion) -> Array:
    """Return what makers of columns (K, n, s) make, (K, n, makers, s), a part at a time."""
    parts = []
    for start in range(0, len(motion.time), _CHUNK):
        some = slice(start, start + _CHUNK)
        part = Motion(motion.time[some], motion.q[some], motion.qd[some], motion.qdd[some])
        parts.append(np.stack([maker(part) for maker in makers], axis=2))
    return np.concatenate(parts)


def _kinds(names: Sequence[str]) -> list[str]:
    """Return what stands before the bracket in parameter names, each once."""
    return list(dict.fromkeys(name.partition("[")[0] for name in names))
