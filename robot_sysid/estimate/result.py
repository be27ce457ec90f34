"""From fits to the Result: bodies, joints, sensors, the model file, the verdict, notes, traces.

Shapes: n joints of the chain, J joints with equations; k estimated parameters; a body has ten
inertial parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import link_names, split_name
from robot_sysid.dynamics.inverse_dynamics import gravity_vector
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimate.file_fit import FileFit
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.held_out import held_out_logs, validation
from robot_sysid.estimate.identifiability import analyse_identifiability
from robot_sysid.estimate.links import LINK_KINDS
from robot_sysid.estimate.options import FILE_FRICTION
from robot_sysid.estimate.questions import CHANGES
from robot_sysid.estimate.terms import (
    FRICTION,
    LAST_LINK,
    LINKS,
    MOTORS,
    PAYLOAD,
    PAYLOAD_NAMES,
)
from robot_sysid.estimate.trust import (
    HARMLESS,
    UNEXPLAINED,
    UNUSUAL,
    Judgement,
    find_misfits,
    first,
    implausible_joints,
    implausible_link,
    judge_file,
    missed_friction,
    unexplained_share,
    wrong_links,
)
from robot_sysid.records import (
    Array,
    DataOrigin,
    Estimate,
    InertialParameters,
    JointLimits,
    Validation,
    WrongLink,
)
from robot_sysid.records.data import Traces
from robot_sysid.records.file_access import MODEL_NAMES
from robot_sysid.records.messages import percent, with_error
from robot_sysid.results.record import (
    LINK,
    BodyEstimate,
    JointEstimate,
    ModelFile,
    Quantity,
    Result,
    Verdict,
)
from robot_sysid.signals.process import ProcessedSignals

# Distance of an encoder zero from zero, in standard errors, above which it is significant.
_CLEAR = 3.0
# Size of an encoder zero up to which no note is added, even if it is significant [rad].
_SMALL_ZERO = 1e-3
# Rows from which identifiability is computed: more do not change it.
_MOST_ROWS = 1500


def link_result(
    fitted: Fit,
    file: FileFit,
    tests: Sequence[Validation],
    origin: DataOrigin,
    notes: Sequence[str] = (),
) -> Result:
    """Return the result for an arm from recordings without a payload.

    Its verdict is that of the first reason against the fit, the links or the model file; without
    such a reason, that on the model file. Where too much torque is unexplained (``UNEXPLAINED``),
    or the given friction model misses terms that the torques show, it is never better than
    ``Verdict.TORQUES_ONLY``.

    Args:
        fitted: the fit of all terms.
        file: the fit of the model file.
        tests: errors on logs that were not fitted.
        origin: where the recordings come from.
        notes: sentences for the user so far.
    """
    robot = fitted.arm.robot
    tests = (validation(fitted), *tests, *held_out_logs(fitted))
    errors = [signals.acceleration_error for signals in signals_of(fitted)]
    acceleration_error = max(errors, default=0.0)
    common = common_result(fitted, origin, LINK)
    *other_links, last_link = common.links.values()
    findings = [*find_misfits(fitted, tests, acceleration_error)]
    share, sentence = unexplained_share(fitted)
    all_notes = [*robot.notes, *notes]
    if share > UNUSUAL:
        all_notes.append(sentence)
    findings += implausible_link(robot, last_link)
    findings += implausible_joints(robot, common.joints, fitted.torque)
    written, file_notes = model_file(fitted, file)
    all_notes += file_notes
    judgement = file_verdict(file)
    verdict, _ = judgement
    if not verdict.is_trustworthy:
        findings.append(judgement)
    status, reasons = first(findings, verdict)
    missed = missed_friction(fitted)
    doubts = [sentence] if share > UNEXPLAINED else []
    doubts += [missed] if missed else []
    if doubts:
        # A file that clearly predicts better is written all the same, for torques only.
        if status is Verdict.BETTER:
            status = Verdict.TORQUES_ONLY
        else:
            status, _ = first(findings, Verdict.UNEXPLAINED)
        reasons = (*reasons, *doubts)
    # Links that took up the torque of missed friction say nothing of the model's.
    contradicted = () if missed else tuple(wrong_links(other_links))
    all_notes += map(_wrong_link_line, contradicted)
    all_notes += result_notes(fitted, written, missed)
    return replace(
        common,
        verdict=status,
        reasons=reasons,
        wrong_links=contradicted,
        file=written,
        validation=tests,
        notes=tuple(dict.fromkeys(all_notes)),
    )


def _wrong_link_line(link: WrongLink) -> str:
    """Return a sentence for the user on a link of the model that the recordings contradict."""
    moment = with_error(link.first_moment, link.error, "kg m")
    return (
        f"{link.name} of the model is probably wrong: its mass times the distance of its centre of "
        f"mass is {moment}, in the model {link.first_moment_of_model:.3g}; the torques do not "
        "separate mass and distance"
    )


def file_verdict(file: FileFit) -> Judgement:
    """Return (verdict, reason) on the written file compared with the given model."""
    return judge_file(file.before, file.after)


def common_result(fitted: Fit, origin: DataOrigin, question: str) -> Result:
    """Return a result with the fields that do not depend on whether a payload is identified.

    Its verdict, ``Verdict.OK``, is a placeholder that callers replace.
    """
    robot = fitted.arm.robot
    joints: dict[str, JointEstimate] = {}
    motors: dict[str, JointEstimate] = {}
    for name, joint in joint_estimates(fitted):
        (joints if name in robot.joint_names else motors)[name] = joint
    signals = signals_of(fitted)
    scales = fitted.question.link_scales
    return Result(
        robot=robot,
        question=question,
        estimate=_estimate(fitted),
        verdict=Verdict.OK,
        torques="chain" if len(fitted.arm.joints) == robot.n_joints else "terminal",
        data=origin,
        links={link.name: link for link in link_estimates(fitted)},
        joints=joints,
        couplings=motors,
        sensors=sensors(fitted),
        friction_model="-".join(fitted.question.friction) or "none",
        cutoff=signals[0].cutoff if signals else None,
        link_scales={name: getattr(scales, name) for name in LINK_KINDS},
    )


def signals_of(fitted: Fit) -> list[ProcessedSignals]:
    """Return the low-passed signals of all recordings; resting poses have none."""
    return [r.signals for r in fitted.recordings if r.signals is not None]


def _select(fitted: Fit, names: Sequence[str]) -> Array:
    """Return the 0/1 matrix (m, k) that selects named estimated parameters."""
    return np.eye(len(fitted.names))[fitted.at(names)]


def body_estimate(
    fitted: Fit,
    name: str,
    combinations: Array,
    theta: Array,
    model_theta: Array | None,
    joint: str | None = None,
) -> BodyEstimate:
    """Return a body whose parameters are combinations (10, k) of the estimated ones.

    Args:
        theta: (10,) their values.
        model_theta: (10,) in the model; None where the model lacks the body.
        joint: the joint that moves the body.
    """
    weight = np.abs(combinations)
    share = weight @ fitted.share() / np.maximum(np.sum(weight, axis=1), 1e-300)
    hidden = weight[:, fitted.is_hidden]
    return BodyEstimate(
        theta=theta,
        name=name,
        covariance=combinations @ fitted.covariance @ combinations.T,
        is_determined=np.max(hidden, axis=1, initial=0.0) < 1e-9,
        budget=fitted.budget(combinations),
        data_share=np.clip(share, 0.0, 1.0),
        prior=None if model_theta is None else InertialParameters(model_theta),
        joint=joint,
    )


def link_estimates(fitted: Fit) -> Iterator[BodyEstimate]:
    """Yield the estimate of every link whose parameters were estimated, base to terminal."""
    robot = fitted.arm.robot
    estimated = set(fitted.names)
    for index, link in enumerate(robot.links):
        names = link_names(robot, index)
        if index == robot.n_joints - 1:
            names = PARAMETER_NAMES
        if estimated.issuperset(names):
            theta = fitted.values[fitted.at(names)]
            yield body_estimate(
                fitted,
                link.body_name,
                _select(fitted, names),
                theta,
                link.theta,
                robot.joint_names[index],
            )


def quantity(fitted: Fit, name: str) -> Quantity:
    """Return a named parameter with its standard error, NaN where it is held at a bound."""
    if name in fitted.at_bound:
        return Quantity(fitted.by_name[name], math.nan)
    return Quantity(
        fitted.by_name[name], float(fitted.errors[fitted.names.index(name)])
    )


def joint_estimates(fitted: Fit) -> Iterator[tuple[str, JointEstimate]]:
    """Yield (name, friction and rotor inertia) of each chain joint, then of motors of several."""
    arm = fitted.arm
    terms: dict[str, dict[str, Quantity]] = {}
    for term in fitted.equations.terms:
        if term.cause in (FRICTION, MOTORS):
            for name in term.names:
                kind, owner = split_name(name)
                terms.setdefault(owner, {})[kind] = quantity(fitted, name)
    for joint in arm.robot.joint_names:
        of_joint = terms.get(joint, {})
        of_model = {
            kind: arm.model[f"{kind}[{joint}]"]
            for kind in ("coulomb", "viscous", "armature")
        }
        yield (
            joint,
            JointEstimate(
                friction_model="-".join(fitted.question.friction)
                if of_joint
                else "none",
                terms=of_joint,
                model_terms=of_model,
                noise=fitted.noise_per_joint.get(joint, math.nan),
            ),
        )
    for motor in arm.motors:
        if motor.name in terms:
            of_model = {}
            if motor.tendon is not None:
                of_model = dict(zip(motor.terms, motor.model.tolist()))
            of_motor = terms[motor.name]
            yield motor.name, JointEstimate("-".join(of_motor), of_motor, of_model)


def sensors(fitted: Fit) -> dict[str, Quantity]:
    """Return name to estimate of all parameters that are neither of bodies nor of friction."""
    excluded = (LINKS, LAST_LINK, PAYLOAD, FRICTION, MOTORS)
    values: dict[str, Quantity] = {}
    for term in fitted.equations.terms:
        if term.cause not in excluded:
            values.update((name, quantity(fitted, name)) for name in term.names)
    return values


def _estimate(fitted: Fit) -> Estimate:
    """Return all k estimated parameters and their errors as a record.

    The parameters of interest come first: the terminal link, a payload, friction.
    """
    interest: list[str] = []
    nuisances: list[str] = []
    for term in fitted.equations.terms:
        is_wanted = term.cause in (LAST_LINK, PAYLOAD, FRICTION)
        (interest if is_wanted else nuisances).extend(term.names)
    ordered = (*interest, *nuisances)
    order = fitted.at(ordered)
    counts = np.sum(fitted.sums.counts, axis=0)
    squares = fitted.sums.squared_residuals(fitted.full)
    rms = np.sqrt(squares / np.maximum(counts, 1.0))
    joints = fitted.sums.joints
    return Estimate(
        names=ordered,
        values=fitted.values[order],
        identifiability=analyse_identifiability(
            _rows(fitted, interest), interest, joints[-1]
        ),
        rmse=float(np.sqrt(np.sum(squares) / max(float(np.sum(counts)), 1.0))),
        rmse_per_joint=dict(zip(joints, rms.tolist())),
        samples=dict(zip(joints, counts.astype(int).tolist())),
        standard_errors=fitted.errors[order],
        noise_per_joint=fitted.noise_per_joint,
    )


def _rows(fitted: Fit, names: Sequence[str]) -> Array:
    """Return the rows (M, k) of named parameters, reduced to a triangle: at most ``_MOST_ROWS``."""
    wanted = set(names)
    terms = [
        term for term in fitted.arm.terms.values() if wanted.intersection(term.names)
    ]
    present = [name for term in terms for name in term.names]
    at = [present.index(name) for name in names]
    blocks = []
    for recording in fitted.recordings:
        step = max(1, sum(map(len, fitted.recordings)) // _MOST_ROWS)
        for rows in recording.chunks(len(present) * len(fitted.arm.joints)):
            columns = [term.columns(rows, fitted.point) for term in terms]
            shown = np.concatenate(columns, axis=2)[:, :, at][::step]
            used = recording.used[rows.span][:, fitted.arm.indices][::step]
            blocks.append(shown[used])
    return np.asarray(np.linalg.qr(np.concatenate(blocks), mode="r"))


def model_file(fitted: Fit, file: FileFit) -> tuple[ModelFile, list[str]]:
    """Return (contents of the model file, sentences for the user on what the file leaves out)."""
    robot = fitted.arm.robot
    thetas = file.fit.thetas
    theta_errors = np.zeros_like(thetas)
    for body in link_estimates(file.fit):
        theta_errors[robot.joint_names.index(str(body.joint))] = body.errors
    joints = {}
    notes = []
    for owner, terms in _file_terms(fitted, file):
        if terms:
            joints[owner] = terms
        elif owner in robot.joint_names and FILE_FRICTION not in file.unchanged:
            notes.append(
                f"{owner} does not move fast enough in these logs: its friction and rotor inertia "
                "are not identifiable, the model's values are kept"
            )
    notes += _offset_notes(file)
    urdf = None
    if file.urdf is not None:
        urdf, _ = model_file(fitted, file.urdf)
        omissions = [
            f"the motor that turns with {motor}" for motor in fitted.question.motors
        ]
        rotors = [
            name for name in robot.joint_names if "armature" in joints.get(name, {})
        ]
        if rotors:
            is_all = len(rotors) == robot.n_joints
            omissions.append(
                f"the rotor inertia of {'all joints' if is_all else ', '.join(rotors)}"
            )
        urdf = replace(urdf, omissions=tuple(omissions))
        shares = []
        for test in (file.after, file.urdf.after):
            error = test.relative_error
            shares.append("not known" if error is None else percent(error))
        notes.append(
            f"{MODEL_NAMES['urdf']} lacks {' and '.join(omissions)}, which no URDF can hold; its "
            "links take up the torque of what it lacks, so that their masses differ from the "
            f"identified ones; {MODEL_NAMES['mjcf']} holds everything (torque error on held-out "
            f"data {shares[0]}, of the URDF {shares[1]})"
        )
    motors = tuple(m for m in fitted.arm.motors if m.name in fitted.question.motors)
    written = ModelFile(
        thetas,
        theta_errors,
        joints,
        file.gravity,
        file.before,
        file.after,
        unchanged=file.unchanged,
        motors=motors if file.kind == "mjcf" else (),
        urdf_file=urdf,
    )
    return written, notes


def _file_terms(
    fitted: Fit, file: FileFit
) -> Iterator[tuple[str, dict[str, Quantity]]]:
    """Yield (joint or motor, its friction terms and rotor inertia in the model file).

    A rotor is written, with its error, where it differs from the model's. The offset of a torque
    sensor is not friction, and is not written. What is written has to hold on another day, too: the
    errors of friction have its change (``CHANGES``) in them.
    """
    for owner, joint in joint_estimates(file.fit):
        terms = {}
        for term, (value, error) in joint.terms.items():
            if term != "offset":
                terms[term] = Quantity(value, math.hypot(error, CHANGES * value))
        name = f"armature[{owner}]"
        model_rotor = fitted.arm.model.get(name, 0.0)
        rotor = file.rotors.get(owner, model_rotor)
        if rotor != model_rotor:
            # Without an estimate of its own, the joint has the rotor of a motor that it shares.
            is_own = name in fitted.names
            error = quantity(fitted, name).error if is_own else math.nan
            terms["armature"] = Quantity(rotor, error)
        yield owner, terms


def _offset_notes(file: FileFit) -> Iterator[str]:
    """Yield a sentence on torque offsets that are larger than a file's held-out error."""
    fitted = file.fit
    squares = 0.0
    phrases = []
    for row, joint in enumerate(fitted.arm.joints):
        name = f"offset[{joint}]"
        if name in fitted.names:
            offset = quantity(fitted, name)
            if abs(offset.value) > _CLEAR * offset.error:
                squares += offset.value**2 * float(np.sum(fitted.sums.counts[:, row]))
                phrases.append(f"{joint} {offset.value:.2g} N·m")
    squared = squares / float(np.sum(fitted.sums.squared_torque))
    error = file.after.relative_error or 0.0
    if squared > max(HARMLESS, error) ** 2:
        yield (
            f"no model file holds an offset of a torque sensor ({', '.join(phrases)}), or friction "
            "that is larger in one direction: with it left in, the written file's torque error on "
            f"held-out data is {percent(float(np.sqrt(squared + error**2)))}"
        )


