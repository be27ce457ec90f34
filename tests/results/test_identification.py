"""From logs to a result: a common filter, its numbers, its verdict, its notes and its traces."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.core_fits import BASIC, ORIGIN, filter_logs, fit_logs
from rigs.arms.wrong_arms import draw_arm
from rigs.logs.measured_logs import XML, log_of, plan_of
from robot_sysid import spatial
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.trust import missed_friction
from robot_sysid.records import Motion
from robot_sysid.records.messages import Level
from robot_sysid.records.quantities import FILE
from robot_sysid.results.identification import link_result
from robot_sysid.results.reasons import missed_terms
from robot_sysid.results.record import LINK
from robot_sysid.results.traces import traces_of
from robot_sysid.results.verdicts import Verdict


def fits_of(robot, log, **options):
    """Return the fits of a log and of its file."""
    fitted = fit_logs(robot, log, **options)
    return fitted, fit_file(fitted)


def result_of(*arguments, **options):
    return link_result(*fits_of(*arguments, **options), (), ORIGIN)


@pytest.fixture(scope="module")
def fits(robot, noisy):
    return fits_of(robot, noisy)


@pytest.fixture(scope="module")
def result(fits):
    return link_result(*fits, (), ORIGIN)


def test_no_log_takes_from_another_what_that_shows(plant, robot, noisy):
    """One of coarse positions asks for a low cut-off, and has it alone; its pieces share it."""
    coarse = log_of(plant, encoder_resolution=3e-3)
    (alone,) = filter_logs(robot, noisy, cutoff=None)
    fine, low, again = filter_logs(robot, noisy, coarse, coarse, cutoff=None)
    assert fine.cutoff == alone.cutoff
    np.testing.assert_array_equal(fine.q, alone.q)
    assert low.cutoff == again.cutoff < fine.cutoff
    given = filter_logs(robot, noisy, coarse, cutoff=5.0)
    assert [recording.cutoff for recording in given] == [5.0, 5.0]


def test_bodies_joints_and_sensors_are_those_of_the_plant(plant, result):
    assert result.question == LINK
    assert result.verdict is Verdict.BETTER and result.failure is None
    assert list(result.links) == ["link0", "link1", "link2"]
    first, _, last = result.links.values()
    error = np.abs(last.theta - plant.prior.theta)
    assert np.max(error / last.errors) < 4.0 and last.errors[0] < 0.35 * last.mass
    assert first.data_share[0] < 0.3 and last.data_share[9] > 0.9
    for name in plant.joint_names:
        rows = {row.name: row for row in result.quantities if row.of == name}
        assert rows.keys() >= {*BASIC.split("-"), "scale", "zero", "further_load"}
        assert rows["coulomb"].value == pytest.approx(0.3, abs=0.05)
        noise = result.quality.noise_per_joint[name]
        assert noise == pytest.approx(0.1 * np.sqrt(2.0 * 8.0 / 200.0), rel=0.3)
    assert [*result.standard_errors][:10] == [*spatial.PARAMETER_NAMES]
    assert result.validation[0].rmse < 1.5 * result.quality.rmse


@pytest.mark.parametrize(
    ("share", "verdict", "is_noted"),
    [
        (0.01, Verdict.BETTER, False),
        (0.1, Verdict.BETTER, True),
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
    remarks = [remark for remark in result.remarks if message in remark.text]
    assert len(remarks) == is_noted
    for remark in remarks:
        is_doubt = verdict is Verdict.TORQUES_ONLY
        assert remark.level is (Level.DOUBTS if is_doubt else Level.SAYS)


def test_a_resting_joint_keeps_the_models_numbers_and_an_offset_is_noted(
    plant, robot, result
):
    plan = plan_of(plant).scale_amplitudes(np.array([1.0, 1.0, 0.0]))
    log = log_of(plant, plan, noise_torque=0.05)
    # Weight of links makes no torque at the first joint, which could stand for it.
    resting = result_of(robot, replace(log, tau=log.tau + [0.2, 0.0, 0.0]))
    assert resting.quantity("coulomb", "joint2") is None
    assert resting.quantity("coulomb", "joint2", FILE) is None
    notes = "\n".join(remark.text for remark in resting.remarks)
    assert "these logs move joint2 too slowly" in notes
    _, text = notes.split("no model file holds an offset of a torque sensor (joint0 ")
    assert float(text.split()[0]) == pytest.approx(0.2, abs=0.04)
    assert not any("torque sensor" in remark.text for remark in result.remarks)


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
    result = result_of(small_arms.robot_of(xml), log, friction_model="coulomb-viscous")
    assert result.verdict is verdict and result.failure is None
    (remark,) = [each for each in result.remarks if re.search(note, each.text)]
    is_doubt = verdict is not Verdict.BETTER
    assert remark.level is (Level.DOUBTS if is_doubt else Level.SAYS)
    assert not any("probably wrong" in each.text for each in result.remarks)


def test_the_number_that_friction_left_out_moves_most_is_said_with_its_error(
    plant, robot
):
    log = log_of(plant, noise_torque=0.02, encoder_resolution=1e-5)
    fitted = fit_logs(robot, log, friction_model="viscous-armature")
    missed = missed_friction(fitted)
    found = fitted.by_name[missed.moved.key]
    change, error = missed.change
    # Of a joint's friction, whose truth the arm's model has.
    true = vars(plant.friction)[missed.moved.name]
    (joint,) = [
        k for k, name in enumerate(plant.joint_names) if name == missed.moved.of
    ]
    assert found - change == pytest.approx(true[joint], abs=3.0 * error)
    assert abs(change) > 3.0 * error
    text = missed_terms(missed, no_friction=False)
    assert f"the viscous friction of {missed.moved.of} is off by {change:.2g}" in text


@pytest.mark.parametrize("options", [{"no_friction": True}, {"torques": "terminal"}])
def test_every_option_gives_a_possible_result(robot, noisy, options):
    result = result_of(robot, noisy, **options)
    # Friction that is neither estimated nor written is torque that nothing explains.
    is_refused = "no_friction" in options
    assert result.verdict.is_trustworthy == (result.failure is None) == (not is_refused)
    assert result.body.is_consistent
    assert result.file.after.relative_error < result.file.before.relative_error


def test_traces_hold_the_residual_of_the_file(robot, fits):
    _, file = fits
    traces = traces_of(file, every_sample=False)
    assert traces.joints == robot.joint_names
    squares = file.sums.squared_residuals(file.full)
    assert_allclose(np.nansum(traces.residual**2, axis=0), squares, rtol=1e-6)
    # The model before is clearly worse.
    error_before = np.nanstd(traces.measured - traces.prior_prediction, axis=0)
    assert np.all(error_before > 2.0 * np.nanstd(traces.residual, axis=0))


def test_dry_friction_of_the_one_joint_that_carries_is_possible():
    """The joints that stood still carry, too: what they hold says what is much in this arm."""
    axes = (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X)
    arm = small_arms.robot_of(small_arms.serial_arm(axes, joint='range="-2.5 2.5"'))

    def with_two_still(plan, _):
        motion = plan.evaluate(np.arange(round(250.0 * plan.duration)) / 250.0)
        moves = np.array([1.0, 1.0, 0.0, 0.0])
        q = np.where(moves, motion.q, arm.reference)
        return Motion(motion.time, q, moves * motion.qd, moves * motion.qdd)

    truth = draw_arm(arm, "straight", False, 10.0, True, 1, with_two_still, 0.3)
    fitted = fit_logs(arm, replace(truth.log, name="log"))
    found = link_result(fitted, fit_file(fitted), (), ORIGIN)
    assert found.quantity("coulomb", arm.joint_names[1]).value > 0.0
    assert found.verdict is not Verdict.IMPLAUSIBLE
    carried = [fitted.measured_torque[arm.joint_names[k]] for k in (2, 3)]
    expected = np.sqrt(np.mean(truth.log.tau[:, 2:] ** 2, axis=0))
    assert_allclose(carried, expected, rtol=0.05)
