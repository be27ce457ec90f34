"""Made-up runs of a small arm whose names are markup and formulas, and the pages about them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics.spatial import PARAMETER_NAMES, parameter_scale
from robot_sysid.parser import load_robot_model
from robot_sysid.records import (
    DataOrigin,
    Estimate,
    Flange,
    Identifiability,
    InertialParameters,
    JointLimits,
    Source,
    Validation,
)
from robot_sysid.records.data import Traces
from robot_sysid.records.results import CLOSED, OPEN, RolloutError, RolloutTest
from robot_sysid.report.page import REPORT_NAME, save_data, write_report
from robot_sysid.report.runs import fingerprint
from robot_sysid.results.cards import load_errors, payload_cards
from robot_sysid.results.json import params_json_text
from robot_sysid.results.record import (
    LINK,
    PAYLOAD,
    BaseParameters,
    BodyEstimate,
    Figure,
    JointEstimate,
    ModelFile,
    OneRecording,
    Payload,
    Result,
    Verdict,
)
from tests.support import arms

LONG = "関節 with a very long name that goes on and on and on"
NAMED = {"link1": "&lt;script&gt;alert(1)&lt;/script&gt;", "joint1": "$x^{1}&amp;", "link0": LONG}
JOINT = 'range="-2 2" frictionloss=".3" damping=".2" armature=".05"'
HELD_OUT, OTHER = "20 % of the log, not fitted", "other <b>log</b>.csv"


def arm_text():
    """An arm with odd names."""
    text = arms.serial_arm((arms.Z, arms.Y), joint=JOINT)
    for name, odd in NAMED.items():
        text = text.replace(f'name="{name}"', f'name="{odd}"')
    return text


def body(name, theta, joint=None, before=None):
    """Parameters known to about a percent, half of it noise."""
    errors = 0.01 * parameter_scale(theta[0], 0.1)
    budget = {"torque scale": 0.8 * errors, "joint offsets": 0.1 * errors}
    share, shown = np.array([1.0] * 8 + [0.4, 0.9]), np.ones(10, dtype=bool)
    values = InertialParameters(theta), np.diag(errors**2), shown, 0.6 * errors, budget, share
    return BodyEstimate(name, *values, before, joint)


def predicted(joints, source, relative):
    """Errors of a prediction."""
    rmse = {name: 3.0 * relative / (1 + k) for k, name in enumerate(joints)}
    return Validation(source, 500, 2.0 * relative, relative, rmse, dict.fromkeys(joints, relative))


def link_result(path):
    """A result about every link of the arm in a file."""
    robot = load_robot_model(path)
    names, thetas = robot.joint_names, np.array([link.theta for link in robot.links])
    after = 1.05 * thetas
    links = tuple(
        body(link.body_name, theta, joint, InertialParameters(link.theta))
        for link, joint, theta in zip(robot.links, names, after)
    )
    terms = {"coulomb": Figure(0.31, 0.01), "viscous": Figure(0.2, float("inf"))}
    written = {name: {"coulomb": Figure(0.3, 0.01)} for name in names}
    pairs = [
        (predicted(names, source, 0.12), predicted(names, source, 0.034))
        for source in (HELD_OUT, OTHER)
    ]
    file = ModelFile(1.04 * thetas, 0.01 * thetas, written, None, *pairs[0], (pairs[1],))
    seen = Identifiability(10, 10, 50.0, 5.0, (True,) * 8 + (False, True), ("Iyz(<i>link</i>)",))
    estimate = Estimate(
        names=PARAMETER_NAMES,
        values=after[-1],
        identifiability=seen,
        rmse=0.031,
        rmse_per_joint=dict.fromkeys(names, 0.031),
        standard_errors=links[-1].errors,
        noise_errors=links[-1].noise_errors,
    )
    base = BaseParameters(
        ("Izz(link_1) + m(link_2)", "m"), np.ones(2), np.ones(2), 9, (True, False)
    )
    return Result(
        question=LINK,
        model_path=path,
        model_sha256=robot.sha256,
        joint_name=names[-1],
        body_name=robot.links[-1].body_name,
        joint_names=names,
        prior=robot.prior,
        estimate=estimate,
        verdict=Verdict.BETTER,
        torques="chain",
        data=DataOrigin(Source.LOG, "<u>log</u>.csv", 6.0, 100.0),
        versions={},
        links=links,
        joints={name: JointEstimate("coulomb-viscous", terms) for name in names},
        couplings={"$a$+b": JointEstimate("coulomb", {"coulomb": Figure(0.1, 0.02)})},
        sensors={f"zero[{names[1]}]": Figure(0.002, 0.001)},
        base=base,
        file=file,
        validation=(predicted(names, HELD_OUT, 0.03), predicted(names, OTHER, 0.031)),
        friction_model="coulomb-viscous",
        notes=("a `note` about <b>names</b>",),
        rollout=_played(names),
    )


def _played(names):
    before, after = np.full(len(names), 0.02), np.full(len(names), 0.01)
    errors = tuple(RolloutError(loop, 0.3, 9, before, after) for loop in (OPEN, CLOSED))
    return RolloutTest(names, "the last fifth", "a servo", errors, ("a note",))


def payload_result(path, verdict=Verdict.OK):
    """A result about a payload on that arm."""
    found = link_result(path)
    link = found.links[-1]
    theta = np.array([1.2, 0.01, 0.0, 0.1, 0.02, 0.0, 0.0, 0.02, 0.0, 0.01])
    carried = Payload(
        flange=Flange("site '<flange>'", np.eye(3), np.zeros(3), link.name),
        body=body("payload", theta),
        link=link,
        total=replace(link, inertial=InertialParameters(link.inertial.theta + theta)),
        recordings={"empty": ("a.csv",), "loaded": ("<s>b</s>.csv", "c.csv")},
        scatter=(OneRecording("<s>b</s>.csv", True, 1.19, np.zeros(3), 0.01, 0.02),),
        torque_scale={found.joint_names[1]: Figure(1.1, 0.01)},
    )
    return replace(found, question=PAYLOAD, payload=carried, verdict=verdict, rollout=None)


def traces(result):
    """Torques of sines, the residual white."""
    rng, time, names = np.random.default_rng(0), np.arange(600) * 0.01, result.joint_names
    phases = time[:, None] * (1.0 + np.arange(len(names)))
    q, qd = np.sin(phases), (1.0 + np.arange(len(names))) * np.cos(phases)
    friction = 0.31 * np.sign(qd) + 0.2 * qd
    predicted = 3.0 * q + friction
    measured = predicted + 0.05 * rng.normal(size=q.shape)
    measured[np.abs(qd) < 0.1] = np.nan
    full = np.full(len(names), 2.0)
    limits = JointLimits(-full, full, 3.0 * full, np.full(len(names), np.inf))
    known = (time, q, qd, measured, predicted, 0.8 * predicted, friction, limits, result.prior)
    return Traces(names, (False,) * len(names), *known)


def saved(folder, result):
    """A folder that a run left, without its report."""
    folder.mkdir(parents=True, exist_ok=True)
    found = result.payload
    cards = ()
    if found is not None and result.verdict.is_trustworthy:
        cards = payload_cards(found.body.inertial, found.flange, load_errors(found.body))
    (folder / "params.json").write_text(params_json_text(result, cards), encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def link_run(tmp_path_factory):
    """The folder of a run on a log of an arm whose truth is known."""
    folder = tmp_path_factory.mktemp("link")
    model = folder / "arm.xml"
    model.write_text(arm_text(), encoding="utf-8")
    result = link_result(model)
    run = saved(folder / "link", result)
    save_data(run, traces(result), fingerprint(run / "params.json"))
    comment = "<!-- System ID: body 'x' identified with RMSE 0.031000 Nm -->"
    (run / "updated_model.xml").write_text(comment + arm_text(), encoding="utf-8")
    return run


@pytest.fixture(scope="session")
def page(link_run):
    """The page about it."""
    (path,) = write_report([link_run], link_run)
    assert path.name == REPORT_NAME
    return path


@pytest.fixture(scope="session")
def pages(link_run, page, tmp_path_factory):
    """One page of each kind."""
    folder = tmp_path_factory.mktemp("others")
    payload = saved(folder / "payload", payload_result(link_run.parent / "arm.xml"))
    (about,) = write_report([payload], payload)
    (comparison,) = write_report([link_run, payload, link_run], folder)
    return {"link": page, "comparison": comparison, "payload": about}
