"""The plant, another model of the same arm that plays the real one, and the sensors that read it.

Sensors make noise, encoder steps and late torques of the truth. An ideal one changes nothing.
Anything that spoils the positions also removes velocities and accelerations from the record,
because an arm with only encoders would have to compute them from those same positions; torques may
be spoiled while the motion stays exactly known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import posed
from robot_sysid.errors import InputError
from robot_sysid.model.chain import is_hinge_or_slide, joint_label
from robot_sysid.model.compilation import compile_model
from robot_sysid.parser import robot_from_compiled
from robot_sysid.records import Array, Measurement, Motion, MotionPlan, RobotModel
from robot_sysid.records.options import per_joint
from robot_sysid.simulation.options import SimulatedArmOptions
from robot_sysid.simulator import simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_times


class PlantSimulation:
    """Measurements of a plant that follows a trajectory exactly, with Coulomb's dry friction.

    They can be read as often as wanted; every reading is the same.

    Args:
        plant: the arm that plays the real one, see ``load_plant``.
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
        moved = plan.evaluate(np.zeros(1)).q.shape[1]
        if moved != plant.n_joints:
            raise InputError(
                f"the trajectory moves {moved} joints, the plant has {plant.n_joints}"
            )
        self._plant = plant
        self._plan = plan
        self._options = options
        self._sample_rate = sample_rate
        self._seed = rng.integers(2**63, size=4)

    def __iter__(self) -> Iterator[Measurement]:
        """Yield what the sensors report, chunk by chunk in constant memory."""
        options = self._options
        motions = motion_chunks(self._plan, self._sample_rate)
        delayed = simulate_inverse(self._plant, self._earlier_motions())
        rng = np.random.default_rng(self._seed)
        for motion, late in zip(motions, delayed):
            noise = np.asarray(options.noise_torque) * rng.standard_normal(
                late.tau.shape
            )
            tau = late.tau + noise
            measured = Measurement(motion.time, motion.q, motion.qd, tau, motion.qdd)
            if options.encoder_resolution > 0.0:
                q = quantised(motion.q, options.encoder_resolution)
                measured = replace(measured, q=q, qd=None, qdd=None)
            yield measured

    def _earlier_motions(self) -> Iterator[Motion]:
        """Yield the motion whose torque is measured, that before the delay; at first the start."""
        for time in sample_times(self._plan.duration, self._sample_rate):
            yield self._plan.evaluate(
                np.maximum(time - self._options.torque_delay, 0.0)
            )


GEOMETRY_TOLERANCE = 1e-6
"""How far apart the terminal bodies of model and plant may be without a note [m]."""


def load_plant(
    robot: RobotModel, plant_path: Path, mesh_dir: Path | None = None
) -> RobotModel:
    """Load the model that plays the real arm, matched to the arm to be identified.

    An MJCF or URDF file with the same joints; masses, friction, armature, fingers and everything
    else may differ. Its meshes are in ``mesh_dir``, or where the file says. Apart from the chain it
    is held at its own reference configuration; notes say where its geometry differs.

    Raises:
        ModelError: the file cannot be used; says why.
        InputError: its joints are others than the robot's; lists the differences.
    """
    compiled = compile_model(Path(plant_path), mesh_dir)
    terminal = robot.terminal_joint
    if terminal not in _hinges_and_slides(compiled.mj_model):
        known = ", ".join(_hinges_and_slides(compiled.mj_model)) or "none"
        raise InputError(
            f"the plant {Path(plant_path).name} has no joint {terminal}, the last joint of "
            f"{robot.path.name}; its joints are: {known}"
        )
    plant = robot_from_compiled(compiled, Path(plant_path), terminal)
    differences = joint_differences(robot, plant)
    if differences:
        raise InputError(
            f"the plant {plant.path.name} does not have the joints of {robot.path.name}: "
            f"{'; '.join(differences)}. Give a model of the same arm with the same joint names"
        )
    ours = _hinges_and_slides(robot.mj_model)
    held = [name for name in _hinges_and_slides(plant.mj_model) if name not in ours]
    note = (
        (f"joints only the plant has are held still: {', '.join(held)}",)
        if held
        else ()
    )
    return replace(plant, notes=plant.notes + note + _geometry_notes(robot, plant))


def _hinges_and_slides(mj_model: Any) -> list[str]:
    joints = range(mj_model.njnt)
    return [joint_label(mj_model, j) for j in joints if is_hinge_or_slide(mj_model, j)]


def joint_differences(robot: RobotModel, plant: RobotModel) -> tuple[str, ...]:
    """Return in words how the chain of a plant differs from the robot's; empty if it does not."""
    ours = robot.joint_names
    theirs = plant.joint_names
    if ours != theirs:
        return (f"{', '.join(theirs)} instead of {', '.join(ours)}",)
    kinds = ("hinge", "slide")
    return tuple(
        f"{name} is a {kinds[int(slides)]} instead of a {kinds[int(own)]}"
        for name, slides, own in zip(ours, plant.is_slide, robot.is_slide)
        if slides != own
    )


def _geometry_notes(robot: RobotModel, plant: RobotModel) -> tuple[str, ...]:
    """Return a sentence where the same joint positions put the terminal body elsewhere."""

    def place(arm: RobotModel, q: Array) -> Array:
        qpos = arm.reference_qpos.copy()
        qpos[arm.qpos_index] = q
        return np.array(posed(arm.mj_model, qpos).xpos[arm.body_id])

    poses = robot.reference, robot.reference + 0.5
    distance = max(
        float(np.linalg.norm(place(robot, q) - place(plant, q))) for q in poses
    )
    if distance <= GEOMETRY_TOLERANCE:
        return ()
    return (
        f"the same joint positions put the terminal body of the plant {1e3 * distance:.3g} mm from "
        "where the model has it, so the identified values also carry that difference",
    )


def quantised(values: Array, step: float) -> Array:
    """Return the nearest multiples of ``step``."""
    return np.round(values / step) * step
