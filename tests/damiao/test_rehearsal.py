"""A rehearsal gives back what it simulates: links, friction and rotors, within their ±."""

from __future__ import annotations

import numpy as np
import pytest

from rigs.motors.rehearsals import ARMS, plan, rehearse

WORST = 2.5
"""Stated errors that the worst of some thirty numbers may be off."""


@pytest.fixture(scope="module", params=["kinova", "openarm", "wxai"])
def planned_files(request, tmp_path_factory):
    """An arm, its trajectory and a folder for its recordings."""
    arm = ARMS[request.param]
    if not arm.model.exists():
        pytest.skip(f"{arm.model} is not at hand")
    folder = tmp_path_factory.mktemp(request.param)
    return arm, plan(arm, folder, duration=10.0), folder


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100.0, 250.0, 500.0])
def test_identification_returns_what_a_rehearsal_simulates(planned_files, rate):
    arm, trajectory, folder = planned_files
    estimates = rehearse(arm, trajectory, rate, folder)
    errors = np.abs([estimate.stated_errors for estimate in estimates])
    assert np.max(errors) < WORST
    assert np.mean(errors <= 2.0) > 0.95
    assert np.mean(errors <= 1.0) > 0.7
