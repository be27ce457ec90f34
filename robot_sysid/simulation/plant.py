"""The plant, another model of the same arm that plays the real one, and the sensors that read it.

Sensors add noise and delay to the true torques and round the true positions to encoder steps. With
an encoder resolution the record holds no velocities and accelerations: an arm with encoders alone
would have to compute them from the rounded positions. Torque noise leaves the motion exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import data_at_pose
from robot_sysid.errors import InputError
from robot_sysid.model.chain import is_hinge_or_slide, joint_label
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import robot_from_compiled
from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel
from robot_sysid.records.option_fields import joint_values
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_times

GEOMETRY_TOLERANCE = 1e-6
"""Distance between the terminal bodies of model and plant above which a note is made [m]."""
_PROBE_STEP = 0.5
"""Shift of all joints from the reference to the second pose that is compared [rad or m]."""


class PlantSimulation:
    """Measurements of a plant that follows a trajectory exactly, with Coulomb's dry friction.

    It may be iterated over any number of times and yields equal measurements, noise included, each
    time.

    Args:
        plant: the arm that plays the real one, see ``load_plant``.
        plan: the trajectory.
        options: errors of the sensors.
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
        joint_values(options.noise_torque, plant.n_joints, "--noise-torque")
        plan_joints = plan.evaluate(np.zeros(1)).q.shape[1]
        if plan_joints != plant.n_joints:
            raise InputError(
                f"the trajectory moves {plan_joints} joints, the plant has {plant.n_joints}"
            )
        self._plant = plant
        self._plan = plan
        self._options = options
        self._sample_rate = sample_rate
        self._seed = rng.integers(2**63, size=4)

    def __iter__(self) -> Iterator[Measurement]:
        """Yield the sensors' readings, chunk by chunk in constant memory."""
        options = self._options
        noise_levels = np.asarray(options.noise_torque)
        motions = motion_chunks(self._plan, self._sample_rate)
        delayed = simulate_inverse(self._plant, self._delayed_motions())
        rng = np.random.default_rng(self._seed)
        for motion, delayed_chunk in zip(motions, delayed):
            noise = noise_levels * rng.standard_normal(delayed_chunk.tau.shape)
            tau = delayed_chunk.tau + noise
            measured = Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)
            if options.encoder_resolution > 0.0:
                q = round_to_multiples(motion.q, options.encoder_resolution)
                measured = replace(measured, q=q, qd=None, qdd=None)
            yield measured

    def _delayed_motions(self) -> Iterator[Motion]:
        """Yield the motion one torque delay before each sample, at the start the first state."""
        for time in sample_times(self._plan.duration, self._sample_rate):
            delayed_time = time - self._options.torque_delay
            yield self._plan.evaluate(np.maximum(delayed_time, 0.0))


def load_plant(
    robot: RobotModel, plant_path: Path, mesh_dir: Path | None = None
) -> RobotModel:
    """Load the model that plays the real arm, matched to the arm to be identified.

    Args:
        robot: the arm to be identified.
        plant_path: MJCF or URDF file with the same joints; masses, friction, armature, fingers and
            everything else may differ.
        mesh_dir: folder of its meshes; default where the file says.

    Returns:
        The plant, held at its own reference configuration apart from the chain; its notes say where
        its geometry differs.

    Raises:
        ModelError: the file cannot be used; says why.
        InputError: its joints are others than the robot's; lists the differences.
    """
    compiled = compile_model(Path(plant_path), mesh_dir)
    terminal = robot.terminal_joint
    plant_joints = _hinges_and_slides(compiled.mj_model)
    if terminal not in plant_joints:
        raise InputError(
            f"the plant {Path(plant_path).name} has no joint {terminal}, the last joint of "
            f"{robot.path.name}; its joints are: {', '.join(plant_joints) or 'none'}"
        )
    plant = robot_from_compiled(compiled, Path(plant_path), terminal)
    differences = joint_differences(robot, plant)
    if differences:
        raise InputError(
            f"the plant {plant.path.name} does not have the joints of {robot.path.name}: "
            f"{'; '.join(differences)}. Give a model of the same arm with the same joint names"
        )
    robot_joints = _hinges_and_slides(robot.mj_model)
    notes = list(plant.notes)
    held = [name for name in plant_joints if name not in robot_joints]
    if held:
        notes.append(f"joints only the plant has are held still: {', '.join(held)}")
    distance = _terminal_distance(robot, plant)
    if distance > GEOMETRY_TOLERANCE:
        notes.append(
            f"the same joint positions put the terminal body of the plant {1e3 * distance:.3g} mm "
            "from where the model has it, so the identified values also carry that difference"
        )
    return replace(plant, notes=tuple(notes))


def _hinges_and_slides(mj_model: Any) -> list[str]:
    """Return the names of a compiled model's hinge and slide joints."""
    joints = range(mj_model.njnt)
    return [joint_label(mj_model, j) for j in joints if is_hinge_or_slide(mj_model, j)]


def joint_differences(robot: RobotModel, plant: RobotModel) -> tuple[str, ...]:
    """Return sentences on how the chain of a plant differs from the robot's; empty if equal."""
    if robot.joint_names != plant.joint_names:
        names = ", ".join(plant.joint_names)
        return (f"{names} instead of {', '.join(robot.joint_names)}",)
    types = ("hinge", "slide")
    differences = []
    for joint in np.flatnonzero(plant.is_slide != robot.is_slide).tolist():
        plant_type = types[int(plant.is_slide[joint])]
        robot_type = types[int(robot.is_slide[joint])]
        name = robot.joint_names[joint]
        differences.append(f"{name} is a {plant_type} instead of a {robot_type}")
    return tuple(differences)


def _terminal_distance(robot: RobotModel, plant: RobotModel) -> float:
    """Return the largest distance of the terminal bodies of robot and plant in two poses [m]."""

    def terminal_position(arm: RobotModel, q: Array) -> Array:
        qpos = arm.reference_qpos.copy()
        qpos[arm.qpos_index] = q
        return np.array(data_at_pose(arm.mj_model, qpos).xpos[arm.body_id])

    distances = []
    for q in (robot.reference, robot.reference + _PROBE_STEP):
        offset = terminal_position(robot, q) - terminal_position(plant, q)
        distances.append(float(np.linalg.norm(offset)))
    return max(distances)


def round_to_multiples(values: Array, step: float) -> Array:
    """Return the multiples of ``step`` nearest to ``values``, as an encoder reports them."""
    return np.round(values / step) * step
