"""From a log to signals: masks of rows, motion recovered from an encoder."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rigs.logs.swing import Swing, filtered, seconds
from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.signals.process import (
    LARGEST_SLOW_SHARE,
    PINION,
    TURN_TRAVELS,
    abrupt_stops,
    travel_from_turns,
)

assert_close = partial(assert_allclose, rtol=0.0)
"""Compare arrays within the absolute tolerance ``atol`` alone."""


def root_mean_square(values):
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("seed", [0, 1])
def test_motion_of_a_quantised_log_is_recovered(seed):
    """Acceleration within 1 % of its root mean square from a 1e-4 rad encoder."""
    swing = Swing(seed)
    signals = filtered(swing.measurement(seconds(12.0, 200.0), 1e-4))
    for order, limit in ((0, 3e-4), (1, 2e-3), (2, 1e-2)):
        true = swing.q(signals.time, order)
        got = (signals.q, signals.qd, signals.qdd)[order]
        assert root_mean_square(got - true) < limit * root_mean_square(true)
    assert_close(signals.tau, swing.tau(signals.time), atol=1e-12)


def test_columns_do_not_depend_on_the_blocks_that_they_are_made_in():
    signals = filtered(Swing().measurement(seconds(90.0, 100.0)), cutoff=15.0)
    columns = signals.filter_columns(lambda motion: np.sign(motion.qd) * motion.q)
    expected = signals.low_pass.decimate(np.sign(signals.qd) * signals.q)
    assert len(columns) > 1000
    assert_close(columns, expected, atol=1e-12)


def test_columns_are_kept_for_the_samples_that_they_are_made_of():
    """Rows that are chosen change nothing in them; other samples have columns of their own."""
    signals = filtered(Swing().measurement(seconds(12.0, 100.0)), cutoff=8.0)
    made = signals.kept.get("speed", lambda: signals.filter_columns(lambda m: m.qd))
    chosen = signals.only(np.zeros(len(signals), dtype=bool))
    assert not np.any(chosen.is_used)
    assert chosen.kept.get("speed", lambda: 0.0 * made) is made
    assert_array_equal(chosen.with_all_rows(name="again").is_used, signals.is_used)
    faster = signals.using(signals.is_used, qd=2.0 * signals.qd)
    again = faster.kept.get("speed", lambda: faster.filter_columns(lambda m: m.qd))
    assert_close(again, 2.0 * made, atol=1e-12)
    told = signals.using(signals.is_used, {"speed": 2.0 * made}, qd=2.0 * signals.qd)
    assert_array_equal(told.kept.get("speed", lambda: made), 2.0 * made)


def low_pass_with_deadband(log, deadband):
    """Return the signals of a log, low-passed at 8 Hz, with a deadband of all joints [rad/s]."""
    signals = filtered(log, cutoff=8.0)
    return replace(signals, deadband=np.full_like(signals.deadband, deadband))


@pytest.mark.parametrize("deadband", [0.05, 0.5])
def test_exactly_the_rows_with_too_many_slow_samples_are_masked(deadband):
    """A row is a weighted sum over a window; the weight on slow samples counts."""
    signals = low_pass_with_deadband(Swing().measurement(seconds(6.0, 100.0)), deadband)
    weight = np.abs(signals.low_pass.kernel) / np.sum(np.abs(signals.low_pass.kernel))
    half = signals.low_pass.half_width
    slow = np.abs(signals.qd) < deadband
    centres = np.arange(half, len(signals.time) - half, signals.low_pass.step)
    share = np.array([weight @ slow[at - half : at + half + 1] for at in centres])
    assert_array_equal(signals.is_used, share <= LARGEST_SLOW_SHARE)
    assert np.any(~signals.is_used & ~slow[centres])
    rows = signals.low_pass.decimate(signals.tau)
    assert_allclose(rows, Swing().tau(signals.motion.time), atol=1e-3)


def test_a_joint_at_rest_is_masked_and_named():
    log = Swing().measurement(seconds(10.0, 200.0), 1e-4)
    positions = np.array(log.q)
    positions[:, 1] = 0.3
    signals = filtered(
        replace(log, q=positions), cutoff=8.0, is_slide=(False, True, False)
    )
    assert not np.any(signals.is_used[:, 1])
    assert np.mean(signals.is_used[:, 0]) > 0.9
    (note,) = [n for n in signals.notes if "only 0 % of the rows" in n]
    assert "1 joint are used (b)" in note
    assert "m/s, where the direction" in note and "rad" not in note


def with_losses(log, share, seed=0):
    """Return a log without a random share of its rows, with noise of 0.02 N m in its torque."""
    rng = default_rng(seed)
    is_kept = rng.uniform(size=len(log)) >= share
    tau = log.tau + rng.normal(0.0, 0.02, log.tau.shape)
    return Recording(log.time[is_kept], log.q[is_kept], None, tau[is_kept])


def row_errors(signals, swing):
    """Return the errors of accelerations and torques (K, n) in all rows, and a mask (K,) of the
    rows in use.
    """
    time = signals.time
    qdd = signals.low_pass.decimate(signals.qdd - swing.q(time, 2))
    tau = signals.low_pass.decimate(signals.tau - swing.tau(time))
    return qdd, tau, np.all(signals.is_used, axis=1)


def test_only_rows_beside_a_long_hole_are_masked():
    """They are lost for half a period of the cut-off and the usual filter's main lobe, not more."""
    swing = Swing()
    time = seconds(12.0, 200.0)
    keep = np.ones(len(time), dtype=bool)
    keep[400:404] = False
    keep[1600:1660] = False
    signals = low_pass_with_deadband(swing.measurement(time[keep], 1e-5), 0.0)
    qdd, tau, is_used = row_errors(signals, swing)
    masked = signals.motion.time[~is_used]
    margin = 2.5 / signals.cutoff
    assert time[1600] - margin < masked.min() < time[1600]
    assert time[1660] < masked.max() < time[1660] + margin
    assert np.max(np.abs(qdd[is_used])) < 1e-2 and np.max(np.abs(tau[is_used])) < 1e-2


