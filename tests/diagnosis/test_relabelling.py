"""Wrong titles, signs and scales of torques: each is its own inverse, and scales are found."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.diagnosis.contest import MARGIN
from robot_sysid.diagnosis.relabelling import (
    find_wrong_scales,
    relabellings,
    torque_scales,
)
from robot_sysid.estimation.question import EstimationOptions

OPTIONS = EstimationOptions()


def test_every_relabelling_of_torque_is_its_own_inverse_and_less_likely(truth, contest):
    log = contest.posterior.model.log
    mistakes = [m for m in relabellings(truth.robot) if m.motion is None and m.torque]
    for mistake in mistakes[::3]:
        spoilt = log.with_torque(mistake.torque(log.torque))
        restored = spoilt.with_torque(mistake.torque(spoilt.torque))
        assert_allclose(restored.right_sides, log.right_sides, atol=1e-9)
        model = contest.posterior.model.with_torque_of(spoilt)
        log_evidence = model.posterior().log_evidence
        assert log_evidence < contest.posterior.log_evidence - MARGIN


def test_estimated_scales_are_proportional_to_the_torques(contest):
    log = contest.posterior.model.log
    scales = torque_scales(log, OPTIONS)
    scaled = torque_scales(log.with_torque(300.0 * log.torque), OPTIONS)
    assert_allclose(scaled.scale, 300.0 * scales.scale, rtol=0.02)


def test_scales_of_single_joints_are_found_within_their_errors(contest):
    truth = np.array([1.3, 1.9, 1.5, 1.7, 1.2])
    log = contest.posterior.model.log
    log = log.with_torque(truth * log.torque)
    scales = torque_scales(log, OPTIONS)
    error = np.log(scales.scale / truth)[scales.identified]
    assert len(error) > 2
    assert error @ np.linalg.solve(scales.covariance, error) < 3.0 * len(error)


@pytest.mark.parametrize(("factor", "cause"), [(1e3, "mN·m"), (1 / 101, "the gear")])
def test_the_advised_scale_includes_the_applied_ones(contest, factor, cause):
    base = contest.posterior
    log = base.model.log.with_torque(factor * base.model.log.torque)
    base = replace(base, model=base.model.with_torque_of(log))
    applied = np.array([2.0, 3.0, 4.0, 5.0, 6.0])
    advised = []
    for divided in (np.ones(5), applied):
        (correction,) = find_wrong_scales(base, OPTIONS, divided)
        assert cause in correction.finding.text
        numbers = re.search(r"--torque-scale ([0-9.,]+[0-9])", correction.finding.text)[
            1
        ]
        advised.append([float(number) for number in numbers.split(",")])
    assert_allclose(advised[1], advised[0] * applied, rtol=0.01)
