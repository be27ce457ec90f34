"""Made-up results of a two-joint arm, for tests of what is said about them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot_sysid.dynamics.friction import TERMS
from robot_sysid.estimate.quantities import beyond_model
from robot_sysid.records import (
    ITSELF,
    ArmLink,
    DataOrigin,
    Errors,
    FitQuality,
    Flange,
    InertialParameters,
    JointFriction,
    Limits,
    ModelErrors,
    RobotModel,
    SubtreeBody,
    Validation,
)
from robot_sysid.records.messages import Level, Remark, says
from robot_sysid.records.quantities import (
    BOUND,
    FILE,
    BodyEstimate,
    Quantity,
    body_quantities,
)
from robot_sysid.results.record import (
    Elsewhere,
    ErrorPart,
    Identification,
    ModelFile,
    MotionErrors,
    Payload,
)
from robot_sysid.results.verdicts import Verdict
from robot_sysid.spatial import PARAMETER_NAMES, theta_from_com

JOINTS = ("j5", "j6")
FRICTION = ("coulomb[j5]", "viscous[j5]", "coulomb[j6]", "viscous[j6]")
NAMES = (*PARAMETER_NAMES, *FRICTION)
THETA = theta_from_com(2.0, np.array([0.0, 0.01, 0.1]), np.diag([0.01, 0.012, 0.005]))
VALUES = np.array([*THETA, 0.5, 0.2, 0.4, 0.1])
ARM = RobotModel(
    path=Path("arm.xml"),
    mj_model=None,
    joint_names=JOINTS,
    qpos_index=np.arange(2),
    dof_index=np.arange(2),
    reference_qpos=np.zeros(2),
    is_slide=np.zeros(2, dtype=bool),
    limits=Limits(*np.array([[-2.0], [2.0], [2.0]]) * np.ones(2)),
    friction=JointFriction(
        np.array([0.3, 0.2]), np.array([0.1, 0.0]), np.zeros((0, 2))
    ),
    links=(ArmLink(2, "link6", np.zeros(6), np.eye(3), np.zeros(3), 0.5 * THETA),),
    sha256="ab",
)
MODEL_FRICTION = {
    "j5": {"coulomb": 0.3, "viscous": 0.1, "armature": 0.0},
    "j6": {"coulomb": 0.2, "viscous": 0.0, "armature": 0.0},
}


QUALITY = FitQuality(
    joint_names=("j5", "j6"),
    blocks=np.full((1, 2), 200 * 0.03**2),
    counts=np.full(2, 200),
    condition_number=50.0,
    n_base_params=12,
    unidentifiable=(),
    noise_per_joint={"j5": 0.03, "j6": 0.031},
)
ERRORS = 1e-3 * np.maximum(np.abs(VALUES), 1e-2)


class Estimate(NamedTuple):
    """Parameters without any fault: white noise, small errors, all from the data."""

    names: tuple = NAMES
    values: np.ndarray = VALUES
    standard_errors: np.ndarray = ERRORS
    quality: FitQuality = QUALITY


ESTIMATE = Estimate()


def found(result=ESTIMATE, **changes):
    """Everything around it, of measured data: the terminal link and the joints as in it.

    A ``verdict`` among the changes is its remark.
    """
    if "verdict" in changes:
        verdict = changes.pop("verdict")
        reason = "because" if verdict.level is not Level.SAYS else ""
        changes.setdefault("remarks", (verdict.remark(reason),))
    last = terminal(result)
    rows = [*body_quantities(last)]
    for joint in JOINTS:
        rows += joint_rows(result, joint)
    defaults = Identification(
        robot=ARM,
        quality=result.quality,
        standard_errors=dict(zip(result.names, result.standard_errors.tolist())),
        remarks=(Verdict.BETTER.remark(),),
        torques="chain",
        data=DataOrigin("log arm.csv", 15.0, 1000.0),
        quantities=tuple(rows),
        links={last.name: last},
        total=last,
        thetas=THETA[None],
        friction_model="coulomb-viscous",
    )
    return replace(defaults, **changes)


def terminal(result=ESTIMATE):
    """The terminal link as an estimate has it; its errors are of noise and of other links."""
    errors = np.array(result.standard_errors)[:10]
    seen = np.isfinite(errors)
    return BodyEstimate(
        result.values[:10],
        "link6",
        np.diag(np.where(seen, errors, 0.0) ** 2),
        seen,
        {"noise": 0.6 * errors, "the other links' parameters": 0.8 * errors},
        np.where(seen, 1.0, 0.0),
        InertialParameters(0.5 * THETA),
    )


def joint_rows(result, joint):
    """The friction of a joint as an estimate has it."""
    rows = []
    numbers = zip(result.names, result.values, result.standard_errors)
    for name, value, error in numbers:
        term, _, owner = name.partition("[")
        if owner == f"{joint}]":
            model = MODEL_FRICTION[joint].get(term)
            rows.append(Quantity(term, joint, TERMS[term].unit, model, value, error))
    return rows


def itself():
    """The model's own simulation, of which most is not asked."""
    exact = replace(terminal(), covariance=np.zeros((10, 10)), budget={})
    joints = [replace(row, error=None) for row in joint_rows(ESTIMATE, "j6")]
    rows = [*body_quantities(exact), *joints]
    return found(
        data=DataOrigin(ITSELF, 15.0, 1000.0, 1),
        verdict=Verdict.OK,
        links={},
        total=exact,
        standard_errors={},
        quantities=tuple(rows),
        friction_model=None,
    )


