"""Information of logs adds: the sum is that of all logs together, whatever their number."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from robot_sysid.errors import InputError
from robot_sysid.estimation.identify import answer_link
from robot_sysid.estimation.log_information import (
    answer_from,
    log_information,
    settled_options,
)
from robot_sysid.estimation.question import FILE_GRAVITY, EstimationOptions
from robot_sysid.records.messages import Progress
from tests.support.core_fits import filter_logs
from tests.support.measured_logs import CUTOFF, RATE, log_of, plan_of

OPTIONS = settled_options(EstimationOptions(cutoff=CUTOFF))
DURATIONS = (10.0, 14.0, 25.0)


@pytest.fixture(scope="module")
def logs(plant):
    logs = []
    for k, duration in enumerate(DURATIONS):
        logs.append(log_of(plant, plan_of(plant, 1 + k, duration), k, noise_torque=0.1))
    return logs


@pytest.fixture(scope="module")
def first_round(robot, logs):
    return sum(log_information(robot, [log], OPTIONS) for log in logs)


@pytest.fixture(scope="module")
def second_round(robot, logs, first_round):
    """Return the information of each log, given the first round."""
    return [log_information(robot, [log], OPTIONS, first_round) for log in logs]


@pytest.fixture(scope="module")
def answer(robot, second_round):
    return answer_from(robot, sum(second_round))


def test_the_sum_gives_the_estimate_and_the_file_of_all_logs(robot, logs, answer):
    datasets, _ = filter_logs(robot, *logs)
    joint = answer_link(robot, datasets, OPTIONS, Progress(), (FILE_GRAVITY,))
    assert answer.fit.unknowns.estimated_names == joint.fit.unknowns.estimated_names
    errors = joint.errors.total.standard_errors
    values, joint_values = (
        fit.values[fit.unknowns.estimated] for fit in (answer.fit, joint.fit)
    )
    assert np.max(np.abs(values - joint_values) / errors) < 0.02
    assert answer.errors.total.standard_errors == pytest.approx(errors, rel=0.15)
    assert set(answer.errors.causes) == set(joint.errors.causes)
    choice = answer.fit.choice
    expected = joint.fit.choice
    for name in ("friction", "couplings", "common_scale"):
        assert getattr(choice, name) == getattr(expected, name)
    scales = vars(choice.link_scales)
    assert scales == pytest.approx(vars(expected.link_scales), rel=0.02)
    error = joint.file.validation.relative_error
    assert answer.file.validation.relative_error == pytest.approx(error, rel=0.02)
    thetas, joint_thetas = (
        file.fit.columns.thetas(file.fit.values) for file in (answer.file, joint.file)
    )
    assert_allclose(thetas[-1], joint_thetas[-1], atol=5e-3)


def test_a_log_that_is_added_but_not_fitted_tests_the_others(robot, second_round):
    one, two, three = second_round
    (test,) = answer_from(robot, one + two, three).tests
    assert test.rmse == pytest.approx(0.1 * np.sqrt(2.0 * CUTOFF / RATE), rel=0.2)
    assert test.source == "1 log, added, not fitted"


def test_brackets_and_order_do_not_matter(robot, second_round, answer):
    one, two, three = second_round
    total = one + (two + three)
    for other, rtol, atol in ((total, 1e-9, 1e-12), (three + two + one, 1e-6, 1e-9)):
        values = answer_from(robot, other).fit.values
        assert_allclose(values, answer.fit.values, rtol=rtol, atol=atol)
    assert total.logs == 3 and total.duration == pytest.approx(sum(DURATIONS), abs=0.1)
    assert len(total.checkpoints.q) == 400


def test_information_has_a_constant_size_and_survives_pickling(
    robot, second_round, answer
):
    """It grows neither with the length of a log nor with their number, but for some rows."""
    two = sum(second_round[1:])
    three = sum(second_round)
    sizes = []
    for information in (*second_round, two, three):
        content = information.evidence.blocks, information.residuals, information.pull
        sizes.append(len(pickle.dumps(content)))
    assert abs(sizes[-1] - sizes[-2]) < 20
    assert max(sizes) == max(sizes[-2:])
    unpickled = answer_from(robot, pickle.loads(pickle.dumps(three)))
    assert_array_equal(unpickled.fit.values, answer.fit.values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cutoff": 7.0}, r"cutoff \(8.0 and 7.0\)"),
        ({"friction_model": "coulomb"}, "friction_model"),
        ({"link_uncertainty": 0.0}, "link_uncertainty"),
    ],
)
def test_information_of_different_options_does_not_add(
    robot, logs, first_round, change, message
):
    other = log_information(robot, logs[:1], replace(OPTIONS, **change))
    with pytest.raises(InputError, match=message):
        _ = first_round + other
    with pytest.raises(InputError, match=message):
        log_information(robot, logs[:1], OPTIONS, other)


def test_rounds_models_and_repeated_logs_do_not_add(robot, first_round, second_round):
    one = second_round[0]
    with pytest.raises(InputError, match="the first round"):
        _ = first_round + one
    with pytest.raises(InputError, match="first round, which does not know its errors"):
        answer_from(robot, first_round)
    with pytest.raises(InputError, match="the model"):
        answer_from(replace(robot, sha256="another"), sum(second_round))
    with pytest.raises(InputError, match="add each log once"):
        _ = one + one
    with pytest.raises(TypeError):
        _ = first_round + 1
