"""The joint fit: what the model has wrong does not reach the payload."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.friction import friction_model
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.payload.joint_fit import LARGEST_LOSS, Task, fit_jointly
from robot_sysid.records import Motion
from tests.support.arms import SEEDS
from tests.support.payload_logs import (
    PAYLOAD,
    TrueArm,
    exact_recording,
    four_joint_arm,
    wide_motion,
)

ROBOT = four_joint_arm()
TERMS = friction_model("coulomb-viscous-offset-armature")
SURE = EstimationOptions(zero_uncertainty=0.0, gravity_uncertainty=0.0)
"""Of an arm whose encoders and level are exact, so that nothing can turn the payload."""


def relative(found, truth=PAYLOAD):
    scale = spatial.parameter_scale(truth[0], spatial.characteristic_length(truth))
    return np.max(np.abs(found - truth) / scale)


def recovered(seed, options=SURE, **rest):
    """Relative error of the payload of one exact empty and one exact loaded recording."""
    arm = TrueArm(ROBOT, seed)
    recordings = [arm.recording(wide_motion([seed, k]), k > 0) for k in range(2)]
    fit = fit_jointly(Task(ROBOT, TERMS, False, options, **rest), recordings)
    return relative(fit.payload)


@pytest.mark.slow
@given(SEEDS)
def test_exact_recordings_give_the_payload_whatever_the_model_has_wrong(seed):
    """Links off by up to 30 %, friction and rotors that the model does not have, other motions."""
    # Priors count as if torques had noise of 1e-6 of their size, which pulls by its square.
    assert recovered(seed) < 1e-8


def test_one_exact_recording_of_each_kind_is_enough():
    assert recovered(1) < 1e-8
    # Encoder zeros and level turn the payload with the link: the model's wrong link tells of them.
    assert recovered(1, EstimationOptions()) < 1e-4


@pytest.mark.slow
def test_the_order_of_the_recordings_does_not_matter():
    recordings = TrueArm(ROBOT, 2).abba(2, sigma=0.05)
    task = Task(ROBOT, TERMS, False, EstimationOptions())
    one = fit_jointly(task, recordings).payload
    other = fit_jointly(task, recordings[::-1]).payload
    assert relative(one, other) < 1e-7


@pytest.mark.slow
def test_a_drift_of_friction_is_told_from_the_payload():
    recordings = TrueArm(ROBOT, 3).abba(3, drift=0.15)
    fit = fit_jointly(Task(ROBOT, TERMS, True, SURE), recordings)
    names = fit.equations.drift_names
    np.testing.assert_allclose(fit.values[fit.equations.places(names)], 0.15, rtol=1e-3)
    assert relative(fit.payload) < 1e-5
    blind = fit_jointly(Task(ROBOT, TERMS, False, SURE), recordings)
    assert relative(blind.payload) > 100.0 * relative(fit.payload)


@pytest.mark.slow
def test_a_known_mass_tells_the_torque_scales():
    scale = np.array([1.03, 0.96, 1.02, 0.98])
    recordings = TrueArm(ROBOT, 4, scale=scale).abba(4)
    task = Task(ROBOT, TERMS, False, SURE, known_mass=float(PAYLOAD[0]), scale_prior=3.0)
    fit = fit_jointly(task, recordings)
    found = 1.0 + fit.values[fit.equations.places(fit.equations.scale_names)]
    np.testing.assert_allclose(found, scale, atol=1e-5)
    assert relative(fit.payload) < 1e-4


def test_a_scale_of_all_joints_goes_into_the_payload_and_not_into_the_links():
    """Only the model's masses could tell it from a heavier payload, and they are not trusted."""
    recordings = TrueArm(ROBOT, 5, wrong=0.1, scale=np.full(4, 1.05)).abba(5)
    fit = fit_jointly(Task(ROBOT, TERMS, False, SURE), recordings)
    assert fit.payload[0] == pytest.approx(1.05 * PAYLOAD[0], rel=1e-6)
    assert np.mean(fit.values[fit.equations.places(fit.equations.scale_names)]) == pytest.approx(
        0.0, abs=1e-9
    )


@pytest.mark.slow
def test_what_gears_lose_with_their_load_is_found_and_stays_within_bounds():
    arm = TrueArm(ROBOT, 6)
    recordings = []
    for each in arm.abba(6):
        signals = each.source.signals
        motion = Motion(signals.time, signals.q, signals.qd, signals.qdd)
        carried = arm.torque(motion, each.is_loaded) - friction_of(arm, motion)
        lost = np.array([0.0, 0.08, -0.05, 0.0]) * np.abs(carried) * np.sign(signals.qd)
        recordings.append(
            exact_recording(motion, signals.tau + lost, each.is_loaded, each.place, each.name)
        )
    terms = friction_model("coulomb-viscous-offset-armature-load")
    fit = fit_jointly(Task(ROBOT, terms, False, SURE), recordings)
    found = fit.values[fit.equations.places(fit.equations.load_names)]
    assert found[1] == pytest.approx(0.08, abs=0.02)
    assert np.all((found >= -1e-6) & (found <= LARGEST_LOSS))


def friction_of(arm, motion):
    """What is not rigid in the torque of an arm."""
    dry = arm.coulomb * np.sign(motion.qd) + arm.viscous * motion.qd
    return dry + arm.armature * motion.qdd + arm.offset