def result_notes(fitted: Fit, file: ModelFile | None, missed: str) -> Iterator[str]:
    """Yield sentences for the user on friction, motors, encoder zeros and gravity."""
    left_out = fitted.question.options.left_out_terms
    if missed:
        yield missed
    elif left_out:
        yield f"not estimated, as the friction model is given without: {', '.join(left_out)}"
    for motor in fitted.arm.motors:
        if motor.tendon is None and motor.name in fitted.question.motors:
            yield f"a motor turns with {motor.name}: the torques give clear evidence of it"
    for name, zero in sensors(fitted).items():
        kind, joint = split_name(name)
        if kind == "zero" and abs(zero.value) > max(_CLEAR * zero.error, _SMALL_ZERO):
            yield (
                f"the log reads {joint} {1e3 * zero.value:.1f} ± {1e3 * zero.error:.1g} mrad too "
                "large; the links are those of the true positions"
            )
    if file is not None and file.gravity is not None:
        level = gravity_vector(fitted.arm.robot)
        sine = float(np.linalg.norm(np.cross(level, file.gravity)))
        angle = math.degrees(math.atan2(sine, level @ file.gravity))
        yield (
            f"the written model's gravity is turned by {angle:.2f} degrees: the base is tilted by "
            "that, or encoder zeros look like it (--keep gravity leaves it alone)"
        )


