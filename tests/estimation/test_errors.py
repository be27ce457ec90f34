"""Stated standard errors are as large as errors are, and add up from their causes."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.real_arms import ARMS, SENSOR_ARMS, draw_arm
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.estimation import errors as errors_module
from robot_sysid.estimation.algebra.priors import misfits
from robot_sysid.estimation.choices import choose
from robot_sysid.estimation.columns import PAYLOAD_NAMES
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.identify import Piece, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import COMMON, SCALES
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Measurement
from robot_sysid.records.messages import Progress
from tests.support import arms
from tests.support.core_fits import NOISE_ONLY, fit_logs, fit_recordings, fitter_of
from tests.support.imperfect_arm import ImperfectArm, Imperfections
from tests.support.measured_logs import log_of, plan_of, seeded_log
from tests.support.payload_logs import PAYLOAD, RATE, TrueArm, add_torque, wide_motion
from tests.support.places import DATA, MODELS
from tests.support.synthetic_data import autocorrelated

SMALL = arms.robot_of(arms.THREE)
WITHIN = 3.5
"""Standard errors by which the worst of some twenty parameters may differ from the truth."""
NOISY_SENSORS = {"noise_torque": 0.1, "encoder_resolution": 1e-4}
EXACT_MODEL = EstimationOptions(**NOISE_ONLY)


def exact_recording(robot):
    """Return (an arm that is as its model says, an exact recording of it)."""
    arm = TrueArm(robot, 1, model_error=0.0)
    return arm, arm.recording(wide_motion(3, 3), False)


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 0.1 * RATE])
def test_errors_are_the_spread_of_many_recordings(memory):
    """Of torque noise alone, white or autocorrelated (``memory`` in samples)."""
    arm, exact = exact_recording(SMALL)
    errors = []
    stated = []
    for run in range(48):
        white = np.random.default_rng(run).standard_normal(exact.torque.shape)
        noise = 0.1 * autocorrelated(white, memory)
        fit = fit_recordings(SMALL, [add_torque(exact, noise)], EXACT_MODEL)
        errors.append((fit.values - arm.values(fit.columns))[fit.unknowns.estimated])
        stated.append(fit_errors(fit).total.standard_errors)
    squares = np.mean(np.square(errors), axis=0) / np.mean(np.square(stated), axis=0)
    assert np.all((np.sqrt(squares) > 0.6) & (np.sqrt(squares) < 1.6))
    coverage = np.mean(np.abs(errors) < 1.96 * np.array(stated))
    assert coverage == pytest.approx(0.95, abs=0.03)


@pytest.mark.slow
def test_total_errors_cover_everything_that_is_wrong_with_an_arm():
    plan = plan_of(SMALL, 1, 20.0)
    sizes = Imperfections(
        links=0.04, zero=2e-3, tilt=np.radians(0.4), lag=3e-3, load=0.02, noise=0.2
    )
    ratios = []
    for run in range(24):
        rng = np.random.default_rng(run)
        scale = 1.0 + 0.02 * rng.standard_normal(3)
        arm = ImperfectArm(SMALL, rng, sizes, scale)
        fit = fit_logs(SMALL, arm.log(plan, np.zeros(10), rng))
        stated = fit_errors(fit).total.standard_errors[:10]
        ratios.append((fit.values[:10] - arm.thetas[-1]) / stated)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert np.mean(np.abs(ratios) < 1.96) > 0.9


@pytest.mark.parametrize(("seed", "seconds"), [(2, 0.1), (0, 0.3)])
def test_autocorrelated_noise_contradicts_no_prior(plant, seed, seconds):
    """The model is the plant; by white noise of that size, priors would be contradicted."""
    log = seeded_log(plant, seed, **NOISY_SENSORS)
    white = np.random.default_rng(seed).standard_normal(log.tau.shape)
    slow = 0.1 * autocorrelated(white, 200.0 * seconds)
    fit = fit_logs(plant, replace(log, tau=log.tau + slow))
    assert fit_errors(fit).conflicts == ()
    assert misfits(fit.information, 1.0 / fit.weights, fit.unknowns.groups)


@pytest.mark.slow
@pytest.mark.parametrize("is_repeated", [True, False])
def test_more_logs_make_nothing_worse(plant, robot, is_repeated):
    """One, ten and a hundred logs, of one motion or of different ones."""
    errors = []
    for count in (1, 10, 100):
        logs = []
        for k in range(count):
            plan = plan_of(plant, 1 if is_repeated else 1 + k)
            logs.append(log_of(plant, plan, k, **NOISY_SENSORS))
        fit = fit_logs(robot, *logs)
        errors.append(fit_errors(fit).total.standard_errors[0])
        assert abs(fit.values[0] - plant.prior.mass) < 2.0 * errors[-1]
    assert errors[0] > errors[1] > 0.98 * errors[2]


# ---- of a payload


@pytest.fixture(scope="module")
def errors(payload_fit):
    return fit_errors(payload_fit)


@pytest.fixture(scope="module")
def payload_rows(payload_fit):
    """Return the rows (10, free parameters) that pick the payload."""
    free = payload_fit.unknowns.estimated
    return np.eye(len(free))[
        np.searchsorted(free, payload_fit.columns.indices(PAYLOAD_NAMES))
    ]


def test_squares_of_the_causes_and_of_noise_add_up(payload_fit, errors, payload_rows):
    covariance, noise, budget = errors.of(payload_rows, PAYLOAD)
    assert COMMON not in budget and len(budget) >= 6
    total = noise**2 + np.sum([part**2 for part in budget.values()], axis=0)
    assert_allclose(np.diag(covariance), total, rtol=1e-6)


def test_a_scale_of_all_joints_is_an_error_in_proportion(errors, payload_rows):
    """No torque shows it: 3 % of each of four joints is 1.5 % of all."""
    covariance, _, budget = errors.of(payload_rows, None)
    covariance_scaled, _, budget_scaled = errors.of(payload_rows, PAYLOAD)
    assert errors.common == pytest.approx(0.015, rel=0.01)
    growth = np.sqrt(np.diag(covariance_scaled) - np.diag(covariance))
    assert_allclose(growth, errors.common * np.abs(PAYLOAD), rtol=1e-6)
    assert budget_scaled[SCALES][0] > budget[SCALES][0]


def test_the_truth_lies_within_the_errors(payload_fit, errors, payload_rows):
    payload = payload_fit.values[payload_fit.columns.indices(PAYLOAD_NAMES)]
    stated = np.sqrt(np.diag(errors.of(payload_rows, payload)[0]))
    assert np.max(np.abs(payload - PAYLOAD) / stated) < WITHIN
    assert np.all(errors.are_identified(payload_rows))
    share = errors.share(payload_fit)
    assert np.all((share >= 0.0) & (share <= 1.0))
    names = payload_fit.unknowns.estimated_names
    assert share[names.index("m(payload)")] > 0.99
    # Its own joint shows nothing of it; the weights of other links say a little.
    assert share[names.index("m(link0)")] < 0.3


def test_parameters_that_no_torque_shows_have_infinite_errors():
    """Axes parallel to gravity: the moment along them, and any sum with it, stays unknown."""
    upright = arms.robot_of(arms.serial_arm((arms.Z,) * 3))
    arm = TrueArm(upright, 1, model_error=0.0)
    recording = arm.recording(wide_motion(1, 3), False)
    fit = fit_recordings(upright, [recording], EXACT_MODEL)
    errors = fit_errors(fit)
    rows = np.eye(len(fit.unknowns.estimated))[:10]
    visible = [name in ("m", "hx", "hy", "Izz") for name in PARAMETER_NAMES]
    assert_array_equal(errors.are_identified(rows), visible)
    assert np.isinf(errors.of(rows[3:4])[1][0])
    assert not errors.are_identified(rows[:1] + rows[3:4])[0]


# ---- more data
# A longer log also shows better how wrong the model's links are, and which prior it contradicts.
# That may widen the priors, and errors with them. With the priors and choices of the full log in
# all of its pieces, nothing may grow.

GROWTH = 1.05
"""Largest ratio of a stated error to that of a part of the data; noise is estimated anew."""
SHARES = (0.25, 0.5, 1.0)
QUESTION = Question(EstimationOptions())


def cut_log(log, share):
    """Return the beginning of a log."""
    end = int(share * len(log.time))
    return Measurement(log.time[:end], log.q[:end], None, log.tau[:end])


def pieces_of_a_real_log(run):
    """Return (robot, a list of logs for each share) of a KUKA LWR4+."""
    if not DATA.exists():
        pytest.skip("the logs of real arms are not here")
    folder = DATA / "kuka_lwr4"
    robot = load_robot_model(folder / "kuka_lwr4.urdf")
    path = folder / f"lwr4_hw{run}_200Hz.csv"
    log = open_log(robot, path, LogOptions(), Progress()).samples
    return robot, [[cut_log(log, share)] for share in SHARES]


def pieces_of_a_wrong_model(arm_name, seed):
    """Return (robot, a list of logs for each share) of an arm with links as wrong as real ones."""
    if not MODELS.exists():
        pytest.skip("public models are not here")
    robot = load_robot_model(MODELS / ARMS[arm_name])
    has_sensors = arm_name in SENSOR_ARMS
    log = draw_arm(robot, "real", has_sensors, 24.0, seed % 2 == 0, seed).log
    return robot, [[cut_log(log, share)] for share in SHARES]


def repetitions(arm_name, seed):
    """Return (robot, one, two and four copies with new noise) of half of such a log."""
    robot, (_, (log,), _) = pieces_of_a_wrong_model(arm_name, seed)
    rng = np.random.default_rng(seed)
    size = 0.003 * np.max(np.abs(log.tau), axis=0)
    logs = [
        replace(log, tau=log.tau + size * rng.standard_normal(log.tau.shape))
        for _ in range(4)
    ]
    return robot, [logs[:count] for count in (1, 2, 4)]


CASES = [
    pytest.param(pieces_of_a_real_log, (2,), id="run_2"),
    pytest.param(pieces_of_a_real_log, (3,), id="run 3"),
    pytest.param(pieces_of_a_wrong_model, ("ur5e", 2), id="ur5e 2"),
    pytest.param(pieces_of_a_wrong_model, ("ur5e", 3), id="ur5e 3"),
    pytest.param(pieces_of_a_wrong_model, ("iiwa14", 0), id="iiwa14"),
    pytest.param(repetitions, ("ur5e", 2), id="repeated ur5e"),
    pytest.param(repetitions, ("iiwa14", 0), id="repeated iiwa14"),
]


def fitter_of_logs(robot, logs):
    """Return the fitter of logs, each low-passed as a recording of its own."""
    pieces = [Piece(f"log{number}", log) for number, log in enumerate(logs)]
    return fitter_of(robot, low_pass_recordings(robot, pieces, QUESTION.options)[0])


def choice_and_start(fitter):
    """Return (choice of a fitter's logs, point at which the fit begins)."""
    choice, _, start = choose(fitter, QUESTION, QUESTION.options.friction)
    return choice, start


def mass_errors(fit, errors):
    """Return the stated errors (links,) of all masses [kg]."""
    estimated = fit.unknowns.estimated
    masses = [indices[0] for indices, _ in fit.unknowns.bodies.values()]
    rows = np.eye(len(estimated))[np.searchsorted(estimated, masses)]
    covariance, _, _ = errors.of(rows, fit.values[masses])
    return np.sqrt(np.diag(covariance))


def growth_of(errors):
    """Return ratios (shares - 1, n) of errors (shares, n) to the least of smaller shares."""
    return errors[1:] / np.minimum.accumulate(errors, axis=0)[:-1]


@pytest.mark.slow
@pytest.mark.parametrize(("pieces", "arguments"), CASES)
def test_with_unchanged_priors_more_data_makes_no_mass_less_certain(
    pieces, arguments, monkeypatch
):
    robot, logs_of_share = pieces(*arguments)
    fitters = [fitter_of_logs(robot, logs) for logs in logs_of_share]
    choice, _ = choice_and_start(fitters[-1])
    monkeypatch.setattr(errors_module, "misfits", lambda *_: ())
    stated = []
    for fitter in fitters:
        fit = fitter.fit(QUESTION, choice)
        stated.append(mass_errors(fit, fit_errors(fit)))
    assert np.max(growth_of(np.array(stated))) < GROWTH


@pytest.mark.slow
@pytest.mark.parametrize(("pieces", "arguments"), [CASES[k] for k in (0, 2, 4)])
def test_errors_grow_no_more_than_the_prior_of_links(pieces, arguments):
    """By default, with everything chosen anew from each share."""
    robot, logs_of_share = pieces(*arguments)
    errors = []
    scales = []
    for logs in logs_of_share:
        fitter = fitter_of_logs(robot, logs)
        choice, start = choice_and_start(fitter)
        fit = fitter.fit(QUESTION, choice, start)
        errors.append(mass_errors(fit, fit_errors(fit)))
        scales.append(astuple(choice.link_scales))
    print(np.round(errors, 3), np.round(scales, 2), sep="\n")
    wider = np.max(growth_of(np.array(scales)), axis=1)
    growth = growth_of(np.array(errors))
    assert np.all(growth < GROWTH * np.maximum(wider, 1.0)[:, None])
