"""Each recording alone says what all of them say, within the errors it states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.identify.payload.checks.scatter import disagreements, each_recording
from robot_sysid.records import Flange
from tests.support.payload_logs import PAYLOAD

FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


@pytest.fixture(scope="module")
def scatter(fit, recordings):
    return each_recording(fit, recordings, FLANGE, 1.0)


def test_every_recording_says_the_same_within_its_errors(fit, scatter):
    assert [one.name for one in scatter] == ["log0", "log3", "log1", "log2"]
    assert [one.is_loaded for one in scatter] == [False, False, True, True]
    for one in scatter:
        assert abs(one.mass - fit.payload[0]) < 3.0 * one.noise_error
        assert one.noise_error < one.error < 0.1
        # The centre of mass is told in the flange frame, 5 cm further out.
        assert one.com == pytest.approx(PAYLOAD[1:4] / PAYLOAD[0] - [0, 0, 0.05], abs=0.01)
    assert list(disagreements(scatter, fit.payload[0])) == []


def test_correlated_noise_makes_the_errors_larger(fit, recordings, scatter):
    twice = each_recording(fit, recordings, FLANGE, 2.0)
    for one, other in zip(scatter, twice):
        assert other.noise_error == pytest.approx(2.0 * one.noise_error)


def test_what_noise_does_not_explain_is_named(scatter):
    odd = replace(scatter[0], mass=scatter[0].mass + 10.0 * scatter[0].noise_error)
    found = disagreements((odd, *scatter[1:]), scatter[1].mass)
    assert [one.name for one in found] == [odd.name]


def test_one_recording_of_a_kind_has_nothing_to_be_compared_with(fit, recordings):
    few = replace(fit, samples=fit.samples[:3])
    names = [one.name for one in each_recording(few, recordings[:3], FLANGE, 1.0)]
    assert names == ["log1", "log2"]
