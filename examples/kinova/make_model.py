"""Write the example's meshes and models: the guess, the truth, the truth with an empty gripper.

Run it after changing a number in gen3.py or a shape in links.py; it overwrites the folder model/.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import gen3
import numpy as np
from links import LARGE, SMALL, knuckle_height, link_meshes
from numpy.typing import NDArray
from shapes import write_stl

from robot_sysid import spatial

Array = NDArray[np.float64]

# A cylinder or capsule: ((x, y, z of one end and of the other), radius) [m].
Cylinder = tuple[tuple[float, ...], float]

FOLDER = Path(__file__).resolve().parent / "model"

COLOURS = {
    "shell": ".88 .89 .91 1",
    "dark": ".17 .18 .21 1",
    "accent": ".10 .46 .62 1",
    "steel": ".55 .58 .62 1",
    "floor": ".96 .97 .98 1",
}
GUESS_NOTE = (
    "The arm as an engineer starts from it: Kinova's published numbers for the links, a rough "
    "value for the last joint's friction, and a slim probe as the tool."
)
TRUTH_NOTE = (
    "The arm as it really is in this example: the published numbers of the newer arm with brakes, "
    "friction in every joint, and a gripper that holds a steel block."
)
EMPTY_NOTE = (
    "The arm as it really is in this example, with nothing in its gripper: what a payload is "
    "weighed against."
)


@dataclass(frozen=True)
class Variant:
    """Differences between the models.

    Attributes:
        file: file name inside the folder model/.
        note: what the model stands for.
        links: published inertial of every body but the last.
        link6: theta (10,) of the terminal link with its tool.
        friction: (Coulomb [N m], viscous [N m s/rad]) per joint.
        tool: (mesh, material) of each part at the flange.
        hull: capsules that stand for the tool in contacts.
    """

    file: str
    note: str
    links: Mapping[str, gen3.Inertial]
    link6: Array
    friction: Sequence[tuple[float, float]]
    tool: tuple[tuple[str, str], ...]
    hull: tuple[Cylinder, ...]


def variants() -> tuple[Variant, Variant, Variant]:
    """Return the guess, the ground truth, and the ground truth without the workpiece."""
    guess = Variant(
        "kinova_fullinertia_guess.xml",
        GUESS_NOTE,
        gen3.STANDARD,
        gen3.GUESS_LINK6,
        gen3.GUESS_FRICTION,
        (("probe", "accent"),),
        (((0, 0, 0.06, 0, 0, 0.2), 0.0225), ((0, 0, 0.2, 0, 0, 0.295), 0.005)),
    )
    truth = Variant(
        "kinova_fullinertia.xml",
        TRUTH_NOTE,
        gen3.BRAKES,
        gen3.true_link6(gen3.gripper() + gen3.workpiece()),
        gen3.TRUE_FRICTION,
        (("gripper", "dark"), ("fingers", "steel"), ("workpiece", "accent")),
        (
            ((-0.03, 0, 0.115, 0.03, 0, 0.115), 0.035),
            ((-0.02, 0, 0.19, 0.02, 0, 0.19), 0.03),
        ),
    )
    empty = replace(
        truth,
        file="kinova_empty_gripper.xml",
        note=EMPTY_NOTE,
        link6=gen3.true_link6(gen3.gripper()),
        tool=truth.tool[:2],
    )
    return guess, truth, empty


def model_xml(variant: Variant) -> str:
    """Return a variant as MJCF text."""
    root = ET.Element("mujoco", model=Path(variant.file).stem)
    root.append(
        _comment(variant.note + " Written by make_model.py; change the numbers there.")
    )
    ET.SubElement(root, "compiler", angle="radian", meshdir="meshes")
    _add_look(root)
    _add_assets(root, variant)
    _add_bodies(ET.SubElement(root, "worldbody"), variant)
    _add_contact(root)
    _add_actuators(root)
    keyframe = ET.SubElement(root, "keyframe")
    ET.SubElement(keyframe, "key", name="home", qpos=_numbers(gen3.HOME))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode").replace(" />", "/>") + "\n"


def main() -> None:
    """Write all models and meshes."""
    (FOLDER / "meshes").mkdir(parents=True, exist_ok=True)
    for name, mesh in link_meshes().items():
        write_stl(FOLDER / "meshes" / f"{name}.stl", mesh)
    for variant in variants():
        (FOLDER / variant.file).write_text(model_xml(variant), encoding="utf-8")
        print(f"wrote {FOLDER / variant.file}")


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with all their digits, so that what is read is what was meant."""
    return " ".join(repr(float(value)).removesuffix(".0") for value in values)


