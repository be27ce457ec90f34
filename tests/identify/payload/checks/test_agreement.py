"""Recordings on the wrong side are found whatever they are said to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.identify.payload.checks.agreement import contradictions, masses_apart, misfits
from robot_sysid.identify.payload.joint_fit import fit_jointly
from tests.support.payload_logs import PAYLOAD


def test_masses_are_those_on_the_arm(fit, recordings):
    masses, errors = masses_apart(fit, fit.samples)
    truth = [PAYLOAD[0] * each.is_loaded for each in recordings]
    assert masses == pytest.approx(truth, abs=0.03)
    assert errors[0] == 0.0 and np.all(errors[1:] > 0.0) and np.all(errors < 0.05)
    assert contradictions(fit, recordings) == ()


@pytest.mark.slow
def test_a_recording_on_the_wrong_side_is_named_with_all_masses(task, recordings):
    wrong = list(recordings)
    wrong[0] = replace(wrong[0], is_loaded=True)
    wrong[1] = replace(wrong[1], is_loaded=False)
    told = contradictions(fit_jointly(task, wrong), wrong)
    assert [name for name, _ in told] == ["log0", "log1", "log2", "log3"]
    assert [mass for _, mass in told] == pytest.approx([0.0, 1.2, 1.2, 0.0], abs=0.05)


@pytest.mark.parametrize(("off", "told"), [(0.01, False), (0.08, False), (0.3, True)])
def test_only_clear_differences_count(recordings, off, told):
    masses = np.array([0.0, 1.0, 1.0 + off, 0.0])
    assert bool(misfits(recordings, masses, np.full(4, 0.01))) == told
