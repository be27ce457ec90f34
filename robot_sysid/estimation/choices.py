"""What the recordings decide: couplings, each joint's friction, how far links may be off.

One rule for all questions: a joint starts with the simplest candidate and moves on as long as
another one is clearly better on its own held-out torques (``held_out.is_clearly_lower``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.friction import BENT, FrictionModel, friction_model
from robot_sysid.estimation.columns import Point
from robot_sysid.estimation.couplings import Coupling
from robot_sysid.estimation.fit import Fit, Fitter
from robot_sysid.estimation.held_out import HeldOut, held_out, is_clearly_lower
from robot_sysid.estimation.unknowns import Choice, Question, Unknowns, unknowns
from robot_sysid.records import Array

CANDIDATES = (
    "coulomb-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt",
    "coulomb-viscous-offset-armature-stribeck",
    "coulomb-viscous-offset-armature-load",
    "sigmoid-viscous-offset-armature",
    "coulomb-viscous-offset-armature-quadratic-cubic",
    "coulomb-viscous-offset-armature-sqrt-load",
    "coulomb-viscous-offset-armature-stribeck-load",
)
"""Friction models that are tried, the same for every joint of every arm, simplest first."""
IN_FILE, WITH_POLYNOMIAL = CANDIDATES[0], CANDIDATES[5]
"""Those that a model file can hold."""
SCALES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Factors of the other links' uncertainty that are tried."""
AS_GOOD = 1.02
"""Squared errors up to this ratio are as good as equal."""


Errors = Mapping[str, Mapping[str, float]]
"""Joint to friction model to its held-out root mean square error [N m]."""


def choose(
    fitter: Fitter,
    question: Question,
    given: FrictionModel | None,
    couplings: tuple[Coupling, ...] | None = None,
) -> tuple[Choice, Errors, Point]:
    """Return what the recordings decide, by which errors, and where to begin.

    Args:
        given: friction terms of every joint, where the user says them.
        couplings: what ``coupled`` has chosen; None for all that have columns.
    """
    choice = _simplest(fitter, given, fitter.columns.couplings if couplings is None else couplings)
    fit = fitter.fit(question, choice, rounds=1)
    errors: Errors = {}
    if given is None and fitter.columns.torques == "chain":
        choice, errors, fit = _with_friction(fitter, question, choice, fit)
    choice = replace(choice, prior_scale=prior_scale(fit, question, choice))
    return choice, errors, fit.point


def _simplest(
    fitter: Fitter, given: FrictionModel | None, couplings: tuple[Coupling, ...]
) -> Choice:
    model = given or friction_model(CANDIDATES[0])
    return Choice((model,) * fitter.columns.robot.n_joints, couplings)


def _sought(fit: Fit, question: Question, choice: Choice) -> Unknowns:
    return unknowns(fit.columns, question, choice, fit.evidence.torque, fit.evidence.shown)


def squared_errors(judge: HeldOut, fit: Fit, question: Question, choice: Choice) -> Array:
    """Return held-out squared errors (blocks, joints) of a choice, around a fit's point."""
    return judge.squared(_sought(fit, question, choice))


def coupled(
    fitter: Fitter, question: Question, given: FrictionModel | None, offered: tuple[Coupling, ...]
) -> tuple[Coupling, ...]:
    """Return which neighbours share a motor: where that predicts torques clearly better.

    Args:
        given: friction terms of every joint, where the user says them.
        offered: couplings that have columns.
    """
    fit = fitter.fit(question, _simplest(fitter, given, ()), rounds=1)
    judge, left, choice = held_out(fit), list(offered), fit.choice
    best = judge.score(squared_errors(judge, fit, question, choice))
    while left:
        trials = [replace(choice, couplings=(*choice.couplings, each)) for each in left]
        scores = [judge.score(squared_errors(judge, fit, question, each)) for each in trials]
        found = int(np.argmin([float(np.mean(score)) for score in scores]))
        if not is_clearly_lower(scores[found], best):
            break
        best, choice = scores[found], trials[found]
        del left[found]
    return choice.couplings


