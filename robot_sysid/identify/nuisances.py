"""What is not known of a real arm: the priors that the options stand for, and their columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
PER_CENT, MILLI = 0.01, 1e-3


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
        yield _link_group(robot, links, PER_CENT * options.link_uncertainty)
    joints = robot.joint_names if options.torques == "chain" else robot.joint_names[-1:]
    if options.scale_uncertainty > 0.0:
        names = scale_names(robot)[-len(joints) :]
        yield _alike(SCALES, names, joints, PER_CENT * options.scale_uncertainty)
    if options.zero_uncertainty > 0.0:
        size = MILLI * options.zero_uncertainty
        yield _alike(ZEROS, zero_names(robot), robot.joint_names, size)
    tilted = options.gravity_uncertainty > 0.0 and options.tilt == "off"
    if tilted and np.any(gravity(robot)):
        size = float(np.radians(options.gravity_uncertainty))
        yield _alike(TILT, GRAVITY_NAMES, ("the base", "the base"), size)
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


def _alike(cause: str, names: Sequence[str], members: Sequence[str], size: float) -> NuisanceGroup:
    count = len(names)
    return NuisanceGroup(cause, tuple(names), np.zeros(count), size * np.eye(count), tuple(members))


def _link_group(robot: RobotModel, links: Sequence[int], share: float) -> NuisanceGroup:
    size = len(PARAMETER_NAMES)
    thetas = [robot.links[link].theta for link in links]
    lengths = [float(np.linalg.norm(robot.links[link + 1].translation)) for link in links]
    factor = link_factor(thetas, share, lengths)
    names = [name for link in links for name in link_names(robot, link)]
    members = [robot.links[link].body_name for link in links for _ in range(size)]
    mean = np.concatenate(thetas)
    return NuisanceGroup(LINKS, tuple(names), mean, factor, tuple(members), may_widen=True)


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
    at = signals.low_pass.centres(len(signals))
    motion = Motion(signals.time[at], signals.q[at], signals.qd[at], signals.qdd[at])
    makers = {SCALES: columns.scale, ZEROS: columns.zero, TILT: columns.tilt}
    makers.update({term: partial(columns.friction, term=term) for term in LACKING})
    rows = list(equations.rows_of)
    for group in groups:
        kinds = [group.cause] if group.cause in makers else _kinds(group.names)
        blocks = [makers[kind](motion)[:, rows] for kind in kinds if kind in makers]
        if blocks:
            count = len(group.names) // len(blocks)
            made = np.concatenate([block[:, :, -count:] for block in blocks], axis=-1)
            samples = samples.with_columns(group.names, list(np.moveaxis(made, 1, 0)))
    return samples


def _kinds(names: Sequence[str]) -> list[str]:
    """Return what stands before the bracket in parameter names, each once."""
    return list(dict.fromkeys(name.partition("[")[0] for name in names))
