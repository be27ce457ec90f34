"""A payload: weighed rightly, refused where it is none, and compared between recordings."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.core_fits import ORIGIN, fit_recordings
from rigs.logs.payload_logs import PAYLOAD, TrueArm, add_torque, four_joint_arm
from robot_sysid import spatial
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.payload import (
    contradiction,
    torque_scale_rows,
    written_payload,
)
from robot_sysid.estimate.restricted_fit import errors_of, fit_file
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.records import Flange
from robot_sysid.results.payload import payload_result
from robot_sysid.results.verdicts import Verdict

ROBOT = four_joint_arm()
FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def result_of(weighed, known_mass=None):
    """Return (result of a fit with a payload, the fit of its file)."""
    fitted = weighed
    file = None
    if known_mass is None:
        file = fit_file(weighed, written_payload(weighed)[0])
    else:
        logs = weighed.recordings
        fitted = fit_recordings(ROBOT, logs, loaded=True, known_mass=known_mass)
    fits = fitted, weighed, file
    return payload_result(*fits, FLANGE, ORIGIN, (), np.ones(4)), file


@pytest.fixture(scope="module")
def result_and_file(payload_fit):
    return result_of(payload_fit)


def test_a_payload_is_given_in_the_flange_frame_with_its_errors(
    payload_fit, result_and_file
):
    result, _ = result_and_file
    payload = result.payload
    assert result.verdict is Verdict.OK and contradiction(payload_fit) is None
    assert result.file.after.relative_error < result.file.before.relative_error
    theta = payload.theta
    assert np.max(np.abs(theta - FLANGE.to_flange(PAYLOAD)) / payload.errors) < 4.0
    assert payload.errors[0] < 0.03 and result.body is payload
    difference = result.total.theta - result.links["link3"].theta
    assert_allclose(FLANGE.to_flange(difference), theta, atol=1e-12)
    assert payload.recordings == {"empty": ("log0", "log3"), "loaded": ("log1", "log2")}
    assert "torque_scale" not in {row.name for row in result.quantities}
    assert result.quantity("drift", "joint0") is None
    row = result.quantity("mass", "payload")
    assert (row.value, row.error) == (payload.mass, pytest.approx(payload.errors[0]))


def test_scales_that_change_when_the_payload_comes_on_are_within_the_error():
    """Two logs of other motions: 0.3 % more torque of a heavy arm is no payload."""
    arm = TrueArm(ROBOT, 3, payload=np.zeros(10))
    empty, loaded = (
        replace(log, order=order)
        for log, order in zip(arm.abba(3, sigma=0.02), (-1.0, 1.0))
    )
    (rows,) = row_chunks(loaded, 1)
    loaded = add_torque(loaded, 0.003 * rows.recording.torque)
    fitted = fit_recordings(ROBOT, [empty, loaded], loaded=True)
    at = fitted.names.index("m(payload)")
    assert abs(fitted.free[at]) < 2.0 * fitted.errors[at]


def test_an_inertia_within_its_error_of_zero_is_replaced_by_a_balls():
    """In the payload, in the link with it and in the file; a note has its errors."""
    ball = spatial.aluminium_ball(0.4, np.array([0.03, -0.02, 0.08]))
    arm = TrueArm(ROBOT, 0, model_error=0.03, payload=ball)
    weighed = fit_recordings(ROBOT, arm.abba(0, sigma=0.1), loaded=True)
    result, file = result_of(weighed)
    payload = result.payload
    theta = result.body.theta
    assert result.verdict is Verdict.INERTIA_NOT_KNOWN and result.verdict.is_trustworthy
    expected = spatial.aluminium_ball(theta[0], theta[1:4] / theta[0])
    assert_allclose(theta, expected, atol=1e-12)
    difference = result.total.theta - result.links["link3"].theta
    carried = [file.by_name[f"{name}(payload)"] for name in spatial.PARAMETER_NAMES]
    for body in (difference, np.array(carried)):
        assert_allclose(FLANGE.to_flange(body), theta, atol=1e-12)
    for body in (payload, result.total):
        assert np.all(np.isinf(body.errors) == (np.arange(10) >= 4))
    texts = [remark.text for remark in result.remarks]
    (note,) = [text for text in texts if "differ significantly from zero" in text]
    assert note.count("±") == 3


def test_the_given_model_of_the_file_is_judged_with_its_own_rotors(
    payload_fit, result_and_file
):
    """Only the payload is on the arm in both: rotors that are found are the file's."""
    _, file = result_and_file
    options = EstimationOptions(keep=("rotors",))
    question = replace(payload_fit.question, options=options)
    _, kept = result_of(replace(payload_fit, question=question))
    before = errors_of(file).before, errors_of(kept).before
    assert before[0].rmse_per_joint == before[1].rmse_per_joint
    assert validation(file).relative_error < validation(kept).relative_error


@pytest.mark.slow
def test_a_known_mass_identifies_scales_from_wherever_they_start():
    """Constants of motors are guesses before, a quarter off and more."""
    scales = np.array([1.0, 0.75, 1.3, 0.8])
    arm = TrueArm(ROBOT, 5, model_error=0.03, scales=scales)
    logs = arm.abba(5, sigma=0.5)
    mass = float(PAYLOAD[0])
    fitted = fit_recordings(ROBOT, logs, loaded=True, known_mass=mass)
    nearly = [replace(log, tau=log.tau / scales) for log in logs]
    right = fit_recordings(ROBOT, nearly, loaded=True, known_mass=mass)
    found, again = (
        [row.value for row in torque_scale_rows(fit, start)]
        for fit, start in ((fitted, np.ones(4)), (right, scales))
    )
    errors = np.array([row.error for row in torque_scale_rows(fitted, np.ones(4))])
    # Joints along gravity show nothing of it.
    is_shown = errors < 0.1
    assert np.count_nonzero(is_shown) >= 2
    assert np.max(np.abs(found - scales)[is_shown] / errors[is_shown]) < 3.0
    assert_allclose(found, again, atol=float(np.max(0.5 * errors)))


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("is_right", [True, False])
def test_a_known_mass_identifies_scales_unless_the_weight_contradicts_it(
    payload_fit, is_right
):
    result, _ = result_of(payload_fit, known_mass=1.2 if is_right else 3.0)
    if not is_right:
        assert result.verdict is Verdict.WRONG_WEIGHT and result.failure
        return
    payload = result.payload
    assert result.verdict is Verdict.OK and payload.known_mass == 1.2
    assert result.body.mass == pytest.approx(1.2, rel=1e-4)
    rows = [row for row in result.quantities if row.name == "torque_scale"]
    for row in rows:
        assert abs(row.value - 1.0) < 3.0 * row.error, row.of
    # Joints along gravity show nothing of it.
    assert min(row.error for row in rows) < 0.01
