"""From a fit to its answer: bodies, joints, sensors and the model file, with their errors.

Shapes: the arm's chain has n joints; a fit has p parameters (``Columns.names``), of which k are
estimated (``Unknowns.estimated``, ascending). A body has ten inertial parameters in the order of
``PARAMETER_NAMES``: mass [kg], first moments [kg m], inertia about its frame's origin [kg m^2].
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.newton_euler import LinkDynamics, gravity_vector
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.identifiability import (
    BaseCombinations,
    analyse_identifiability,
    base_combinations,
    essential,
)
from robot_sysid.estimation.algebra.least_squares import (
    residual_errors,
    restrict,
    sample_counts,
)
from robot_sysid.estimation.algebra.uncertainty import triangle_of
from robot_sysid.estimation.choices import Errors
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import FitErrors
from robot_sysid.estimation.file_fit import FileFit
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.log_comparison import FrictionOfLogs
from robot_sysid.estimation.question import FILE_FRICTION
from robot_sysid.estimation.trust import HARMLESS
from robot_sysid.estimation.unknowns import FRICTION, LINKS
from robot_sysid.records import (
    DELAY_NAME,
    Array,
    Estimate,
    InertialParameters,
    RobotModel,
    Validation,
)
from robot_sysid.records.file_access import MODEL_NAMES
from robot_sysid.records.messages import percent, with_error
from robot_sysid.results.cards import is_inertia_known, principal_moments
from robot_sysid.results.record import (
    BaseParameters,
    BodyEstimate,
    JointEstimate,
    ModelFile,
    Quantity,
)

# Rows that combine (Coulomb friction, offset) to the friction forward and backward.
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]])


@dataclass(frozen=True)
class Answer:
    """An identified arm: the fit, its errors and tests, and the fit for a model file.

    The functions of ``estimation.identify`` return it, and ``estimation.build_result`` makes the
    ``Result`` record from it.

    Attributes:
        fit: the estimate of all p parameters.
        file: the fit for a model file; None where no file is written.
        errors: covariance of the k estimated parameters, by cause.
        validation: cross-validated error of the recordings that were fitted.
        tests: errors in predicting the torques of logs that were not fitted, one per log.
        candidates: joint to friction model to its held-out root mean square error [N m]; empty
            where no friction models were compared.
        acceleration_error: expected error of the acceleration, as a share of the acceleration.
        notes: sentences for the user.
        friction_of_logs: friction according to each log; None for a single log.
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
        """The model of the arm that was identified."""
        return self.fit.columns.robot

    @cached_property
    def share(self) -> Array:
        """Share (k,), 0 to 1, of each estimated value that comes from the data, not the priors."""
        return self.errors.share(self.fit)

    def selection_matrix(self, names: Sequence[str]) -> Array:
        """Return the 0/1 matrix (m, k) that selects m named parameters from the k estimated ones.

        Every name has to be that of an estimated parameter.
        """
        indices = self.fit.unknowns.estimated
        return np.eye(len(indices))[
            np.searchsorted(indices, self.fit.columns.indices(names))
        ]

    def body(
        self, name: str, combinations: Array, theta: Array, model_theta: Array | None
    ) -> BodyEstimate:
        """Return the estimate of a body, with the errors of its ten inertial parameters.

        Args:
            name: of the body.
            combinations: (10, k) matrix from the k estimated parameters to the body's parameters,
                from which the errors follow.
            theta: (10,) estimated values of the body's parameters.
            model_theta: (10,) the body's parameters in the model; None where the model lacks it.
        """
        covariance, noise, budget = self.errors.of(combinations, theta)
        weight = np.abs(combinations)
        share = weight @ self.share / np.maximum(np.sum(weight, axis=1), 1e-300)
        return BodyEstimate(
            name=name,
            inertial=InertialParameters(theta),
            covariance=covariance,
            is_determined=self.errors.are_identified(combinations),
            noise_errors=noise,
            budget=budget,
            data_share=np.clip(share, 0.0, 1.0),
            prior=None if model_theta is None else InertialParameters(model_theta),
        )

    def links(self) -> Iterator[BodyEstimate]:
        """Yield the estimate of every link whose parameters were estimated, base to terminal."""
        links = enumerate(self.robot.links)
        joints = {link.body_name: k for k, link in links if link.has_mass}
        for name, (indices, _) in self.fit.unknowns.bodies.items():
            if name in joints:
                joint = joints[name]
                selection = self.selection_matrix(
                    [self.fit.columns.names[k] for k in indices]
                )
                model_theta = self.robot.links[joint].theta
                body = self.body(name, selection, self.fit.values[indices], model_theta)
                yield replace(body, joint=self.robot.joint_names[joint])

    def quantity(self, name: str) -> Quantity:
        """Return a named parameter in SI units with its standard error.

        The error is NaN for a parameter that is held at a bound. Every other parameter has to be
        an estimated one.
        """
        index = self.fit.columns.index[name]
        unknowns = self.fit.unknowns
        value = float(self.fit.final[index])
        if name in unknowns.names_at_bound:
            return Quantity(value, float("nan"))
        (row,) = np.flatnonzero(unknowns.estimated == index)
        return Quantity(value, float(self.errors.total.standard_errors[row]))

    def joints(self) -> Iterator[tuple[str, JointEstimate]]:
        """Yield (name, friction and rotor inertia) of each chain joint, base to terminal.

        The motors that turn several joints follow.
        """
        noise = self.fit.noise_per_joint
        friction_terms = self._friction_terms()
        robot = self.robot
        models = dict(zip(robot.joint_names, self.fit.choice.friction))
        for index, joint in enumerate(robot.joint_names):
            terms = self._quantities(joint, friction_terms.get(joint, ()))
            model_terms = {
                "coulomb": float(robot.friction.coulomb[index]),
                "viscous": float(robot.friction.viscous[index]),
                "armature": float(robot.armature[index]),
            }
            yield (
                joint,
                JointEstimate(
                    friction_model=models[joint].name if terms else "none",
                    terms=terms,
                    model_terms=model_terms,
                    candidates=self.candidates.get(joint, {}) if terms else {},
                    noise=noise.get(joint, float("nan")),
                    directional_coulomb=self._directional_coulomb(joint, terms),
                    logs=self._friction_by_log(joint),
                    other_day_terms=self._other_day_friction(joint),
                ),
            )
        for motor in self.fit.choice.couplings:
            terms = self._quantities(motor.name, friction_terms.get(motor.name, ()))
            of_model = zip(motor.terms, motor.model.tolist())
            model_terms = {} if motor.tendon is None else dict(of_model)
            yield (
                motor.name,
                JointEstimate("-".join(terms) or "none", terms, model_terms),
            )

    def _quantities(self, owner: str, terms: Iterable[str]) -> dict[str, Quantity]:
        """Return each of the friction terms of a joint or motor, mapped to its estimate."""
        return {term: self.quantity(f"{term}[{owner}]") for term in terms}

    def _friction_by_log(self, owner: str) -> dict[str, dict[str, Quantity]]:
        """Return name of a log to friction term of a joint to its value according to that log.

        It is empty for a single log. The errors are those due to the noise of each log.
        """
        friction = self.friction_of_logs
        if friction is None:
            return {}
        terms = friction.terms_of(owner)
        values = friction.between.values
        errors = friction.between.errors
        by_log: dict[str, dict[str, Quantity]] = {}
        for row, log in enumerate(friction.logs):
            by_log[log] = {}
            for term, index in terms.items():
                value = float(values[row, index])
                by_log[log][term] = Quantity(value, float(errors[row, index]))
        return by_log

    def _other_day_friction(self, owner: str) -> dict[str, Quantity]:
        """Return friction term of a joint to its estimate, with the error for another day's log.

        This error includes the scatter of friction from log to log. It is empty for a single log.
        """
        friction = self.friction_of_logs
        if friction is None:
            return {}
        values, errors = np.array([self.quantity(name) for name in friction.names]).T
        next_errors = friction.between.next_log(errors)
        terms = friction.terms_of(owner).items()
        return {
            term: Quantity(float(values[k]), float(next_errors[k])) for term, k in terms
        }

    def _friction_terms(self) -> dict[str, list[str]]:
        """Return joint or motor to the names of its friction terms in the friction model.

        Terms that are estimated or held at a bound count; terms that only a prior allows for (the
        nuisances with the cause "friction model") do not.
        """
        nuisances = set[str]()
        for group in self.fit.unknowns.groups:
            if group.cause == FRICTION:
                nuisances.update(group.names)
        sensor_terms = {"scale", "zero", "drift"}
        terms: dict[str, list[str]] = {}
        for name in (
            *self.fit.unknowns.estimated_names,
            *self.fit.unknowns.names_at_bound,
        ):
            term, bracket, owner = name.partition("[")
            if bracket and name not in nuisances and term not in sensor_terms:
                terms.setdefault(owner[:-1], []).append(term)
        return terms

    def _directional_coulomb(
        self, joint: str, terms: Mapping[str, Quantity]
    ) -> tuple[Quantity, Quantity] | None:
        """Return (Coulomb friction forward, backward) of a joint [N m]: level plus, minus offset.

        None where no offset or no level is estimated, or the level is held at a bound.

        Args:
            terms: friction term of the joint to its estimate.
        """
        level = "coulomb" if "coulomb" in terms else "sigmoid"
        if level not in terms or "offset" not in terms or np.isnan(terms[level].error):
            return None
        selection = self.selection_matrix([f"{level}[{joint}]", f"offset[{joint}]"])
        spread = np.sqrt(
            np.maximum(np.diag(_SIGNS @ self.errors.of(selection)[0] @ _SIGNS.T), 0.0)
        )
        values = _SIGNS @ [terms[level].value, terms["offset"].value]
        forward, backward = zip(values.tolist(), spread.tolist())
        return Quantity(*forward), Quantity(*backward)

    def body_names(self) -> set[str]:
        """Return the names of all estimated parameters of bodies."""
        names = set[str]()
        for indices, _ in self.fit.unknowns.bodies.values():
            names.update(self.fit.columns.names[k] for k in indices)
        return names

    def sensors(self) -> dict[str, Quantity]:
        """Return name to estimate of every parameter that is neither of a body nor of the friction
        model: torque scales, encoder zeros, drift, tilt, delay, and nuisances of friction.
        """
        excluded = self.body_names()
        for owner, terms in self._friction_terms().items():
            excluded.update(f"{term}[{owner}]" for term in terms)
        names = self.fit.unknowns.estimated_names
        return {name: self.quantity(name) for name in names if name not in excluded}


