"""URDF text as MuJoCo can compile it.

Mesh paths become absolute, links are kept apart, unusable meshes are left out; but nothing that
enters the dynamics: a mesh goes only where the link has its own ``<inertial>`` or does not move, or
the mesh is only drawn.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator

import numpy as np

from robot_sysid import spatial
from robot_sysid.errors import ModelError
from robot_sysid.mjcf.assets import Asset, find_assets, relocate
from robot_sysid.mjcf.documents import ModelDocument, Node, get, put_inertial
from robot_sysid.mjcf.inertial import (
    MARGIN,
    URDF_MOMENTS,
    format_number,
    urdf_inertial_about_com,
)
from robot_sysid.mjcf.wrong_digits import (
    is_far_from_possible,
    nearest_possible,
    wrong_number,
)
from robot_sysid.records import Array
from robot_sysid.records.messages import LeastMassGiven, MeshesLeftOut
from robot_sysid.wording import option_name

# Suffixes of the mesh files that MuJoCo reads.
_READABLE_MESHES = (".stl", ".obj", ".msh")
# Name of MuJoCo's own body that stands still.
_WORLD = "world"
# Mass that a moving link without mass gets [kg]: MuJoCo refuses less than 1e-15.
_MINIMUM_MASS = 1e-6
# Moments of inertia that such a link gets [kg m^2].
_MINIMUM_INERTIA = 1e-9
# What moments of inertia are raised by, over what is needed: rounding to three digits must not
# leave them where MuJoCo refuses them.
_BEYOND_EDGE = 1.01
LARGEST = 1e12
"""Largest size of any number of an arm in SI units; squares of far larger ones overflow."""


def make_compilable(document: ModelDocument, fix_base: bool = False) -> tuple[str, ...]:
    """Make a URDF one that MuJoCo can compile, and return notes on what was changed.

    Args:
        document: the URDF.
        fix_base: whether what a floating joint carries stands still.

    Raises:
        ModelError: a mesh that decides a link's inertia is missing, or a floating joint is where
            MuJoCo takes none, and ``fix_base`` is not stated.
        ValueError: a number cannot be read.
    """
    notes = [*drop_unused_axes(document), *_use_absolute_meshes(document)]
    # MuJoCo takes a free joint on its world alone, which is a first link of that name.
    rename_link(document, _name_of_world(document), _WORLD)
    if not fix_base:
        for joint in _floating_below_links(document):
            raise free_joint_error(str(joint.get("name")))
    welded = weld_floating(document)
    if welded:
        notes.append(
            f"floating joint {', '.join(welded)}, of which MuJoCo takes none there, is fixed, in a "
            "written model too"
        )
    document.set_compiler({"fusestatic": "false", "strippath": "false"})
    mended, nearest = mend_inertias(document)
    notes += [f"{text}; it is used, in a written model too" for text in mended]
    raised = [*nearest, *raise_inertias(document)]
    if raised:
        listed = "', '".join(raised)
        notes.append(
            f"no body has the moments of inertia of link '{listed}', and MuJoCo refuses them: the "
            "nearest possible ones are used, in a written model too"
        )
    inertias = link_inertias(document)
    for link in document.root.findall("link"):
        # MuJoCo 3.3 ignores the rpy of an inertial.
        if np.any(_origin(link, "rpy")) and not _lacks_inertia(link):
            inertia = inertias[link.get("name")]
            put_inertial(link, urdf_inertial_about_com(*inertia))
    names = give_minimum(document)
    if names:
        listed = "', '".join(names)
        text = (
            f"moving link '{listed}' has no mass, or no inertia, which MuJoCo refuses; where it "
            f"has none it was given {_MINIMUM_MASS:g} kg and {_MINIMUM_INERTIA:g} kg·m²"
        )
        notes.append(LeastMassGiven(text))
    return tuple(notes)


def drop_unused_axes(document: ModelDocument) -> list[str]:
    """Remove the <axis> of joints that have none, where it is no three numbers, and return a note.

    MuJoCo reads it of fixed and floating joints, too.
    """
    names = []
    for joint in document.root.findall("joint"):
        axis = joint.find("axis")
        if axis is None or joint.get("type") not in ("fixed", "floating"):
            continue
        if not _is_vector(axis.get("xyz")):
            joint.remove(axis)
            names.append(str(joint.get("name")))
    if not names:
        return []
    return [
        f"the axis of joint {', '.join(names)}, which has none because of its type, is no three "
        "numbers: it is left out, in a written model too"
    ]


def _is_vector(text: str | None) -> bool:
    """Return whether a text is three numbers."""
    try:
        return len([float(word) for word in (text or "").split()]) == 3
    except ValueError:
        return False


def _name_of_world(document: ModelDocument) -> str:
    """Return the name of the link that is MuJoCo's world: one of that name, or an empty first link
    that a floating joint carries the arm from.
    """
    links = {link.get("name"): link for link in document.root.findall("link")}
    if _WORLD in links:
        return _WORLD
    joints = document.root.findall("joint")
    children = {get(joint.find("child"), "link") for joint in joints}
    floating = [joint for joint in joints if joint.get("type") == "floating"]
    for joint in floating:
        name = get(joint.find("parent"), "link")
        link = links.get(name)
        if name not in children and link is not None and not link.findall("*"):
            return str(name)
    return _WORLD


def free_joint_error(label: str) -> ModelError:
    """Return the error of a free joint that carries the arm."""
    return ModelError(
        f"free joint {label} carries the arm, whose base may move anywhere; if the arm stands on "
        f"something, {option_name('fix_base')} welds it where the model has it",
        [("--fix-base",)],
    )


def _floating_below_links(document: ModelDocument) -> list[Node]:
    """Return the floating joints that MuJoCo does not take: below a link that is not its world, or
    above a link that has the world's name.
    """
    joints = document.root.findall("joint[@type='floating']")
    world = _name_of_world(document)
    return [
        joint
        for joint in joints
        if get(joint.find("parent"), "link") != world
        or get(joint.find("child"), "link") == _WORLD
    ]


def weld_floating(document: ModelDocument) -> list[str]:
    """Make floating joints fixed where MuJoCo takes none, and return their names.

    A link of the world's name that is no first one gets another name, which MuJoCo would put all
    that it carries in the world by.
    """
    welded = _floating_below_links(document)
    if any(get(joint.find("child"), "link") == _WORLD for joint in welded):
        rename_link(document, _WORLD, f"{_WORLD}_link")
    for joint in welded:
        joint.set("type", "fixed")
    return [str(joint.get("name")) for joint in welded]


def rename_link(document: ModelDocument, name: str, new_name: str) -> None:
    """Give a link another name, and the ends of joints that are there."""
    root = document.root
    for end in (*root.findall("joint/parent"), *root.findall("joint/child")):
        if end.get("link") == name:
            end.set("link", new_name)
    for link in root.findall("link"):
        if link.get("name") == name:
            link.set("name", new_name)


def _use_absolute_meshes(document: ModelDocument) -> Iterator[str]:
    """Remove shapes with an unusable mesh, make the paths of all others absolute; yield notes.

    A shape is a link's <visual> or <collision>. ModelError where the inertia of a link that moves
    would be computed from the removed shape: the link has no <inertial>, as other links have, or
    ``inertiafromgeom`` overrules it.
    """
    from_geometry = document.compiler_setting("inertiafromgeom") == "true"
    assets = {asset.node: asset for asset in find_assets(document)}
    moving_links = _moving_links(document)
    # Where most links state no mass, the way between their joints says how large they are.
    massless = moving_links & links_without_mass(document)
    has_masses = 2 * len(massless) <= len(moving_links)
    collisions = document.root.findall("link/collision")
    removed = set()
    for shape in (*document.root.findall("link/visual"), *collisions):
        mesh = shape.find("geometry/mesh")
        problem = None if mesh is None else _mesh_problem(assets.get(mesh))
        if problem is None:
            continue
        link = shape.getparent()
        link.remove(shape)
        if shape.tag == "collision":
            name = mesh.get("filename")
            is_weighed = from_geometry or (has_masses and link.find("inertial") is None)
            if is_weighed and link.get("name") in moving_links:
                raise ModelError(
                    f"{document.path}: collision mesh {name} of link '{link.get('name')}' is "
                    f"{problem}, and the link has no <inertial> of its own; pass "
                    f"{option_name('mesh_dir', 'FOLDER')} or add an <inertial>"
                )
            removed.add(str(name).rpartition("/")[2])
    relocate(document, folder=None)
    if removed:
        yield MeshesLeftOut(
            "collision meshes that are missing, or in a format that MuJoCo does not read, are left "
            f"out: {', '.join(sorted(removed))}. Masses and inertias do not come from them, but "
            f"contacts with them are not seen ({option_name('mesh_dir', 'FOLDER')} says where they "
            "are). MuJoCo loads a written URDF once they are there, and a written MJCF without them"
        )


def base_link(document: ModelDocument) -> str:
    """Return the name of the first link of a URDF that no joint carries; "" of an MJCF."""
    carried = {get(j.find("child"), "link") for j in document.root.findall("joint")}
    names = [link.get("name") for link in document.root.findall("link")]
    return next((name for name in names if name and name not in carried), "")


def _moving_links(document: ModelDocument) -> set[str | None]:
    """Return the names of the links that a joint moves, or that are fixed to one that moves."""
    carried: dict[str | None, list[str | None]] = {}
    waiting = []
    for joint in document.root.findall("joint"):
        parent = get(joint.find("parent"), "link")
        child = get(joint.find("child"), "link")
        carried.setdefault(parent, []).append(child)
        if joint.get("type") != "fixed":
            waiting.append(child)
    moving: set[str | None] = set()
    while waiting:
        link = waiting.pop()
        if link not in moving:
            moving.add(link)
            waiting += carried.get(link, [])
    return moving


def _mesh_problem(asset: Asset | None) -> str | None:
    """Return what keeps MuJoCo from reading a mesh; None where nothing does."""
    if asset is None or asset.path is None:
        return "not found"
    if asset.path.suffix.lower() not in _READABLE_MESHES:
        return f"in a format MuJoCo cannot read ({asset.path.suffix})"
    return None


def give_minimum(document: ModelDocument, excluded: Collection[Node] = ()) -> list[str]:
    """Give links on joints of their own that weigh nothing a minimum of inertia.

    Left out are the excluded ones, and those that links with mass are welded to. Returns the names
    of the links that got one.
    """
    links = {link.get("name"): link for link in document.root.findall("link")}
    carrying_mass = set()
    moving_links = []
    for joint in document.root.findall("joint"):
        link = links.get(get(joint.find("child"), "link"))
        if link is None:
            continue
        if joint.get("type") != "fixed":
            moving_links.append(link)
        elif _mass(link) > 0.0:
            carrying_mass.add(get(joint.find("parent"), "link"))
    names = []
    for link in moving_links:
        name = link.get("name")
        is_kept = link in excluded or name in carrying_mass
        if is_kept or not _lacks_inertia(link):
            continue
        mass = max(_mass(link), _MINIMUM_MASS)
        inertia = _MINIMUM_INERTIA * np.eye(3)
        put_inertial(link, urdf_inertial_about_com(mass, _origin(link, "xyz"), inertia))
        names.append(str(name))
    return names


def links_without_mass(document: ModelDocument) -> frozenset[str]:
    """Return the names of links that state no mass, or none that is more than nothing.

    MuJoCo computes that of a link without <inertial> from its shapes, as if they were of water.
    """
    return frozenset(
        str(link.get("name"))
        for link in document.root.findall("link")
        if _mass(link) <= 0.0
    )


def collide_as_drawn(document: ModelDocument) -> bool:
    """Make what is only drawn of links without <collision> their shapes; return whether any is."""
    is_changed = False
    for link in document.root.findall("link"):
        if link.find("collision") is not None:
            continue
        for shape in link.findall("visual"):
            shape.tag = "collision"
            is_changed = True
    return is_changed


def link_inertias(document: ModelDocument) -> dict[str, tuple[float, Array, Array]]:
    """Return link name to (mass, centre of mass (3,), inertia about it (3, 3) in link axes).

    Units are kg, m and kg m^2; links without an <inertia> are left out. ValueError where a number
    cannot be read or is larger than ``LARGEST``.
    """
    inertias = {}
    for link in document.root.findall("link"):
        node = link.find("inertial/inertia")
        if node is None:
            continue
        com = _origin(link, "xyz")
        angles = _origin(link, "rpy")
        moments = [float(node.get(name) or 0.0) for name in URDF_MOMENTS]
        if not np.all(np.abs([*moments, *com, *angles]) <= LARGEST):
            raise ValueError(
                f"the inertial of link {link.get('name')} is none that an arm has"
            )
        rotation = spatial.rotation_of_angles(angles)
        inertia = spatial.symmetric_from_six(np.array(moments))
        inertia = rotation @ inertia @ rotation.T
        inertias[link.get("name")] = (_mass(link), com, inertia)
    return inertias


def inertia_increases(document: ModelDocument) -> dict[str, float]:
    """Return link name to what has to be added to its ixx, iyy and izz so that MuJoCo takes them.

    Only links with an inertia that no body has: a principal moment is not positive, or, unless
    ``balanceinertia`` mends that, larger than the sum of the other two, which of a flat body
    rounding alone can make it where MuJoCo computes the principal axes. The increase has three
    digits [kg m^2]. ValueError where a number cannot be read.
    """
    is_balanced = document.compiler_setting("balanceinertia") == "true"
    increases = {}
    for name, (_, _, inertia) in link_inertias(document).items():
        if not np.any(inertia):
            continue  # of a massless link, which gets a minimum where MuJoCo needs one
        smallest, middle, largest = np.linalg.eigvalsh(inertia).tolist()
        excess = 0.0 if is_balanced else largest - middle - smallest
        is_turned = np.any(inertia[np.triu_indices(3, 1)])
        if excess > 0.0 or (is_turned and not is_balanced):
            excess += MARGIN * largest
        none = 1e-14  # for MuJoCo
        least = max(1e-6 * max(largest, -smallest), 2.0 * none)
        if smallest <= none:
            excess = max(excess, least - smallest)
        if excess > 0.0:
            increases[name] = float(f"{_BEYOND_EDGE * excess:.3g}")
    return increases


def mend_inertias(
    document: ModelDocument, excluded: Collection[Node] = ()
) -> tuple[list[str], list[str]]:
    """Give links whose inertia is far from possible the number that is probably right, in place.

    Where no single number explains it, they get the nearest possible inertia, unless
    ``balanceinertia`` makes one. Excluded links stay as they are.

    Returns:
        (what is wrong with each number that was put right, names of links with the nearest one).

    Raises:
        ValueError: a number cannot be read.
    """
    is_balanced = document.compiler_setting("balanceinertia") == "true"
    lengths = _lengths(document)
    mended = []
    nearest = []
    for link in document.root.findall("link"):
        node = link.find("inertial/inertia")
        if node is None or link in excluded:
            continue
        six = np.array([float(node.get(name) or 0.0) for name in URDF_MOMENTS])
        inertia = spatial.symmetric_from_six(six)
        if not is_far_from_possible(inertia):
            continue
        name = str(link.get("name"))
        reach = 2.0 * float(np.linalg.norm(_origin(link, "xyz")))
        length = max(lengths.get(name, 0.0), reach)
        wrong = wrong_number(six, _mass(link), length)
        body = None if is_balanced else nearest_possible(inertia)
        if wrong is not None:
            node.set(wrong.name, format_number(wrong.right))
            mended.append(wrong.describe(f"link '{name}'"))
        elif body is not None:
            for key, value in zip(URDF_MOMENTS, spatial.six_from_symmetric(body)):
                node.set(key, format_number(value))
            nearest.append(name)
    return mended, nearest


def _lengths(document: ModelDocument) -> dict[str, float]:
    """Return link name to the distance from its joint to the farthest next one [m]."""
    lengths: dict[str, float] = {}
    for joint in document.root.findall("joint"):
        parent = str(get(joint.find("parent"), "link"))
        text = get(joint.find("origin"), "xyz") or "0"
        length = float(np.linalg.norm(list(map(float, text.split()))))
        lengths[parent] = max(lengths.get(parent, 0.0), length)
    return lengths


def raise_inertias(
    document: ModelDocument, excluded: Collection[Node] = ()
) -> list[str]:
    """Add the increases of ``inertia_increases`` to the file's links, but for the excluded ones.

    Returns the names of links whose moments were raised by more than rounding.
    """
    raised = []
    increases = inertia_increases(document)
    for link in document.root.findall("link"):
        increase = increases.get(link.get("name"), 0.0)
        node = link.find("inertial/inertia")
        if node is None or not increase or link in excluded:
            continue
        moments = []
        for name in ("ixx", "iyy", "izz"):
            moments.append(float(node.get(name) or 0.0) + increase)
            node.set(name, format_number(moments[-1]))
        # Six digits can make a flat body impossible by less.
        if increase > 1e-5 * max(moments):
            raised.append(str(link.get("name")))
    return raised


def velocity_limits(document: ModelDocument) -> dict[str, float]:
    """Return joint name to the speed limit it states [rad/s or m/s]; MuJoCo drops these."""
    limits = {}
    for joint in document.root.findall("joint"):
        with contextlib.suppress(ValueError):
            limit = float(get(joint.find("limit"), "velocity") or "")
            if 0.0 < limit < math.inf:
                limits[str(joint.get("name"))] = limit
    return limits


def mimics(document: ModelDocument) -> dict[str, str]:
    """Return joint name to that of the joint which it follows; older MuJoCos drop these.

    A multiplier of zero ties it to nothing.
    """
    followed = {}
    for joint in document.root.findall("joint"):
        mimic = joint.find("mimic")
        with contextlib.suppress(ValueError):
            if mimic is not None and float(mimic.get("multiplier") or 1.0) != 0.0:
                followed[str(joint.get("name"))] = str(mimic.get("joint"))
    return followed


def _origin(link: Node, name: str) -> Array:
    """Return the "xyz" or "rpy" of a link's inertial, three numbers in a valid file; else zeros."""
    text = get(link.find("inertial/origin"), name)
    return np.array(list(map(float, text.split()))) if text else np.zeros(3)


def _lacks_inertia(link: Node) -> bool:
    """Return whether a link has no mass or no inertia, and no shape to compute them from."""
    if link.find("inertial") is None:
        return link.find("collision") is None
    if _mass(link) <= 0.0:
        return True
    node = link.find("inertial/inertia")
    return not any(float(get(node, n) or 0.0) > 0.0 for n in ("ixx", "iyy", "izz"))


def _mass(link: Node) -> float:
    """Return the mass that a link states [kg]; 0 where it states none."""
    try:
        return float(get(link.find("inertial/mass"), "value") or 0.0)
    except ValueError:
        return 0.0
