"""Small URDF files for tests, and arms of other files as URDF."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robot_sysid.mjcf.inertial import urdf_inertial_about_com
from robot_sysid.records import Array


def link(name, content=""):
    return f'<link name="{name}">{content}</link>'


def inertial(mass=1.0, rpy="0 0 0", inertia="0.01 0.02 0.025"):
    x, y, z = inertia.split()
    return (
        f'<inertial><origin xyz="0.1 0 0" rpy="{rpy}"/><mass value="{mass}"/>'
        f'<inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def joint(parent, child, kind="revolute"):
    return (
        f'<joint name="{parent}_{child}" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/><origin xyz="0 0 0.2" rpy="0.1 0 0"/>'
        '<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>'
    )


def mesh(shape, name):
    return f'<{shape}><geometry><mesh filename="{name}"/></geometry></{shape}>'


def robot(*parts):
    return '<robot name="r">\n' + "\n".join(parts) + "\n</robot>\n"


def serial(links, fixed=()):
    """A base and links of this content, each on the one before it; some of them do not move."""
    names = ["base", *links]
    kinds = ["fixed" if name in fixed else "revolute" for name in links]
    joints = map(joint, names, names[1:], kinds)
    return "\n".join([link("base"), *map(link, links, links.values()), *joints])


def drawn_tree(rng, n_links=6):
    """The text of a URDF in which joints of all kinds, some of which mimic another, are turned."""
    names = ["base"]
    moving = []
    parts = [link("base")]
    for k in range(n_links):
        name = f"l{k}"
        kind = str(rng.choice(["revolute", "continuous", "prismatic", "fixed"]))
        moments = rng.uniform(0.5, 1.0, 3) * 10.0 ** rng.uniform(-4.0, -1.0)
        turn = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        inertia = turn @ np.diag(moments) @ turn.T
        mass = 10.0 ** rng.uniform(-1.0, 1.0)
        at = 0.1 * rng.normal(size=3)
        parts.append(link(name, urdf_inertial_about_com(mass, at, inertia)))
        more = f'<axis xyz="{_numbers(rng.normal(size=3))}"/>'
        more += '<limit lower="-1.23456789" upper="2.3456789" effort="9" velocity="1"/>'
        more += f'<dynamics damping="{rng.uniform()}" friction="{rng.uniform()}"/>'
        if kind != "fixed" and moving and rng.random() < 0.3:
            factor, offset = rng.normal(size=2)
            leader = rng.choice(moving)
            more += f'<mimic joint="{leader}" multiplier="{factor}" offset="{offset}"/>'
        elif kind != "fixed":
            moving.append(f"j{k}")
        place = _numbers(rng.normal(size=3))
        parts.append(
            f'<joint name="j{k}" type="{kind}"><origin xyz="{place}" '
            f'rpy="{_numbers(rng.normal(size=3))}"/><parent link="{rng.choice(names)}"/>'
            f'<child link="{name}"/>{more}</joint>'
        )
        names.append(name)
    return robot(*parts)


def write_bodies(folder, bodies):
    """The path of an arm of links with mass, centre of mass and inertia about that."""
    links = {name: urdf_inertial_about_com(*body) for name, body in bodies.items()}
    return write_arm(folder, links)


def write_arm(folder, links, *parts):
    """The path of a file with a base and links of this content, each on the one before it."""
    path = folder / "arm.urdf"
    path.write_text(robot(serial(links), *parts))
    return path


def urdf_of(
    mj_model: Any, change: Callable[[str, Array], Array] = lambda name, inertia: inertia
) -> str:
    """Return the text of a URDF with the bodies and hinges of a compiled model, without shapes.

    Args:
        mj_model: every body has one hinge at its origin, or is fixed.
        change: returns the inertia (3, 3) about the centre of mass, in the link's axes, that the
            file states of a body, given its name and its true one.
    """
    parts = [link("root")]
    for number in range(1, mj_model.nbody):
        body = mj_model.body(number)
        axes = _rotation(body.iquat).as_matrix()
        inertia = axes @ np.diag(body.inertia) @ axes.T
        content = ""
        if body.mass[0]:
            inertia = change(body.name, inertia)
            content = urdf_inertial_about_com(body.mass[0], body.ipos, inertia)
        parent = mj_model.body(body.parentid[0]).name if body.parentid[0] else "root"
        origin = f'<origin xyz="{_numbers(body.pos)}" rpy="{_numbers(_angles(body))}"/>'
        parts.append(link(body.name, content))
        ends = f'{origin}<parent link="{parent}"/><child link="{body.name}"/>'
        parts.append(_joint_of(mj_model, body, ends))
    return robot(*parts)


def _joint_of(mj_model: Any, body: Any, ends: str) -> str:
    """Return the joint of a body, its origin and ends given."""
    if not body.jntnum[0]:
        return f'<joint name="fixed_{body.name}" type="fixed">{ends}</joint>'
    hinge = mj_model.joint(body.jntadr[0])
    lower, upper = hinge.range if hinge.limited[0] else (-np.pi, np.pi)
    dof = hinge.dofadr[0]
    return (
        f'<joint name="{hinge.name}" type="revolute">{ends}<axis xyz="{_numbers(hinge.axis)}"/>'
        f'<limit lower="{lower:.9g}" upper="{upper:.9g}" effort="100" velocity="2"/>'
        f'<dynamics damping="{_first(mj_model.dof_damping[dof]):.9g}" '
        f'friction="{mj_model.dof_frictionloss[dof]:.9g}"/></joint>'
    )


def _rotation(quat: Array) -> Rotation:
    """Return the rotation of a quaternion (4,) in MuJoCo's order."""
    return Rotation.from_quat(np.roll(quat, -1))


def _angles(body: Any) -> Array:
    """Return the roll, pitch and yaw of a body (3,) [rad]."""
    with warnings.catch_warnings():
        # Two of the angles turn about one axis where the third is 90 degrees; any pair will do.
        warnings.simplefilter("ignore")
        return np.asarray(_rotation(body.quat).as_euler("xyz"))


def _first(values: Any) -> float:
    """Return the first of several numbers, or the number: damping has three since MuJoCo 3.7."""
    return float(np.ravel(values)[0])


def _numbers(values: Array) -> str:
    """Return numbers as text."""
    return " ".join(f"{value:.12g}" for value in values)
