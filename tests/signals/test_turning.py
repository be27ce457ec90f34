"""Where readings do not tell which way a joint moves."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.signals.turning import CLEARLY_APART, turning_samples

RATE = 200.0
NOISE = 1e-4


@pytest.mark.parametrize("outward", [1.0, -1.0])
@pytest.mark.parametrize("standing", [0.0, 0.05])
def test_a_joint_may_stand_until_it_is_clearly_away_from_its_turn(outward, standing):
    """It turns round with 2 rad/s^2, at once or after a pause."""
    time = np.arange(-1.0, 1.0, 1.0 / RATE) + 0.5 / RATE
    moving = np.sign(time) * np.maximum(np.abs(time) - 0.5 * standing, 0.0)
    place = -(moving**2)
    rng = np.random.default_rng(0)
    reading = outward * (place + NOISE * rng.standard_normal(len(time)))
    smooth_speed = -2.0 * outward * time
    readings = np.column_stack((reading, reading))
    speeds = np.column_stack((smooth_speed, np.ones_like(time)))
    turning = turning_samples(readings, speeds, np.full(2, NOISE))

    assert np.all(turning[np.abs(time) <= 0.5 * standing, 0])
    # Noise moves the outermost reading, and each one that is compared with it.
    clear = -place > (CLEARLY_APART + 8.0) * NOISE
    assert not np.any(turning[clear, 0])
    assert np.any(turning[:, 0])
    # A joint that never turns round is never unsure.
    assert not np.any(turning[:, 1])


def test_readings_without_noise_show_every_motion():
    time = np.arange(400) / RATE
    q = np.sin(2.0 * np.pi * time)[:, None]
    qd = 2.0 * np.pi * np.cos(2.0 * np.pi * time)[:, None]
    turning = turning_samples(q, qd, np.zeros(1))
    assert 0 < np.count_nonzero(turning) <= 4