def _comment(text: str) -> ET.Element:
    """Return an XML comment."""
    return ET.Comment(f" {text} ")


def _add_look(root: ET.Element) -> None:
    """Add light, picture quality, and the default classes of shapes."""
    visual = ET.SubElement(root, "visual")
    ET.SubElement(
        visual,
        "headlight",
        ambient=".38 .38 .38",
        diffuse=".28 .28 .28",
        specular=".1 .1 .1",
    )
    ET.SubElement(visual, "global", offwidth="1920", offheight="1440")
    ET.SubElement(visual, "quality", shadowsize="4096", offsamples="8")
    ET.SubElement(root, "statistic", center="0 0 .5", extent="1.1")
    default = ET.SubElement(root, "default")
    looks = ET.SubElement(default, "default", {"class": "visual"})
    ET.SubElement(looks, "geom", type="mesh", contype="0", conaffinity="0", group="2")
    hull = ET.SubElement(default, "default", {"class": "collision"})
    ET.SubElement(hull, "geom", type="capsule", group="3", rgba=".8 .3 .2 .4")


def _add_assets(root: ET.Element, variant: Variant) -> None:
    """Add materials and meshes."""
    asset = ET.SubElement(root, "asset")
    for name, colour in COLOURS.items():
        ET.SubElement(
            asset, "material", name=name, rgba=colour, specular=".3", shininess=".4"
        )
    for mesh in (
        *gen3.LINKS[:-1],
        "bracelet",
        "camera",
        *(name for name, _ in variant.tool),
    ):
        ET.SubElement(asset, "mesh", name=mesh, file=f"{mesh}.stl")


def _add_bodies(world: ET.Element, variant: Variant) -> None:
    """Add light, floor and the arm."""
    ET.SubElement(
        world,
        "light",
        directional="true",
        pos=".7 -1 2",
        dir="-.35 .5 -1",
        diffuse=".5 .5 .5",
    )
    world.append(
        _comment(
            "The floor is only drawn: the arm's own contacts are what matters here."
        )
    )
    floor = {"name": "floor", "type": "plane", "size": "0 0 .05", "material": "floor"}
    ET.SubElement(world, "geom", floor, contype="0", conaffinity="0")
    parent = world
    for number, name in enumerate(gen3.LINKS, start=-1):
        parent = _add_body(parent, name, variant)
        if number >= 0:
            _add_joint(parent, number, variant.friction[number])
        _add_geoms(parent, name, variant)
    ET.SubElement(
        parent, "site", name="flange", pos=_numbers(gen3.FLANGE), size=".004", group="4"
    )


def _add_body(parent: ET.Element, name: str, variant: Variant) -> ET.Element:
    """Add a link with its joint and shapes; return its element."""
    if name == "link6":
        parent.append(
            _comment(
                "The terminal link with its tool; +z leaves the arm at the flange."
            )
        )
    body = ET.SubElement(parent, "body", name=name)
    if name in gen3.FRAMES:
        position, turn = gen3.FRAMES[name]
        body.set("pos", _numbers(position))
        body.set("quat", _numbers(turn))
    mass, com, inertia = _inertial(name, variant)
    about_com = _numbers(spatial.fullinertia_from_symmetric(inertia))
    ET.SubElement(
        body,
        "inertial",
        pos=_numbers(com),
        mass=_numbers([mass]),
        fullinertia=about_com,
    )
    return body


def _inertial(name: str, variant: Variant) -> tuple[float, Array, Array]:
    """Return (mass, centre of mass (3,), inertia about it (3, 3))."""
    if name == "link6":
        return spatial.com_from_theta(variant.link6)
    mass, com, six = variant.links[name]
    return mass, np.array(com), spatial.symmetric_from_six(np.array(six))


