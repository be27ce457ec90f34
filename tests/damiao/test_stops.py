"""How far an arm gets after a damaged frame, and how it is stopped with a motor weak or lost."""

from __future__ import annotations

import pytest

from benchmarks.motor_faults import DAMAGE_BOUND, damage_cases, hold_cases
from tests.support.fault_bench import outcomes_of

DAMAGED_FRAMES = 40


@pytest.mark.slow
def test_one_damaged_frame_moves_no_joint_far_from_its_path():
    cases = damage_cases("kinova", DAMAGED_FRAMES, seed=1)
    damaged_runs = list(outcomes_of(cases))
    assert len(damaged_runs) == len(cases)
    worst = max(damaged_runs, key=lambda outcome: outcome.departure)
    assert worst.departure < DAMAGE_BOUND, worst.line()


def outcomes_of_holding(fault, kp, poses):
    """What comes of faults whose name contains this, of an arm that is held still."""
    cases = [case for case in hold_cases("kinova") if fault in case.name]
    cases = [case for case in cases if case.setup.kp == kp and case.setup.pose in poses]
    return list(outcomes_of(cases))


@pytest.mark.slow
@pytest.mark.parametrize("kp", [60.0, 180.0])
def test_a_weak_motors_joint_is_carried_and_no_energy_goes_into_the_arm(kp):
    """A stop that moved the reference to the joint let it fall by 0.8 rad at kp 60."""
    falls = outcomes_of_holding("weak", kp, poses=(0, 2))
    assert len(falls) == 4
    for outcome in falls:
        assert outcome.fall < 0.1, outcome.line()
        assert outcome.energy_gain < 0.05, outcome.line()
        assert outcome.others_speed < 0.35, outcome.line()


@pytest.mark.slow
@pytest.mark.parametrize("kp", [60.0, 180.0])
def test_beside_a_lost_motor_the_other_joints_are_held(kp):
    """Its own joint swings at 6 rad/s and throws the others: to 0.9 rad/s before it is noticed."""
    falls = outcomes_of_holding("lost", kp, poses=(1, 3))
    assert len(falls) == 2
    for outcome in falls:
        assert outcome.others_fall < 0.06, outcome.line()
        assert outcome.others_speed < 1.0, outcome.line()
        assert outcome.others_later_speed < 0.4, outcome.line()
        assert outcome.energy_gain < 0.12, outcome.line()
