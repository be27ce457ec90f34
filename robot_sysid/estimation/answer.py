"""From a fit to its answer: bodies, joints, sensors and the model file, with their errors."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.newton_euler import LinkDynamics
from robot_sysid.dynamics.nuisances import gravity
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.base_parameters import (
    BaseCombinations,
    base_combinations,
    essential,
)
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability
from robot_sysid.estimation.algebra.information import residual_errors, restricted, sample_counts
from robot_sysid.estimation.algebra.uncertainty import triangle_of
from robot_sysid.estimation.choices import Errors
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.dataset import DecimatedSamples
from robot_sysid.estimation.errors import FitErrors
from robot_sysid.estimation.file_fit import FileFit
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.recordings import FrictionOfLogs
from robot_sysid.estimation.unknowns import FILE_FRICTION, LINKS
from robot_sysid.estimation.unknowns import FRICTION as LACKING
from robot_sysid.estimation.verdict import HARMLESS
from robot_sysid.records import (
    DELAY_NAME,
    Array,
    Estimate,
    InertialParameters,
    JointLimits,
    Motion,
    RobotModel,
    Validation,
)
from robot_sysid.records.atomic_files import MODEL_NAMES
from robot_sysid.records.data import Traces
from robot_sysid.records.figures import percent, with_error
from robot_sysid.results.cards import inertia_is_known, principal_moments
from robot_sysid.results.record import (
    BaseParameters,
    BodyEstimate,
    Figure,
    JointEstimate,
    ModelFile,
)

_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]])


@dataclass(frozen=True)
class Answer:
    """A fit with all that follows from it.

    Attributes:
        fit: the estimate.
        file: what a model file is given; None where none is asked for.
        errors: how far off the estimate may be.
        validation: its own prediction of stretches that were not fitted.
        tests: its prediction of other logs.
        candidates: how well friction models that were tried predict what was not fitted.
        acceleration_error: expected error of the acceleration, as a part of it.
        notes: one sentence each.
        friction_of_logs: where there are several.
    """

    fit: Fit
    file: FileFit | None
    errors: FitErrors
    validation: Validation
    tests: tuple[Validation, ...] = ()
    candidates: Errors = field(default_factory=dict)
    acceleration_error: float = 0.0
    notes: tuple[str, ...] = ()
    friction_of_logs: FrictionOfLogs | None = None

    @property
    def robot(self) -> RobotModel:
        """The arm."""
        return self.fit.columns.robot

    @cached_property
    def share(self) -> Array:
        """How much of each value (k,) that was sought comes from the data."""
        return self.errors.share(self.fit)

    def pick(self, names: Sequence[str]) -> Array:
        """Return rows (m, k) that pick parameters out of those that were sought."""
        kept = self.fit.unknowns.kept
        return np.eye(len(kept))[np.searchsorted(kept, self.fit.columns.at(names))]

    def body(self, name: str, change: Array, theta: Array, before: Array | None) -> BodyEstimate:
        """Return a body whose parameters are combinations (10, k) of what was sought."""
        covariance, noise, budget = self.errors.of(change, theta)
        weight = np.abs(change)
        share = weight @ self.share / np.maximum(np.sum(weight, axis=1), 1e-300)
        return BodyEstimate(
            name=name,
            inertial=InertialParameters(theta),
            covariance=covariance,
            shown=self.errors.shown(change),
            noise_errors=noise,
            budget=budget,
            data_share=np.clip(share, 0.0, 1.0),
            before=None if before is None else InertialParameters(before),
        )

    def links(self) -> Iterator[BodyEstimate]:
        """Yield every link that was sought, base to terminal."""
        pairs = zip(self.robot.joint_names, self.robot.links)
        joints = {link.body_name: (joint, link.theta) for joint, link in pairs if link.has_mass}
        for name, (at, _) in self.fit.unknowns.bodies.items():
            if name in joints:
                joint, before = joints[name]
                names = [self.fit.columns.names[k] for k in at]
                found = self.body(name, self.pick(names), self.fit.values[at], before)
                yield replace(found, joint=joint)

    def figure(self, name: str) -> Figure:
        """Return a parameter with its whole error."""
        place, sought = self.fit.columns.place[name], self.fit.unknowns
        value = float(self.fit.final[place])
        if name in sought.at_bound:
            return Figure(value, float("nan"))
        at = int(np.searchsorted(sought.kept, place))
        return Figure(value, float(self.errors.whole.standard_errors[at]))

    def joints(self) -> Iterator[tuple[str, JointEstimate]]:
        """Yield each chain joint, and each coupled motor, with its friction."""
        noise = self.fit.noise_per_joint
        own, robot = self._own_terms(), self.robot
        models = dict(zip(robot.joint_names, self.fit.choice.friction))
        for index, joint in enumerate(robot.joint_names):
            terms = {name: self.figure(f"{name}[{joint}]") for name in own.get(joint, ())}
            before = {
                "coulomb": float(robot.friction.coulomb[index]),
                "viscous": float(robot.friction.viscous[index]),
                "armature": float(robot.armature[index]),
            }
            yield (
                joint,
                JointEstimate(
                    friction_model=models[joint].name if terms else "none",
                    terms=terms,
                    before=before,
                    candidates=self.candidates.get(joint, {}) if terms else {},
                    noise=noise.get(joint, float("nan")),
                    two_ways=self._two_ways(joint, terms),
                    logs=self._friction_by_log(joint),
                    another_day=self._another_day(joint),
                ),
            )
        for motor in self.fit.choice.couplings:
            terms = {name: self.figure(f"{name}[{motor.name}]") for name in own.get(motor.name, ())}
            of_model = zip(motor.terms, motor.model.tolist())
            before = {} if motor.tendon is None else dict(of_model)
            yield motor.name, JointEstimate("-".join(terms) or "none", terms, before)

    def _friction_by_log(self, owner: str) -> dict[str, dict[str, Figure]]:
        """Return log to the friction terms of a joint according to it; empty for a single log."""
        friction = self.friction_of_logs
        if friction is None:
            return {}
        terms = friction.terms_of(owner)
        values = friction.between.values
        errors = friction.between.errors
        return {
            log: {
                term: Figure(float(values[row, place]), float(errors[row, place]))
                for term, place in terms.items()
            }
            for row, log in enumerate(friction.logs)
        }

    def _another_day(self, owner: str) -> dict[str, Figure]:
        """Return friction term of a joint as it is in another log than those of the fit."""
        friction = self.friction_of_logs
        if friction is None:
            return {}
        figures = [self.figure(name) for name in friction.names]
        errors = friction.between.next_log(np.array([figure.error for figure in figures]))
        return {
            term: Figure(figures[place].value, float(errors[place]))
            for term, place in friction.terms_of(owner).items()
        }

    def _own_terms(self) -> dict[str, list[str]]:
        """Return joint or motor to the friction terms that were sought of it."""
        lacking = {n for g in self.fit.unknowns.groups if g.cause == LACKING for n in g.names}
        other = {"scale", "zero", "drift"}
        found: dict[str, list[str]] = {}
        for name in (*self.fit.unknowns.kept_names, *self.fit.unknowns.at_bound):
            term, bracket, owner = name.partition("[")
            if bracket and name not in lacking and term not in other:
                found.setdefault(owner[:-1], []).append(term)
        return found

    def _two_ways(self, joint: str, terms: Mapping[str, Figure]) -> tuple[Figure, Figure] | None:
        """Return Coulomb friction forward and backward, which differ by twice the offset."""
        level = "coulomb" if "coulomb" in terms else "sigmoid"
        if level not in terms or "offset" not in terms or np.isnan(terms[level].error):
            return None
        both = self.pick([f"{level}[{joint}]", f"offset[{joint}]"])
        spread = np.sqrt(np.maximum(np.diag(_SIGNS @ self.errors.of(both)[0] @ _SIGNS.T), 0.0))
        values = _SIGNS @ [terms[level].value, terms["offset"].value]
        return tuple(Figure(*pair) for pair in zip(values.tolist(), spread.tolist()))  # type: ignore[return-value]

    def body_names(self) -> set[str]:
        """Return the names of all parameters of bodies that were sought."""
        sought = self.fit.unknowns
        return {sought.names[k] for at, _ in sought.bodies.values() for k in at}

    def sensors(self) -> dict[str, Figure]:
        """Return scales, zeros, drift, tilt, delay, and friction that was only allowed for."""
        own = {f"{term}[{owner}]" for owner, terms in self._own_terms().items() for term in terms}
        bodies = self.body_names()
        names = [n for n in self.fit.unknowns.kept_names if n not in own and n not in bodies]
        return {name: self.figure(name) for name in names}


def model_file(answer: Answer) -> tuple[ModelFile, tuple[str, ...]]:
    """Return what is written, and sentences on what is not."""
    assert answer.file is not None
    file, fit, robot = answer.file, answer.file.fit, answer.robot
    own = replace(answer, fit=fit, file=None, errors=file.errors)
    thetas = fit.columns.thetas(fit.values)
    spread = np.zeros_like(thetas)
    for body in own.links():
        spread[robot.joint_names.index(str(body.joint))] = body.errors
    joints, notes, kept = {}, [], fit.question.kept_parts
    for owner, each in own.joints():
        written = {name: figure for name, figure in each.terms.items() if name != "offset"}
        rotor = each.before.get("armature", 0.0)
        if fit.choice.rotors.get(owner, rotor) != rotor:
            written["armature"] = answer.figure(f"armature[{owner}]")
        if written:
            joints[owner] = written
        elif owner in robot.joint_names:
            notes.append(
                f"{owner} does not move fast enough in these logs: nothing is learnt of its "
                "friction and rotor inertia, the model's own stay"
            )
    notes = [*([] if FILE_FRICTION in kept else notes), *_beside(own, file.after)]
    turned = fit.next_point.gravity if fit.unknowns.settle else None
    if turned is not None and np.array_equal(turned, gravity(robot)):
        turned = None
    written_file = ModelFile(
        thetas,
        spread,
        joints,
        turned,
        file.before,
        file.after,
        kept=tuple(sorted(kept)),
        motors=fit.choice.couplings,
    )
    if file.beside is not None:
        beside, _ = model_file(replace(answer, file=file.beside))
        return replace(written_file, beside=beside), (*notes, _what_lacks(written_file, beside))
    return written_file, tuple(notes)


def _what_lacks(file: ModelFile, beside: ModelFile) -> str:
    """Return a sentence on the URDF that is written beside an MJCF."""
    shares = [
        "" if test is None or test.relative_error is None else percent(test.relative_error)
        for test in (beside.after, file.after)
    ]
    motors = ", ".join(motor.name for motor in file.motors)
    return (
        f"a URDF cannot hold the motor that turns with {motors}, or rotor inertia: "
        f"{MODEL_NAMES['mjcf']} holds both (torque error on held-out data {shares[1]}), "
        f"{MODEL_NAMES['urdf']} beside it lacks them ({shares[0]})"
    )


def _beside(file: Answer, after: Validation) -> Iterator[str]:
    """Yield what a file's torques lack beside offsets of sensors, where that is most of it."""
    fit, sought = file.fit, file.fit.unknowns.kept_names
    counts = zip(fit.columns.joints, sample_counts(fit.evidence.whole))
    free = {j: count for j, count in counts if j not in fit.choice.offsets}
    found = {j: file.figure(f"offset[{j}]") for j in free if f"offset[{j}]" in sought}
    squares = sum(found[joint].value ** 2 * free[joint] for joint in found)
    squared, error = squares / np.sum(fit.evidence.squared_torque), after.relative_error or 0.0
    if squared > max(HARMLESS, error) ** 2:
        listed = ", ".join(f"{joint} {with_error(*each, 'N·m')}" for joint, each in found.items())
        yield (
            f"no model file holds an offset of a torque sensor ({listed}), or friction that is "
            "larger in one direction: with it left in, the written file's torque error on "
            f"held-out data is {percent(float(np.sqrt(squared + error**2)))}"
        )


