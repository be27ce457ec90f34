"""The bodies of a compiled arm: their inertia, the links that they make up, the flange on the last
one, and which of them touch.

The flange is the frame, fixed to the terminal body, in which controllers want a payload: a site or
a body of the model, or plain numbers. A frame that moves against the terminal body is no flange.

Links next to each other often overlap in a model: it does not matter that a model leaves out the
housing of the joint between them. Any other two bodies that touch are a collision.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.dynamics.inverse_dynamics import data_at_pose, subtree
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.inertial import sum_theta
from robot_sysid.model.chain import body_label
from robot_sysid.records import ArmLink, Array, Flange, RobotModel, SubtreeBody
from robot_sysid.wording import option_name


def body_theta(mj_model: Any, body_id: int) -> Array:
    """Return theta (10,) of one compiled body in its own frame, inertia about its origin."""
    mass = mj_model.body_mass[body_id]
    com = mj_model.body_ipos[body_id]
    return spatial.theta_from_com(mass, com, inertia_about_com(mj_model, body_id))


def inertia_about_com(mj_model: Any, body_id: int) -> Array:
    """Return the inertia (3, 3) of one compiled body about its centre of mass, in body axes."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, mj_model.body_iquat[body_id])
    axes = flat.reshape(3, 3)
    return axes @ np.diag(mj_model.body_inertia[body_id]) @ axes.T


def write_body(mj_model: Any, body_id: int, theta: Array) -> None:
    """Give a compiled body the parameters theta (10,); ``mj_setConst`` makes the rest agree."""
    mass, com, inertia = spatial.com_from_theta(theta)
    moments, axes = spatial.principal_axes(inertia)
    # The compiler's shortcuts for bodies whose inertia lies in the body frame no longer hold.
    mj_model.body_sameframe[body_id] = mj_model.body_simple[body_id] = 0
    mj_model.dof_simplenum[:] = 0
    mj_model.body_mass[body_id] = mass
    mj_model.body_ipos[body_id] = com
    mj_model.body_inertia[body_id] = moments
    mujoco.mju_mat2Quat(mj_model.body_iquat[body_id], axes.ravel())


def pose_in(frame: Any, other: Any) -> tuple[Array, Array]:
    """Return rotation (3, 3) and origin (3,) [m] of a frame in another one.

    Both are bodies or sites of MuJoCo's data.
    """
    axes = other.xmat.reshape(3, 3)
    origin = axes.T @ (frame.xpos - other.xpos)
    return axes.T @ frame.xmat.reshape(3, 3), origin


def subtree_bodies(
    mj_model: Any, qpos: Array, body_id: int, excluded: Collection[int] = ()
) -> tuple[SubtreeBody, ...]:
    """Return a body and all below it but the excluded ones (ids), held at ``qpos`` (nq,).

    All their theta are in the frame of the body ``body_id``, which comes first. ``welded`` is True
    of this body, and of those without a joint between it and them.
    """
    data = data_at_pose(mj_model, qpos)
    return _bodies_below(mj_model, data, body_id, excluded)


def _bodies_below(
    mj_model: Any, data: Any, body_id: int, excluded: Collection[int]
) -> tuple[SubtreeBody, ...]:
    """Return the same of a model whose ``data`` have all frames."""
    bodies: dict[int, SubtreeBody] = {}
    for i in subtree(mj_model, body_id):
        if i in excluded:
            continue
        theta = body_theta(mj_model, i)
        if i != body_id:
            pose = pose_in(data.body(i), data.body(body_id))
            theta = spatial.transform_theta(theta, *pose)
        parent = bodies.get(mj_model.body_parentid[i])
        is_welded = parent is None or (parent.welded and not mj_model.body_jntnum[i])
        bodies[i] = SubtreeBody(i, body_label(mj_model, i), theta, is_welded)
    return tuple(bodies.values())


def link_reach(robot: RobotModel) -> float:
    """Return how far the terminal link reaches from its body's origin [m].

    It is the distance of the farthest point of its geoms' bounding spheres, but at least the length
    of a uniform rod whose mass is as far away.
    """
    mj_model = robot.mj_model
    data = data_at_pose(mj_model, robot.reference_qpos)
    geoms = np.isin(mj_model.geom_bodyid, subtree(mj_model, robot.body_id))
    steps = data.geom_xpos[geoms] - data.xpos[robot.body_id]
    spheres = np.linalg.norm(steps, axis=1) + mj_model.geom_rbound[geoms]
    rod = spatial.ROD * spatial.characteristic_length(robot.prior.theta)
    return max(rod, np.max(spheres, initial=0.0))


