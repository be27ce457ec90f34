"""Model files: small ones of every kind, public ones where they are, damaged as XML and bytes."""

from __future__ import annotations

import functools
from pathlib import Path
from random import Random
from typing import Any

from lxml import etree

from benchmarks.trust.fuzz.harness import Case, write_case
from benchmarks.trust.fuzz.mutations import damaged_xml
from rigs.arms import small_arms
from rigs.files import model_files, urdf
from rigs.files.places import MODELS
from robot_sysid.mjcf.inertial import plan_write_back
from robot_sysid.mjcf.updated_model import BodyChange, ModelChange, changed_model_text
from robot_sysid.model.bodies import subtree_bodies
from robot_sysid.model.compilation import captured_warnings
from robot_sysid.parser import load_robot_model

ATTRIBUTES = (
    *(
        "name",
        "pos",
        "quat",
        "euler",
        "axis",
        "range",
        "mass",
        "inertia",
        "fullinertia",
        "class",
    ),
    *(
        "childclass",
        "file",
        "type",
        "size",
        "damping",
        "armature",
        "frictionloss",
        "ref",
        "angle",
    ),
    *(
        "xyz",
        "rpy",
        "filename",
        "lower",
        "upper",
        "effort",
        "velocity",
        "ixx",
        "izz",
        "value",
    ),
    *(
        "inertiafromgeom",
        "meshdir",
        "balanceinertia",
        "settotalmass",
        "gravity",
        "fromto",
        "count",
    ),
    *(
        "joint",
        "limited",
        "gravcomp",
        "mocap",
        "timestep",
        "link",
        "stiffness",
        "springref",
        "key",
    ),
)
PARTS = (
    '<include file="part.xml"/>',
    '<include file="model.xml"/>',
    '<include file="../../../../etc/passwd"/>',
    '<asset><mesh name="m" file="shape.obj"/><mesh name="n" file="/dev/zero"/></asset>',
    '<asset><mesh name="m" file="shape.obj" scale="0 -1 1e9"/></asset>',
    '<asset><mesh name="t" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>',
    '<geom type="mesh" mesh="m"/>',
    '<geom type="capsule" size=".1" fromto="0 0 0 0 0 0"/>',
    '<compiler inertiafromgeom="true" balanceinertia="true" settotalmass="3" angle="degree"/>',
    '<compiler discardvisual="true" fusestatic="true" boundmass="1" meshdir="nowhere"/>',
    '<default><default class="c"><joint damping="1"/></default></default>',
    '<keyframe><key name="home" qpos="0 1"/></keyframe>',
    '<equality><joint joint1="joint0" joint2="joint1" polycoef="0 1 0 0 0"/></equality>',
    '<equality><connect body1="link0" body2="link1" anchor="0 0 0"/></equality>',
    '<tendon><fixed name="t"><joint joint="joint0" coef="1"/></fixed></tendon>',
    '<actuator><position joint="joint0" kp="10"/><motor joint="joint1" gear="1e300"/></actuator>',
    '<replicate count="20" euler="0 0 1"><geom size=".1"/></replicate>',
    '<composite type="cable" count="30 1 1" size="1"><joint kind="main"/></composite>',
    '<body name="extra"><joint type="free"/><geom size=".1"/></body>',
    '<body name="ball"><joint type="ball"/><geom size=".1" mass="0"/></body>',
    '<body mocap="true"/>',
    '<frame pos="0 0 1"><body><freejoint/></body></frame>',
    '<joint name="joint1" type="slide"/>',
    '<inertial pos="0 0 0" mass="-1" diaginertia="1 1 9"/>',
    '<extension><plugin plugin="mujoco.pid"/></extension>',
    '<link name="extra"/>',
    '<joint name="j" type="prismatic"><parent link="base"/><child link="base"/></joint>',
    '<mimic joint="base_upper" multiplier="1e300"/>',
    '<collision><geometry><mesh filename="package://there/shape.obj"/></geometry></collision>',
    '<visual><geometry><cylinder radius="-1" length="nan"/></geometry></visual>',
    '<mujoco><compiler fusestatic="false" strippath="true"/></mujoco>',
)
PUBLIC_SHARE = 0.001
"""A public model takes a second, for its meshes."""


def urdf_arm() -> str:
    """Return a URDF of three links, the last one on a fixed joint."""
    heavy = urdf.inertial(0.5, "0.1 0.2 0.3")
    light = urdf.inertial(0.1)
    links = {"upper": urdf.inertial(), "fore": heavy, "hand": light + _MESH}
    return urdf.robot(urdf.serial(links, fixed=("hand",)))


_PART = b'<mujoco><worldbody><body name="part"><geom size=".1"/></body></worldbody></mujoco>'
_MESH = urdf.mesh("visual", "shape.obj")
_PARSER = etree.XMLParser(recover=True)  # of dashes inside a comment


@functools.cache
def _roots() -> tuple[Any, ...]:
    """Return small models as XML trees."""
    texts = [*small_arms.MODELS.values(), model_files.ARM, *[urdf_arm()] * 8]
    small = [text for text in texts if len(text) < 3000]
    return tuple(etree.fromstring(text, _PARSER) for text in small)


@functools.cache
def _public() -> tuple[tuple[Path, Any], ...]:
    """Return public models with their folders; none where they are absent."""
    paths = sorted(path for form in ("*.xml", "*.urdf") for path in MODELS.rglob(form))
    small = [path for path in paths if path.stat().st_size < 30_000]
    return tuple((path, etree.fromstring(path.read_bytes(), _PARSER)) for path in small)


def case(random: Random) -> Case:
    """Return a model file and the files that it may refer to."""
    files = {"part.xml": _PART, "shape.obj": model_files.TETRAHEDRON.encode()}
    if random.random() < 0.1:
        files["part.xml"] = damaged_xml(
            random, random.choice(_roots()), ATTRIBUTES, PARTS
        )
    root = random.choice(_roots())
    if _public() and random.random() > 1.0 - PUBLIC_SHARE:
        path, root = random.choice(_public())
        files["beside"] = str(path.parent).encode()
    return {"model.xml": damaged_xml(random, root, ATTRIBUTES, PARTS), **files}


def use(case: Case, folder: Path) -> None:
    """Load the model and write it back."""
    path = write_case(case, folder) / "model.xml"
    if "beside" in case:
        for other in Path(case["beside"].decode()).iterdir():
            if not (path.parent / other.name).exists():
                (path.parent / other.name).symlink_to(other)
    with captured_warnings():
        robot = load_robot_model(path)
        bodies = subtree_bodies(robot.mj_model, robot.reference_qpos, robot.body_id)
        plan = plan_write_back(robot.prior.theta, bodies)
        change = ModelChange((BodyChange(robot.body_name, 0, plan.theta),), 0.1)
        changed_model_text(path, change, folder / "out")
