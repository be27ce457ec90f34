"""When dry friction shows in full: counts, the speed to mask at, and what the user is told."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.simulation.frictionloss import FrictionRamp, RampUse
from tests.support.arms import SEEDS
from tests.support.closed_loop_proof import ramp_torque

JOINTS = ("shoulder", "elbow", "wrist")


def ramp(coulomb=(0.4, 0.0, 1.0), inertia=(0.9, 0.0, 5e-3), rate=(105.0, 0.0, 105.0)):
    """A joint with armature, one without dry friction, a light one."""
    return FrictionRamp(np.array(coulomb), np.array(inertia), np.array(rate))


def sine(speed, samples=2000):
    """Velocities and accelerations (N, 3) of a 0.5 Hz sine of this peak speed."""
    angle = np.pi * np.arange(samples)[:, None] / 1000.0 + np.zeros(3)
    return speed * np.sin(angle), speed * np.pi * np.cos(angle)


def use_of(qd, qdd, which=None):
    """RampUse of one motion by the formula."""
    ramps = which or ramp()
    use = RampUse(JOINTS, ramps)
    use.add(qd, ramp_torque(ramps, qd, qdd))
    return use


@given(SEEDS, st.floats(0.01, 5.0))
def test_above_the_ramp_speed_coulombs_law_is_exact(seed, scale):
    rng = np.random.default_rng(seed)
    qd, qdd = scale * rng.normal(size=(2, 200, 3))
    ramps = ramp()
    use = use_of(qd, qdd)
    faster = np.abs(qd) > use.ramp_speed
    law, found = ramps.coulomb * np.sign(qd), ramp_torque(ramps, qd, qdd)
    np.testing.assert_allclose(found[faster], law[faster], rtol=1e-5, atol=0.0)


@given(SEEDS, st.integers(1, 199))
def test_counts_do_not_depend_on_how_the_stream_is_cut(seed, edge):
    qd, qdd = np.random.default_rng(seed).normal(size=(2, 200, 3))
    dry = ramp_torque(ramp(), qd, qdd)
    whole, parts = RampUse(JOINTS, ramp()), RampUse(JOINTS, ramp())
    whole.add(qd, dry)
    for rows in (slice(0, edge), slice(edge, None)):
        parts.add(qd[rows], dry[rows])
    np.testing.assert_array_equal(whole.share, parts.share)
    np.testing.assert_array_equal(whole.ramp_speed, parts.ramp_speed)


def test_a_slow_light_joint_is_the_one_that_never_gets_there():
    use = use_of(*sine(1.0))
    assert use.never_full == ("wrist",)
    (sentence,) = use.sentences(deadband=0.1)
    # 1 N m over 5e-3 kg m^2 times 105 1/s is 1.9 rad/s and 0.53 N m s/rad.
    assert "wrist (1 N m) is never reached" in sentence
    assert "above about 1.9 rad/s" in sentence and "below 1 rad/s" in sentence
    assert "0.53 N m s/rad" in sentence


def test_the_same_joint_with_armature_shows_its_friction():
    assert use_of(*sine(1.0), ramp(inertia=(0.9, 0.0, 0.9))).sentences(deadband=0.1) == ()


def test_joints_with_samples_on_their_ramp_are_told_where_to_mask():
    use = use_of(*sine(4.0))
    assert use.never_full == ()
    (sentence,) = use.sentences()
    assert f"wrist {use.ramp_speed[2]:.2g}" in sentence and "shoulder" in sentence
    advised = float(sentence.split("--velocity-deadband ")[1].split()[0])
    assert np.max(use.ramp_speed) <= advised < 1.1 * np.max(use.ramp_speed)
    assert use.sentences(deadband=advised) == ()


def test_a_joint_at_rest_is_said_to_show_nothing():
    sentences = use_of(np.zeros((10, 3)), np.zeros((10, 3))).sentences()
    assert [text.split()[0] for text in sentences] == ["shoulder", "wrist"]
    assert all("does not move" in text for text in sentences)
