"""What logs say adds: the sum says what all logs say together, whatever their number and length."""

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
from robot_sysid.estimation.question import FILE_GRAVITY as GRAVITY
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records.messages import Progress
from tests.support.core_fits import filter_logs
from tests.support.measured_logs import CUTOFF, RATE, log_of, plan_of

OPTIONS = settled_options(EstimationOptions(cutoff=CUTOFF))
LENGTHS = (10.0, 14.0, 25.0)


@pytest.fixture(scope="module")
def logs(plant):
    lengths = enumerate(LENGTHS)
    return [
        log_of(plant, plan_of(plant, 1 + k, s), k, noise_torque=0.1) for k, s in lengths
    ]


@pytest.fixture(scope="module")
def first(robot, logs):
    return sum(log_information(robot, [log], OPTIONS) for log in logs)


@pytest.fixture(scope="module")
def parts(robot, logs, first):
    return [log_information(robot, [log], OPTIONS, first) for log in logs]


@pytest.fixture(scope="module")
def together(robot, logs):
    datasets, _ = filter_logs(robot, *logs)
    return answer_link(robot, datasets, OPTIONS, Progress(), (GRAVITY,))


@pytest.fixture(scope="module")
def found(robot, parts):
    return answer_from(robot, sum(parts))


def apart(*answers):
    """By how much what was sought differs."""
    one, other = (each.fit.values[each.fit.unknowns.estimated] for each in answers)
    return np.abs(one - other)


def test_the_sum_gives_the_estimate_and_the_file_of_all_logs(found, together):
    assert found.fit.unknowns.estimated_names == together.fit.unknowns.estimated_names
    errors = together.errors.total.standard_errors
    assert np.max(apart(found, together) / errors) < 0.02
    assert found.errors.total.standard_errors == pytest.approx(errors, rel=0.15)
    assert set(found.errors.causes) == set(together.errors.causes)
    choice = found.fit.choice
    choice_together = together.fit.choice
    assert choice.friction == choice_together.friction
    assert choice.couplings == choice_together.couplings
    assert choice.common_scale == choice_together.common_scale
    scales = vars(choice.link_scales)
    scales_together = vars(choice_together.link_scales)
    assert scales == pytest.approx(scales_together, rel=0.02)
    assert found.file.after.relative_error == pytest.approx(
        together.file.after.relative_error, rel=0.02
    )
    thetas = [
        each.file.fit.columns.thetas(each.file.fit.values) for each in (found, together)
    ]
    assert_allclose(thetas[0][-1], thetas[1][-1], atol=5e-3)


def test_two_logs_of_a_sum_test_each_other(robot, parts):
    (test,) = answer_from(robot, parts[0] + parts[1], parts[2]).tests
    assert test.rmse == pytest.approx(0.1 * np.sqrt(2.0 * CUTOFF / RATE), rel=0.2)
    assert test.source == "1 log, added, not fitted"


def test_brackets_and_order_do_not_matter(robot, parts, found):
    one, two, three = parts
    whole = one + (two + three)
    for other, rtol, atol in ((whole, 1e-9, 1e-12), (three + two + one, 1e-6, 1e-9)):
        values = answer_from(robot, other).fit.values
        assert_allclose(values, found.fit.values, rtol=rtol, atol=atol)
    assert whole.logs == 3 and whole.duration == pytest.approx(sum(LENGTHS), abs=0.1)
    assert len(whole.checkpoints.q) == 400


def test_what_is_sent_does_not_grow_and_survives_the_way(robot, parts, found):
    """Neither with the length of a log nor with their number, but for a sample of rows."""
    every = (*parts, sum(parts[1:]), sum(parts))
    sizes = [len(pickle.dumps((e.evidence.blocks, e.residuals, e.pull))) for e in every]
    assert max(sizes[-2:]) - min(sizes[-2:]) < 20
    assert max(sizes) == max(sizes[-2:])
    again = answer_from(robot, pickle.loads(pickle.dumps(every[-1])))
    assert_array_equal(again.fit.values, found.fit.values)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"cutoff": 7.0}, r"cutoff \(8.0 and 7.0\)"),
        ({"friction_model": "coulomb"}, "friction_model"),
        ({"link_uncertainty": 0.0}, "link_uncertainty"),
    ],
)
def test_what_was_settled_differently_does_not_add(robot, logs, first, changed, words):
    other = log_information(robot, logs[:1], replace(OPTIONS, **changed))
    with pytest.raises(InputError, match=words):
        _ = first + other
    with pytest.raises(InputError, match=words):
        log_information(robot, logs[:1], OPTIONS, other)


def test_rounds_and_models_are_kept_apart(robot, first, parts):
    with pytest.raises(InputError, match="the first round"):
        _ = first + parts[0]
    with pytest.raises(InputError, match="first round, which does not know its errors"):
        answer_from(robot, first)
    with pytest.raises(InputError, match="the model"):
        answer_from(replace(robot, sha256="another"), sum(parts))
    with pytest.raises(InputError, match="add each log once"):
        _ = parts[0] + parts[0]
    with pytest.raises(TypeError):
        _ = first + 1
