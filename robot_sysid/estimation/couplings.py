"""Motors that turn with several joints: friction and rotor inertia of a combined speed.

A motor that turns at s = sum_j r_j qd_j (joint units) puts its torque tau_m on each of these joints
in the same ratio: tau_j = r_j tau_m, because power is the same on both sides. Its own friction and
rotor inertia follow s, not the joints' own speeds. A wrist whose last motor sits in the forearm is
the usual case: r = 1 on the last two joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.friction import (
    DEFAULT_MEASURED,
    Coupling,
    FrictionModel,
    friction_model,
)
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.least_squares import sample_counts
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.algebra.priors import NuisanceGroup, WithPriors
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.unknowns import (
    LEAST_COULOMB,
    Choice,
    Question,
    Unknowns,
    build_unknowns,
    independent_prior,
)
from robot_sysid.json_files import read_json
from robot_sysid.model.chain import CAN_HOLD_ROTORS, shared_motors
from robot_sysid.records import Array, RobotModel

CLEAR_EVIDENCE = 15.0
"""By how much a coupling has to raise the logarithm of the marginal likelihood. That of a Staubli
TX40's wrist does by 114 to 148; where there is none, one does by 3 at most on three logs of a KUKA
LWR4+, and by 13 on 12 s of a UR10e."""
# Factor on the prior of a motor that counts as absent.
_ABSENT = 1e-4
# Least standard deviation of a motor's parameters.
_LEAST = 1e-9
# Standard errors that one of a motor's parameters has to be away from zero.
_CLEAR = 3.0
# Cosine from which on ratios of speeds are the same.
_SAME_DIRECTION = 1.0 - 1e-9


def coupling(robot: RobotModel, ratios: Array, tendon: int | None = None) -> Coupling:
    """Return the coupling with these ratios (n,), which may be a fixed tendon of the model."""
    text = ""
    for joint, ratio in zip(robot.joint_names, ratios):
        if ratio != 0.0:
            size = "" if abs(ratio) == 1.0 else f"{abs(ratio):g}*"
            sign = "-" if ratio < 0.0 else "+" if text else ""
            text += f"{sign}{size}{joint}"
    motor = Coupling(np.asarray(ratios, dtype=float), text)
    if tendon is None:
        return motor
    model = robot.mj_model
    rotor = model.tendon_armature[tendon] if CAN_HOLD_ROTORS else 0.0
    numbers = {
        "coulomb": model.tendon_frictionloss[tendon],
        "viscous": model.tendon_damping[tendon],
        "armature": rotor,
    }
    of_model = np.array([float(numbers.get(term, 0.0)) for term in motor.terms])
    return replace(motor, model=of_model, tendon=tendon)


def couplings_of_model(robot: RobotModel) -> tuple[Coupling, ...]:
    """Return the motors of the model that turn several joints of the arm.

    A tendon without friction and rotor inertia is no motor, but a spring or a gripper's fingers.
    """
    ratios = shared_motors(robot.mj_model, robot.dof_index)
    motors = (
        coupling(robot, joint_ratios, tendon) for tendon, joint_ratios in ratios.items()
    )
    return tuple(motor for motor in motors if np.any(motor.model))


def neighbours(robot: RobotModel) -> Iterator[Coupling]:
    """Yield the couplings that a wrist may have: each joint with the next one, of either sign."""
    for joint in range(robot.n_joints - 1):
        for sign in (1.0, -1.0):
            ratios = np.zeros(robot.n_joints)
            ratios[joint] = 1.0
            ratios[joint + 1] = sign
            yield coupling(robot, ratios)


def couplings_of(
    robot: RobotModel, options: EstimationOptions
) -> tuple[tuple[Coupling, ...], tuple[Coupling, ...]]:
    """Return (couplings that have columns, those of them that need evidence of the recordings).

    Couplings of the model and of the user's file need no evidence. Torques of the last joint alone
    identify none.

    Raises:
        InputError: the file that states them cannot be read, or does not fit the arm.
    """
    stated = () if options.coupling is None else read_couplings(options.coupling, robot)
    if options.torques != "chain":
        return stated, ()
    of_model = couplings_of_model(robot)
    fixed = (*of_model, *(motor for motor in stated if not _is_among(motor, of_model)))
    if options.coupling is not None:
        return fixed, ()
    offered = tuple(motor for motor in neighbours(robot) if not _is_among(motor, fixed))
    return (*fixed, *offered), offered


def _is_among(motor: Coupling, others: Sequence[Coupling]) -> bool:
    """Tell whether a motor's ratios are parallel to those of another motor."""
    directions = [
        item.ratios / np.linalg.norm(item.ratios) for item in (motor, *others)
    ]
    return any(abs(directions[0] @ other) > _SAME_DIRECTION for other in directions[1:])


def select_couplings(
    fitter: Fitter,
    question: Question,
    model: FrictionModel | None,
    offered: tuple[Coupling, ...],
) -> tuple[Coupling, ...]:
    """Return the couplings that need no evidence and the offered ones that have clear evidence.

    A motor is selected where it makes the torques clearly more likely, with noise estimated anew
    beside it, and one of its parameters is clearly not zero. Joint torque sensors behind the gears
    measure no torque of motors, and so none of a motor that joints share.
    """
    couplings = fitter.columns.couplings
    joint_model = model or friction_model(DEFAULT_MEASURED)
    choice = Choice(
        (joint_model,) * fitter.columns.robot.n_joints,
        couplings[: len(couplings) - len(offered)],
    )
    fit = fitter.fit(question, choice, rounds=1)
    while True:
        wider = [
            fitter.solve_around(
                fit.point, question, replace(fit.choice, couplings=motors)
            )
            for motors in _promising_couplings(fit, question, offered)
        ]
        gains = [_evidence_gain(fit, wider_fit) for wider_fit in wider]
        if not gains or max(gains) < CLEAR_EVIDENCE:
            return fit.choice.couplings
        fit = wider[int(np.argmax(gains))]


