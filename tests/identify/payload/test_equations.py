"""Equations of empty and loaded recordings: the truth solves them, whatever is scaled or drifts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES, PayloadEquations
from tests.support.arms import SEEDS
from tests.support.payload_logs import TrueArm, four_joint_arm, wide_motion

ROBOT = four_joint_arm()
TERMS = friction_model("coulomb-viscous-offset-armature")


@pytest.mark.slow
@given(SEEDS, st.booleans(), st.floats(-0.2, 0.2), st.floats(-0.1, 0.1))
def test_the_truth_solves_the_equations(seed, is_loaded, drift, scale):
    scales = 1.0 + scale * np.array([1.0, -0.5, 0.3, 0.7])
    arm = TrueArm(ROBOT, seed, scale=scales)
    recording = arm.recording(wide_motion(seed, duration=3.0), is_loaded, 0.7, drift=drift)
    equations = PayloadEquations(ROBOT, TERMS, drifts=True)
    truth = arm.values(equations, drift)
    samples = equations.samples(recording, truth)
    assert samples.names == equations.names
    for rows, tau, columns in zip(samples.rows, samples.tau, samples.columns):
        error = rows @ truth[columns] - tau
        assert np.max(np.abs(error)) < 1e-9 * max(np.max(np.abs(tau)), 1.0)


def test_a_payload_stands_in_loaded_recordings_only():
    arm = TrueArm(ROBOT, 1)
    equations = PayloadEquations(ROBOT, TERMS, drifts=False)
    places = equations.places(PAYLOAD_NAMES)
    for is_loaded in (False, True):
        recording = arm.recording(wide_motion(2, duration=3.0), is_loaded)
        samples = equations.samples(recording, equations.prior)
        for rows, columns in zip(samples.rows, samples.columns):
            seen = rows[:, np.isin(columns, places)]
            assert np.any(seen) == is_loaded
            if is_loaded:
                np.testing.assert_array_equal(seen, rows[:, :10])


def test_links_are_told_with_the_payload_on_the_last_one():
    arm = TrueArm(ROBOT, 3)
    equations = PayloadEquations(ROBOT, TERMS, drifts=False)
    truth = arm.values(equations)
    np.testing.assert_allclose(equations.thetas(truth, False), arm.thetas)
    np.testing.assert_allclose(equations.thetas(truth, True)[-1], arm.thetas[-1] + arm.payload)


def test_drift_is_a_parameter_only_where_it_is_sought():
    assert not PayloadEquations(ROBOT, TERMS, drifts=False).drift_names
    names = PayloadEquations(ROBOT, TERMS, drifts=True).drift_names
    assert names == tuple(f"drift[{joint}]" for joint in ROBOT.joint_names)


def test_load_dependent_friction_knows_the_payload():
    equations = PayloadEquations(ROBOT, friction_model("coulomb-load"), drifts=False)
    arm = TrueArm(ROBOT, 4)
    truth = arm.values(equations)
    recording = arm.recording(wide_motion(5, duration=3.0), True)
    alone = equations.samples(
        recording, np.where(np.isin(equations.names, PAYLOAD_NAMES), 0, truth)
    )
    with_it = equations.samples(recording, truth)
    # Column 11 is the load term: what the gear of the second joint carries.
    assert np.max(np.abs(with_it.rows[1][:, 11])) > 1.02 * np.max(np.abs(alone.rows[1][:, 11]))
    assert with_it.rows[1][:, :10] == pytest.approx(alone.rows[1][:, :10])