def model_file(answer: Answer) -> tuple[ModelFile, tuple[str, ...]]:
    """Return (contents of the model file, sentences for the user on what the file leaves out).

    The answer has to contain the fit for a file (``Answer.file``).
    """
    assert answer.file is not None
    file = answer.file
    fit = answer.file.fit
    robot = answer.robot
    # A file holds fewer friction terms than the friction of logs, and states them once.
    file_answer = replace(
        answer, fit=fit, file=None, errors=file.errors, friction_of_logs=None
    )
    thetas = fit.columns.thetas(fit.values)
    spread = np.zeros_like(thetas)
    for body in file_answer.links():
        spread[robot.joint_names.index(str(body.joint))] = body.errors
    joints = {}
    notes = []
    unchanged_parts = fit.question.unchanged_parts
    for owner, joint in file_answer.joints():
        written = {
            name: figure for name, figure in joint.terms.items() if name != "offset"
        }
        rotor = joint.model_terms.get("armature", 0.0)
        if fit.choice.rotors.get(owner, rotor) != rotor:
            written["armature"] = answer.quantity(f"armature[{owner}]")
        if written:
            joints[owner] = written
        elif owner in robot.joint_names:
            notes.append(
                f"{owner} does not move fast enough in these logs: nothing is learnt of its "
                "friction and rotor inertia, the model's own stay"
            )
    notes = [
        *([] if FILE_FRICTION in unchanged_parts else notes),
        *_offset_notes(file_answer, file.validation_after),
    ]
    turned = fit.next_point.gravity if fit.unknowns.increments else None
    if turned is not None and np.array_equal(turned, gravity_vector(robot)):
        turned = None
    written_file = ModelFile(
        thetas,
        spread,
        joints,
        turned,
        file.validation_before,
        file.validation_after,
        unchanged=tuple(sorted(unchanged_parts)),
        motors=fit.choice.couplings,
    )
    if file.urdf is not None:
        urdf, _ = model_file(replace(answer, file=file.urdf))
        return replace(written_file, urdf_file=urdf), (
            *notes,
            _urdf_note(written_file, urdf),
        )
    return written_file, tuple(notes)


