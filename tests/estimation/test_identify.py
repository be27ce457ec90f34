"""From recordings to an answer: a common filter, every option, refits, and recordings compared."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from robot_sysid.dynamics import spatial
from robot_sysid.errors import InputError
from robot_sysid.estimation.build_result import result_of
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.payload_recordings import (
    bodies_apart,
    contradiction,
    payloads_by_recording,
)
from robot_sysid.estimation.question import EstimationOptions
from robot_sysid.records import Flange, Measurement
from robot_sysid.records.messages import Progress
from robot_sysid.results.record import Verdict
from tests.estimation.conftest import SIGMA
from tests.support import arms
from tests.support.core_fits import BASIC, ORIGIN, filter_logs, fit_recordings
from tests.support.measured_logs import XML, log_of
from tests.support.payload_logs import (
    PAYLOAD,
    TrueArm,
    add_noise,
    four_joint_arm,
    wide_motion,
)

FLANGE = Flange("here", np.eye(3), np.array([0.0, 0.0, 0.05]))


def answer_logs(robot, *logs, kept=None, **options):
    """Return the answer from logs; the model file keeps the parts ``kept``, None for no file."""
    options = {"friction_model": BASIC, **options}
    return answer_link(robot, *filter_logs(robot, *logs, **options), Progress(), kept)


def test_all_logs_pass_the_lowest_cutoff_that_one_requires(plant, robot, noisy):
    coarse = log_of(plant, encoder_resolution=3e-3)
    cutoffs = []
    for logs in ([noisy], [coarse], [noisy, coarse]):
        datasets, _ = filter_logs(robot, *logs, cutoff=None)
        for dataset in datasets:
            cutoffs.append(dataset.signals.cutoff)
    fine_cutoff, coarse_cutoff, *common_cutoffs = cutoffs
    assert common_cutoffs == [coarse_cutoff] * 2 and coarse_cutoff < fine_cutoff
    pieces = [Piece("fine", noisy), Piece("coarse", coarse)]
    _, notes = low_pass_recordings(robot, pieces, EstimationOptions())
    reasons = [note.split(" Hz ")[1] for note in notes if "cut-off" in note]
    assert [reason[:8] for reason in reasons] == ["as anoth", "chosen f"], notes


def test_a_log_with_hardly_any_complete_rows_is_refused_by_name(robot, noisy):
    is_kept = noisy.time % 0.3 > 0.12
    damaged = Measurement(
        noisy.time[is_kept], noisy.q[is_kept], None, noisy.tau[is_kept]
    )
    pieces = [Piece("complete", noisy), Piece("damaged", damaged)]
    with pytest.raises(InputError, match="damaged: only .* free of lost samples"):
        low_pass_recordings(robot, pieces, EstimationOptions())


@pytest.mark.parametrize(
    "options",
    [
        {"no_friction": True, "friction_model": None},
        {"torques": "terminal", "friction_model": "auto"},
    ],
    ids=str,
)
def test_every_option_gives_a_possible_result(robot, noisy, options):
    result = result_of(answer_logs(robot, noisy, kept=(), **options), ORIGIN)
    # Friction that may not be estimated is torque that nothing explains.
    is_trustworthy = "no_friction" not in options
    assert result.verdict.is_trustworthy == is_trustworthy, result.reasons
    assert result.failure is None and result.estimate.inertial.is_consistent
    file = result.file
    error_before = file.validation_before.relative_error
    assert file.validation_after.relative_error < error_before


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
    """The file has rotors all the same: its error says nothing of the fit's numbers."""
    log = log_of(plant, noise_torque=0.02, encoder_resolution=1e-5)
    xml = XML.replace('armature=".05"', f'armature="{rotor}"').replace(
        'damping=".2"', ""
    )
    terms = "coulomb-viscous"
    answer = answer_logs(arms.robot_of(xml), log, kept=(), friction_model=terms)
    result = result_of(answer, ORIGIN)
    assert result.verdict is verdict and result.failure is None
    notes = tuple(text for text in result.notes if re.search(note, text))
    assert len(notes) == 1
    assert result.reasons[-1:] == (() if verdict is Verdict.BETTER else notes)
    assert not result.wrong_links


def test_the_mass_is_found_with_friction_chosen_by_the_logs(robot, noisy):
    result = result_of(answer_logs(robot, noisy, friction_model="auto"), ORIGIN)
    assert result.estimate.inertial.mass == pytest.approx(0.8, abs=0.15)


# ---- recordings of a payload compared


