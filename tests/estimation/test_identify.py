"""From recordings to an answer: one filter for all, every option, other logs that test it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.identify import Piece, answer_link, filtered, refit
from robot_sysid.estimation.identify import tested as validated
from robot_sysid.estimation.result import result_of
from robot_sysid.records import Measurement
from robot_sysid.records.progress import Progress
from tests.support import arms
from tests.support.core_fits import BASIC, ORIGIN, datasets_of, fitted
from tests.support.measured_logs import CUTOFF, log_of, plan_of


def answered(robot, *logs, kept=None, **options):
    datasets, chosen = datasets_of(robot, *logs, **options)
    return answer_link(robot, datasets, chosen, Progress(), kept)


def test_all_go_through_the_lowest_cutoff_that_one_asks_for(plant, robot, noisy):
    coarse = log_of(plant, encoder_resolution=3e-3)
    cutoffs = [
        {each.signals.cutoff for each in datasets_of(robot, *logs, cutoff=None)[0]}
        for logs in ([noisy], [coarse], [noisy, coarse])
    ]
    assert cutoffs[1] == cutoffs[2] and len(cutoffs[2]) == 1 and max(cutoffs[1]) < max(cutoffs[0])


def test_what_there_is_to_say_is_said_once_with_what_it_is_about(robot, noisy):
    flipped = replace(noisy, tau=noisy.tau * np.array([1.0, -1.0, 1.0]))
    pieces = [Piece("a.csv", noisy), Piece("b.csv", flipped)]
    _, notes = filtered(robot, pieces, EstimationOptions(cutoff=CUTOFF))
    assert sum(note.startswith("all recordings: cut-off 8 Hz as given") for note in notes) == 1
    (told,) = [note for note in notes if "runs against the model's" in note]
    assert told.startswith("b.csv: ") and "joint1" in told
    short = Measurement(noisy.time[:50], noisy.q[:50], None, noisy.tau[:50])
    with pytest.raises(InputError, match=r"c\.csv: .*too short"):
        filtered(robot, [Piece("c.csv", short)], EstimationOptions(cutoff=CUTOFF))


@pytest.mark.parametrize(
    "options",
    [
        {"friction_model": f"{BASIC}-sqrt"},
        {"no_friction": True},
        {"torques": "terminal"},
        {"torques": "terminal", "friction_model": "auto"},
        {"velocity_deadband": (0.01, 0.02, 0.03)},
        {"link_uncertainty": 0.0},
        {"delay": "auto"},
        {"tilt": "auto"},
    ],
    ids=str,
)
def test_every_option_gives_a_possible_result(robot, noisy, options):
    result = result_of(answered(robot, noisy, kept=(), **options), ORIGIN)
    assert result.verdict.is_trustworthy and result.failure is None, result.reasons
    assert result.estimate.inertial.is_consistent
    if options.get("torques") != "terminal" and not options.get("no_friction"):
        assert result.estimate.inertial.mass == pytest.approx(0.8, abs=0.15)
    assert result.file.after.relative_error < result.file.before.relative_error


def test_a_tilt_needs_gravity():
    weightless = arms.robot_of(arms.serial_arm((arms.Z, arms.Y, arms.X), option='gravity="0 0 0"'))
    with pytest.raises(InputError, match="--tilt auto needs gravity"):
        answered(weightless, log_of(weightless), tilt="auto")


def test_another_log_is_predicted_down_to_its_noise(plant, robot, noisy):
    (log,), options = datasets_of(robot, noisy)
    fit = fitted(robot, [log], options)
    other = log_of(plant, plan_of(plant, 7), 7, noise_torque=0.1, encoder_resolution=1e-4)
    others, _ = datasets_of(robot, other)
    found = validated(fit, others, "other.csv")
    assert found.source == "other.csv"
    assert found.rmse < 1.3 * np.sqrt(np.mean(fit.weighted.noise**2))
    heavier, _ = datasets_of(robot, replace(other, tau=1.2 * other.tau))
    assert validated(fit, heavier, "x").relative_error > 3.0 * found.relative_error


def test_rows_that_a_refit_leaves_out_say_nothing(robot, noisy):
    rows = 0.9 * len(noisy)
    spoiled = np.where(np.arange(len(noisy))[:, None] > rows, 99.0, noisy.tau)
    answer = answered(robot, replace(noisy, tau=spoiled))
    (dataset,) = answer.fit.columns.datasets
    time = dataset.motion.time
    again = refit(answer, [time < time[0] + 0.8 * (time[-1] - time[0])], ())
    assert again.fit.values[0] == pytest.approx(0.8, abs=0.2)
    assert again.file is not None and spatial.is_consistent(again.file.fit.values[:10])
    assert not 0.5 < answer.fit.values[0] < 1.1
