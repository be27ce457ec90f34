"""How far an arm gets after a damaged frame, and how it is stopped with a motor weak or lost.

Tests called "in_depth" repeat others with more cases.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from rigs.fault_bench import SetUp, outcomes_of
from rigs.fault_lines import DAMAGE_BOUND, DAMAGES, damage_cases, hold_cases

KINDS = len(DAMAGES)
"""Number of kinds of damage: fields of a frame and sizes of the error."""
IN_DEPTH = "in_depth"
LOWERED = SetUp(park="rest")
"""An arm that goes through all phases, lowering included."""


def soft_and_stiff(first_pose, second_pose):
    """Parametrise a test by stiffness and poses: a soft and a stiff arm, or both in both poses."""
    both = (first_pose, second_pose)
    cases = [
        (60.0, (first_pose,)),
        (180.0, (second_pose,)),
        pytest.param(60.0, both, id=f"{IN_DEPTH}_60"),
        pytest.param(180.0, both, id=f"{IN_DEPTH}_180"),
    ]
    return pytest.mark.parametrize(("kp", "poses"), cases)


@pytest.mark.slow
@pytest.mark.parametrize("setup", [LOWERED, pytest.param(None, id=IN_DEPTH)])
def test_one_damaged_frame_moves_no_joint_far_from_its_path(setup):
    """Each kind of damage once, every other one without a model, or 40 of them with any set-up."""
    cases = damage_cases(KINDS if setup else 40, seed=1)
    if setup:
        for number, case in enumerate(cases):
            half = replace(setup, model_is_given=number % 2 == 0)
            cases[number] = replace(case, setup=half)
    damaged_runs = list(outcomes_of(cases))
    assert len(damaged_runs) == len(cases)
    worst = max(damaged_runs, key=lambda outcome: outcome.departure)
    assert worst.departure < DAMAGE_BOUND, worst.line()


def stopped_while_holding(fault, kp, poses):
    """What comes of faults whose name contains this, of an arm that is held still in two poses."""
    cases = []
    for case in hold_cases():
        setup = case.setup
        if fault in case.name and setup.kp == kp and setup.pose in poses:
            cases.append(replace(case, setup=replace(setup, duration=1.5)))
    outcomes = list(outcomes_of(cases))
    assert [outcome.ending for outcome in outcomes] == ["stopped"] * len(cases)
    return outcomes


@pytest.mark.slow
@soft_and_stiff(0, 2)
def test_a_weak_motors_joint_is_carried_and_no_energy_goes_into_the_arm(kp, poses):
    """A stop that moved the reference to the joint let it fall by 0.8 rad at kp 60."""
    falls = stopped_while_holding("weak", kp, poses)
    assert len(falls) == 2 * len(poses)
    for outcome in falls:
        assert outcome.fall < 0.1, outcome.line()
        assert outcome.energy_gain < 0.05, outcome.line()
        assert outcome.others_speed < 0.35, outcome.line()


@pytest.mark.slow
@soft_and_stiff(1, 3)
def test_beside_a_lost_motor_the_other_joints_are_held(kp, poses):
    """Its own joint swings at 6 rad/s and throws the others: to 0.9 rad/s before it is noticed."""
    falls = stopped_while_holding("lost", kp, poses)
    assert len(falls) == len(poses)
    for outcome in falls:
        assert outcome.others_fall < 0.06, outcome.line()
        assert outcome.others_speed < 1.0, outcome.line()
        assert outcome.others_later_speed < 0.4, outcome.line()
        assert outcome.energy_gain < 0.12, outcome.line()
