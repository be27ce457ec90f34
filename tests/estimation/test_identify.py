"""From recordings to an answer: one filter for all, every option, other logs, the model itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.answer import base_parameters, structural_base
from robot_sysid.estimation.build_result import result_of, traces_of
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.held_out import validate_datasets as validated
from robot_sysid.estimation.identify import (
    Piece,
    answer_link,
    low_pass_recordings,
    refit,
)
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records.messages import Progress
from tests.support import arms
from tests.support.core_fits import BASIC, ORIGIN, filter_logs, fit_recordings
from tests.support.measured_logs import XML, log_of, plan_of
from tests.support.payload_logs import TrueArm, add_noise, four_joint_arm, wide_motion


def answered(robot, *logs, kept=None, **options):
    datasets, chosen = filter_logs(robot, *logs, **{"friction_model": BASIC, **options})
    return answer_link(robot, datasets, chosen, Progress(), kept)


def test_all_go_through_the_lowest_cutoff_that_one_asks_for(plant, robot, noisy):
    coarse = log_of(plant, encoder_resolution=3e-3)
    cutoffs = [
        {each.signals.cutoff for each in filter_logs(robot, *logs, cutoff=None)[0]}
        for logs in ([noisy], [coarse], [noisy, coarse])
    ]
    assert (
        cutoffs[1] == cutoffs[2]
        and len(cutoffs[2]) == 1
        and max(cutoffs[1]) < max(cutoffs[0])
    )
    pieces = [Piece("fine", noisy), Piece("coarse", coarse)]
    notes = [
        note
        for note in low_pass_recordings(robot, pieces, EstimationOptions())[1]
        if "cut-off" in note
    ]
    assert [note.split(" Hz ")[1][:8] for note in notes] == ["as anoth", "chosen f"], (
        notes
    )


@pytest.mark.parametrize(
    "options",
    [
        {"no_friction": True, "friction_model": None},
        {"torques": "terminal", "friction_model": "auto"},
    ],
    ids=str,
)
def test_every_option_gives_a_possible_result(robot, noisy, options):
    result = result_of(answered(robot, noisy, kept=(), **options), ORIGIN)
    # Friction that may not be found is torque that nothing explains.
    assert result.verdict.is_trustworthy != bool(options.get("no_friction")), (
        result.reasons
    )
    assert result.failure is None and result.estimate.inertial.is_consistent
    if options.get("torques") != "terminal" and not options.get("no_friction"):
        assert result.estimate.inertial.mass == pytest.approx(0.8, abs=0.15)
    assert (
        result.file.validation_after.relative_error
        < result.file.validation_before.relative_error
    )


def test_a_tilt_needs_gravity():
    weightless = arms.robot_of(
        arms.serial_arm((arms.Z, arms.Y, arms.X), option='gravity="0 0 0"')
    )
    with pytest.raises(InputError, match="--tilt auto needs gravity"):
        answered(weightless, log_of(weightless), tilt="auto")


def test_another_log_is_predicted_down_to_its_noise(plant, robot, noisy):
    (log,), options = filter_logs(robot, noisy)
    fit = fit_recordings(robot, [log], options)
    other = log_of(
        plant, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4
    )
    others, _ = filter_logs(robot, other)
    errors = fit_errors(fit)
    found = validated(fit, errors, others, "other.csv")
    assert found.source == "other.csv"
    assert found.rmse < 1.3 * np.sqrt(np.mean(fit.weights**-2.0))
    heavier, _ = filter_logs(robot, replace(other, tau=1.2 * other.tau))
    assert (
        validated(fit, errors, heavier, "x").relative_error > 3.0 * found.relative_error
    )


@pytest.mark.parametrize("still", [True, False])
def test_a_log_of_a_joint_that_stood_still_is_no_test_but_one_of_another_body_is(
    plant, robot, noisy, still
):
    """Its friction is not known; a link of another mass is told whatever else is open."""
    (log,), options = filter_logs(robot, noisy)
    used = np.ones(log.motion.q.shape, dtype=bool)
    used[:, 1] = not still
    fit = fit_recordings(robot, [replace(log, used=used)], options)
    told = []
    for mass in (".8", "1.6"):
        other = XML
        arm = arms.robot_of(other.replace('mass=".8"', f'mass="{mass}"'))
        seen = log_of(
            arm, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4
        )
        others, _ = filter_logs(robot, seen)
        found = validated(fit, fit_errors(fit), others, "other.csv")
        told.append(found.is_informative)
    assert told == [not still, True]


def test_rows_that_a_refit_leaves_out_say_nothing(robot, noisy):
    last = np.arange(len(noisy))[:, None] > 0.9 * len(noisy)
    answer = answered(robot, replace(noisy, tau=noisy.tau + 8.0 * last))
    (dataset,) = answer.fit.columns.datasets
    time = dataset.motion.time
    again = refit(answer, [time < time[0] + 0.8 * (time[-1] - time[0])], ())
    assert again.fit.values[0] == pytest.approx(0.8, abs=0.2)
    assert again.file is not None and spatial.is_consistent(again.file.fit.values[:10])
    assert abs(answer.fit.values[0] - 0.8) > 2.0 * abs(again.fit.values[0] - 0.8)


def test_what_a_report_draws_is_the_residual_of_the_file(robot, noisy):
    answer = answered(robot, noisy, kept=())
    fit = answer.file.fit
    traces = traces_of(answer)
    squares = fit.evidence.total.squared_residuals(fit.values)
    # Near a reversal the low-pass takes from friction's jump.
    moves = np.isfinite(traces.measured[:, -1]) & (np.abs(traces.qd[:, -1]) > 0.3)
    assert traces.joints == robot.joint_names
    assert_allclose(np.nansum(traces.residual**2, axis=0), squares, rtol=1e-9)
    # The guess is clearly worse, and dry friction is most of what friction makes at low speed.
    worse = np.nanstd(traces.measured - traces.prior_prediction, axis=0)
    assert np.all(worse > 2.0 * np.nanstd(traces.residual, axis=0))
    speed, friction = (np.abs(each[moves, -1]) for each in (traces.qd, traces.friction))
    offset = abs(fit.value("offset[joint2]"))
    assert_allclose(friction, 0.3 + 0.2 * speed, atol=0.05 + offset)


# ---- base parameters


def test_structural_rank_is_that_of_textbooks():
    """A vertical first axis shows one parameter, an arm of three crossing ones fifteen."""
    assert structural_base(arms.robot_of(arms.serial_arm((arms.Z,)))).rank == 1
    assert structural_base(arms.robot_of(arms.THREE)).rank == 15


def combined(words, known):
    """What a combination such as "m + 0.5*hz(link1)" is."""
    total = 0.0
    sign = 1.0
    for word in words.split():
        if word in ("+", "-"):
            sign = 1.0 if word == "+" else -1.0
        else:
            weight, _, name = word.rpartition("*")
            total += sign * float(weight or 1.0) * known[name]
    return total


@pytest.mark.parametrize("link_uncertainty", [5.0, 0.0])
def test_what_the_torques_show_is_found_whatever_is_sought(link_uncertainty):
    robot = four_joint_arm()
    arm = TrueArm(robot, 3, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(3), False), 0.01, 0)
    options = EstimationOptions(link_uncertainty=link_uncertainty)
    fit = fit_recordings(robot, [recording], options)
    found = base_parameters(fit, fit_errors(fit))
    assert len(found.values) == found.structural_rank == structural_base(robot).rank
    known = dict(zip(fit.columns.names, arm.values(fit.columns)))
    truth = np.array([combined(words, known) for words in found.combinations])
    assert np.all(np.abs(found.values - truth) < 4.0 * found.standard_errors + 1e-3)
    kept = dict(
        zip((words.split()[0] for words in found.combinations), found.essential)
    )
    # Rotors turn as some of the inertia does, so that nobody misses it.
    assert kept["m"] and kept["Ixx"] and kept["Izz"] and not kept["Izz(link0)"]


# ---- the model's own simulation