def written_payload(answer: Answer) -> tuple[Array, str]:
    """Return the payload (10,) that a model gets, and why its inertia is not known; "" where it is.

    Where it is not, a ball of aluminium of that mass is as good a guess as any.
    """
    theta = answer.fit.values[answer.fit.columns.at(PAYLOAD_NAMES)]
    mass, com, _ = spatial.com_from_theta(theta)
    body = answer.body("payload", answer.pick(PAYLOAD_NAMES), theta, None)
    if mass <= 0.0 or inertia_is_known(body):
        return theta, ""
    moments, errors, _ = principal_moments(body)
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    said = f"the payload's principal moments of inertia, {listed} kg·m², are not told from zero"
    if not np.all(np.isfinite(errors)):
        said = "these torques do not show the payload's inertia"
    return spatial.aluminium_ball(mass, com), said


def estimate_of(answer: Answer) -> Estimate:
    """Return all parameters: the terminal link, friction, then what is only allowed for."""
    fit, errors = answer.fit, answer.errors
    names = fit.unknowns.kept_names
    sensors = answer.sensors()
    asked = {DELAY_NAME, "tilt_1", "tilt_2"} & set(fit.unknowns.settle)
    links = answer.body_names() - set(PARAMETER_NAMES)
    interest = [n for n in names if n not in links and (n not in sensors or n in asked)]
    order = [names.index(n) for n in (*interest, *(n for n in names if n not in set(interest)))]
    said, whole = residual_errors(fit.evidence.whole, fit.values), errors.whole
    return Estimate(
        names=tuple(names[k] for k in order),
        values=fit.final[fit.unknowns.kept][order],
        identifiability=analyse_identifiability(restricted(fit.evidence.whole, interest)),
        **said,
        method="wls",
        covariance=whole.covariance[np.ix_(order, order)],
        standard_errors=whole.standard_errors[order],
        noise_per_joint=fit.noise_per_joint,
        effective_samples=dict(zip(said["samples"], whole.effective)),
        constrained=fit.is_constrained,
    )


