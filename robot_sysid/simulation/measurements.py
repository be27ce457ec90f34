"""Measurements of a simulated plant: another model of the arm, moved and read like a real one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.records import Measurement, MotionPlan, RobotModel
from robot_sysid.records.options import PerJoint, per_joint
from robot_sysid.simulation.closed_loop import ClosedLoop
from robot_sysid.simulation.sensors import Sensors, SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks


class PlantSimulation:
    """A run of the plant that can be read as often as wanted; every reading is the same.

    Args:
        plant: the arm that plays the real one, see ``loading.load_plant``.
        plan: the trajectory.
        options: how to simulate it, and its sensors.
        sample_rate: of the measurements [Hz].
        rng: source of the sensor noise; drawn from once, here.

    Raises:
        InputError: options and arm do not fit together.
        SimulationError: the plant cannot be simulated.
    """

    def __init__(
        self,
        plant: RobotModel,
        plan: MotionPlan,
        options: SimulatedArmOptions,
        sample_rate: float,
        rng: np.random.Generator,
    ) -> None:
        per_joint(options.noise_torque, plant.n_joints, "--noise-torque")
        per_joint(options.noise_position, plant.n_joints, "--noise-position")
        if plan.n_joints != plant.n_joints:
            raise InputError(
                f"the trajectory moves {plan.n_joints} joints, the plant has {plant.n_joints}"
            )
        self._plant, self._plan, self._sample_rate = plant, plan, sample_rate
        self._sensors = Sensors(options, sample_rate, rng)
        forward = options.simulation == "forward"
        self._loop = ClosedLoop(plant, plan, sample_rate) if forward else None

    def __iter__(self) -> Iterator[Measurement]:
        """Yield what the sensors report, chunk by chunk in constant memory."""
        return self._sensors.read(self.exact())

    def exact(self) -> Iterator[Measurement]:
        """Yield what perfect sensors would report."""
        if self._loop is not None:
            return self._loop.run()
        motions = motion_chunks(self._plan, self._sample_rate)
        return simulate_inverse(self._plant, motions)

    def notes(self, deadband: PerJoint | None = None) -> tuple[str, ...]:
        """Return what the last reading showed, one sentence each; ask once it is at its end.

        Args:
            deadband: speed below which samples are going to be left out [rad/s]; None stands for
                the usual share of each joint's highest speed.
        """
        return () if self._loop is None else self._loop.notes(deadband)

    def least_deadband(self) -> tuple[float, ...]:
        """Return (n,) speeds below which MuJoCo's dry friction was not complete [rad/s].

        Zero for a joint whose friction never is: leaving out all its rows would help nobody. Empty
        where the plant's friction follows Coulomb's law. Ask once the last reading is at its end.
        """
        if self._loop is None:
            return ()
        use = self._loop.ramp_use
        return tuple(
            0.0 if joint in use.never_full else float(speed)
            for joint, speed in zip(self._plant.joint_names, use.ramp_speed)
        )
