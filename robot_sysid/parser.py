"""RobotModel of a model file: chain, terminal link, limits and the model's own parameters."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.friction import POLYNOMIAL, stated_tops
from robot_sysid.dynamics.inverse_dynamics import (
    EARTH_GRAVITY,
    gravity_vector,
    with_gravity,
)
from robot_sysid.dynamics.passive import acts_by_itself
from robot_sysid.errors import InputError, ModelError
from robot_sysid.model.bodies import arm_links
from robot_sysid.model.chain import (
    arm_without_base,
    chain_to,
    find_terminal_joint,
    jaw_in_line,
    joint_friction,
    joint_label,
    joint_limits,
    joints_before,
    refuse_play,
    resolve_joint,
)
from robot_sysid.model.compilation import (
    CompiledModel,
    InMemory,
    compile_as_drawn,
    compile_model,
    is_in_memory,
)
from robot_sysid.model.dry_friction import (
    actuator_label,
    friction_notes,
    refuse_late_yield,
)
from robot_sysid.model.stated import (
    placeholder_notes,
    with_references,
    with_stated_links,
)
from robot_sysid.model.ties import refuse_tied_joints
from robot_sysid.model.units import refuse_cad_units, with_mass_scale
from robot_sysid.model.unstated import lacks_masses, with_bodies_of_geometry
from robot_sysid.records import KINDS, ArmLink, Array, RobotModel
from robot_sysid.records.messages import Detail, LeastMassGiven
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    Factor,
    PerJoint,
    RoughFactors,
    factor_with_error,
)
from robot_sysid.wording import option_name, option_setting


def load_robot_model(
    model: str | os.PathLike[str] | InMemory,
    mesh_dir: str | os.PathLike[str] | None = None,
    joint: str | None = None,
    max_velocity: PerJoint = DEFAULT_MAX_VELOCITY,
    keyframe: str | None = None,
    mass_scale: Factor | None = None,
    total_mass: float | None = None,
    gravity: Sequence[float] | Array | None = None,
    first_joint: str | None = None,
    fix_base: bool = False,
    as_stated: bool = False,
) -> RobotModel:
    """Load an MJCF or URDF file and find the arm in it.

    Args:
        model: the file, or an ``MjSpec`` or ``MjModel``.
        mesh_dir: folder of its meshes; default as the file says.
        joint: name of the terminal joint; default found automatically.
        max_velocity: speed limit of hinge joints, one number or one per joint [rad/s]; a lower
            limit in the model counts.
        keyframe: name of the one that is the arm at rest; default see ``rest_keyframe``.
        mass_scale: by which all its masses and moments of inertia are multiplied.
        total_mass: what the arm weighs with its base, by volume of its links, whatever masses the
            file states [kg]; default as the file says, or as arms of its size weigh where it states
            none.
        gravity: (3,) direction in which it acts, of any length, in the model's axes; default as
            the file says. How large it is, the file says.
        first_joint: name of the arm's first joint, where those before it stand still.
        fix_base: whether the base that a free joint carries stands still.
        as_stated: whether the masses that the file has are those of the arm, whatever they are, as
            in a simulation of the model; default they are placeholders where all links have one
            number, and bodies of the links' geometry stand for them.

    Raises:
        ModelError: the file cannot be used; says why.
        AmbiguousJointError: several joints could be the terminal one.
        InputError: there is no such keyframe, and those there are; or no such direction.
    """
    compiled = compile_model(model, mesh_dir, fix_base)
    mj_model = compiled.mj_model
    refuse_play(mj_model)
    terminal = (
        find_terminal_joint(mj_model)
        if joint is None
        else resolve_joint(mj_model, joint)
    )
    first = None
    if first_joint is not None:
        first = resolve_joint(mj_model, first_joint, "first_joint")
    chain = chain_to(mj_model, terminal, first, fix_base)
    if first is None:
        chain = arm_without_base(mj_model, chain)
    refuse_tied_joints(mj_model, chain, compiled.mimics)
    keyframe_id = rest_keyframe(mj_model, keyframe)
    qpos = mj_model.qpos0.copy()
    if keyframe_id is not None:
        qpos[:] = mj_model.key_qpos[keyframe_id]
    path = Path("model" if is_in_memory(model) else model)
    of_file = _arm_of(compiled, chain, path, qpos, max_velocity)
    massless = compiled.massless
    robot = of_file
    # Who states a factor says that there are masses.
    is_guessed = mass_scale is None and lacks_masses(of_file, massless)
    if total_mass is not None or is_guessed:
        drawn = compile_as_drawn(model, mesh_dir)
        robot = with_bodies_of_geometry(of_file, massless, drawn, total_mass)
    robot = with_mass_scale(robot, *factor_with_error(mass_scale))
    refuse_cad_units(robot)
    links = robot.links
    if as_stated and total_mass is None:
        if is_guessed:
            robot = of_file
            if lacks_masses(of_file, massless, as_stated):
                robot = with_bodies_of_geometry(
                    of_file, massless, drawn, as_stated=True
                )
        robot = with_stated_links(robot)
    if gravity is not None:
        robot = with_gravity(robot, _turned_gravity(robot, gravity))
    notes = (
        *_notes_on_file(robot),
        *_notes_on_options(mass_scale, gravity),
        *_notes_on_choices(robot, joint is None, keyframe_id),
        *_notes_on_masses(robot, links, total_mass, as_stated),
        *_notes_on_what_is_left_out(robot),
    )
    return replace(robot, notes=notes)


def _arm_of(
    compiled: CompiledModel,
    chain: tuple[int, ...],
    path: Path,
    qpos: Array,
    max_velocity: PerJoint,
) -> RobotModel:
    """Return the arm with a chain of joints of a compiled model, as the model states it.

    Args:
        compiled: the model.
        chain: ids of its joints, base to terminal.
        path: of its file.
        qpos: (nq,) its positions at rest.
        max_velocity: as in ``load_robot_model``.

    Raises:
        ModelError: the terminal body weighs nothing.
    """
    mj_model = compiled.mj_model
    joints = list(chain)
    dofs = mj_model.jnt_dofadr[joints].astype(np.int64)
    names = tuple(joint_label(mj_model, j) for j in chain)
    refuse_late_yield(mj_model, joints, names)
    links = with_references(mj_model, qpos, arm_links(mj_model, qpos, chain))
    if links[-1].theta[0] <= 0.0:
        raise ModelError(
            f"the terminal body {links[-1].body_name} and all below it weigh nothing; give it an "
            "<inertial> or geoms with mass as a starting value"
        )
    speeds = [compiled.velocity_limits.get(name) for name in names]
    return RobotModel(
        path=path,
        mj_model=mj_model,
        sha256=compiled.sha256,
        kind=compiled.kind,
        joint_names=names,
        qpos_index=mj_model.jnt_qposadr[joints].astype(np.int64),
        dof_index=dofs,
        reference_qpos=qpos,
        is_slide=mj_model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE),
        limits=joint_limits(mj_model, chain, max_velocity, speeds),
        friction=joint_friction(mj_model, dofs),
        stated_speeds=np.array(
            [np.inf if speed is None else speed for speed in speeds]
        ),
        links=links,
        notes=compiled.notes,
    )


def _notes_on_options(
    mass_scale: Factor | None, gravity: Sequence[float] | Array | None
) -> Iterator[str]:
    """Yield sentences on how options change the model that the file states."""
    if gravity is not None:
        x, y, z = gravity
        yield Detail(f"gravity is taken to act along ({x:g}, {y:g}, {z:g})")
    if mass_scale is not None:
        times = (
            mass_scale if isinstance(mass_scale, RoughFactors) else f"{mass_scale:g}"
        )
        yield f"the model's masses and moments of inertia are taken {times} times"


def _notes_on_file(robot: RobotModel) -> Iterator[str]:
    """Yield what the reader of the file had to assume, as far as it still holds."""
    for note in robot.notes:
        if not (robot.lacks_masses and isinstance(note, LeastMassGiven)):
            yield note


def _notes_on_masses(
    robot: RobotModel,
    links: Sequence[ArmLink],
    total_mass: float | None,
    as_stated: bool,
) -> Iterator[str]:
    """Yield sentences on what the model does not state of its links.

    Args:
        robot: the arm.
        links: its links as logs take them, with their placeholders.
        total_mass: of the arm, if the user states it [kg].
        as_stated: whether the placeholders are taken as the model has them.
    """
    if not robot.lacks_masses:
        yield from placeholder_notes(links, as_stated)
        return
    guessed = [link for link in robot.links if len(link.placeholders) == len(KINDS)]
    owner = "the model's masses"
    if len(guessed) < sum(link.has_mass for link in robot.links):
        owner = f"the masses of {', '.join(link.body_name for link in guessed)}"
    stand = f"bodies of the links' geometry stand for {owner}"
    errors = "each with an error as large as itself"
    if total_mass is not None:
        yield f"{stand}, {robot.mass:.3g} kg of the arm's {total_mass:g} kg, {errors}"
        return
    yield (
        f"the model states no masses, or one number for all links: {stand}, {robot.mass:.3g} kg in "
        f"all as arms of its size weigh, {errors}; {option_name('total_mass', 'KG')} takes what "
        "the arm's data sheet says"
    )


def _notes_on_choices(
    robot: RobotModel, is_found: bool, keyframe: int | None
) -> Iterator[str]:
    """Yield sentences on what was chosen where the user may want something else.

    Args:
        robot: the arm.
        is_found: whether the last one was found, and not named by the user.
        keyframe: id of the keyframe that is the arm at rest, if any.
    """
    mj_model = robot.mj_model
    arm = mj_model.dof_jntid[robot.dof_index].tolist()
    jaw = jaw_in_line(mj_model, arm[-1]) if is_found else None
    if jaw is not None:
        name = joint_label(mj_model, jaw)
        yield (
            f"joint {name} is taken for the jaw of a gripper because of its name, and held still; "
            f"the arm ends at joint {robot.joint_names[-1]} (to add the jaw: "
            f"{option_setting('joint', name)})"
        )
    if keyframe is None and mj_model.nkey:
        keyframes = ", ".join(keyframe_names(mj_model))
        yield (
            "of several keyframes none is called home, so all joints start at their zero; "
            f"{option_name('keyframe')} chooses one of {keyframes}"
        )
    standing = [joint_label(mj_model, j) for j in joints_before(mj_model, arm[0])]
    if standing:
        yield (
            f"taken to stand still where the model has them at rest, before the arm's first joint "
            f"{robot.joint_names[0]}: {', '.join(standing)}"
        )


def _turned_gravity(robot: RobotModel, direction: Sequence[float] | Array) -> Array:
    """Return gravity (3,) along a direction (3,), as large as in the model or on Earth [m/s^2].

    InputError where that is no direction.
    """
    vector = np.array(direction, dtype=float)
    # Squares of large and of small numbers are not finite, or zero.
    vector /= np.max(np.abs(vector), initial=0.0) or 1.0
    length = np.linalg.norm(vector)
    size = np.linalg.norm(gravity_vector(robot)) or EARTH_GRAVITY
    if vector.shape != (3,) or not 0.0 < length < np.inf:
        raise InputError(
            f"{option_name('gravity', 'X Y Z')} takes a direction, three numbers that are not all "
            "0, such as 1 0 0"
        )
    return size / length * vector


def rest_keyframe(mj_model: Any, name: str | None = None) -> int | None:
    """Return the index of the keyframe that is the arm at rest, or None.

    With a ``name`` ("#1" for the nameless one with id 1) it is the keyframe called so, InputError
    where there is none. Without, it is the one called "home", else the only one, else None.
    """
    names = keyframe_names(mj_model)
    if name is None:
        if "home" in names:
            return names.index("home")
        return 0 if len(names) == 1 else None
    if name not in names:
        listed = ", ".join(names) or "none"
        setting = option_setting("keyframe", name)
        raise InputError(f"{setting}: no such keyframe; the model has {listed}")
    return names.index(name)


def keyframe_names(mj_model: Any) -> list[str]:
    """Return the names of a model's keyframes in their order, "#0" for a nameless one with id 0."""
    return [mj_model.key(index).name or f"#{index}" for index in range(mj_model.nkey)]