def with_value(name, value, error):
    """The estimate with one parameter changed."""
    values = VALUES.copy()
    errors = ERRORS.copy()
    values[NAMES.index(name)] = value
    errors[NAMES.index(name)] = error
    return Estimate(NAMES, values, errors)


def without_mass():
    """The mass does not show in the data."""
    seen = replace(QUALITY, n_base_params=11, unidentifiable=("mass",))
    return with_value("m", 2.0, np.inf)._replace(quality=seen)


def validation_of(rmse, source="other.csv", relative=0.02):
    """A validation with this error at each of two joints, in ten blocks of ten samples."""
    blocks = np.outer(np.linspace(0.7, 1.3, 10), 2 * [10 * rmse**2])
    torque = 2 * [100 * (rmse / relative) ** 2]
    counts = np.full(2, 100)
    return Validation(("j5", "j6"), blocks, counts, source, np.array(torque), True)


def body(mass=1.2, com=(0.03, -0.02, 0.08), shown=True, name="payload"):
    """A body whose mass is known to 0.01 kg, 0.006 of it noise and 0.008 torque scale."""
    inertia = mass * np.diag([0.005, 0.006, 0.004])
    theta = theta_from_com(mass, np.array(com), inertia)
    covariance = np.diag([1e-4] + [1e-6] * 3 + [1e-8] * 6)
    errors = np.sqrt(np.diag(covariance))
    seen = np.array([True] * 4 + [shown] * 6)
    budget = {
        "noise": 0.6 * errors,
        "the torque scales": 0.8 * errors,
        "gravity": 1e-6 * errors,
    }
    return BodyEstimate(theta, name, covariance, seen, budget)


def payload(own=None, torque_scale=(), **changes):
    """A payload of 1.2 kg; what is no field of the result is one of ``Payload``.

    ``torque_scale`` has pairs of a joint and its scale.
    """
    total = body(2.0, name="link6 with payload")
    payload_record = Payload(
        **vars(own or body()),
        flange=Flange("site 'flange'", np.eye(3), np.zeros(3), "link6"),
        recordings={"empty": ("a.csv",), "loaded": ("b.csv", "c.csv")},
    )
    for name in vars(payload_record).keys() & changes.keys():
        payload_record = replace(payload_record, **{name: changes.pop(name)})
    rows = [*body_quantities(payload_record)]
    rows += body_quantities(body(0.8, name="link6"))
    rows += body_quantities(total)
    for joint, scale in torque_scale:
        rows.append(Quantity("torque_scale", joint, "", 1.0, scale, 0.004))
    changes = {"verdict": Verdict.OK, "quantities": tuple(rows), **changes}
    return found(payload=payload_record, total=total, **changes)