def arm_links(mj_model: Any, qpos: Array, chain: Sequence[int]) -> tuple[ArmLink, ...]:
    """Return one link per chain joint, base to terminal.

    A link is the body that the joint moves with all that hangs on it, apart from the bodies that a
    later chain joint moves. Where several joints move one body, all but the last have a link
    without mass. Joints outside the chain (ids, base to terminal) are held at ``qpos`` (nq,).
    """
    data = data_at_pose(mj_model, qpos)
    mujoco.mj_comPos(mj_model, data)
    body_ids = mj_model.jnt_bodyid[list(chain)].tolist()
    dofs = mj_model.jnt_dofadr[list(chain)].tolist()
    # The body that the next chain joint moves, which begins the next link.
    next_ids = [*body_ids[1:], mj_model.nbody]
    links = []
    # Frame of the previous link.
    previous = data.body(0)
    jac_linear = np.zeros((3, mj_model.nv))
    jac_angular = np.zeros((3, mj_model.nv))
    for body_id, next_id, dof in zip(body_ids, next_ids, dofs):
        body = data.body(body_id)
        rotation, translation = pose_in(body, previous)
        mujoco.mj_jacBody(mj_model, data, jac_linear, jac_angular, body_id)
        # Angular and linear velocity (2, 3) of the body per unit of the joint's, in world axes.
        velocity = np.stack((jac_angular, jac_linear))[:, :, dof]
        excluded = subtree(mj_model, next_id)
        bodies = _bodies_below(mj_model, data, body_id, excluded)
        links.append(
            ArmLink(
                body_id=body_id,
                body_name=body_label(mj_model, body_id),
                screw=np.ravel(velocity @ body.xmat.reshape(3, 3)),
                rotation=rotation,
                translation=translation,
                theta=sum_theta(bodies),
                bodies=bodies,
            )
        )
        previous = body
    return tuple(links)


# Names by which models call the frame that a tool is bolted to, the surest first. Franka's own
# descriptions call the flange link8.
_NAMES = (
    "attachment",
    "(?:tool_?)?flange",
    "tool0",
    "(?:panda|fer|fr3|fp3)_link8",
    "eef?|end_?effector",
)
_PATTERNS = tuple(
    re.compile(
        rf"(?:site|body) '(?:.*[/_.:-])?(?:{name})(?:[_-](?:site|frame|link))?'",
        re.IGNORECASE,
    )
    for name in _NAMES
)


def find_flange(robot: RobotModel, text: str | None = None) -> Flange:
    """Return the frame that a user named, or the one that looks like a flange.

    Args:
        text: name of a site or body fixed to the terminal body; "x,y,z" in metres or
            "x,y,z,roll,pitch,yaw" with degrees about the fixed axes x, y, z, in the terminal body's
            frame; None for the site or body that is called like a flange, else the terminal body.

    Raises:
        ModelError: no frame, or several, could be meant, or it moves against the terminal body.
    """
    frames = list(_fixed_frames(robot))
    if text is None:
        return _guess_flange(robot, frames)
    name = text.strip()
    for frame in frames:
        if frame.name in (f"site '{name}'", f"body '{name}'"):
            return frame
    if "," in name:
        return _parse_flange(robot, name)
    raise ModelError(
        f"flange {name}: no site or body of that name is fixed to body '{robot.body_name}', but "
        f"these are: {_list_names(frames)}; or give x,y,z in metres"
    )


def _list_names(frames: Sequence[Flange]) -> str:
    """Return what frames are called, separated by commas."""
    return ", ".join(frame.name for frame in frames)


def _fixed_frames(robot: RobotModel) -> Iterator[Flange]:
    """Yield the frames of all sites, then bodies, that are fixed to the terminal body.

    The terminal body is the first of the bodies.
    """
    mj_model = robot.mj_model
    data = data_at_pose(mj_model, robot.reference_qpos)
    fixed = {body.body_id: body.name for body in robot.bodies if body.welded}
    frames = []
    for site, body in enumerate(mj_model.site_bodyid.tolist()):
        name = mj_model.site(site).name
        if name and body in fixed:
            frames.append((f"site '{name}'", data.site(site)))
    for body, name in fixed.items():
        frames.append((f"body '{name}'", data.body(body)))
    for name, frame in frames:
        pose = pose_in(frame, data.body(robot.body_id))
        yield Flange(name, *pose, robot.body_name)