def _promising_couplings(
    fit: Fit, question: Question, offered: Sequence[Coupling]
) -> list[tuple[Coupling, ...]]:
    """Return the couplings of a fit with one offered motor added, for the two best motors at most.

    Each makes the torques more likely. The noise is that of the fit, and friction may have either
    sign: this saves fits with motors that cannot win.
    """
    present = fit.choice.couplings
    candidates = [
        motor for motor in offered if all(motor is not other for other in present)
    ]
    if not candidates:
        return []
    choice = replace(fit.choice, couplings=(*present, *candidates))
    unknowns = build_unknowns(
        fit.columns, question, choice, fit.evidence.torque, fit.evidence.nonzero
    )
    problem = WithPriors(
        fit.evidence.of(unknowns), np.sqrt(fit.inflation * fit.memory) * fit.noise
    )
    priors = [_motor_prior(fit, unknowns, motor) for motor in candidates]
    absent = [replace(prior, widened=_ABSENT) for prior in priors]
    groups = [*unknowns.groups, *absent]
    evidence_without = problem.log_evidence(groups)[1]
    gains = []
    for k in range(len(candidates)):
        groups[len(unknowns.groups) + k] = priors[k]
        gains.append(problem.log_evidence(groups)[1] - evidence_without)
        groups[len(unknowns.groups) + k] = absent[k]
    best = np.argsort(gains)[::-1][:2]
    return [(*present, candidates[k]) for k in best if gains[k] > 0.0]


def _evidence_gain(fit: Fit, wider: Fit) -> float:
    """Return the log marginal likelihood that the last motor of a wider fit adds.

    It is minus infinity where none of the motor's parameters is clearly not zero. The number of
    independent samples is that of the wider fit's residuals.
    """
    prior = _motor_prior(fit, wider.unknowns, wider.choice.couplings[-1])
    priors = [*wider.unknowns.groups, prior]
    correlation = wider.inflation * wider.memory
    problem = WithPriors(
        wider.evidence.of(wider.unknowns), np.sqrt(correlation) * wider.noise
    )
    values, covariance, _ = problem.solve(priors)
    indices = prior.indices(wider.unknowns.kept_names)
    if not np.any(
        np.abs(values[indices]) > _CLEAR * np.sqrt(np.diag(covariance)[indices])
    ):
        return -np.inf
    problem_without = WithPriors(
        fit.evidence.of(fit.unknowns), np.sqrt(correlation) * fit.noise
    )
    counts = np.array(sample_counts(fit.evidence.whole)) / correlation
    less_noise = float(counts @ np.log(fit.noise / wider.noise))
    return (
        problem.log_evidence(priors)[1]
        - problem_without.log_evidence(fit.unknowns.groups)[1]
        + less_noise
    )


def _motor_prior(fit: Fit, unknowns: Unknowns, motor: Coupling) -> NuisanceGroup:
    """Return the prior of a motor that turns several joints: each joint's own terms in a fit.

    A term that is nearly zero there may make a small share of the joint's root mean square torque.
    """
    columns = fit.columns
    turned = np.flatnonzero(motor.ratios)
    names = [name for name in motor.parameter_names if name in unknowns.kept_names]
    sizes = []
    for name in names:
        term = name.partition("[")[0]
        terms = columns.at(
            [f"{term}[{columns.robot.joint_names[joint]}]" for joint in turned]
        )
        size = max(float(np.max(np.abs(fit.values[terms]))), _LEAST)
        for joint in turned:
            rows = fit.evidence.whole.joints[joint]
            column = rows.triangle[:, :-1][:, rows.columns == columns.place[name]]
            column_size = float(np.linalg.norm(column)) / np.sqrt(
                max(rows.n_samples, 1)
            )
            if column_size > 0.0:
                size = max(
                    size, LEAST_COULOMB * fit.evidence.torque[joint] / column_size
                )
        sizes.append(size)
    return independent_prior("couplings", names, names, np.array(sizes))


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
        rows = {f"motor {name!r}": row for name, row in content.items()}
    elif isinstance(content, list):
        rows = {f"row {index + 1}": row for index, row in enumerate(content)}
    else:
        rows = {"": content}
    ratios = []
    for label, entry in rows.items():
        row: Any = entry
        if isinstance(row, list) and len(row) == robot.n_joints:
            row = dict(zip(names, row))
        if not isinstance(row, dict) or not all(map(_is_number, row.values())):
            raise InputError(
                f'--coupling {path}: {label} must be like {{"{names[-1]}": 1.0}}, or in a matrix '
                f"{robot.n_joints} finite numbers in each row, one per joint of the chain"
            )
        unknown = [joint for joint in row if joint not in names]
        if unknown:
            raise InputError(
                f"--coupling {path}: {label} turns with {unknown[0]!r}, which is no joint of the "
                f"arm: {', '.join(names)}"
            )
        ratios.append(np.array([float(row.get(joint, 0.0)) for joint in names]))
    return tuple(
        coupling(robot, motor) for motor in ratios if np.count_nonzero(motor) > 1
    )


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_real and bool(np.isfinite(value))
