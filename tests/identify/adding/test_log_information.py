"""What logs say adds: the sum says what all logs say together, whatever their number and length."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.adding.log_information import (
    MOST_NOTES,
    fit_from,
    log_information,
    settled_options,
)
from robot_sysid.identify.fit import fit_measured
from robot_sysid.records.progress import Progress
from tests.support.measured_logs import CUTOFF, RATE, guessed, log_of, plan_of, true_arm

OPTIONS = settled_options(EstimationOptions(cutoff=CUTOFF))
LENGTHS = (10.0, 14.0, 25.0)


@pytest.fixture(scope="module")
def robot():
    return guessed(true_arm(), 0.9)


@pytest.fixture(scope="module")
def logs():
    plant = true_arm()
    lengths = enumerate(LENGTHS)
    return [log_of(plant, plan_of(plant, 1 + k, s), k, noise_torque=0.1) for k, s in lengths]


@pytest.fixture(scope="module")
def first(robot, logs):
    return sum(log_information(robot, [log], OPTIONS) for log in logs)


@pytest.fixture(scope="module")
def parts(robot, logs, first):
    return [log_information(robot, [log], OPTIONS, first) for log in logs]


@pytest.fixture(scope="module")
def together(robot, logs):
    return fit_measured(robot, logs, OPTIONS, Progress())


def test_the_sum_gives_the_estimate_of_all_logs(robot, parts, together):
    found, whole = fit_from(robot, sum(parts)).estimate, together.estimate
    assert found.names == whole.names and found.samples == whole.samples
    off = np.abs(found.values - whole.values) / whole.standard_errors
    assert np.max(off) < 1e-6
    assert found.standard_errors == pytest.approx(whole.standard_errors, rel=0.15)
    assert found.error_budget.keys() == whole.error_budget.keys()


def test_a_third_round_gives_the_errors_of_all_logs(robot, logs, parts, together):
    second = sum(parts)
    found = fit_from(robot, sum(log_information(robot, [x], OPTIONS, second) for x in logs))
    whole = together.estimate
    off = np.abs(found.estimate.values - whole.values) / whole.standard_errors
    assert np.max(off) < 0.02
    assert found.estimate.standard_errors == pytest.approx(whole.standard_errors, rel=0.01)


def test_what_else_a_fit_knows_comes_along(robot, parts, together):
    found = fit_from(robot, parts[0] + parts[1], parts[2])
    passed = np.sqrt(2.0 * CUTOFF / RATE)
    assert found.validation.rmse == pytest.approx(0.1 * passed, rel=0.2)
    assert found.validation.n_samples == max(parts[2].information.joints, key=_count).n_samples
    whole = fit_from(robot, sum(parts))
    assert whole.torque == pytest.approx(together.torque)
    assert whole.cutoff == together.cutoff and whole.friction == together.friction
    assert len(whole.checkpoints.q) == 400 and len(whole.notes) <= MOST_NOTES
    with pytest.raises(InputError, match="holds no samples"):
        whole.traces()


def _count(joint):
    return joint.n_samples


def test_brackets_do_not_matter(robot, parts):
    one, two, three = parts
    left, right = ((one + two) + three), (one + (two + three))
    values = [fit_from(robot, each).estimate.values for each in (left, right, three + two + one)]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(values[2], values[0], rtol=1e-9, atol=1e-12)
    assert left.logs == 3 and left.duration == pytest.approx(sum(LENGTHS), abs=0.1)


def test_pieces_of_a_log_count_as_one_log(robot, logs, first):
    both = log_information(robot, logs[:2], OPTIONS, first)
    added = sum(log_information(robot, [log], OPTIONS, first) for log in logs[:2])
    assert (both.logs, added.logs) == (1, 2)
    for ours, theirs in zip(both.residuals, added.residuals):
        np.testing.assert_allclose(ours.products, theirs.products, atol=1e-12)


def test_what_is_sent_does_not_grow(robot, first, parts):
    """Neither with the length of a log nor with their number, once the sample of rows is full."""
    sizes = [len(pickle.dumps(replace(each, notes=()))) for each in (*parts, sum(parts))]
    per_row = 8 * (3 + 5 * robot.n_joints + len(parts[0].residuals))
    rows = [len(each.rows.drawn) for each in (*parts, sum(parts))]
    constant = [size - per_row * count for size, count in zip(sizes, rows)]
    assert max(constant) - min(constant) < 200
    again = pickle.loads(pickle.dumps(sum(parts)))
    values = [fit_from(robot, each).estimate.values for each in (again, sum(parts))]
    np.testing.assert_array_equal(*values)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cutoff": 7.0}, r"cutoff \(8.0 and 7.0\)"),
        ({"friction_model": "coulomb"}, r"friction_model \(None and coulomb\)"),
        ({"link_uncertainty": 0.0}, "link_uncertainty"),
        ({"velocity_deadband": 0.1}, "velocity_deadband"),
    ],
)
def test_what_was_settled_differently_does_not_add(robot, logs, first, changed, words):
    other = log_information(robot, logs[:1], replace(OPTIONS, **changed))
    with pytest.raises(InputError, match=words):
        _ = first + other
    with pytest.raises(InputError, match=words):
        log_information(robot, logs[:1], OPTIONS, other)


def test_rounds_and_models_are_kept_apart(robot, logs, first, parts):
    with pytest.raises(InputError, match="the first round"):
        _ = first + parts[0]
    with pytest.raises(InputError, match="first round, which does not know its errors"):
        fit_from(robot, first)
    with pytest.raises(InputError, match="the model"):
        fit_from(replace(robot, sha256="another"), sum(parts))
    with pytest.raises(InputError, match="add each log once"):
        _ = parts[0] + parts[0]
    with pytest.raises(TypeError):
        _ = first + 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"cutoff": None}, "give cutoff=HZ"),
        ({"friction_model": "auto"}, "friction_model='auto'"),
        ({"delay": "auto"}, "delay='auto'"),
        ({"tilt": "auto"}, "tilt='auto'"),
        ({"method": "robust"}, "method='robust'"),
    ],
)
def test_what_depends_on_all_logs_is_refused(options, words):
    with pytest.raises(InputError, match=words):
        settled_options(EstimationOptions(**{"cutoff": CUTOFF, **options}))
