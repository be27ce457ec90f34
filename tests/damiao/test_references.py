"""References: a trajectory file as a function of time, the way to its start, braking."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.references import (
    ORDERS,
    Lowering,
    Reference,
    trajectory_reference,
    transfer_reference,
)
from tests.support.damiao_rig import swing, trajectory_file

ANGLES = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=7)


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_the_sampler_interpolates_and_scales_velocity_with_speed(tmp_path, speed):
    time, q, qd, tau = swing(3)
    sampler = trajectory_reference(trajectory_file(tmp_path, (time, q, qd, tau)), speed)
    for moment in np.append(np.arange(0.0, 2.0 / speed, 0.137), 9.0):
        reference = sampler(moment)
        for actual, signal in zip(reference, (q, speed * qd, tau)):
            expected = [np.interp(moment * speed, time, column) for column in signal.T]
            np.testing.assert_allclose(actual, expected, rtol=0, atol=6e-5)


@given(
    start=ANGLES,
    data=st.data(),
    speed=st.floats(0.05, 2.0),
    shortest=st.floats(0.1, 3.0),
    order=st.sampled_from(ORDERS),
)
def test_an_approach_goes_from_rest_to_rest_within_its_speed(
    start, data, speed, shortest, order
):
    """And carries the arm on its way, with what start and target ask for besides."""
    start = np.array(start)
    target = np.array([data.draw(st.floats(-3.0, 3.0)) for _ in start])
    ends = (
        Reference(start, 0 * start, 2.0 + np.sin(start)),
        Reference(target, 0 * start, 0 * start),
    )
    path, duration = transfer_reference(*ends, speed, shortest, order, np.sin)
    assert duration >= shortest
    for moment, end in ((-1.0, 0), (0.0, 0), (duration, 1), (duration + 1.0, 1)):
        for actual, expected in zip(path(moment), ends[end]):
            np.testing.assert_allclose(actual, expected, atol=1e-9)
    times = np.linspace(0.0, duration, 401)
    q, qd, tau = (np.array(signal) for signal in zip(*map(path, times)))
    assert np.max(np.abs(qd)) <= speed * (1 + 1e-9)
    if order != ORDERS[0]:
        assert np.max(np.count_nonzero(qd, axis=1)) <= 1
    ahead = np.array([path(moment + 1e-6).position for moment in times[:-1]])
    np.testing.assert_allclose(
        (ahead - q[:-1]) / 1e-6, qd[:-1], atol=1e-3 * speed + 1e-6
    )
    extra = (tau - np.sin(q) - 2.0) / (-np.sin(target) - 2.0)
    assert np.all(np.diff(extra, axis=0) >= -1e-9)


def test_an_arm_is_lowered_to_the_end_of_its_range_and_no_farther():
    """A torque that never goes away, as of a joint that lies on its stop, does not lead it on."""
    begin = Reference(np.array([0.4, 0.0]), np.zeros(2), np.array([3.0, 0.0]))
    lowering = Lowering(begin, 0.2, np.full(2, 27.0), np.full(2, -0.1), np.full(2, 1.0))
    lowering.torque = np.array([9.0, 0.0])
    moments = np.arange(0.0, 8.0, 0.004)
    references = [lowering(moment) for moment in moments]
    positions = np.array([reference.position for reference in references])
    assert np.all(positions >= -0.1) and positions[-1, 0] == -0.1
    assert np.max(np.abs(np.diff(positions, axis=0))) <= 0.2 * 0.004 + 1e-12
    assert lowering.is_done and references[-1].velocity[0] == 0.0