@pytest.mark.parametrize(
    "rate, cutoff, share, fewest", [(125.0, 11.0, 0.15, 0.97), (125.0, 11.0, 0.3, 0.75)]
)
def test_samples_lost_at_random_cost_little(rate, cutoff, share, fewest):
    """Nearly all rows stay in use, with noise hardly larger than without losses."""
    swing = Swing()
    log = swing.measurement(seconds(15.0, rate), 5e-5)
    noise = []
    for lost_share in (0.0, share):
        signals = filtered(with_losses(log, lost_share), cutoff=cutoff)
        signals = replace(signals, deadband=0.0 * signals.deadband)
        qdd, tau, is_used = row_errors(signals, swing)
        noise.append([root_mean_square(error[is_used]) for error in (qdd, tau)])
    assert np.mean(is_used) > fewest
    complete, with_lost_samples = np.array(noise)
    assert np.all(with_lost_samples < (1.0 + 3.0 * share) * complete)


def test_a_log_with_too_many_losses_is_refused_with_the_cause():
    """A network that hands on nothing for 0.1 s, three times a second."""
    log = Swing().measurement(seconds(15.0, 125.0), 5e-5)
    is_kept = log.time % 0.3 > 0.1
    damaged_log = Recording(log.time[is_kept], log.q[is_kept], None, log.tau[is_kept])
    with pytest.raises(
        InputError, match=r"free of lost samples.*record without losses"
    ):
        filtered(damaged_log, cutoff=11.0)
    # Another piece of the same log may be long enough.
    filtered(damaged_log, log, cutoff=11.0)


def test_a_log_too_short_for_its_cutoff_is_refused():
    with pytest.raises(
        InputError, match=r"2 s are too short for a cut-off of 3 Hz, which needs"
    ):
        filtered(Swing().measurement(seconds(2.0, 200.0)), cutoff=3.0)
    with pytest.raises(InputError, match="record longer"):
        filtered(Swing().measurement(seconds(0.1, 200.0)))