def _with_friction(
    fitter: Fitter, question: Question, choice: Choice, fit: Fit
) -> tuple[Choice, Errors, Fit]:
    """Give each joint the terms that predict its held-out torques clearly better."""
    joints, robot = fitter.columns.joints, fitter.columns.robot
    squared, speeds = _tried(fitter, question, choice, fit)
    models, errors = _per_joint(joints, squared, held_out(fit).counts)
    friction, speed = list(choice.friction), dict(fit.point.speed or {})
    for place, joint in enumerate(joints):
        index = robot.joint_names.index(joint)
        friction[index] = friction_model(models[joint])
        for term in friction[index].bent:
            speed[term] = speed[term].copy()
            speed[term][index] = speeds[models[joint]][place]
    choice = replace(choice, friction=tuple(friction))
    point = replace(fit.point, speed=speed, values=fit.values)
    return choice, errors, fitter.fit(question, choice, point, rounds=1)


def _tried(
    fitter: Fitter, question: Question, choice: Choice, fit: Fit
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return candidate to its squared errors (blocks, joints), and to the speeds (joints,).

    A term that is nonlinear in a speed is tried at several; each joint keeps its best.
    """
    robot = fitter.columns.robot
    squared: dict[str, Array] = {}
    speeds: dict[str, Array] = {}
    for number in range(max(len(bent.tried) for bent in BENT.values())):
        tried = {term: np.full(robot.n_joints, bent.tried[number]) for term, bent in BENT.items()}
        point = replace(fit.point, speed=tried, values=fit.values, exact_load=True)
        _, data = fitter.around(point)
        judge, around = HeldOut(data, fit.weighted.noise), replace(fit, evidence=data)
        for name in CANDIDATES:
            model = friction_model(name)
            if number and not model.bent:
                continue
            each = replace(choice, friction=(model,) * robot.n_joints)
            error = squared_errors(judge, around, question, each)
            speed = tried[model.bent[0]][0] if model.bent else 0.0
            before = squared.get(name, np.full_like(error, np.inf))
            lower = error.sum(axis=0) < before.sum(axis=0)
            squared[name] = np.where(lower, error, before)
            speeds[name] = np.where(lower, speed, speeds.get(name, np.zeros(error.shape[1])))
    return squared, speeds


def _per_joint(
    joints: tuple[str, ...], squared: Mapping[str, Array], counts: Array
) -> tuple[dict[str, str], dict[str, dict[str, float]]]:
    """Return (joint to its candidate, joint to candidate to its root mean square error)."""
    mean = {name: each / np.maximum(counts, 1.0) for name, each in squared.items()}
    total = np.maximum(counts.sum(axis=0), 1.0)
    models, errors = {}, {}
    for place, joint in enumerate(joints):
        models[joint] = clearly_best({name: each[:, place] for name, each in mean.items()})
        errors[joint] = {
            name: float(np.sqrt(each[:, place].sum() / total[place]))
            for name, each in squared.items()
        }
    return models, errors


def clearly_best(scores: Mapping[str, Array]) -> str:
    """Return the candidate to take, from its squared errors per block (blocks,)."""
    chosen = next(iter(scores))
    while True:
        better = [name for name in scores if is_clearly_lower(scores[name], scores[chosen])]
        if not better:
            return chosen
        fewest = min(len(friction_model(name).terms) for name in better)
        short = [name for name in better if len(friction_model(name).terms) == fewest]
        chosen = min(short, key=lambda name: float(np.mean(scores[name])))


def prior_scale(fit: Fit, question: Question, choice: Choice) -> float:
    """Return the least factor of the links' uncertainty that predicts about as well as any.

    It grows for as long as that does not predict worse.
    """
    judge, scores = held_out(fit), []
    for scale in SCALES:
        each = replace(choice, prior_scale=scale)
        squared = judge.of(replace(fit, unknowns=_sought(fit, question, each)))
        scores.append(float(np.mean(judge.score(squared))))
        if scores[-1] > AS_GOOD * min(scores):
            break
    return SCALES[int(np.flatnonzero(np.array(scores) <= AS_GOOD * min(scores))[0])]