_RANDOM_POSES, _UNIT_LENGTH = 60, 0.3


def base_parameters(fit: Fit, errors: FitErrors) -> BaseParameters:
    """Return the base parameters that the data shows."""
    names = fit.columns.bodies()
    order = np.sort(np.concatenate([names[n] for n in names if n != "payload"]))
    sought = fit.unknowns
    data = fit.evidence.whole.blocks
    rows = triangle_of(block[:, order] for block in data(fit.weights))
    found = base_combinations(rows, parameter_scale(len(order) // 10))
    rest = np.setdiff1d(sought.kept, order)
    inside = np.flatnonzero(np.isin(order, sought.kept))
    change, at = found.matrix[:, inside], np.searchsorted(sought.kept, order[inside])
    spread = change @ errors.whole.covariance[np.ix_(at, at)] @ change.T
    # What is known of sensors counts; free torque scales would explain all torques by themselves.
    known = [g.rows(fit.columns.names) for g in sought.groups if g.cause != LINKS]
    some = np.concatenate((rest, [-1], order[found.leading]))
    rows = triangle_of(block[:, some] for block in itertools.chain(data(fit.weights), known))
    others, right, base = np.split(rows, (len(rest), len(rest) + 1), axis=1)
    kept = essential(base, others, right[:, 0])
    return BaseParameters(
        combinations=found.names([fit.columns.names[index] for index in order]),
        values=found.matrix @ fit.values[order],
        standard_errors=np.sqrt(np.maximum(np.diag(spread), 0.0)),
        structural_rank=structural_base(fit.columns.robot).rank,
        essential=tuple(kept.tolist()),
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


_NOT_FRICTION = ("armature", "zero", "scale", "drift")


def traced(
    robot: RobotModel,
    samples: Sequence[DecimatedSamples],
    motions: Sequence[Motion],
    after: Mapping[str, float],
    before: Mapping[str, float],
) -> Traces:
    """Return what was measured and predicted.

    Args:
        samples: equations of each log.
        motions: the motion of each log, about at the instants of its equations.
        after, before: parameter name to value of the result and of what was known before; what is
            missing is zero.
    """
    joints = samples[0].joints
    place = [robot.joint_names.index(joint) for joint in joints]

    def joined(name: str) -> Array:
        return np.concatenate([np.stack(getattr(each, name), axis=1) for each in samples])

    def moved(name: str) -> Array:
        pairs = zip(samples, motions)
        parts = [
            [np.interp(each.time, motion.time, one) for one in getattr(motion, name).T[place]]
            for each, motion in pairs
        ]
        return np.concatenate([np.column_stack(part) for part in parts])

    missing, measured, limits = joined("tau"), joined("measured"), robot.limits
    rubbing = {n: v for n, v in after.items() if "[" in n and n.split("[")[0] not in _NOT_FRICTION}
    return Traces(
        joints=joints,
        is_slide=tuple(bool(robot.is_slide[j]) for j in place),
        time=np.concatenate([each.time for each in samples]),
        q=moved("q"),
        qd=moved("qd"),
        measured=np.where(np.isfinite(missing), measured, np.nan),
        predicted=measured - missing + _products(samples, after),
        before=measured - missing + _products(samples, before),
        friction=_products(samples, rubbing),
        limits=JointLimits(
            limits.lower[place], limits.upper[place], limits.velocity[place], limits.torque[place]
        ),
    )


def _products(samples: Sequence[DecimatedSamples], values: Mapping[str, float]) -> Array:
    """Return (K, joints) the torque that some parameters make [N m]."""
    known = np.array([values.get(name, 0.0) for name in samples[0].names])
    parts = [[r @ known[c] for r, c in zip(each.rows, each.columns)] for each in samples]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def traces_of(answer: Answer) -> Traces:
    """Return what was measured, and what the written file (else the fit) and the model predict.

    Each joint's sensor offset is taken out of both.
    """
    fit = answer.fit if answer.file is None else answer.file.fit
    names = fit.columns.names
    after, before = (dict(zip(names, v.tolist())) for v in (fit.values, fit.columns.prior))
    if fit.question.loaded:
        before = {name: value for name, value in after.items() if name not in PAYLOAD_NAMES}
    before.update({n: v for n, v in after.items() if n.startswith("offset[")})
    motions = [each.delayed(fit.point.delay).motion for each in fit.columns.datasets]
    return traced(fit.columns.robot, fit.samples, motions, after, before)