def _urdf_note(file: ModelFile, urdf: ModelFile) -> str:
    """Return a sentence that compares a URDF with the MJCF that is written beside it.

    Args:
        file: the MJCF, with motors that turn several joints.
        urdf: the URDF, which cannot hold these motors.
    """
    shares = []
    for test in (urdf.validation_after, file.validation_after):
        error = None if test is None else test.relative_error
        shares.append("" if error is None else percent(error))
    motors = ", ".join(motor.name for motor in file.motors)
    return (
        f"a URDF cannot hold the motor that turns with {motors}, or rotor inertia: "
        f"{MODEL_NAMES['mjcf']} holds both (torque error on held-out data {shares[1]}), "
        f"{MODEL_NAMES['urdf']} beside it lacks them ({shares[0]})"
    )


def _offset_notes(file: Answer, test: Validation) -> Iterator[str]:
    """Yield a sentence on torque offsets where they are larger than the file's held-out error.

    No model file can hold such offsets of torque sensors.

    Args:
        file: the fit for the model file and its errors, as an answer.
        test: held-out error of the model file.
    """
    fit = file.fit
    counts = zip(fit.columns.joints, sample_counts(fit.evidence.total))
    free = {j: count for j, count in counts if j not in fit.choice.offsets}
    names = fit.unknowns.estimated_names
    offsets = {
        j: file.quantity(f"offset[{j}]") for j in free if f"offset[{j}]" in names
    }
    squares = sum(offsets[joint].value ** 2 * free[joint] for joint in offsets)
    squared = squares / np.sum(fit.evidence.squared_torque)
    error = test.relative_error or 0.0
    if squared > max(HARMLESS, error) ** 2:
        listed = ", ".join(
            f"{joint} {with_error(*offset, 'N·m')}" for joint, offset in offsets.items()
        )
        yield (
            f"no model file holds an offset of a torque sensor ({listed}), or friction that is "
            "larger in one direction: with it left in, the written file's torque error on "
            f"held-out data is {percent(float(np.sqrt(squared + error**2)))}"
        )


