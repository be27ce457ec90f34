"""From a fit to its answer: bodies, joints, sensors and the model file, with their errors.

Shapes: the arm's chain has n joints; a fit has p parameters (``Columns.names``), of which k are
estimated (``Unknowns.estimated``, ascending). A body has ten inertial parameters in the order of
``PARAMETER_NAMES``: mass [kg], first moments [kg m], inertia about its frame's origin [kg m^2].
Parameters of joints, motors and torque sensors are named "term[joint]"; those of bodies, tilt and
delay have no brackets.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.equations import split_name
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES, gravity_vector
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability
from robot_sysid.estimation.algebra.least_squares import (
    residual_errors,
    restrict,
    sample_counts,
)
from robot_sysid.estimation.choices import Errors
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import FitErrors
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.question import FILE_FRICTION
from robot_sysid.estimation.trust import HARMLESS
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
from robot_sysid.results.body_errors import is_inertia_known, principal_moments
from robot_sysid.results.record import BodyEstimate, JointEstimate, ModelFile, Quantity

# Rows that combine (Coulomb friction, offset) to the friction forward and backward.
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]])


@dataclass(frozen=True)
class Answer:
    """An estimate with its errors and tests: of an identified arm, or of a model file.

    The functions of ``estimation.identify`` return it, and ``estimation.build_result`` makes the
    ``Result`` record from it.

    Attributes:
        fit: the estimate of all p parameters.
        errors: covariance of the k estimated parameters, by cause.
        validation: held-out error of the recordings that were fitted; of a model file with the
            offsets of torque sensors subtracted.
        candidates: joint to friction model to its held-out root mean square error [N m]; empty
            where no friction models were compared.
        file: the fit for a model file; None where no file is written. Of an MJCF that is written
            for a given URDF, the fit for the URDF that is written beside it.
        model_validation: of a model file, the held-out error of the given model, with the offsets
            of torque sensors subtracted; else None.
        tests: errors in predicting the torques of logs that were not fitted, one per log.
        acceleration_error: expected error of the acceleration, as a share of the acceleration.
        notes: sentences for the user.
        missed_friction: see ``trust.missed_friction``.
    """

    fit: Fit
    errors: FitErrors
    validation: Validation
    candidates: Errors = field(default_factory=dict)
    file: Answer | None = None
    model_validation: Validation | None = None
    tests: tuple[Validation, ...] = ()
    acceleration_error: float = 0.0
    notes: tuple[str, ...] = ()
    missed_friction: str = ""

    @property
    def robot(self) -> RobotModel:
        """The arm as its model states it, before the identification."""
        return self.fit.columns.robot

    @cached_property
    def share(self) -> Array:
        """Share (k,), 0 to 1, of each estimated value that comes from the data, not the priors."""
        return self.errors.share(self.fit)

    def selection_matrix(self, names: Sequence[str]) -> Array:
        """Return the 0/1 matrix (m, k) that selects m named parameters from the k estimated ones.

        Every name has to be that of an estimated parameter.
        """
        return self._select(self.fit.columns.indices(names))

    def _select(self, indices: NDArray[np.int64]) -> Array:
        """Return the 0/1 matrix (m, k) that selects parameters by their index among all p."""
        estimated = self.fit.unknowns.estimated
        return np.eye(len(estimated))[np.searchsorted(estimated, indices)]

    def body(
        self, name: str, combinations: Array, theta: Array, model_theta: Array | None
    ) -> BodyEstimate:
        """Return the estimate of a body, with the errors of its ten inertial parameters.

        Args:
            name: name of the body.
            combinations: (10, k) matrix from the k estimated parameters to the body's parameters,
                from which the errors follow.
            theta: (10,) estimated values of the body's parameters.
            model_theta: (10,) the body's parameters in the model; None where the model lacks it.
        """
        covariance, noise_errors, budget = self.errors.of(combinations, theta)
        # The mean share of the estimated values that a parameter is made of.
        weight = np.abs(combinations)
        share = weight @ self.share / np.maximum(np.sum(weight, axis=1), 1e-300)
        return BodyEstimate(
            name=name,
            inertial=InertialParameters(theta),
            covariance=covariance,
            is_determined=self.errors.are_identified(combinations),
            noise_errors=noise_errors,
            budget=budget,
            data_share=np.clip(share, 0.0, 1.0),
            prior=None if model_theta is None else InertialParameters(model_theta),
        )

    def links(self) -> Iterator[BodyEstimate]:
        """Yield the estimate of every link whose parameters were estimated, base to terminal."""
        # Of several joints that move one body, the last one stands here.
        link_indices = {link.body_name: k for k, link in enumerate(self.robot.links)}
        for name, (indices, _) in self.fit.unknowns.bodies.items():
            if name in link_indices:
                link_index = link_indices[name]
                theta = self.fit.values[indices]
                model_theta = self.robot.links[link_index].theta
                body = self.body(name, self._select(indices), theta, model_theta)
                yield replace(body, joint=self.robot.joint_names[link_index])

    def quantity(self, name: str) -> Quantity:
        """Return a named parameter in SI units with its standard error.

        ``name`` is that of an estimated parameter, or of one that is held at a bound; the error of
        the latter is NaN. Another name raises a ``ValueError``.
        """
        fit = self.fit
        error = np.nan
        if name not in fit.unknowns.names_at_bound:
            row = fit.unknowns.estimated_names.index(name)
            error = self.errors.total.standard_errors[row]
        return Quantity(fit.value(name), float(error))

    def joints(self) -> Iterator[tuple[str, JointEstimate]]:
        """Yield (name, friction and rotor inertia) of each chain joint, base to terminal.

        The motors that turn several joints follow. Of these, the model has friction and rotor
        inertia only where it states the motor as a fixed tendon.
        """
        robot = self.robot
        choice = self.fit.choice
        for index, joint in enumerate(robot.joint_names):
            terms = self._friction(joint)
            model_terms = {
                "coulomb": float(robot.friction.coulomb[index]),
                "viscous": float(robot.friction.viscous[index]),
                "armature": float(robot.armature[index]),
            }
            estimate = JointEstimate(
                friction_model=choice.friction[index].name if terms else "none",
                terms=terms,
                model_terms=model_terms,
                noise=self.fit.noise_per_joint.get(joint, np.nan),
                directional_coulomb=self._directional_coulomb(joint, terms),
            )
            yield joint, estimate
        for motor in choice.couplings:
            terms = self._friction(motor.name)
            model_terms = {}
            if motor.tendon is not None:
                model_terms = dict(zip(motor.terms, motor.model.tolist()))
            yield (
                motor.name,
                JointEstimate("-".join(terms) or "none", terms, model_terms),
            )

    @cached_property
    def _friction_names(self) -> list[str]:
        """Names of all friction terms of the friction model, estimated or held at a bound.

        Terms that only a prior allows for (the cause "friction model") are not among them.
        """
        unknowns = self.fit.unknowns
        names = []
        for name in (*unknowns.estimated_names, *unknowns.names_at_bound):
            term, owner = split_name(name)
            is_friction = owner and term not in ("scale", "zero", "drift")
            if is_friction and name not in unknowns.nuisance_friction:
                names.append(name)
        return names

    def _friction(self, owner: str) -> dict[str, Quantity]:
        """Return friction term to its estimate, for the joint or motor named ``owner``."""
        terms = {}
        for name in self._friction_names:
            term, member = split_name(name)
            if member == owner:
                terms[term] = self.quantity(name)
        return terms

    def _directional_coulomb(
        self, joint: str, terms: Mapping[str, Quantity]
    ) -> tuple[Quantity, Quantity] | None:
        """Return (Coulomb friction forward, backward) of a joint [N m]: level plus, minus offset.

        None where no offset or no level is estimated, or the level is held at a bound.

        Args:
            joint: name of the joint.
            terms: friction term of the joint to its estimate.
        """
        level = "coulomb" if "coulomb" in terms else "sigmoid"
        if level not in terms or "offset" not in terms or np.isnan(terms[level].error):
            return None
        selection = self.selection_matrix([f"{level}[{joint}]", f"offset[{joint}]"])
        covariance, *_ = self.errors.of(selection)
        variances = np.diag(_SIGNS @ covariance @ _SIGNS.T)
        spread = np.sqrt(np.maximum(variances, 0.0))
        values = _SIGNS @ [terms[level].value, terms["offset"].value]
        forward, backward = map(Quantity, values.tolist(), spread.tolist())
        return forward, backward

    def body_parameter_names(self) -> set[str]:
        """Return the names of all estimated parameters of bodies: links and payload."""
        names = set[str]()
        for indices, _ in self.fit.unknowns.bodies.values():
            names.update(self.fit.columns.names[k] for k in indices)
        return names

    def sensors(self) -> dict[str, Quantity]:
        """Return name to estimate of all parameters that are neither of bodies nor of friction.

        These are torque scales, encoder zeros, drift, tilt and delay. Friction terms that only a
        prior allows for, which are not in the friction model, are among them, too.
        """
        excluded = self.body_parameter_names().union(self._friction_names)
        names = self.fit.unknowns.estimated_names
        return {name: self.quantity(name) for name in names if name not in excluded}


def model_file(answer: Answer) -> tuple[ModelFile, tuple[str, ...]]:
    """Return (contents of the model file, sentences for the user on what the file leaves out).

    The answer has to contain the fit for a file (``Answer.file``).
    """
    file = answer.file
    assert file is not None and file.model_validation is not None
    fit = file.fit
    robot = answer.robot
    unchanged_parts = fit.question.unchanged_parts
    thetas = fit.columns.thetas(fit.values)
    theta_errors = np.zeros_like(thetas)
    for body in file.links():
        theta_errors[robot.joint_names.index(str(body.joint))] = body.errors
    joints = {}
    notes = []
    for owner, terms in _file_terms(answer, file):
        if terms:
            joints[owner] = terms
        elif owner in robot.joint_names and FILE_FRICTION not in unchanged_parts:
            notes.append(
                f"{owner} does not move fast enough in these logs: its friction and rotor inertia "
                "are not identifiable, the model's values are kept"
            )
    notes += _offset_notes(file)
    # None, where gravity was not estimated or has not changed, keeps the file's own.
    gravity = None
    if fit.unknowns.increments:
        gravity = fit.next_point.gravity
        if np.array_equal(gravity, gravity_vector(robot)):
            gravity = None
    # Beside an MJCF that is written for a URDF's arm, a URDF is written, too.
    urdf = None
    if file.file is not None:
        urdf, _ = model_file(replace(answer, file=file.file))
        motors = [motor.name for motor in fit.choice.couplings]
        omissions = [f"the motor that turns with {motor}" for motor in motors]
        rotors = [n for n in robot.joint_names if "armature" in joints.get(n, {})]
        if rotors:
            is_all = len(rotors) == robot.n_joints
            owners = "all joints" if is_all else ", ".join(rotors)
            omissions.append(f"the rotor inertia of {owners}")
        urdf = replace(urdf, omissions=tuple(omissions))
        shares = []
        for validation in (file.validation, file.file.validation):
            error = validation.relative_error
            shares.append("not known" if error is None else percent(error))
        notes.append(
            f"{MODEL_NAMES['urdf']} lacks {' and '.join(omissions)}, which no URDF can hold; its "
            "links take up the torque of what it lacks, so that their masses differ from the "
            f"identified ones; {MODEL_NAMES['mjcf']} holds everything (torque error on held-out "
            f"data {shares[0]}, of the URDF {shares[1]})"
        )
    written_file = ModelFile(
        thetas,
        theta_errors,
        joints,
        gravity,
        file.model_validation,
        file.validation,
        unchanged=tuple(sorted(unchanged_parts)),
        motors=fit.choice.couplings,
        urdf_file=urdf,
    )
    return written_file, tuple(notes)


def _file_terms(
    answer: Answer, file: Answer
) -> Iterator[tuple[str, dict[str, Quantity]]]:
    """Yield (joint or motor, its friction terms and rotor inertia in the model file).

    The fit for a file holds rotors that ``answer``, the fit of all effects, has estimated. Such a
    rotor is written, with its error, where it differs from the model's. A torque sensor's offset is
    not friction, and is not written.

    Args:
        answer: the fit of all effects with its errors.
        file: the fit for the model file (``Answer.file``).
    """
    for owner, joint in file.joints():
        terms = dict(joint.terms)
        terms.pop("offset", None)
        model_rotor = joint.model_terms.get("armature", 0.0)
        rotor = file.fit.choice.rotors.get(owner, model_rotor)
        if rotor != model_rotor:
            error = answer.quantity(f"armature[{owner}]").error
            terms["armature"] = Quantity(rotor, error)
        yield owner, terms


def _offset_notes(file: Answer) -> Iterator[str]:
    """Yield a sentence on torque offsets where they are larger than a model file's held-out error.

    No model file can hold such offsets of torque sensors. Offsets that are not significant, which
    ``Choice.offsets`` lists, do not count.

    Args:
        file: the fit for the model file, with its errors and held-out error.
    """
    fit = file.fit
    squares = 0.0
    phrases = []
    for joint, count in zip(fit.columns.joints, sample_counts(fit.evidence.total)):
        name = f"offset[{joint}]"
        if joint not in fit.choice.offsets and name in fit.unknowns.estimated_names:
            offset = fit.value(name)
            squares += offset**2 * count
            # Without an error: that of a fit with few terms says less than the table's.
            phrases.append(f"{joint} {offset:.2g} N·m")
    squared = squares / np.sum(fit.evidence.squared_torque)
    error = file.validation.relative_error or 0.0
    if squared > max(HARMLESS, error) ** 2:
        yield (
            f"no model file holds an offset of a torque sensor ({', '.join(phrases)}), or friction "
            "that is larger in one direction: with it left in, the written file's torque error on "
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
    combinations = answer.selection_matrix(PAYLOAD_NAMES)
    body = answer.body("payload", combinations, theta, model_theta=None)
    if mass <= 0.0 or is_inertia_known(body):
        return theta, ""
    moments, errors = principal_moments(body)
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    reason = (
        f"the payload's principal moments of inertia, {listed} kg·m², do not differ significantly "
        "from zero"
    )
    if not np.all(np.isfinite(errors)):
        reason = "the payload's inertia is not identifiable from these torques"
    return spatial.aluminium_ball(mass, com), reason


def estimate_of(answer: Answer) -> Estimate:
    """Return all k estimated parameters and their errors as a record.

    The parameters of interest come first: the terminal link, a payload, friction, an estimated
    delay and tilt. The nuisances follow: the other links, and the sensors. A delay or tilt that
    only a prior allows for is no increment of the linearisation point, and a nuisance.
    """
    fit = answer.fit
    errors = answer.errors
    names = fit.unknowns.estimated_names
    increments = {DELAY_NAME, *TILT_NAMES}.intersection(fit.unknowns.increments)
    links = answer.body_parameter_names().difference(PARAMETER_NAMES)
    nuisances = links.union(answer.sensors()) - increments
    # Sorting is stable: both groups keep their order.
    order = sorted(range(len(names)), key=lambda k: names[k] in nuisances)
    ordered_names = tuple(names[k] for k in order)
    interest = ordered_names[: len(names) - len(nuisances.intersection(names))]
    # Three fields of the record: rmse, rmse_per_joint and samples (per joint).
    residuals = residual_errors(fit.evidence.total, fit.values)
    return Estimate(
        names=ordered_names,
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