def traces_of(
    fitted: Fit, file: FileFit | None, truth: InertialParameters | None = None
) -> Traces:
    """Return the measured torques, and the predictions of the written file and the given model.

    Without a file, the fit's predictions replace those of the file. Both predictions contain the
    estimated offsets of the torque sensors. With a payload, the second prediction is that of the
    fit without the payload. ``truth`` are the true parameters of a simulated arm's terminal link.
    """
    shown = fitted if file is None else file.fit
    arm = fitted.arm
    values = shown.by_name
    model = dict(arm.model)
    if fitted.question.loaded:
        model = {**values, **dict.fromkeys(PAYLOAD_NAMES, 0.0)}
    model.update((name, values[name]) for name in values if name.startswith("offset["))
    friction: dict[str, float] = {}
    for term in shown.equations.terms:
        if term.cause == FRICTION:
            friction.update(
                (n, values[n]) for n in term.names if split_name(n)[0] != "armature"
            )
    fields: dict[str, list[Array]] = {}
    for recording in fitted.recordings:
        for rows in recording.chunks(36 * arm.robot.n_joints):
            used = recording.used[rows.span][:, arm.indices]
            measured = recording.torque[rows.span][:, arm.indices]
            known = arm.known(rows)
            motion = rows.motion
            signals = {
                "time": motion.time,
                "q": motion.q[:, arm.indices],
                "qd": motion.qd[:, arm.indices],
                "measured": np.where(used, measured, np.nan),
                "predicted": arm.torque(rows, shown.point, values),
                "prior_prediction": arm.torque(rows, shown.point, model),
                "friction": arm.torque(rows, shown.point, friction) - known,
            }
            for name, signal in signals.items():
                fields.setdefault(name, []).append(signal)
    robot = arm.robot
    limits = robot.limits
    indices = arm.indices
    joined = {name: np.concatenate(signals) for name, signals in fields.items()}
    return Traces(
        joints=arm.joints,
        is_slide=tuple(robot.is_slide[indices].tolist()),
        limits=JointLimits(
            limits.lower[indices],
            limits.upper[indices],
            limits.velocity[indices],
            limits.torque[indices],
        ),
        time=joined["time"],
        q=joined["q"],
        qd=joined["qd"],
        measured=joined["measured"],
        predicted=joined["predicted"],
        prior_prediction=joined["prior_prediction"],
        friction=joined["friction"],
        truth=truth,
    )
