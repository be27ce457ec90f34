"""Columns of scale and encoder zeros against MuJoCo's own torque."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.nuisances import tilt_axes, turned
from robot_sysid.errors import InputError
from tests.support.arms import SEEDS

angle = st.floats(-0.3, 0.3)


@given(SEEDS, angle, angle)
def test_turning_keeps_the_strength_and_turns_by_the_angle(seed, first, second):
    down = 9.81 * np.random.default_rng(seed).normal(size=3)
    after = turned(down, np.array([first, second]))
    np.testing.assert_allclose(np.linalg.norm(after), np.linalg.norm(down), rtol=1e-12)
    # Both axes are perpendicular to gravity, so the whole turn shows.
    sine = np.linalg.norm(np.cross(down, after)) / (down @ down)
    np.testing.assert_allclose(sine, np.sin(np.hypot(first, second)), rtol=0.0, atol=1e-12)


def test_without_gravity_there_is_no_tilt():
    with pytest.raises(InputError, match="--tilt auto needs gravity"):
        tilt_axes(np.zeros(3))
