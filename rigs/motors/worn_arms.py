"""Arms on the bench of faults that are not as their models say, as no arm is.

Links are 10 to 20 % off and one of them 40 %; joints have dry friction that no file knows, which is
larger at rest and grows with the load; motors make a little more or less than they say, and their
encoders' zeros are a little off. The motors are the weakest that carry the arm with a margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from rigs.arms.small_arms import robot_of
from rigs.arms.wrong_arms import typical_torque, write_link, wrong_links
from rigs.files.places import GUESS, MODELS
from rigs.motors.fault_bench import (
    FILE_RATE,
    MOTOR_TYPES,
    PHYSICS_STEP,
    SetUp,
    plan_with,
)
from rigs.motors.rehearsals import ARMS as REHEARSED
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.trajectory import generate_excitation_trajectory

TYPES = ("DM4310", "DM4340", "DM8009", "DM10010L", "DM10010")
"""Motors of arms, the weakest first."""
LARGER = 3.0
"""How much larger than an identification's a motion is that moves the whole arm."""
FADING = 0.1
"""Speed with which the friction of rest fades [rad/s]."""


class WornStepper(ArmStepper):
    """An arm whose links, friction and rotors are drawn with a seed, beside those of its model.

    Args:
        robot: the arm as its model says.
        q: positions (n,) at the start [rad].
        typical: torque (n,) that joints need in a motion [N m].
        rng: draws what is wrong.
    """

    def __init__(self, robot, q, typical, rng):
        super().__init__(robot, q, 2.0 * PHYSICS_STEP)
        for link, theta in zip(robot.links, wrong_links(robot, rng)):
            write_link(self.model, link, theta)
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        n = robot.n_joints
        dofs = robot.dof_index
        self.model.dof_armature[dofs] += rng.uniform(0.002, 0.02, n)
        self._dry = typical * rng.uniform(0.02, 0.1, n)
        self._at_rest = self._dry * rng.uniform(0.2, 0.6, n)
        self._loss = rng.uniform(0.02, 0.06, n)
        self.viscous = self.viscous + typical * rng.uniform(0.0, 0.1, n)
        self._known = self.coulomb

    def step(self, torque, damping, duration=None):
        load = np.abs(torque - damping * self.qd)
        rest = self._at_rest * np.exp(-np.abs(self.qd) / FADING)
        dry = self._dry + rest + self._loss * load
        self.coulomb = self._known.copy()
        self.coulomb[: self.n_joints] += dry
        return super().step(torque, damping, duration)


@dataclass(frozen=True)
class WornSetUp(SetUp):
    """What an arm plays that is not as its model says.

    Attributes:
        model: its file, or its XML.
        terminal: its terminal joint, where the model has several that could be.
        motors: types of its motors, base first; by default by what the motion needs.
        seed: draws motion and arm.
    """

    model: Path | str = ""
    terminal: str | None = None
    motors: tuple[str, ...] = ()
    seed: int = 0

    @property
    def robot(self):
        """The model as the player has it."""
        return _load_robot(self.model, self.terminal)

    @property
    def is_at_hand(self):
        """Whether the model's file is there."""
        return isinstance(self.model, str) or self.model.exists()

    def plan(self):
        """Return the plan, with the inertias of the model if it is given."""
        return _plan_of(self)

    def mechanism(self, q):
        """Return the arm as it is, at rest at q (n,) [rad]."""
        typical = typical_torque(self.plan().trajectory.tau)
        return WornStepper(
            self.robot, q, typical, np.random.default_rng([self.seed, 1])
        )

    def prepare(self, run):
        """Let the motors of a run be a little off, too."""
        rng = np.random.default_rng([self.seed, 2])
        for motor in run.motors:
            motor.torque_share = 1.0 + 0.03 * rng.standard_normal()
            motor.torque_factor = 1.0 + 0.02 * rng.standard_normal()
            motor.encoder_error = 2e-3 * rng.standard_normal()


WORN_ARMS = {
    "kinova": WornSetUp(model=GUESS, motors=tuple(MOTOR_TYPES)),
    "openarm": WornSetUp(
        model=REHEARSED["openarm"].model,
        terminal="openarm_left_joint7",
        motors=REHEARSED["openarm"].motors,
    ),
    # No test of motors names these two.
    "ur5e": WornSetUp(model=MODELS / "universal_robots_ur5e" / "ur5e.xml"),
    "xarm7": WornSetUp(model=MODELS / "ufactory_xarm7" / "xarm7_nohand.xml"),
}
"""Arms whose undisturbed runs must not be stopped."""


@cache
def _load_robot(model, terminal):
    if isinstance(model, str):
        return robot_of(model, terminal, max_velocity=1.5)
    return load_robot_model(model, joint=terminal, max_velocity=1.5)


def motor_types(tau, speed):
    """Return the weakest type for each joint whose peak is twice the torque (N, n) [N m]."""
    types = []
    for torque, fastest in zip(np.abs(tau).max(axis=0), speed):
        able = [
            name
            for name in TYPES
            if MOTORS[name].peak_torque > 2.0 * torque
            and MOTORS[name].no_load_rpm * 2.0 * np.pi / 60.0 > 1.5 * fastest
        ]
        types.append(able[0])
    return types


@cache
def _plan_of(setup):
    robot = setup.robot
    rng = np.random.default_rng([setup.seed, 0])
    plan = generate_excitation_trajectory(robot, rng, setup.duration)
    time = np.arange(round(setup.duration * FILE_RATE) + 1) / FILE_RATE
    small = plan.evaluate(time)
    limits = robot.limits
    centre = small.q[0]
    room = np.minimum(centre - limits.lower, limits.upper - centre)
    larger = np.full(robot.n_joints, LARGER)
    larger[-1] = 1.0
    larger = np.minimum(larger, 0.9 * room / np.abs(small.q - centre).max(axis=0))
    larger = np.minimum(larger, 0.99 * limits.velocity / np.abs(small.qd).max(axis=0))
    motion = plan.scale_amplitudes(larger).evaluate(time)
    tau = np.asarray(ArmDynamics(robot)(motion))
    types = setup.motors or motor_types(tau, np.abs(motion.qd).max(axis=0))
    return plan_with(setup, robot, motion, tau, types)
