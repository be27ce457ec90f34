"""A polished file moves like the arm; it is kept only where it predicts torques as well."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from rigs import arms
from rigs.core_fits import BASIC, ORIGIN, filter_logs, fit_recordings
from rigs.measured_logs import guess_model, log_of, true_arm
from robot_sysid import spatial
from robot_sysid.estimate.held_out import validation
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.rows import block_numbers
from robot_sysid.results.identification import link_result
from robot_sysid.servo.polish import (
    OpenLoop,
    Polish,
    polish,
    with_errors_of,
    with_rotors,
)

# Usual position error at the end of a window that steps of 2 ms leave; the softness of MuJoCo's
# frictionloss leaves ten times as much where a joint turns round [rad].
STEP_ERROR = 4e-4


@pytest.fixture(scope="module")
def estimate():
    """Return the fit of a log without noise."""
    plant = true_arm()
    robot = guess_model(plant)
    recordings = filter_logs(robot, log_of(plant))
    return fit_recordings(robot, recordings, EstimationOptions(friction_model=BASIC))


@pytest.fixture(scope="module")
def file(estimate):
    return fit_file(estimate)


@pytest.fixture(scope="module")
def written(estimate, file):
    """Return the arm as the file has it."""
    robot = estimate.arm.robot
    model = copy.copy(robot.mj_model)
    for link, theta in zip(robot.links, file.thetas):
        arms.write_body(model, link.body_id, theta)
    names = {"coulomb": "frictionloss", "viscous": "damping", "armature": "armature"}
    for term, name in names.items():
        numbers = [file.by_name[f"{term}[{joint}]"] for joint in robot.joint_names]
        getattr(model, f"dof_{name}")[robot.dof_index] = numbers
    return arms.robot_of(model)


def friction(fit, term="coulomb"):
    """Return which numbers of a fit are of a friction term."""
    return np.array([name.startswith(term) for name in fit.names])


def test_windows_lie_within_blocks_and_a_right_file_plays_them(file, written):
    problem = OpenLoop(file, written)
    assert len(problem.blocks) > 30
    numbers, _ = block_numbers(file.recordings)
    assert {*problem.blocks} == {*numbers[0]}
    errors = problem.errors(file)
    assert np.median(np.linalg.norm(errors[:, -1], axis=1)) < STEP_ERROR
    # Its own numbers are what the file has; others are played with these.
    heavier = replace(file, values=np.where(friction(file), 2.0, 1.0) * file.values)
    other_errors = problem.errors(heavier)
    assert np.median(np.linalg.norm(other_errors[:, -1], axis=1)) > 10.0 * STEP_ERROR
    assert np.array_equal(problem.errors(file), errors)


@pytest.mark.slow
def test_numbers_of_a_log_without_noise_stay(estimate, file, written):
    polished, sentence = polish(estimate, file, written)
    assert polished is file and sentence.startswith("not polished, the written numbers")
    start, covariance = with_rotors(estimate, file)
    assert start.names[: len(file.names)] == file.names
    problem = OpenLoop(file, written)
    steps = Polish(problem, start, covariance)
    fit = steps.steps_from(start, problem.blocks >= 0)
    for name in ("coulomb", "viscous", "armature"):
        at = friction(fit, name)
        assert np.any(at)
        assert fit.values[at] == pytest.approx(start.values[at], rel=0.03)


@pytest.mark.slow
def test_friction_that_is_wrong_by_30_percent_comes_back(estimate, file, written):
    start, covariance = with_rotors(estimate, file)
    at = friction(start)
    wrong = np.where(at, 1.3, 1.0) * start.values
    covariance = covariance + np.diag((0.3 * start.values * at) ** 2)
    start = replace(start, values=wrong)
    problem = OpenLoop(file, written)
    before = problem.errors(start)
    steps = Polish(problem, start, covariance)
    fit = steps.steps_from(start, problem.blocks >= 0)
    assert fit.values[at] == pytest.approx(wrong[at] / 1.3, rel=0.03)
    assert np.linalg.norm(problem.errors(fit)) < 0.1 * np.linalg.norm(before)
    assert all(map(spatial.is_consistent, fit.thetas))


@pytest.mark.parametrize(("factor", "is_polished"), [(1.0, True), (1.1, False)])
def test_nearer_positions_do_not_pay_for_worse_torques(
    estimate, file, written, monkeypatch, factor, is_polished
):
    """Played positions are made nearer by any step; the torques are those of the numbers."""

    def step(self, start, used):
        values = np.where(friction(start), factor, 1.0) * start.values
        moved = replace(start, values=values)
        moved.__dict__["is_stepped"] = True
        return moved

    def errors(self, fit):
        scale = 1e-3 if fit.__dict__.get("is_stepped") else 2e-3
        return np.full_like(self.measured, scale)

    monkeypatch.setattr(Polish, "__init__", lambda *_: None)
    monkeypatch.setattr(Polish, "steps_from", step)
    monkeypatch.setattr(OpenLoop, "errors", errors)
    polished, sentence = polish(estimate, file, written)
    assert (polished is not file) == is_polished
    assert sentence.startswith("polished: ") == is_polished
    assert "position error is 1 in place of 2 mrad" in sentence
    if is_polished:
        errors = polished.errors[: len(file.names)]
        assert errors == pytest.approx(file.errors, rel=1e-12)
        share = validation(file).relative_error
        assert validation(polished).relative_error == pytest.approx(share, rel=1e-6)


def test_errors_never_become_smaller(estimate, file):
    before = link_result(estimate, file, (), ORIGIN)
    moved = np.where(friction(file), 0.5, 1.0) * file.values
    after = link_result(estimate, replace(file, values=moved), (), ORIGIN)
    kept = with_errors_of(after, before)
    pairs = [*zip(kept.quantities, before.quantities, after.quantities)]
    changed = [pair for pair in pairs if pair[0].value != pair[1].value]
    assert len(changed) >= 3
    for row, old, new in pairs:
        assert row.value == new.value
        assert row.error == pytest.approx(max(old.error, new.error), nan_ok=True)


def test_a_rollout_that_diverges_counts_as_half_a_turn(file, written):
    problem = OpenLoop(file, written)
    problem.tau[0] += 1e15
    assert np.all(problem.errors(file)[0, -1] == np.pi)


def test_without_all_torques_or_enough_motion_there_is_no_polish(
    estimate, file, written
):
    recording = file.recordings[0]
    tau = recording.tau.copy()
    tau[:, 0] = 0.0
    silent = replace(file, recordings=(replace(recording, tau=tau),))
    assert polish(estimate, silent, written)[1].startswith("not polished: a rollout ne")
    still = recording.only(np.zeros(len(recording), dtype=bool))
    resting = replace(file, recordings=(still,))
    assert (
        "not polished: no two tenths of the logs hold 0.3 s"
        in polish(estimate, resting, written)[1]
    )
