"""Noise of accelerations makes rotors too small, by as much as is said."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.core_fits import NOISE_ONLY, filter_logs, fit_recordings
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.trust import acceleration_bias, rotor_biases
from robot_sysid.results.notes import COARSE, link_notes

EXACT = EstimationOptions(**NOISE_ONLY)


@pytest.fixture(scope="module")
def right(robot, noisy):
    """Return the low-passed recording, whose accelerations have next to no noise."""
    (recording,) = filter_logs(robot, noisy)
    return recording


def with_noise(recording, share, seed, sign=1.0):
    """Return a recording whose accelerations have noise, as a share of each joint's."""
    deviations = share * np.sqrt(np.mean(recording.qdd**2, axis=0))
    noise = deviations * np.random.default_rng(seed).normal(size=recording.qdd.shape)
    qdd = recording.qdd + sign * noise
    return recording.using(recording.is_used, qdd=qdd, acceleration_noise=deviations)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.05, 0.1])
def test_the_bias_is_the_mean_error_of_fits_with_such_noise(robot, right, share):
    """Noise and its negative cancel in first order; what stays is the bias."""
    rotors = [f"armature[{joint}]" for joint in robot.joint_names]
    exact = fit_recordings(robot, [right])
    errors = []
    biases = []
    for seed in range(5):
        for sign in (1.0, -1.0):
            fitted = fit_recordings(robot, [with_noise(right, share, seed, sign)])
            at = fitted.at(rotors)
            change = fitted.unbounded_solution[0] - exact.unbounded_solution[0]
            errors.append(change[at])
            biases.append(acceleration_bias(fitted)[at])
    mean = np.mean(errors, axis=0)
    assert np.min(mean) < -0.04 * exact.by_name[rotors[np.argmin(mean)]]
    assert np.mean(biases, axis=0) == pytest.approx(mean, abs=0.25 * np.max(abs(mean)))


def test_no_noise_makes_no_bias(robot, right):
    assert np.all(acceleration_bias(fit_recordings(robot, [right], EXACT)) == 0.0)


def test_a_note_says_by_how_much_rotors_are_too_small(robot, right):
    noisy = replace(with_noise(right, 0.25, 0), acceleration_error=0.25)
    fitted = fit_recordings(robot, [noisy], EXACT)
    (note,) = [note for note in link_notes(fitted) if "too small" in note]
    said = {
        joint: float(size)
        for size, joint in re.findall(r"by about (\S+) ± \S+ kg·m² at (\w+)", note)
    }
    biases = {rotor.of: (bias, error) for rotor, bias, error in rotor_biases(fitted)}
    large = {joint for joint, (bias, error) in biases.items() if -bias > error}
    assert set(said) == large != set()
    for joint, size in said.items():
        assert size == pytest.approx(-biases[joint][0], rel=0.06)


def test_motion_that_is_lost_above_the_cut_off_makes_no_rotor_too_small(robot, right):
    """Torques lose it as well."""
    seldom = replace(right, acceleration_error=2.0 * COARSE)
    fitted = fit_recordings(robot, [seldom], EXACT)
    assert not any("too small" in note for note in link_notes(fitted))
