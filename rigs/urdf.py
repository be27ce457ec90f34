"""Small URDF files for tests."""

from robot_sysid.mjcf.inertial import urdf_inertial_about_com


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


def write_bodies(folder, bodies):
    """The path of an arm of links with mass, centre of mass and inertia about that."""
    links = {name: urdf_inertial_about_com(*body) for name, body in bodies.items()}
    return write_arm(folder, links)


def write_arm(folder, links, *parts):
    """The path of a file with a base and links of this content, each on the one before it."""
    path = folder / "arm.urdf"
    path.write_text(robot(serial(links), *parts))
    return path