def test_every_recording_has_the_common_payload_within_its_errors(payload_fit):
    mass = payload_fit.value("m(payload)")
    payloads = payloads_by_recording(payload_fit, FLANGE)
    names = [payload.name for payload in payloads]
    assert names == ["log0", "log3", "log1", "log2"]
    assert [payload.is_loaded for payload in payloads] == [False, False, True, True]
    # The centre of mass is given in the flange frame, 5 cm further out.
    com = PAYLOAD[1:4] / PAYLOAD[0] - FLANGE.translation
    for payload in payloads:
        assert abs(payload.mass - mass) < 3.0 * payload.noise_error
        assert payload.noise_error < payload.error < 0.1
        assert payload.com == pytest.approx(com, abs=0.01)


def test_bodies_of_each_recording_are_those_on_the_arm(payload_fit, recordings):
    bodies, covariance = bodies_apart(payload_fit, payload_fit.samples)
    assert not np.any(bodies[0])
    assert not np.any(covariance[0]) and not np.any(covariance[:, :, 0])
    is_loaded = [recording.is_loaded for recording in recordings[1:]]
    deviation = bodies[1:] - np.outer(is_loaded, PAYLOAD)
    errors = np.sqrt(np.diag(covariance[1:, :, 1:].reshape(30, 30)))
    assert np.max(np.abs(deviation.ravel()) / errors) < 4.0
    assert np.max(errors[::10]) < 0.05
    assert contradiction(payload_fit, FLANGE) == ""


def find_contradiction(recordings):
    """Return the sentence on recordings of one kind that contradict each other, "" without one."""
    fit = fit_recordings(four_joint_arm(), recordings, loaded=True)
    return contradiction(fit, FLANGE)


def test_swapped_recordings_are_named_with_the_bodies_on_the_arm(recordings):
    empty, loaded, *others = recordings
    swapped = [replace(empty, is_loaded=True), replace(loaded, is_loaded=False)]
    message = find_contradiction([*swapped, *others])
    assert " in mass; compared with log" in message
    mass_of = dict(re.findall(r"(log\d) (\S+) kg at", message))
    masses = [float(mass_of.get(f"log{k}", 0.0)) for k in range(4)]
    assert len(mass_of) == 2 and " nothing" in message
    assert masses == pytest.approx([0.0, 1.2, 1.2, 0.0], abs=0.05)


def half_turn(theta):
    """Return a body turned by half a turn about the flange's axis."""
    rotation = np.diag([-1.0, -1.0, 1.0])
    mass, com, inertia = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, rotation @ com, rotation @ inertia @ rotation)


MORE_INERTIA = np.array([0, 0, 0, 0, 0.05, 0, 0, 0.05, 0, 0.05])


@pytest.mark.parametrize(
    ("index", "change", "difference"),
    [
        (2, lambda theta: 1.01 * theta, ""),
        (2, lambda theta: 1.3 * theta, "log2 differs from log1 in mass"),
        (2, half_turn, "in centre of mass"),
        (2, lambda theta: theta + MORE_INERTIA, "in inertia"),
        (3, lambda theta: 0.2 * theta, "log3 differs from log0 in mass; compared with"),
    ],
)
def test_clear_differences_between_like_recordings_are_named(
    recordings, index, change, difference
):
    """One of the two loaded recordings carries something else, or an empty one anything."""
    arm = TrueArm(four_joint_arm(), 7, model_error=0.03, payload=change(PAYLOAD))
    changed = arm.abba(7, sigma=SIGMA)
    odd = (
        changed[2] if index == 2 else replace(changed[1], name="log3", is_loaded=False)
    )
    datasets = list(recordings)
    datasets[index] = odd
    message = find_contradiction(datasets)
    assert difference in message and bool(difference) == bool(message)
    if change is half_turn:
        texts = re.findall(r"log[12] 1.2\d? kg at \((.+?)\)", message)
        centres = sorted([float(x) for x in text.split(",")] for text in texts)
        # In the flange frame, 5 cm further out [mm].
        assert_allclose(centres, [[-30, 20, 30], [30, -20, 30]], atol=5.0)


@pytest.mark.parametrize(
    ("factor", "message"), [(1.0, ""), (1.06, "log4 differs from ")]
)
def test_three_recordings_of_a_kind_are_compared_with_their_mean(factor, message):
    """One of three loaded recordings carries 6 % more than the mean of the two others."""
    robot = four_joint_arm()
    recordings = []
    for k in range(6):
        payload = PAYLOAD * (factor if k == 4 else 1.0)
        arm = TrueArm(robot, 7, model_error=0.03, payload=payload)
        recording = arm.recording(wide_motion([7, k]), k >= 3, 0.4 * k, f"log{k}")
        recordings.append(add_noise(recording, 0.01, [7, k]))
    contradiction = find_contradiction(recordings)
    assert contradiction.startswith(message) and bool(contradiction) == bool(message)
    assert "log3, log5 in mass" in contradiction or not message