def elsewhere(after=0.03, of_log=0.025, **changes):
    """What is expected on other motions of a model that is 35 % off there before."""
    before, after, of_log = (
        MotionErrors(error, {"j5": error, "j6": 1.2 * error})
        for error in (0.35, after, of_log)
    )
    expected = Elsewhere(
        speed=2.0,
        speed_unit="rad/s",
        before=before,
        after=after,
        at_log_speeds=of_log,
        log_speed=0.6,
        parts=(
            ErrorPart("friction of j5", 0.02),
            ErrorPart("mass and centre of link5", 0.01),
        ),
    )
    return replace(expected, **changes)


def errors_from(before, after, before_as_used, after_as_used):
    """Errors of a model and of a file, and those with offsets counted as errors."""
    return ModelErrors(before, after, Errors(before_as_used, after_as_used))


def without_other_logs(file):
    """What is said of a file where only one log was judged."""
    return replace(file, errors=file.errors[:1])


def model_file(**changes):
    """What is said of a written model that predicts torques to 0.25 % instead of 27 %."""
    of_other = [validation_of(1.6, relative=0.3), validation_of(0.05, relative=0.012)]
    of_log = [
        validation_of(rmse, "fifths of arm.csv", relative)
        for rmse, relative in ((1.5, 0.27), (0.02, 0.0025), (1.6, 0.28), (0.03, 0.0035))
    ]
    file = ModelFile(
        errors=(errors_from(*of_log), errors_from(*of_other, *of_other)),
        gravity=np.array([0.0, 0.1, -9.8]),
        kept=("rotor inertia",),
        elsewhere=elsewhere(),
    )
    return replace(file, **changes)


def whole(**changes):
    """A result of which nothing is missing."""
    first = replace(terminal(), name="link5")
    last = terminal()
    bodies = (SubtreeBody(6, "link6", THETA, True),)
    links = (replace(ARM.links[0], bodies=bodies),)
    rows = [*body_quantities(first), *found().quantities]
    rows += [
        Quantity("viscous", "j5+j6", "N·m·s/rad", None, 0.05, 0.002),
        Quantity("scale", "j5", "", None, 1.01, 0.004),
        Quantity("zero", "j6", "rad", None, 0.0, float("nan"), BOUND),
        Quantity("delay", "arm", "s", None, 0.0032, 2e-5),
        Quantity("tilt_1", "arm", "rad", None, 0.0, np.radians(0.03)),
        *beyond_model(last, np.diag(0.1 * last.prior.scale)),
        Quantity("coulomb", "j5", "N", 0.3, 0.45, 0.01, FILE),
        Quantity("viscous", "j5", "N·s/m", 0.1, 0.25, 0.02, FILE),
    ]
    result = found(
        robot=replace(ARM, is_slide=np.array([True, False]), links=links),
        links={first.name: first, last.name: last},
        quantities=tuple(rows),
        file=model_file(),
        validation=(
            validation_of(0.02, "fifths of arm.csv", 0.0022),
            validation_of(0.03, relative=0.012),
        ),
        friction_model="per joint",
        cutoff=8.0,
        link_scales={"mass": 4.0, "centre_of_mass": 1.0, "inertia": 2.0},
        remarks=(
            Verdict.BETTER.remark(),
            Remark(Level.DOUBTS, "link3", "link3 is wrong", "weigh it"),
            *says(("a note",)),
        ),
    )
    return replace(result, **changes)


def theta_in(path):
    """The ten parameters (10,) that a params.json holds."""
    content = json.loads(path.read_text(encoding="utf-8"))
    six = [content["inertia_tensor"][name] for name in PARAMETER_NAMES[4:]]
    return np.array([content["mass"], *content["center_of_mass_moment"], *six])
