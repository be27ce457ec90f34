"""From logs to a result: a common filter, its numbers, its verdict, its notes and its traces."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.dynamics.inverse_dynamics import TILT_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimate.identify import Piece, identify_link, low_pass_recordings
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.result import link_result, traces_of
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import LINK, Verdict
from tests.support import arms
from tests.support.core_fits import BASIC, ORIGIN, filter_logs
from tests.support.imperfect_arm import ImperfectArm, Imperfections
from tests.support.measured_logs import XML, log_of, plan_of


def fits_of(robot, log, kept=(), **options):
    """Return the fits of a log and of its file, which keeps the parts ``kept``."""
    options = EstimationOptions(**options)
    return identify_link(robot, filter_logs(robot, log), options, Progress(), kept)


def result_of(*arguments, **options):
    return link_result(*fits_of(*arguments, **options), (), ORIGIN)


@pytest.fixture(scope="module")
def fits(robot, noisy):
    return fits_of(robot, noisy)


@pytest.fixture(scope="module")
def result(fits):
    return link_result(*fits, (), ORIGIN)


def test_all_logs_pass_the_lowest_cutoff_that_one_requires(plant, robot, noisy):
    coarse = log_of(plant, encoder_resolution=3e-3)
    cutoffs = []
    for logs in ([noisy], [coarse], [noisy, coarse]):
        recordings = filter_logs(robot, *logs, cutoff=None)
        cutoffs += [recording.signals.cutoff for recording in recordings]
    fine_cutoff, coarse_cutoff, *common_cutoffs = cutoffs
    assert common_cutoffs == [coarse_cutoff] * 2 and coarse_cutoff < fine_cutoff
    is_kept = noisy.time % 0.3 > 0.12
    fields = (noisy.time, noisy.q, None, noisy.tau)
    damaged = Measurement(*(f if f is None else f[is_kept] for f in fields))
    pieces = [Piece("complete", noisy), Piece("damaged", damaged)]
    with pytest.raises(InputError, match="damaged: only .* free of lost samples"):
        low_pass_recordings(robot, pieces)


def test_bodies_joints_and_sensors_are_those_of_the_plant(plant, result):
    assert result.question == LINK
    assert result.verdict is Verdict.BETTER and not result.reasons
    assert list(result.links) == ["link0", "link1", "link2"]
    assert [link.joint for link in result.links.values()] == list(plant.joint_names)
    first, _, last = result.links.values()
    error = np.abs(last.theta - plant.prior.theta)
    assert np.max(error / last.errors) < 4.0 and result.relative_mass_error < 0.25
    assert first.data_share[0] < 0.3 and last.data_share[9] > 0.9
    for name, joint in result.joints.items():
        assert set(joint.terms) == set(BASIC.split("-"))
        assert joint.terms["coulomb"].value == pytest.approx(0.3, abs=0.05)
        assert joint.noise == pytest.approx(0.1 * np.sqrt(2.0 * 8.0 / 200.0), rel=0.3)
        sensors = {f"{term}[{name}]" for term in ("scale", "zero", "load")}
        assert sensors <= set(result.sensors)
    estimate = result.estimate
    assert estimate.names[:10] == spatial.PARAMETER_NAMES
    assert len(estimate.identifiability.identified) == 10 + 4 * 3
    assert result.validation[0].rmse < 1.5 * estimate.rmse


@pytest.mark.parametrize(
    ("share", "verdict", "is_noted"),
    [
        (0.01, Verdict.BETTER, False),
        (0.07, Verdict.BETTER, True),
        (0.2, Verdict.TORQUES_ONLY, True),
    ],
)
def test_unexplained_torque_is_noted(robot, noisy, share, verdict, is_noted):
    """A slow torque that no motion makes: the file may still predict better, its numbers not."""
    wave = np.sqrt(2.0) * np.sin(2.0 * np.pi * 0.37 * noisy.time)
    torque = np.outer(wave, share * np.sqrt(np.mean(noisy.tau**2, axis=0)))
    result = result_of(robot, replace(noisy, tau=noisy.tau + torque))
    assert result.verdict is verdict and result.failure is None
    message = "explained by neither the model nor noise"
    notes = tuple(note for note in result.notes if message in note)
    assert len(notes) == is_noted
    assert result.reasons == (notes if verdict is Verdict.TORQUES_ONLY else ())


@pytest.mark.parametrize("seed", [0, 1])
def test_sensor_parameters_are_the_deviation_from_the_model(plant, seed):
    """An arm that is tilted and late, with wrong zeros and scales, all estimated at once."""
    rng = np.random.default_rng(seed)
    sizes = Imperfections(
        links=0.02, scale=0.02, tilt=np.radians(0.3), lag=0.004, load=0.01, noise=0.05
    )
    arm = ImperfectArm(plant, rng, sizes)
    log = arm.log(plan_of(plant, seed, 20.0), np.zeros(10), rng)
    result = result_of(plant, log)
    truth = arm.sensors()
    assert truth.keys() <= result.sensors.keys()
    for name, (value, error) in result.sensors.items():
        # Friction terms without a true value may be there and are not.
        assert abs(value - truth.get(name, 0.0)) < 4.0 * error, name
    assert {"delay", *TILT_NAMES} <= result.sensors.keys()


def test_a_resting_joint_keeps_the_models_numbers_and_an_offset_is_noted(
    plant, robot, result
):
    plan = plan_of(plant).scale_amplitudes(np.array([1.0, 1.0, 0.0]))
    log = log_of(plant, plan, noise_torque=0.05)
    resting = result_of(robot, replace(log, tau=log.tau + [0.0, 1.0, 0.0]))
    joint = resting.joints["joint2"]
    assert joint.friction_model == "none" and not joint.terms
    assert "joint2" not in resting.file.joints
    notes = "\n".join(resting.notes)
    assert "joint2 does not move fast enough" in notes
    _, text = notes.split("no model file holds an offset of a torque sensor (joint1 ")
    assert float(text.split()[0]) == pytest.approx(1.0, abs=0.1)
    assert not any("torque sensor" in note for note in result.notes)


def test_a_log_with_its_joints_reversed_is_refused(robot, noisy):
    result = result_of(robot, replace(noisy, tau=noisy.tau[:, ::-1]))
    assert not result.verdict.is_trustworthy and result.failure


@pytest.mark.parametrize(
    ("rotor", "verdict", "note"),
    [
        (0.05, Verdict.BETTER, "^not estimated, .*: offset, armature$"),
        (0.0, Verdict.TORQUES_ONLY, r"left out \(offset, armature\)"),
    ],
)
def test_numbers_that_take_up_friction_left_out_are_not_called_usable(
    plant, rotor, verdict, note
):
    log = log_of(plant, noise_torque=0.02, encoder_resolution=1e-5)
    xml = XML.replace('armature=".05"', f'armature="{rotor}"').replace(
        'damping=".2"', ""
    )
    result = result_of(arms.robot_of(xml), log, friction_model="coulomb-viscous")
    assert result.verdict is verdict and result.failure is None
    notes = tuple(text for text in result.notes if re.search(note, text))
    assert len(notes) == 1
    assert result.reasons[-1:] == (() if verdict is Verdict.BETTER else notes)
    assert not result.wrong_links


@pytest.mark.parametrize("options", [{"no_friction": True}, {"torques": "terminal"}])
def test_every_option_gives_a_possible_result(robot, noisy, options):
    result = result_of(robot, noisy, **options)
    # Friction that may not be estimated is torque that nothing explains.
    assert result.verdict.is_trustworthy == ("no_friction" not in options)
    assert result.failure is None and result.estimate.inertial.is_consistent
    file = result.file
    after = file.validation_after.relative_error
    assert after < file.validation_before.relative_error


def test_traces_hold_the_residual_of_the_file(robot, fits):
    _, file = fits
    traces = traces_of(*fits)
    assert traces.joints == robot.joint_names
    squares = file.fit.sums.squared_residuals(file.fit.full)
    assert_allclose(np.nansum(traces.residual**2, axis=0), squares, rtol=1e-6)
    # The model before is clearly worse.
    error_before = np.nanstd(traces.measured - traces.prior_prediction, axis=0)
    assert np.all(error_before > 2.0 * np.nanstd(traces.residual, axis=0))