def _add_joint(body: ET.Element, number: int, friction: tuple[float, float]) -> None:
    """Add the joint of a number with (Coulomb, viscous) friction."""
    joint = gen3.JOINTS[number]
    coulomb, viscous = friction
    attributes = {"name": f"joint{number}", "axis": _numbers(joint.axis)}
    attributes["armature"] = _numbers([gen3.ARMATURE])
    if joint.limit is not None:
        attributes.update(limited="true", range=_numbers((-joint.limit, joint.limit)))
    if coulomb or viscous:
        attributes.update(frictionloss=_numbers([coulomb]), damping=_numbers([viscous]))
    body.append(_comment(f"Kinova allows {joint.velocity:g} rad/s here."))
    ET.SubElement(body, "joint", attributes)


def _add_geoms(body: ET.Element, name: str, variant: Variant) -> None:
    """Add the shapes of a link, for the picture and for contacts."""
    for ends, size in _trims(name):
        disc = {"type": "cylinder", "fromto": _numbers(ends), "size": _numbers([size])}
        ET.SubElement(body, "geom", {"class": "visual", **disc, "material": "dark"})
    drawn: tuple[tuple[str, str], ...] = ((name, "shell"),)
    if name == "link6":
        drawn = (("bracelet", "shell"), ("camera", "dark"), *variant.tool)
    for mesh, material in drawn:
        ET.SubElement(
            body, "geom", {"class": "visual", "mesh": mesh, "material": material}
        )
    for ends, size in _capsules(name) + (variant.hull if name == "link6" else ()):
        capsule = {
            "class": "collision",
            "fromto": _numbers(ends),
            "size": _numbers([size]),
        }
        ET.SubElement(body, "geom", capsule)


def _trims(name: str) -> list[Cylinder]:
    """Return the dark discs of a link: the seam at its joint and the cap of its half knuckle."""
    if name == "base":
        return []
    radius = SMALL if name in ("link4", "link5", "link6") else LARGE
    if name in ("link1", "link3", "link5"):
        top = -knuckle_height(radius)
        return [((0, 0, top - 0.001, 0, 0, top + 0.002), 0.72 * radius)]
    seam = ((0, 0, -0.004, 0, 0, 0.004), round(0.94 * radius, 4))
    if name == "link6":
        return [seam]
    _, y, z = gen3.FRAMES[gen3.LINKS[gen3.LINKS.index(name) + 1]][0]
    top = round(y - knuckle_height(radius), 6)
    return [seam, ((0, top - 0.001, z, 0, top + 0.002, z), 0.72 * radius)]


def _capsules(name: str) -> tuple[Cylinder, ...]:
    """Return the capsules that stand for a body, without its tool, in contacts."""
    if name == "base":
        return (((0, 0, 0.05, 0, 0, 0.11), LARGE),)
    if name == "link6":
        return (
            ((0, 0, 0.03, 0, 0, 0.04), 0.03),
            ((-0.025, 0.05, 0.04, 0.025, 0.05, 0.04), 0.02),
        )
    child = gen3.LINKS[gen3.LINKS.index(name) + 1]
    radius = SMALL if name in ("link4", "link5") else LARGE
    return (((0, 0, 0, *gen3.FRAMES[child][0]), radius),)


def _add_contact(root: ET.Element) -> None:
    """Add the pairs of bodies whose contacts do not count."""
    contact = ET.SubElement(root, "contact")
    contact.append(
        _comment("MuJoCo leaves out contacts of neighbours, but not with a fixed base.")
    )
    ET.SubElement(contact, "exclude", body1="base", body2="link0")


def _add_actuators(root: ET.Element) -> None:
    """Add a torque motor per joint."""
    actuator = ET.SubElement(root, "actuator")
    actuator.append(
        _comment("Nominal torques; the actuators' hard limits are 105 and 52 N m.")
    )
    for number, joint in enumerate(gen3.JOINTS):
        limit = _numbers((-joint.torque, joint.torque))
        names = {"name": f"motor{number}", "joint": f"joint{number}"}
        ET.SubElement(actuator, "motor", names, forcelimited="true", forcerange=limit)


if __name__ == "__main__":
    main()
