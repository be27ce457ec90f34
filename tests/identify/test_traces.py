"""What a report draws comes from the equations that the result was made with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.config import config_from
from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.fit import fit_measured
from robot_sysid.pipeline import run
from robot_sysid.records.progress import Progress
from tests.support import arms, measured_logs


def test_the_residual_of_a_log_is_that_of_the_fit():
    plant = measured_logs.true_arm()
    model = measured_logs.guessed(plant)
    log = measured_logs.log_of(plant, noise_torque=0.05)
    options = EstimationOptions(cutoff=measured_logs.CUTOFF, validate=0.0)
    fit = fit_measured(model, [log], options, Progress())
    traces = fit.traces()
    for joint, residual, counted in zip(traces.joints, traces.residual.T, traces.measured.T):
        assert np.count_nonzero(np.isfinite(counted)) == fit.estimate.samples[joint]
        rmse = float(np.sqrt(np.nanmean(residual**2)))
        assert rmse == pytest.approx(fit.estimate.rmse_per_joint[joint], rel=1e-9)
    # The guess is clearly worse, and dry friction is most of what friction makes at low speed.
    worse = np.nanstd(traces.measured - traces.before, axis=0)
    assert np.all(worse > 2.0 * np.nanstd(traces.residual, axis=0))
    assert np.nanmax(np.abs(traces.friction[:, -1])) == pytest.approx(
        0.3 + 0.2 * np.nanmax(np.abs(traces.qd[:, -1])), rel=0.2
    )


def test_a_simulation_of_the_model_itself_is_explained_to_rounding(arm_file, tmp_path):
    path = arm_file(arms.THREE)
    options = {"duration": 3.0, "sample_rate": 200.0, "seed": 1, "output_dir": tmp_path / "out"}
    outcome = run(config_from(path, **options))
    traces = outcome.traces()
    np.testing.assert_allclose(traces.predicted, traces.measured, atol=1e-9)
    np.testing.assert_allclose(traces.before, traces.measured, atol=1e-9)
    assert traces.truth is None


def test_a_simulated_plant_tells_the_truth(arm_file, tmp_path):
    path = arm_file(arms.THREE)
    options = {"duration": 4.0, "sample_rate": 200.0, "seed": 1, "output_dir": tmp_path / "out"}
    outcome = run(config_from(path, plant_model=path, **options))
    truth = outcome.traces().truth
    np.testing.assert_array_equal(truth.theta, outcome.identification.prior.theta)


def test_shapes_that_do_not_belong_together_are_refused():
    plant = measured_logs.true_arm()
    options = EstimationOptions(cutoff=measured_logs.CUTOFF, validate=0.0)
    fit = fit_measured(plant, [measured_logs.log_of(plant)], options, Progress())
    with pytest.raises(InputError, match="measured has shape"):
        replace(fit.traces(), measured=np.zeros((3, 3)))
