"""The search for numbers with which tracks are played best: found, bounded, with free starts."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.logs.servo_tracks import joined, numbers_of, play_once, track_of
from robot_sysid.servo.play import DIRECTIONS
from robot_sysid.servo.played_fit import PlayedFit, Searched
from robot_sysid.servo.unknowns import (
    ABSENT,
    LEAST,
    NAMES,
    UNKNOWNS,
    column,
    numbers_at,
)

LIKELY_GAIN = 12.0
TRUE = {
    "gain": 10.0,
    "torque_limit": 0.3,
    "damping": 0.06,
    "frictionloss": 0.03,
    "armature": 3e-3,
}
MOVING = ("torque_limit", "damping", "frictionloss", "armature")
READ = 1e-3
"""Step of an encoder [rad]."""


def moves(time):
    """Commands of two sizes and speeds, with jumps."""
    return 0.4 * np.sin(6.0 * time) + 0.25 * np.sign(np.sin(9.0 * time))


def measured_track(command=moves, start=(0.0, 0.0), numbers=TRUE, **track):
    """A track whose measured positions are those of a joint with some numbers."""
    bare = track_of(command, start=start, slope=0.5, **track)
    q = play_once(bare, numbers_of(**numbers))[0]
    q = READ * np.round(q / READ)
    return track_of(command, start=start, slope=0.5, measured=q, **track)


def fit_of(tracks, free=MOVING, with_links=False, n_problems=1):
    """The search of some unknowns of joints, each of which is a problem."""
    shape = (n_problems, len(NAMES))
    return PlayedFit(
        tracks,
        tracks.joint,
        np.full(n_problems, LIKELY_GAIN),
        np.zeros(shape),
        np.ones(shape),
        np.isin(NAMES, free),
        with_links,
    )


def place(**numbers):
    """Unknowns (1, u) at some numbers, the others at their means, or absent."""
    x = ABSENT[None].copy()
    for name, value in numbers.items():
        unknown = UNKNOWNS[name]
        if name == "gain":
            value = value / LIKELY_GAIN
        is_logarithm = unknown.is_logarithm
        size = np.log(value / unknown.mean) if is_logarithm else value - unknown.mean
        x[0, column(name)] = size / unknown.deviation
    return x


def beginning(tracks, x):
    return Searched(x, np.zeros((len(x), DIRECTIONS)), np.zeros((2, len(tracks))))


def numbers_by_name(x):
    """The numbers that unknowns (1, u) stand for."""
    found = dict(zip(NAMES, numbers_at(x)[0].tolist()))
    found["gain"] *= LIKELY_GAIN
    return found


def relative_errors(solved, names):
    """What numbers are off by, over the true ones."""
    found = numbers_by_name(solved.at.x)
    return np.array([found[name] / TRUE[name] - 1.0 for name in names])


def test_unknowns_stand_for_numbers_and_back():
    x = place(**TRUE, stribeck=0.004, zero=-0.02, command_delay=0.03)
    found = numbers_by_name(x)
    expected = {**TRUE, "stribeck": 0.004, "zero": -0.02, "command_delay": 0.03}
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-12)


def test_the_numbers_of_a_joint_are_found_from_usual_ones():
    tracks = measured_track()
    fit = fit_of(tracks)
    begin = beginning(tracks, place(gain=TRUE["gain"]))
    solved = fit.search(begin)
    assert np.max(np.abs(relative_errors(solved, MOVING))) < 0.05
    # An encoder's steps are off by 1/sqrt(12) of one.
    assert solved.error[0] < READ
    index = [column(name) for name in MOVING]
    errors = np.sqrt(np.diag(solved.covariance[0]))[index]
    x = solved.at.x[0] - place(**TRUE)[0]
    assert np.all(np.abs(x[index]) < 3.0 * errors)
    is_free = np.isin(np.arange(len(solved.covariance[0])), index)
    assert not np.any(solved.covariance[0][~is_free])
    # What is not searched stays where it was.
    others = np.setdiff1d(np.arange(len(NAMES)), index)
    assert_array_equal(solved.at.x[0, others], begin.x[0, others])


def test_a_delay_that_would_be_negative_is_none():
    tracks = measured_track()
    early = track_of(
        lambda time: moves(time - 0.02), slope=0.5, measured=tracks.measured[0]
    )
    solved = fit_of(early, ("command_delay",)).search(
        beginning(early, place(**TRUE, command_delay=0.01))
    )
    assert solved.at.x[0, column("command_delay")] == 0.0
    assert np.all(solved.at.x >= LEAST)


def test_starts_are_free():
    """A start that is read wrongly changes no number, and is found."""
    begin = (0.05, 0.4)
    right = measured_track(start=begin)
    wrong = track_of(
        moves,
        start=(begin[0] + 0.002, begin[1] - 0.1),
        slope=0.5,
        measured=right.measured[0],
    )
    at_truth = place(**TRUE)
    free = ("damping", "frictionloss")
    solved = [
        fit_of(tracks, free).search(beginning(tracks, at_truth))
        for tracks in (right, wrong)
    ]
    numbers = [relative_errors(one, free) for one in solved]
    assert_allclose(numbers[0], numbers[1], atol=0.03)
    assert solved[1].at.start[1, 0] == pytest.approx(0.1, abs=0.03)
    # Without the correction the wrong start is most of the error.
    held = play_once(wrong, numbers_of(**TRUE)) - wrong.measured
    assert np.sqrt(np.mean(held**2)) > 2.0 * solved[1].error[0]


def test_no_search_ends_where_it_is_worse_than_at_its_beginning():
    tracks = measured_track(seconds=0.5)
    fit = fit_of(tracks)
    begin = place(**TRUE)
    missed = play_once(tracks, numbers_of(**TRUE)) - tracks.measured
    solved = fit.search(beginning(tracks, begin), passes=3)
    assert solved.error[0] < np.sqrt(np.mean(missed**2)) + 2e-4


def test_problems_side_by_side_are_problems_alone():
    both = joined(
        measured_track(seconds=0.5), measured_track(seconds=0.5, inertia=0.03, joint=1)
    )
    free = ("damping", "armature")
    together = fit_of(both, free, n_problems=2).search(
        beginning(both, np.repeat(place(**TRUE), 2, axis=0)), passes=4
    )
    for k in range(2):
        track = both.at(np.array([k]))
        alone = PlayedFit(
            track,
            np.zeros(1, dtype=int),
            np.full(1, LIKELY_GAIN),
            np.zeros((1, len(NAMES))),
            np.ones((1, len(NAMES))),
            np.isin(NAMES, free),
            with_links=False,
        )
        solved = alone.search(beginning(track, place(**TRUE)), passes=4)
        # One that has ended goes on while the other one does.
        errors = np.sqrt(np.diag(solved.covariance[0]))[: len(NAMES)]
        difference = np.abs(solved.at.x[0] - together.at.x[k])
        assert np.all(difference <= 0.2 * errors)


def test_a_number_that_is_known_before_is_not_changed_by_a_motion_that_hardly_shows_it():
    """A joint that never reaches its limit."""
    calm = measured_track(lambda time: 0.1 * np.sin(5.0 * time))
    begin = place(**{**TRUE, "torque_limit": 0.8})
    fit = fit_of(calm)
    k = column("torque_limit")
    fit.mean[0, k] = 0.5
    fit.deviation[0, k] = 0.1
    solved = fit.search(beginning(calm, begin), passes=6)
    assert solved.at.x[0, k] == pytest.approx(0.5, abs=0.02)
    assert np.sqrt(solved.covariance[0, k, k]) == pytest.approx(0.1, rel=0.05)


def test_searches_begin_where_draws_play_best():
    tracks = measured_track(seconds=0.5)
    fit = fit_of(tracks)
    base = place(gain=TRUE["gain"])
    rng = np.random.default_rng(0)
    candidates = base + np.abs(rng.normal(size=(20, *base.shape)))
    candidates[:, :, ~np.isin(NAMES, MOVING)] = base[:, ~np.isin(NAMES, MOVING)]
    first, second = fit.begin(candidates, 2)

    def squares(at):
        missed = fit.missed(at.x[None], at.links[None], at.start[None])
        return np.sum(missed**2)

    sums = sorted(squares(beginning(tracks, x)) for x in candidates)
    assert_allclose([squares(first), squares(second)], sums[:2])
    assert not np.any(first.start) and not np.any(first.links)


def test_a_gain_that_sag_alone_shows_is_as_sure_as_the_weight():
    """A weight of 1 N m that is known to 30 % lets a servo rest where its gain is known to 30 %."""
    slow = {"start": (-0.1, 0.0), "torque": 1.0, "seconds": 0.5, "error": 0.3}
    numbers = {"gain": 10.0, "torque_limit": 5.0, "damping": 0.2}
    bare = track_of(np.zeros_like, **slow)
    q = play_once(bare, numbers_of(**numbers))[0]
    tracks = track_of(np.zeros_like, measured=q, **slow)
    deviation = UNKNOWNS["gain"].deviation
    k = column("gain")
    sizes = []
    for with_links in (False, True):
        fit = fit_of(tracks, ("gain",), with_links)
        x = place(**numbers, frictionloss=1e-9, armature=1e-9)
        solved = fit.search(beginning(tracks, x), passes=2)
        sizes.append(deviation * np.sqrt(solved.covariance[0, k, k]))
    assert sizes[0] < 0.01
    expected = (0.3**-2.0 + deviation**-2.0) ** -0.5
    assert sizes[1] == pytest.approx(expected, rel=0.05)
    # The first direction alone has a torque; of the others nothing is learnt.
    of_links = np.diag(solved.covariance[0])[len(NAMES) :]
    assert of_links[0] < 1.0
    assert_allclose(of_links[1:], 1.0, rtol=1e-6)


def test_progress_is_reported_with_each_pass():
    tracks = measured_track(seconds=0.2)
    reports = []
    fit_of(tracks, ("damping",)).search(
        beginning(tracks, place(**TRUE)),
        passes=3,
        report=lambda done, total, errors: reports.append((done, total, errors.shape)),
    )
    assert reports[0] == (1, 3, (1,))
    assert [done for done, *_ in reports] == [*range(1, len(reports) + 1)]


@pytest.mark.slow
def test_errors_are_as_large_as_stated():
    """Errors in stated ones, of many joints and of noise that is that of an encoder."""
    offs = []
    index = [column(name) for name in MOVING]
    rng = np.random.default_rng(0)
    for _ in range(12):
        phase = rng.uniform(0.0, 6.0)
        drawn = {
            name: value * np.exp(0.4 * rng.normal()) for name, value in TRUE.items()
        }
        tracks = measured_track(
            lambda time, phase=phase: moves(time + phase) - moves(phase),
            numbers=drawn,
            seconds=2.0,
        )
        solved = fit_of(tracks).search(beginning(tracks, place(**drawn)))
        x = solved.at.x[0] - place(**drawn)[0]
        errors = np.sqrt(np.diag(solved.covariance[0]))
        offs.append((x / np.where(errors[: len(x)], errors[: len(x)], 1.0))[index])
    assert 0.4 < np.sqrt(np.mean(np.square(offs))) < 1.4
    assert np.max(np.abs(offs)) < 4.0
