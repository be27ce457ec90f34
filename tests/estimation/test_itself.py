"""A model identified from its own simulation gives itself back, and says what the data was."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.identify import ITSELF, identify_itself
from robot_sysid.records import Source
from robot_sysid.records.progress import Progress
from robot_sysid.results.record import Verdict
from robot_sysid.trajectory import CHUNK
from tests.support.measured_logs import plan_of


class Listener(Progress):
    """Remembers what it is told."""

    def __init__(self):
        self.notes, self.steps = [], 0

    def note(self, message):
        self.notes.append(message)

    def track(self, items, label, total):
        for item in items:
            self.steps += 1
            yield item
        assert self.steps == total


@pytest.mark.parametrize("torques", ["chain", "terminal"])
@pytest.mark.parametrize("friction", [True, False])
def test_the_models_own_values_come_back(plant, torques, friction):
    options = EstimationOptions(torques=torques, no_friction=not friction)
    plan = plan_of(plant, 1, 4.0)
    found, traces = identify_itself(plant, plan, 200.0, 7, options, Progress())
    estimate = found.estimate
    np.testing.assert_allclose(estimate.values[:10], plant.prior.theta, rtol=0.0, atol=1e-10)
    values = [estimate.value(f"{term}[joint2]") for term in ("coulomb", "viscous")]
    assert values == (pytest.approx([0.3, 0.2], abs=1e-10) if friction else [None, None])
    whole = torques == "chain"
    assert found.verdict is (Verdict.OK if whole else Verdict.PARTLY_FROM_MODEL)
    assert (found.torques, estimate.method, found.known_to) == (torques, "ols", None)
    drawn = traces()
    np.testing.assert_allclose(drawn.predicted, drawn.measured, atol=1e-9)
    np.testing.assert_allclose(drawn.before, drawn.measured, atol=1e-9)


def test_the_result_says_what_the_data_was(plant):
    listener, plan = Listener(), plan_of(plant, 1, 6.0)
    found, _ = identify_itself(plant, plan, 1000.0, 7, EstimationOptions(), listener)
    assert listener.notes == [ITSELF] and listener.steps == int(np.ceil(6001 / CHUNK))
    data = found.data
    assert (data.source, data.duration, data.sample_rate, data.seed) == (
        *(Source.ITSELF, plan.duration, 1000.0, 7),
    )
    assert not found.is_measured and found.joint_names == plant.joint_names
    assert (found.delay, found.tilt, found.cutoff, found.validation) == (None, None, None, ())