def written_payload(answer: Answer) -> tuple[Array, str]:
    """Return the payload (10,) to write into a model, and why its inertia is not identified.

    The reason is "" where the inertia is identified. Otherwise the payload is replaced by a ball of
    aluminium of the estimated mass at the estimated centre of mass. The parameters are in the frame
    of the terminal body.
    """
    theta = answer.fit.values[answer.fit.columns.indices(PAYLOAD_NAMES)]
    mass, com, _ = spatial.com_from_theta(theta)
    body = answer.body("payload", answer.selection_matrix(PAYLOAD_NAMES), theta, None)
    if mass <= 0.0 or is_inertia_known(body):
        return theta, ""
    moments, errors, _ = principal_moments(body)
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    reason = f"the payload's principal moments of inertia, {listed} kg·m², are not told from zero"
    if not np.all(np.isfinite(errors)):
        reason = "these torques do not show the payload's inertia"
    return spatial.aluminium_ball(mass, com), reason


def estimate_of(answer: Answer) -> Estimate:
    """Return all k estimated parameters and their errors as a record.

    The parameters of interest come first: the terminal link, a payload, friction, an estimated
    delay and tilt. The nuisances follow: the other links, and the sensors.
    """
    fit = answer.fit
    errors = answer.errors
    names = fit.unknowns.estimated_names
    sensors = answer.sensors()
    increments = {DELAY_NAME, "tilt_1", "tilt_2"} & set(fit.unknowns.increments)
    links = answer.body_names() - set(PARAMETER_NAMES)
    nuisances = links.union(sensors) - increments
    interest = [name for name in names if name not in nuisances]
    others = [name for name in names if name in nuisances]
    order = [names.index(name) for name in (*interest, *others)]
    residuals = residual_errors(fit.evidence.total, fit.values)
    return Estimate(
        names=tuple(names[k] for k in order),
        values=fit.final[fit.unknowns.estimated][order],
        identifiability=analyse_identifiability(restrict(fit.evidence.total, interest)),
        **residuals,
        method="wls",
        covariance=errors.total.covariance[np.ix_(order, order)],
        standard_errors=errors.total.standard_errors[order],
        noise_per_joint=fit.noise_per_joint,
        effective_samples=dict(zip(residuals["samples"], errors.total.effective)),
        constrained=fit.is_constrained,
    )


