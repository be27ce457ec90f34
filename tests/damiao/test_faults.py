"""Damaged frames, each at a moment of its own, and stops of an arm that a weak motor holds still.

An arm's model plays on simulated motors. Single faults are rows of ``test_incidents.py``. Tests
called "in_depth" repeat others with more cases.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from rigs.motors.fault_bench import (
    DAMAGES,
    SetUp,
    damage_cases,
    hold_cases,
    outcomes_of,
)

IN_DEPTH = "in_depth"
LOWERED = SetUp(park="rest")
"""An arm that goes through all phases, lowering included."""
pytestmark = pytest.mark.slow


@pytest.mark.parametrize("setup", [LOWERED, pytest.param(None, id=IN_DEPTH)])
def test_one_damaged_frame_moves_no_joint_far_from_its_path(setup):
    """Each kind of damage once, every other one without a model, or 40 of them with any set-up."""
    cases = damage_cases(len(DAMAGES) if setup else 40, seed=1)
    if setup:
        for number, case in enumerate(cases):
            half = replace(setup, model_is_given=number % 2 == 0)
            cases[number] = replace(case, setup=half)
    damaged_runs = list(outcomes_of(cases))
    assert len(damaged_runs) == len(cases)
    worst = max(damaged_runs, key=lambda outcome: outcome.figures["departure"])
    assert worst.figures["departure"] < cases[0].bound, worst


HOLDS = [
    ("weak motor, 0.5", "DM10010L", 60.0, (0,)),
    ("weak motor, 0.6", "DM8009", 180.0, (2,)),
    ("weak motor, 0.6", "DM4340", 60.0, (3,)),
    ("motor lost", "DM10010L", 60.0, (1,)),
    ("motor lost", "DM10010L", 180.0, (3,)),
    *(
        pytest.param(fault, "DM10010L", kp, poses, id=f"{IN_DEPTH}_{fault}_{kp}")
        for fault, poses in (("weak motor, 0.5", (0, 2)), ("motor lost", (1, 3)))
        for kp in (60.0, 180.0)
    ),
]
"""Faults of an arm that is held still, its shoulder's motor, stiffness and poses."""
HOLD_BOUNDS = {
    "weak": {"others speed": 0.35},
    "motor": {"others fall": 0.06, "others speed": 1.0, "others later speed": 0.4},
}
ENERGY_BOUNDS = {"weak": 0.05, "motor": 0.12}


@pytest.mark.parametrize(("fault", "shoulder", "kp", "poses"), HOLDS)
def test_a_stop_carries_the_arm_and_gives_it_no_energy(fault, shoulder, kp, poses):
    """A stop that moved the reference to a weak motor's joint let it fall by 0.8 rad at kp 60.

    A weak motor's joint gets hardly farther than if its motor gave its most at once: 0.1 rad and
    more farther where only late stiffness raised its torque. A lost motor's own joint swings at 6
    rad/s and throws the others: to 0.9 rad/s before it is noticed.
    """
    cases = [
        replace(case, setup=replace(case.setup, duration=1.5))
        for case in hold_cases()
        if (case.name, case.setup.shoulder, case.setup.kp) == (fault, shoulder, kp)
        and case.setup.pose in poses
    ]
    outcomes = list(outcomes_of(cases))
    assert len(outcomes) == len(poses)
    kind = fault.split()[0]
    for outcome in outcomes:
        assert outcome.ending == "stopped", outcome
        assert outcome.energy_gain < ENERGY_BOUNDS[kind], outcome
        for quantity, bound in HOLD_BOUNDS[kind].items():
            assert outcome.figures[quantity] < bound, outcome
        if kind == "weak":
            assert outcome.figures["own fall"] < outcome.figures["least fall"] + 0.03
