"""What is promised of a file on other motions is what it then does there."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms import small_arms
from rigs.arms.core_fits import fit_recordings
from rigs.arms.wrong_arms import draw_arm
from rigs.files import results as made
from robot_sysid.dynamics.friction import BEND, OFFSET
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.rows import Rows
from robot_sysid.expected.errors import expected, largest_expected
from robot_sysid.expected.knowledge import Knowledge, knowledge_of
from robot_sysid.expected.motions import made_up_motions, sums_elsewhere
from robot_sysid.expected.other_motions import FurtherMotion, OtherMotions
from robot_sysid.expected.unknown import joint_torques
from robot_sysid.records import Motion, Recording
from robot_sysid.results.identification import errors_elsewhere, with_other_motions
from robot_sysid.results.notes import other_motion_notes, part_names
from robot_sysid.results.verdicts import Verdict
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.solver import exact_recording

MODEL = small_arms.robot_of(
    small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X),
        joint='range="-2.5 2.5" frictionloss=".4" armature=".05" damping=".1"',
    )
)
SPEEDS = MODEL.limits.velocity
OFFSETS = [OFFSET.key_of(joint) for joint in MODEL.joint_names]


def drawn(seed, duration=15.0, move=None):
    """Return an arm that is as far off its model as real ones, with its log."""
    return draw_arm(MODEL, "real", False, duration, True, seed, move)


def with_still_joint(plan, _):
    """Return the motion of a plan in which the third joint stands still."""
    motion = plan.evaluate(np.arange(round(250.0 * plan.duration)) / 250.0)
    moves = np.array([1.0, 1.0, 0.0, 1.0])
    q = np.where(moves, motion.q, MODEL.reference)
    return Motion(motion.time, q, moves * motion.qd, moves * motion.qdd)


def fit_of(truth):
    """Return the fit of all terms, and that of the file, of a drawn arm's log."""
    log = replace(truth.log, name="log")
    recordings, _ = low_pass_recordings(MODEL, [log])
    fitted = fit_recordings(MODEL, recordings)
    return fitted, fit_file(fitted)


def motions_of(seed):
    """Return made-up motions of the whole range and speed."""
    return [*made_up_motions(MODEL, SPEEDS, np.random.default_rng(seed))]


@pytest.fixture(scope="module")
def fits():
    """The fit of all terms of a log, and that of its file."""
    return fit_of(drawn(3))


@pytest.fixture(scope="module")
def sums(fits):
    """Sums of made-up motions at the point of the fit."""
    fitted, _ = fits
    return sums_elsewhere(fitted.arm, fitted.point, motions_of(5))


def torque_of_model(motion):
    """Return the torque (N, n) of the given model, by Newton and Euler [N m]."""
    return ArmDynamics(MODEL)(motion)


@pytest.mark.parametrize("counts_offsets", [False, True])
def test_without_errors_the_squares_are_those_of_what_the_model_lacks(
    fits, sums, counts_offsets
):
    """Of an arm that is the model with offsets, judged on the model without friction's half."""
    fitted, _ = fits
    offset = 0.3
    truth = {**fitted.arm.model, **dict.fromkeys(OFFSETS, offset)}
    values = np.array([truth.get(name, 0.0) for name in sums.names])
    held = dict(fitted.arm.model)
    for joint in MODEL.joint_names:
        held[f"coulomb[{joint}]"] *= 0.5
    nothing = np.zeros((len(values), len(values)))
    known = Knowledge(values, nothing)
    squares = expected(held, known, sums, counts_offsets)
    motions = motions_of(5)
    tau = np.concatenate([*map(torque_of_model, motions)])
    lacking = 0.2 * np.sign(np.concatenate([motion.qd for motion in motions]))
    lacking = lacking + offset if counts_offsets else lacking - np.mean(lacking, axis=0)
    assert_allclose(
        squares.of_parameters.sum(axis=1), np.sum(lacking**2, axis=0), rtol=1e-9
    )
    assert_allclose(squares.torque, np.sum(tau**2, axis=0), rtol=1e-9)
    of_joint = squares.relative_error_per_joint
    lacking_share = np.linalg.norm(lacking, axis=0) / np.linalg.norm(tau, axis=0)
    assert_allclose([of_joint[joint] for joint in sums.joints], lacking_share)


