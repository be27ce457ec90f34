"""Held-out stretches are predicted as well as noise allows, and terms have to earn their place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.identify.payload.checks.held_out import FOLDS, choose_terms, folds, held_out_error
from robot_sysid.identify.payload.data.rows import FilteredRows
from robot_sysid.identify.payload.joint_fit import fit_jointly


def test_folds_share_nothing_and_leave_nothing_out(fit):
    parts = folds(fit.samples)
    assert len(parts) == FOLDS
    used = [[np.isfinite(each.tau[0]) for each in fold] for fold in parts]
    for recording in range(len(fit.samples)):
        together = np.sum([fold[recording] for fold in used], axis=0)
        np.testing.assert_array_equal(together, 1)


def test_the_error_is_that_of_the_noise(fit):
    found = held_out_error(fit)
    residual = np.sqrt(np.mean([fit.weighted.noise**2]))
    assert found.rmse == pytest.approx(residual, rel=0.15)
    assert 0.0 < found.relative_error < 0.05
    assert set(found.rmse_per_joint) == set(fit.equations.joint_names)


@pytest.mark.slow
def test_a_root_of_speed_is_taken_where_it_is_there_and_left_where_it_is_not(task, recordings, fit):
    assert choose_terms(task, recordings, fit).name == "without"
    rooted = []
    for each in recordings:
        signals = each.source.signals
        root = 0.5 * np.sign(signals.qd) * np.sqrt(np.abs(signals.qd))
        source = FilteredRows(replace(signals, tau=signals.tau + root))
        rooted.append(replace(each, source=source))
    assert choose_terms(task, rooted, fit_jointly(task, rooted)).name == "with"
