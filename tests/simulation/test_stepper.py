"""The arm that simulated motors drive."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import SimulationError
from robot_sysid.records import Motion
from robot_sysid.simulation.forward_dynamics import ArmStepper
from robot_sysid.simulator import simulate_inverse
from tests.support import arms

HINGE = (
    '<mujoco><compiler angle="radian"/><option gravity="0 0 {g}"/><worldbody><body>'
    '<inertial pos="{x} 0 0" mass="2" diaginertia=".01 .01 .01"/>'
    '<joint axis="0 1 0" frictionloss="{fc}" damping="{fv}"/>'
    "</body></worldbody></mujoco>"
)


def one_hinge(g=0.0, x=0.0, fc=0.0, fv=0.0, timestep=1e-3):
    robot = arms.robot_of(HINGE.format(g=g, x=x, fc=fc, fv=fv))
    return ArmStepper(robot, timestep=timestep)


def run(arm, torque, seconds, damping=0.0):
    n = arm.n_joints
    for _ in range(round(seconds / arm.timestep)):
        acted = arm.step(np.full(n, float(torque)), np.full(n, float(damping)))
    return acted


def inverse_error(robot, timestep, seconds=0.2):
    """Largest difference between what acted and the inverse dynamics of the motion [N m]."""
    arm, rows = ArmStepper(robot, timestep=timestep), []
    phase = np.arange(arm.n_joints) / arm.n_joints
    for k in range(round(seconds / timestep)):
        torque = 3.0 * np.sin(2 * np.pi * (3 * k * timestep + phase))
        before = arm.qd
        acted = arm.step(torque, np.full(arm.n_joints, 2.0))
        rows.append((arm.q, arm.qd, (arm.qd - before) / timestep, acted))
    q, qd, qdd, acted = (np.array(x) for x in zip(*rows))
    (inverse,) = simulate_inverse(robot, [Motion(timestep * np.arange(len(q)), q, qd, qdd)])
    # Where a joint sticks, Coulomb's law does not tell the friction.
    return np.max(np.abs(inverse.tau - acted), where=qd != 0.0, initial=0.0)


@pytest.mark.parametrize("name", ["seven", "slide in chain", "coupled fingers"])
def test_its_torques_are_those_of_inverse_dynamics_to_first_order(name):
    robot = arms.robot_of(arms.MODELS[name])
    coarse, fine = inverse_error(robot, 1e-3), inverse_error(robot, 2.5e-4)
    assert coarse < 1.0
    # A quarter of the step, so about a quarter of the error; half would be a lower order.
    assert fine < 0.4 * coarse


def test_dry_friction_holds_until_its_limit_and_then_resists_with_it():
    arm = one_hinge(fc=0.4)
    run(arm, 0.39, 0.5)
    assert arm.qd[0] == 0.0 and arm.q[0] == 0.0
    run(arm, 0.6, 0.1)
    assert arm.qd[0] == pytest.approx((0.6 - 0.4) / 0.01 * 0.1, rel=1e-9)


def test_constant_speed_takes_coulomb_plus_viscous_friction():
    arm = one_hinge(fc=0.4, fv=0.1)
    acted = run(arm, 0.9, 3.0)
    assert arm.qd[0] == pytest.approx((0.9 - 0.4) / 0.1, rel=1e-6)
    assert acted[0] == pytest.approx(0.4 + 0.1 * arm.qd[0], rel=1e-6)


@pytest.mark.parametrize("damping", [0.0, 5.0, 1e3, 1e6])
def test_any_damping_is_stable(damping):
    arm = one_hinge(g=-9.81, x=0.1, fc=0.01)
    run(arm, 0.0, 0.5, damping)
    speed = np.abs(arm.qd[0])
    assert speed < 30.0
    if damping:
        assert speed <= 2.0 * 9.81 * 0.1 / damping * 1.001


def test_a_state_that_is_not_finite_is_said():
    arm = one_hinge()
    with pytest.raises(SimulationError, match="diverged"):
        arm.step(np.array([np.nan]), np.zeros(1))
