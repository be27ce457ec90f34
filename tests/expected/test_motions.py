"""Made-up motions keep an arm's range and speeds, and their sums are those of its torque."""

import numpy as np

from rigs.arms import small_arms
from rigs.arms.excitation_arms import robot
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.estimate.terms import ArmTerms
from robot_sysid.expected.motions import MOTIONS, made_up_motions, sums_elsewhere

ARM = robot(
    small_arms.serial_arm(
        (small_arms.Z, small_arms.Y, small_arms.X),
        joint='range="-2.5 1.5" frictionloss=".4" armature=".05" damping=".1" stiffness="3"',
    )
)
SPEEDS = np.array([2.0, 1.0, 0.2])


def drawn():
    """Return the motions of one seed."""
    return [*made_up_motions(ARM, SPEEDS, np.random.default_rng(0))]


def test_motions_keep_ranges_and_speeds_and_use_them():
    motions = drawn()
    q = np.concatenate([motion.q for motion in motions])
    assert np.all((q >= -2.5) & (q <= 1.5))
    assert np.ptp(q, axis=0)[0] > 3.0
    for motion in motions:
        fastest = np.max(np.abs(motion.qd), axis=0)
        assert np.all(fastest <= SPEEDS * (1.0 + 1e-9))
        np.testing.assert_allclose(fastest[1:], SPEEDS[1:], rtol=1e-9)


def test_velocities_and_accelerations_are_derivatives():
    for motion in drawn():
        step = motion.time[1] - motion.time[0]
        for values, rates in ((motion.q, motion.qd), (motion.qd, motion.qdd)):
            # Simpson's rule over two steps: its error is of fourth order.
            area = step / 3.0 * (rates[:-2] + 4.0 * rates[1:-1] + rates[2:])
            np.testing.assert_allclose(values[2:] - values[:-2], area, atol=0.02)


def test_sums_give_the_squares_of_the_whole_torque():
    motions = drawn()
    terms = ArmTerms(ARM)
    sums = sums_elsewhere(terms, terms.start(), motions)
    values = np.array([terms.model.get(name, 0.0) for name in sums.names])
    dynamics = ArmDynamics(ARM)
    squares = sum(np.sum(dynamics(motion) ** 2, axis=0) for motion in motions)
    assert len(motions) == MOTIONS
    np.testing.assert_allclose(sums.squared_residuals(values), squares, rtol=1e-9)