RATE = 200.0
NOISE = 1e-4


@pytest.mark.parametrize("outward", [1.0, -1.0])
@pytest.mark.parametrize("standing", [0.0, 0.05])
def test_samples_near_a_turn_may_be_at_rest(outward, standing):
    """The joint reverses with 2 rad/s^2, at once or after a pause."""
    time = np.arange(-1.0, 1.0, 1.0 / RATE) + 0.5 / RATE
    moving = np.sign(time) * np.maximum(np.abs(time) - 0.5 * standing, 0.0)
    position = -(moving**2)
    noise = NOISE * default_rng(0).standard_normal(len(time))
    exact = np.column_stack((outward * position, outward * position))
    readings = exact + noise[:, None]
    speeds = np.column_stack((-2.0 * outward * time, np.ones_like(time)))
    travel = travel_from_turns(readings, exact, speeds)
    assert np.all(travel[np.abs(time) <= 0.5 * standing, 0] == 0.0)
    # Noise moves the outermost reading, and each one that is compared with it.
    moved = 8.0 * NOISE
    clear = -position > 6.0 * NOISE + moved
    assert_close(travel[clear, 0], -position[clear], atol=moved)
    assert np.any(travel[:, 0] == 0.0)
    # A joint that has been away once is not at its turn again.
    ways = travel[time < 0.0, 0][::-1], travel[time > 0.0, 0]
    assert all(np.all(np.diff(way) >= 0.0) for way in ways)
    # A joint that never turns round is never unsure.
    assert np.all(travel[:, 1] == np.inf)


@pytest.mark.parametrize("travel", TURN_TRAVELS)
def test_a_turns_zone_is_a_travel_of_the_gears_whatever_sensors_read(travel):
    """It is 1 mrad at least, also of sensors without noise; of a slide, that of a pinion."""
    swing = Swing(frequencies=np.array([0.3]), joints=2)
    log = swing.measurement(seconds(20.0, 500.0))
    signals = filtered(log, cutoff=8.0, is_slide=(False, True))
    from_turn = swing.amplitude - np.abs(swing.q(signals.time))
    near = from_turn < travel * np.array([1.0, PINION])
    # Before its first turn and after its last one, nothing tells how far a joint is from one.
    turns = [np.flatnonzero(np.diff(np.sign(speed))) for speed in signals.qd.T]
    first, last = max(own[1] for own in turns), min(own[-2] for own in turns)
    zone = signals.from_turn <= travel
    assert_array_equal(zone[first:last], near[first:last])
    assert travel >= 1e-3 and np.all(np.any(near[first:last], axis=0))
    lost = signals.low_pass.weight_shares(zone) > LARGEST_SLOW_SHARE
    assert_array_equal(signals.at_turns(travel), lost)


@pytest.mark.parametrize("resolution", [1e-5, 1e-4])
def test_only_rows_beside_an_abrupt_stop_are_masked(resolution):
    """One joint runs into the end of its range; another comes to rest there as a motor stops it."""
    time = seconds(12.0, RATE)
    way = np.clip(time - 4.0, 0.0, 3.0)
    shapes = time**2, way, np.cos(np.pi / 3.0 * way)
    q = np.round(np.column_stack(shapes) / resolution) * resolution
    assert_close(time[abrupt_stops(time, q)], [4.0, 7.0], atol=1.5 / RATE)
    for joints, ends in (([0, 1], [4.0, 7.0]), ([0, 2], [])):
        own = q[:, joints]
        signals = filtered(Recording(time, own, None, own), cutoff=8.0)
        rows = signals.motion.time
        off = np.min(np.abs(np.subtract.outer(rows, ends)), axis=1, initial=np.inf)
        is_lost = ~signals.is_complete
        assert np.all(off[is_lost] < 2.5 / 8.0) and np.all(is_lost[off < 0.5 / 8.0])