def test_squares_of_errors_are_those_of_parameters_drawn_from_them(fits, sums):
    """tr(C G) is the mean over arms whose parameters differ by C."""
    fitted, _ = fits
    known = knowledge_of(fitted, sums).after()
    held = dict(zip(sums.names, known.values.tolist()))
    squares = expected(held, known, sums, counts_offsets=True)
    values, vectors = np.linalg.eigh(known.covariance)
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((3000, len(values)))
    draws = draws * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    offset_at = sums.at(OFFSETS)
    # What the model holds of offsets is nothing, so that theirs are errors as a whole.
    draws[:, offset_at] += known.values[offset_at]
    padded = np.column_stack((draws, np.zeros(len(draws))))
    mean = np.mean([sums.squares_of(draw, sums.totals) for draw in padded], axis=0)
    assert_allclose(squares.of_parameters.sum(axis=1), mean, rtol=0.1)


def test_parts_make_up_the_whole(fits, sums):
    fitted, file = fits
    known = knowledge_of(fitted, sums).after()
    squares = expected(file.by_name, known, sums)
    names = part_names(fitted.arm, sums)
    assert len(names) == len(sums.names)
    parts = squares.parts(names)
    first, *_, last = parts.values()
    assert first >= last > 0.0
    total = np.sum(squares.of_parameters) / np.sum(squares.torque)
    assert_allclose(squares.relative_error**2, total)
    assert {*parts} <= {*names}


def test_what_a_log_shows_is_known_better_after_it(fits, sums):
    fitted, _ = fits
    known = knowledge_of(fitted, sums)
    before = known.after().covariance
    after = known.after(known.rows(sums, 15.0, known.weights)).covariance
    scale = np.sqrt(np.maximum(np.diag(before), 1e-300))
    less = (before - after) / np.outer(scale, scale)
    assert np.min(np.linalg.eigvalsh(less)) > -1e-6
    assert np.max(np.diag(less)) > 0.5


def test_nothing_known_is_as_wide_as_an_unknown_arm(fits, sums):
    """What the log lets free is bounded: the last link by itself, friction by the torque."""
    fitted, _ = fits
    errors = np.sqrt(np.diag(knowledge_of(fitted, sums).after().covariance))
    by_name = dict(zip(sums.names, errors.tolist()))
    bodies = zip(fitted.arm.terms["last link"].names, MODEL.prior.scale)
    assert all(by_name[name] <= 2.0 * size for name, size in bodies)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("seed", [3, 4, 5, 6])
def test_a_promise_is_kept(seed):
    """The file's error against the true arm, on motions of another seed."""
    truth = drawn(seed)
    fitted, file = fit_of(truth)
    promised = errors_elsewhere(OtherMotions(fitted), file)
    arm = truth.arm
    true = []
    read = motions_of(100 + seed)
    for motion in read:
        rigid, friction = arm.torques(replace(motion, q=motion.q - arm.zeros))
        true.append(arm.scales * rigid + friction)
    tau = np.concatenate(true)
    for values, promise in (
        (file.arm.model, promised.before),
        (file.by_name, promised.after),
    ):
        off = tau - torque_by_terms(file, read, values)
        off = off - np.mean(off, axis=0)
        actual = np.linalg.norm(off) / np.linalg.norm(tau)
        assert 0.5 < actual / promise.relative_error < 2.0
    assert promised.after.relative_error < promised.before.relative_error
    assert not promised.still


def torque_by_terms(file, motions, values):
    """Return the torque (N, n) of what a file holds, offsets left out [N m].

    It is that of the columns of terms, which test_motions holds to Newton and Euler.
    """
    held = {**values, **dict.fromkeys(OFFSETS, 0.0)}
    torques = []
    for motion in motions:
        nothing = np.zeros_like(motion.q)
        recording = exact_recording(
            Recording(motion.time, motion.q, motion.qd, nothing, motion.qdd)
        )
        torques.append(file.arm.torque(Rows(recording, slice(None)), file.point, held))
    return np.concatenate(torques)