def _notes_on_what_is_left_out(robot: RobotModel) -> Iterator[str]:
    """Yield sentences on parts of the model that the analysis leaves out."""
    mj_model = robot.mj_model
    is_joint_equality = mj_model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)
    is_joint_equality &= mj_model.eq_active0.astype(bool)
    partners = np.stack((mj_model.eq_obj1id, mj_model.eq_obj2id))[:, is_joint_equality]
    joints = mj_model.dof_jntid[robot.dof_index].tolist()
    coupled = [joint_label(mj_model, joint) for joint in joints if joint in partners]
    if coupled:
        yield (
            f"equality constraints on {', '.join(coupled)} are ignored: what they tie to the arm "
            "is taken to stand still beside it"
        )
    yield from friction_notes(mj_model, joints, robot.joint_names)
    yield from _notes_on_passive_actuators(robot)
    types = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    if np.any(np.isin(mj_model.eq_type, types)):
        yield "the model's connect and weld constraints are ignored"
    if not np.any(gravity_vector(robot)):
        direction = option_name("gravity", "X Y Z")
        yield f"the model has no gravity, so its links weigh nothing; {direction} states some"
    if mj_model.opt.density or mj_model.opt.viscosity:
        yield "the model's air or fluid drag is ignored"
    # MuJoCo before 3.7 has no such damping.
    stated = [term.stated_value(robot) for term in POLYNOMIAL]
    is_other = np.any(stated, axis=0) & (stated_tops(robot) == 0.0)
    if np.any(is_other):
        names = ", ".join(robot.joint_names[k] for k in np.flatnonzero(is_other))
        yield (
            f"nonlinear damping of {names} is taken to be as the model states it; what is "
            "identified of its friction stands beside it"
        )


def _notes_on_passive_actuators(robot: RobotModel) -> Iterator[str]:
    """Yield a sentence on actuators that act whatever their control is."""
    mj_model = robot.mj_model
    passive = np.flatnonzero(acts_by_itself(mj_model)).tolist()
    if passive:
        names = ", ".join(actuator_label(mj_model, actuator) for actuator in passive)
        yield (
            f"actuators {names} act whatever their control is: their torque counts as the arm's, "
            "like a spring's, and stays in a written model, beside what is identified of friction"
        )
