"""The self-test: a model's own values come back from its own simulation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.pipeline.self_test import run_self_test, self_test_verdict
from robot_sysid.records import Identifiability, Source
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import Verdict
from robot_sysid.trajectory import CHUNK
from tests.support import results
from tests.support.measured_logs import plan_of, true_arm


class ChunkCounter(Progress):
    """Counts notes and the chunks that a run has worked through."""

    def __init__(self):
        self.notes = []
        self.n_chunks = 0

    def note(self, *messages):
        self.notes += messages

    def track(self, items, label, total):
        for item in items:
            self.n_chunks += 1
            yield item


@pytest.mark.parametrize(
    ("torques", "friction"), [("chain", True), ("terminal", False)]
)
def test_the_models_own_values_come_back_with_where_they_are_from(torques, friction):
    plant = true_arm()
    options = EstimationOptions(torques=torques, no_friction=not friction)
    progress = ChunkCounter()
    plan = plan_of(plant, 1, 4.0)
    identification = run_self_test(plant, plan, 500.0, 7, options, progress)
    result = identification.result
    estimate = result.estimate
    assert_allclose(estimate.values[:10], plant.prior.theta, rtol=0.0, atol=1e-10)
    coefficients = [
        estimate.value("coulomb[joint2]"),
        estimate.value("viscous[joint2]"),
    ]
    assert coefficients == (
        pytest.approx([0.3, 0.2], abs=1e-10) if friction else [None, None]
    )
    is_full = torques == "chain"
    assert result.verdict is (Verdict.OK if is_full else Verdict.PARTLY_FROM_MODEL)
    assert (result.torques, result.relative_mass_error) == (torques, None)
    assert not result.is_measured
    traces = identification.traces()
    assert_allclose(traces.predicted, traces.measured, atol=1e-9)
    assert_allclose(traces.prior_prediction, traces.measured, atol=1e-9)
    assert progress.notes == [] and progress.n_chunks == int(np.ceil(2001 / CHUNK))
    data = result.data
    origin = data.source, data.duration, data.sample_rate, data.seed
    assert origin == (Source.ITSELF, plan.duration, 500.0, 7)


POSSIBLE = spatial.theta_from_com(1.0, np.zeros(3), np.eye(3))


@pytest.mark.parametrize(
    ("scale", "error", "rank", "expected"),
    [
        (1.0, 0.49, 12, Verdict.OK),
        (1.0, 0.51, 12, Verdict.TOO_WEAK),
        (1.0, 0.51, 11, Verdict.TOO_WEAK),
        (1.0, 0.49, 11, Verdict.PARTLY_FROM_MODEL),
        (1.0, np.inf, 11, Verdict.PARTLY_FROM_MODEL),
        # An error that a scale would not show is never too large.
        (1e-9, 0.9e-6, 12, Verdict.OK),
        (1e-9, 1.1e-6, 12, Verdict.TOO_WEAK),
    ],
)
def test_the_verdict_on_an_own_simulation_says_what_is_wrong_first(
    scale, error, rank, expected
):
    estimate = results.estimate(
        values=np.append(scale * POSSIBLE, np.zeros(4)),
        standard_errors=np.append(error, np.zeros(13)),
        identifiability=Identifiability(rank, 12, 1.0, 1.0, (True,) * 14, ()),
    )
    assert self_test_verdict(estimate) is expected
