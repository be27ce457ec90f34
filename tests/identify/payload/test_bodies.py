"""Payload and link come out as possible bodies, and stay where they are possible already."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.identify.payload.bodies import ALUMINIUM, LINK, possible_values, with_ball
from robot_sysid.identify.payload.equations import PAYLOAD_NAMES
from robot_sysid.identify.payload.joint_fit import fit_jointly
from tests.support.payload_logs import TrueArm, four_joint_arm

POINT = spatial.theta_from_com(0.8, np.array([0.02, 0.01, 0.06]), 1e-7 * np.eye(3))


def test_what_is_possible_stays(fit):
    assert spatial.is_consistent(fit.payload)
    np.testing.assert_array_equal(possible_values(fit), fit.values)


@pytest.mark.slow
def test_a_point_mass_under_noise_becomes_a_possible_body(task):
    arm = TrueArm(four_joint_arm(), 8, wrong=0.03, payload=POINT)
    found = fit_jointly(task, arm.abba(8, sigma=0.1))
    assert not spatial.is_consistent(found.payload)
    values = possible_values(found)
    payload = values[found.equations.places(PAYLOAD_NAMES)]
    assert spatial.is_consistent(payload) and spatial.is_consistent(values[list(LINK)])
    assert payload[0] == pytest.approx(POINT[0], rel=0.05)
    assert payload[1:4] / payload[0] == pytest.approx(POINT[1:4] / POINT[0], abs=0.01)


def test_a_ball_has_the_mass_and_the_place_of_the_payload(fit):
    places = fit.equations.places(PAYLOAD_NAMES)
    ball = with_ball(fit).values[places]
    mass, com, inertia = spatial.com_from_theta(ball)
    np.testing.assert_allclose(ball[:4], fit.payload[:4], rtol=1e-12)
    radius = np.sqrt(2.5 * inertia[0, 0] / mass)
    assert 4.0 / 3.0 * np.pi * radius**3 * ALUMINIUM == pytest.approx(mass, rel=1e-6)
    assert spatial.is_consistent(ball)


def test_an_impossible_link_gives_way_too(fit):
    broken = fit.values.copy()
    broken[4] = -1.0
    values = possible_values(replace(fit, values=broken))
    assert spatial.is_consistent(values[list(LINK)])
