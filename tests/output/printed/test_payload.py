"""What is printed of a payload: a number never stands without its error."""

from __future__ import annotations

import re

import numpy as np
import pytest

from robot_sysid.dynamics import spatial
from robot_sysid.output.printed.payload import _inertia_errors, payload_lines
from robot_sysid.records.payload import PayloadStatus
from tests.support.payload_results import body, result


def text(verbose=False, **changes):
    return "\n".join(payload_lines(result(**changes), verbose))


def test_the_block():
    lines = payload_lines(result())
    assert lines[0] == "Identified payload, in the frame of site 'flange':"
    table = [re.split(r"  +", line.strip()) for line in lines[1:11]]
    assert table[0] == ["identified", "±", "unit"]
    assert table[1] == ["mass", "1.200", "0.010", "kg"]
    assert table[2][:2] == ["centre of mass x", "0.03000"] and table[2][3] == "m"
    assert table[5][:2] == ["inertia xx about it", "0.00600"] and table[5][3] == "kg·m²"
    assert lines[12] == "  Error of the mass by cause, kg: torque scale 0.008, noise 0.006"
    assert "Terminal link without it: 0.800 ± 0.010 kg" in text()
    assert "  b.csv (loaded): 1.190 ± 0.010 kg" in text()
    assert "Held out, fifths: 0.1000 N·m (2 %)" in text()
    assert f"Result: {PayloadStatus.OK.value}" in text()


def test_an_inertia_that_is_not_seen_is_not_told_as_if_it_were():
    told = text(payload=body(shown=False))
    assert "Inertia: not seen" in told and "about it" not in told


def test_a_mass_that_cannot_be_is_told_alone():
    told = text(status=PayloadStatus.SWAPPED, payload=body(-1.0))
    assert "-1.000  0.010  kg" in told and "because" in told
    assert "centre of mass x" not in told


def test_torque_scales_have_intervals():
    told = text(known_mass=2.0, torque_scale={"joint0": (1.02, 0.01)})
    assert "Torque scales by the known mass of 2 kg" in told
    assert "joint0: 1.0200 [1.0004, 1.0396]" in told


def test_more_is_said_on_request():
    assert "coulomb[joint0]" not in text()
    told = text(verbose=True)
    assert "coulomb[joint0]: 0.500 ± 0.010" in told and "load[joint0]: 0 (held)" in told


def test_errors_of_the_inertia_follow_from_the_covariance():
    """Against draws: first order is right for small errors."""
    found = body()
    rng = np.random.default_rng(0)
    thetas = rng.multivariate_normal(found.inertial.theta, found.covariance, 4000)
    drawn = [spatial.six_from_symmetric(spatial.com_from_theta(t)[2]) for t in thetas]
    assert _inertia_errors(found) == pytest.approx(np.std(drawn, axis=0), rel=0.08)