@pytest.mark.slow
def test_a_joint_that_stood_still_is_named_and_counted():
    fitted, file = fit_of(drawn(3, move=with_still_joint))
    motions = OtherMotions(fitted)
    promised = errors_elsewhere(motions, file)
    assert promised.still == ("joint2",)
    said = " ".join(other_motion_notes(motions))
    assert "joint2 stood still" in said
    moving = OtherMotions(fit_of(drawn(3))[0])
    assert "stood still" not in " ".join(other_motion_notes(moving))
    # A motion that moves it helps.
    assert promised.next is not None
    assert promised.next.relative_error < promised.after.relative_error


@pytest.mark.slow
def test_slow_logs_are_told_to_be_slow(fits):
    def slowly(plan, _):
        """Return the motion at a fifth of the speed."""
        motion = plan.evaluate(np.arange(round(250.0 * plan.duration)) / 1250.0)
        time = 5.0 * motion.time
        return Motion(time, motion.q, motion.qd / 5.0, motion.qdd / 25.0)

    fitted, file = fit_of(drawn(3, duration=30.0, move=slowly))
    motions = OtherMotions(fitted)
    assert "the logs are slow for all joints" in " ".join(other_motion_notes(motions))
    promised = errors_elsewhere(motions, file)
    assert promised.at_log_speeds.relative_error < promised.after.relative_error


def test_nothing_is_promised_where_the_fit_does_not_fit(fits):
    fitted, file = fits
    doubted = Verdict.TORQUES_ONLY.remark("a part follows from nothing")
    result = made.found(file=made.model_file(elsewhere=None))
    refused = replace(result, remarks=(doubted,))
    assert with_other_motions(refused, fitted, file).file.elsewhere is None
    trusted = with_other_motions(result, fitted, file)
    assert trusted.file.elsewhere.after.relative_error > 0.0
    said = [remark.text for remark in trusted.remarks]
    assert any("of this arm as it was" in text for text in said)


def test_the_same_run_promises_the_same(fits):
    fitted, file = fits
    first, second = (errors_elsewhere(OtherMotions(fitted), file) for _ in range(2))
    assert first == second


def test_what_no_file_holds_is_off_after_an_endless_log_too():
    """It is what the best file of arms lacks that are drawn from what the first log says."""
    fitted, file = fit_of(drawn(6, move=with_still_joint))
    motions = OtherMotions(fitted)
    endless = [FurtherMotion((), 1e9)]
    _, promised = motions.next_motion(file, np.inf, endless)
    sums = motions.fast
    of_log = knowledge_of(fitted, sums)
    known = of_log.after()
    in_file = np.isin(sums.names, motions.names_in_file)
    weighted = of_log.rows(sums, 1.0, of_log.weights)
    rng = np.random.default_rng(0)
    arms = rng.multivariate_normal(known.values, known.covariance, 200, "ignore")
    squares = []
    for values in arms:
        held = np.zeros(len(values))
        rows = weighted[in_file]
        held[in_file] = np.linalg.pinv(rows[:, in_file]) @ rows @ values
        exact = Knowledge(values, np.zeros(known.covariance.shape))
        errors = largest_expected(dict(zip(sums.names, held)), exact, sums)
        squares.append(errors.relative_error**2)
    assert_allclose(np.sqrt(np.mean(squares)), promised, rtol=0.15)


def test_friction_of_a_joint_that_stood_still_may_bend_like_that_of_others():
    """That the model states no friction says nothing of it."""
    axes = (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.X)
    bare = small_arms.robot_of(small_arms.serial_arm(axes, joint='range="-2.5 2.5"'))
    truth = draw_arm(bare, "real", False, 15.0, True, 6, with_still_joint)
    recordings, _ = low_pass_recordings(bare, [replace(truth.log, name="log")])
    fitted = fit_recordings(bare, recordings)
    sums = sums_elsewhere(fitted.arm, fitted.point, motions_of(5))
    known = knowledge_of(fitted, sums).after()
    bends = [sums.names.index(BEND.key_of(joint)) for joint in bare.joint_names]
    deviations = np.sqrt(np.diag(known.covariance)[bends])
    shares = deviations / joint_torques(fitted, sums)
    assert 0.3 * np.max(shares) < shares[2] < 3.0 * np.max(shares)