def _guess_flange(robot: RobotModel, frames: Sequence[Flange]) -> Flange:
    """Return the frame that is called like a flange, else the terminal body's, with a note on it.

    A note is a sentence for the user. ModelError where several different frames are called so.
    """
    for pattern in _PATTERNS:
        matches = [frame for frame in frames if pattern.fullmatch(frame.name)]
        if not matches:
            continue
        # A site counts more than a body.
        sites = [frame for frame in matches if frame.name.startswith("site")]
        matches = sites or matches
        # Several names of one and the same frame are no ambiguity.
        poses = [np.column_stack((f.rotation, f.translation)) for f in matches]
        if not np.allclose(poses, poses[0], rtol=0.0, atol=1e-9):
            listed = _list_names(matches)
            raise ModelError(
                f"{listed} could each be the flange; choose one by its name"
            )
        flange = matches[0]
        others = option_name("flange")
        note = f"{flange.name} was taken for the flange, because of its name ({others} has others)"
        if pattern is _PATTERNS[-1]:
            note += "; an end effector's frame may also be the tip of the tool: check"
        return replace(flange, note=note)
    note = (
        f"no site or body that is fixed to body '{robot.body_name}' is called like a flange, so "
        f"the frame of that body is taken; those that can be named: {_list_names(frames)}"
    )
    return Flange(
        f"body '{robot.body_name}'", np.eye(3), np.zeros(3), robot.body_name, note
    )


def _parse_flange(robot: RobotModel, text: str) -> Flange:
    """Return the frame of "x,y,z" or "x,y,z,roll,pitch,yaw", or raise ModelError."""
    numbers = []
    with contextlib.suppress(ValueError):
        numbers = list(map(float, text.split(",")))
    if len(numbers) not in (3, 6) or not np.all(np.isfinite(numbers)):
        remedy = "wanted are x,y,z in metres or x,y,z,roll,pitch,yaw with degrees"
        raise ModelError(f"flange {text}: neither a name nor numbers; {remedy}")
    translation = np.array(numbers[:3])
    if np.max(np.abs(translation)) > 3.0:
        raise ModelError(
            f"flange {text}: more than 3 m away from body '{robot.body_name}'; the numbers are "
            "metres, not millimetres"
        )
    angles = np.radians(numbers[3:] or [0.0] * 3)
    rotation = spatial.rotation_of_angles(angles)
    return Flange(text.replace(" ", ""), rotation, translation, robot.body_name)


def count_moving_joints(robot: RobotModel) -> NDArray[np.int64]:
    """Return how many chain joints move each body (nbody,); k joints are the chain's first k.

    Bodies with equal counts keep their distances.
    """
    model = robot.mj_model
    counts = np.zeros(model.nbody, dtype=np.int64)
    for body in model.dof_bodyid[robot.dof_index].tolist():
        counts[subtree(model, body)] += 1
    return counts


def update_contacts(mj_model: Any, data: Any) -> None:
    """Compute frames and contacts at the positions that ``data`` has, in place.

    ModelError where MuJoCo has too little memory for the contacts.
    """
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_comPos(mj_model, data)
    try:
        mujoco.mj_collision(mj_model, data)
    except mujoco.FatalError:
        raise ModelError(
            "so many parts of the model touch each other that MuJoCo's memory does not hold their "
            'contacts; give it more with <size memory="1G"/>, or let fewer parts collide'
        ) from None


def touching_by_design(
    robot: RobotModel, pairs: Collection[tuple[int, int]]
) -> set[tuple[int, int]]:
    """Return those of some touching pairs of body ids that touch by the model's design.

    In a pair the lower id is first. One carries the other (bodies welded together count as one), or
    they touch at every tried position of the chain joints between them, a grid of seven per joint
    over their ranges, the others at reference (MuJoCo takes the convex hull of a mesh):
    no position would avoid it. Not by design is a pair of the arm and something beside it (MuJoCo's
    root body differs), or one with more than three joints between.
    """
    model = robot.mj_model
    counts = count_moving_joints(robot)
    weld = model.body_weldid
    carrier = weld[model.body_parentid[weld]]
    by_design = set()
    for pair in pairs:
        # The chain joints first, ..., last - 1 are between the two bodies.
        first, last = sorted(counts[list(pair)].tolist())
        first_root, second_root = model.body_rootid[list(pair)]
        if last - first > 3 or first_root != second_root:
            continue
        one, other = pair
        is_carried = weld[one] == carrier[other] or weld[other] == carrier[one]
        if is_carried or _never_part(robot, pair, slice(first, last)):
            by_design.add(pair)
    return by_design


def _never_part(robot: RobotModel, pair: tuple[int, int], between: slice) -> bool:
    """Return whether two bodies touch at all tried positions of the chain joints between them."""
    model = robot.mj_model
    # Half a turn to both sides where a joint has no limit.
    limits = robot.limits.around(robot.reference, np.pi)
    grid = np.linspace(limits.lower[between], limits.upper[between], 7)
    data = data_at_pose(model, robot.reference_qpos)
    for positions in product(*grid.T):
        data.qpos[robot.qpos_index[between]] = positions
        update_contacts(model, data)
        geoms = data.contact.geom[data.contact.dist <= 0.0].reshape(-1, 2)
        # A flexible body's contact has the geom -1.
        geoms = geoms[np.all(geoms >= 0, axis=1)]
        bodies = np.sort(model.geom_bodyid[geoms], axis=1)
        if list(pair) not in bodies.tolist():
            return False
    return True