# Number of random poses from which the structural base parameters are computed.
_RANDOM_POSES = 60
# Length of a typical link, from which the typical sizes of its parameters follow [m].
_UNIT_LENGTH = 0.3


def base_parameters(fit: Fit, errors: FitErrors) -> BaseParameters:
    """Return the base parameters of all links that the data identifies, with standard errors.

    Args:
        errors: of the k estimated parameters of the fit.
    """
    names = fit.columns.bodies()
    order = np.sort(np.concatenate([names[n] for n in names if n != "payload"]))
    unknowns = fit.unknowns
    data = fit.evidence.total.equation_blocks
    rows = triangle_of(block[:, order] for block in data(fit.weights))
    combinations = base_combinations(rows, parameter_scale(len(order) // 10))
    others = np.setdiff1d(unknowns.estimated, order)
    inside = np.flatnonzero(np.isin(order, unknowns.estimated))
    change = combinations.matrix[:, inside]
    at = np.searchsorted(unknowns.estimated, order[inside])
    spread = change @ errors.total.covariance[np.ix_(at, at)] @ change.T
    # Priors of sensors are needed: free torque scales would explain all torques by themselves.
    priors = [
        g.prior_rows(fit.columns.names) for g in unknowns.groups if g.cause != LINKS
    ]
    selected = np.concatenate((others, [-1], order[combinations.leading]))
    rows = triangle_of(
        block[:, selected] for block in itertools.chain(data(fit.weights), priors)
    )
    nuisance_columns, right_side, base_columns = np.split(
        rows, (len(others), len(others) + 1), axis=1
    )
    is_essential = essential(base_columns, nuisance_columns, right_side[:, 0])
    return BaseParameters(
        combinations=combinations.names([fit.columns.names[index] for index in order]),
        values=combinations.matrix @ fit.values[order],
        standard_errors=np.sqrt(np.maximum(np.diag(spread), 0.0)),
        structural_rank=structural_base(fit.columns.robot).rank,
        essential=tuple(is_essential.tolist()),
    )


def parameter_scale(links: int) -> Array:
    """Return (10 links,) typical sizes of the parameters of links of 1 kg and 0.3 m [SI].

    Args:
        links: number of links.
    """
    return np.tile(spatial.parameter_scale(1.0, _UNIT_LENGTH), links)


def structural_base(robot: RobotModel, seed: int = 0) -> BaseCombinations:
    """Return the base parameters that torques of all joints can identify with the best motion.

    They are computed from the regressor of random poses, speeds and accelerations. The parameters
    are the ten of each link with mass, base to terminal.

    Args:
        seed: of the random motion.
    """
    rng = np.random.default_rng(seed)
    shape = (_RANDOM_POSES, robot.n_joints)
    q = robot.reference + rng.uniform(-np.pi, np.pi, shape)
    moves = LinkDynamics(robot).motion(
        q, rng.normal(0.0, 3.0, shape), rng.normal(0.0, 3.0, shape)
    )
    links = [k for k, link in enumerate(robot.links) if link.has_mass]
    columns = moves.columns(links)
    return base_combinations(
        columns.reshape(-1, columns.shape[-1]), parameter_scale(len(links))
    )
