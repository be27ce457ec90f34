"""The fit behind the checks: what it sees, and that a mistake undone is no mistake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.diagnosis.evidence import evidence_of
from robot_sysid.diagnosis.hypotheses import explanations, hypotheses
from robot_sysid.diagnosis.model_fit import ModelFit, plausible
from robot_sysid.diagnosis.torque import joint_zeros, torque_scales


def test_a_right_log_fits_and_tells_the_link(truth, evidence, fit):
    base = fit.fit(evidence.sample)
    assert base.cost < 1.0 and plausible(fit, base)
    assert base.thetas[-1, 0] == pytest.approx(truth.theta[0], rel=0.15)


def test_without_payload_and_friction_the_model_is_its_own_fit(truth):
    log = replace(truth.log, tau=truth.model)
    evidence = evidence_of(truth.robot, [log])
    base = ModelFit(evidence).fit(evidence.sample)
    # What is left is the encoder's steps.
    assert base.cost < 0.1


def test_every_mistake_is_undone_by_making_it_again(evidence, fit):
    """Signs, exchanges and the reversed order are their own inverses."""
    robot, sample = evidence.robot, evidence.sample
    right = fit.fit(sample).cost
    for _, made, spoilt in list(hypotheses(sample, robot))[2::7]:
        undone = {text: each for _, text, each in hypotheses(spoilt, robot)}
        assert fit.fit(undone[made]).cost == pytest.approx(right, rel=1e-9)


def test_a_right_log_has_no_explanation(evidence, fit):
    assert explanations(evidence, fit) == []


@settings(max_examples=10, deadline=None)
@given(st.floats(-3.0, 3.0))
def test_scaling_all_torques_scales_what_is_found(evidence, fit, exponent):
    factor = 10.0**exponent
    scaled = replace(evidence, sample=evidence.sample.with_torque(factor))
    (one, _), (other, _) = torque_scales(evidence, fit), torque_scales(scaled, fit)
    np.testing.assert_allclose(other, factor * one, rtol=1e-6)


def test_a_shifted_zero_is_found(truth):
    q = truth.log.q + [0.0, 0.12, 0.0, 0.0, 0.0]
    evidence = evidence_of(truth.robot, [replace(truth.log, q=q)])
    zeros, errors, _ = joint_zeros(evidence, ModelFit(evidence))
    assert abs(zeros[1] - 0.12) < 4.0 * errors[1] + 0.02
