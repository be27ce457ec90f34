"""Small arms as inline XML, and what tests need to know about them.

``serial_arm`` builds an arm from a list of joint axes; ``MODELS`` holds one arm per thing that
public model files do. ``random_chain`` and ``rigid_bodies`` are hypothesis strategies.
"""

import copy

import mujoco
import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot_sysid import spatial
from robot_sysid.estimate.rows import Rows
from robot_sysid.mjcf.inertial import sum_theta
from robot_sysid.model.bodies import subtree_bodies, write_body
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, Recording
from robot_sysid.solver import LastLinkTerms, exact_recording

X = "1 0 0"
Y = "0 1 0"
Z = "0 0 1"
THREE_AXES = (Z, Y, X)
SEVEN_AXES = (Z, Y, Z, Y, Z, Y, Z)
LINK = '<inertial pos=".01 -.02 .1" mass="1.2" fullinertia=".02 .021 .004 .001 -.0005 .0007"/>'
TIP = '<inertial pos=".02 .03 .06" mass=".8" fullinertia=".005 .006 .003 .0004 -.0003 .0005"/>'


def world(content, option="", extra=""):
    """An MJCF model around the given world bodies."""
    return (
        f'<mujoco><compiler angle="radian"/><option {option}/>'
        f"<worldbody>{content}</worldbody>{extra}</mujoco>"
    )


def link(joints, inside="", name="", pos="0 .02 .25", quat="1 0 0 0", inertial=LINK):
    """One body."""
    label = f'name="{name}"' if name else ""
    return f'<body {label} pos="{pos}" quat="{quat}">{inertial}{joints}{inside}</body>'


def hinge(name, axis, attributes='range="-2.5 2.5"'):
    """One hinge joint."""
    label = f'name="{name}"' if name else ""
    return f'<joint {label} axis="{axis}" {attributes}/>'


def serial_bodies(
    axes, tip="", joint='range="-2.5 2.5"', prefix="", tip_inertial=TIP, **attributes
):
    """Nested bodies link0, link1, ... with joints joint0, joint1, ..., all of the same kind.

    ``attributes`` are those of ``link``; ``inside`` is in every body, before the next one.
    """
    inside = attributes.pop("inside", "")
    content = tip
    for index in reversed(range(len(axes))):
        inertial = tip_inertial if index == len(axes) - 1 else LINK
        joints = hinge(f"{prefix}joint{index}", axes[index], joint) + inside
        name = f"{prefix}link{index}"
        content = link(joints, content, name, inertial=inertial, **attributes)
    return content


def serial_arm(
    axes=THREE_AXES,
    tip="",
    option="",
    extra="",
    joint='range="-2.5 2.5"',
    tip_inertial=TIP,
):
    """A whole model with one serial arm."""
    return world(serial_bodies(axes, tip, joint, "", tip_inertial), option, extra)


def fingers(joint='type="slide" axis="0 1 0" range="0 .04"'):
    """Two finger bodies beside each other."""
    content = ""
    for side, y in (("left", ".02"), ("right", "-.02")):
        content += (
            f'<body name="{side}_finger" pos="0 {y} .1"><joint name="{side}_finger_joint" {joint}/>'
            '<geom type="box" size=".01 .005 .03" mass=".03" contype="0" conaffinity="0"/></body>'
        )
    return content


SEVEN = serial_arm(SEVEN_AXES, joint='range="-2.5 2.5" frictionloss=".4" damping=".1"')
THREE = serial_arm()
SLIDE_IN_CHAIN = world(
    link(
        hinge("turn", Z),
        link(
            '<joint name="lift" type="slide" axis="0 .1 1" range="-.2 .4"/>',
            link(
                hinge("bend", Y),
                link(hinge("roll", X), "", "tip", inertial=TIP),
                "forearm",
            ),
            "carriage",
        ),
        "column",
    )
)
SHARED_BODIES = world(
    link(
        hinge("yaw", Z, 'range="-2 2" pos=".05 0 .02"')
        + hinge("pitch", Y, 'range="-1 1" pos="0 .03 .01"')
        + hinge("roll", X, 'range="-2 2" pos="0 0 -.04"'),
        link(
            '<joint name="reach" type="slide" axis="1 0 1" range="-.1 .1"/>'
            + hinge("spin", "1 1 0", 'range="-2 2" pos=".1 .2 -.1"'),
            "",
            "tip",
            quat="1 .3 -.2 .5",
            inertial=TIP,
        ),
        "shoulder",
    )
)
UNLIMITED = serial_arm(joint="")
NAMELESS = world(
    link(hinge("", Z), link(hinge("", Y), link(hinge("", X), inertial=TIP)))
)
COUPLED_FINGERS = serial_arm(
    (Z, Y, Z, Y, X, Z),
    tip=fingers(),
    extra='<tendon><fixed name="grip"><joint joint="left_finger_joint" coef=".5"/>'
    '<joint joint="right_finger_joint" coef=".5"/></fixed></tendon>'
    '<equality><joint joint1="left_finger_joint" joint2="right_finger_joint"/></equality>'
    '<actuator><general tendon="grip"/></actuator>',
)
TWO_ARMS = world(
    "".join(
        f'<body name="{side}base" pos="0 {y} 0">{serial_bodies((Z, Y, Z, Y), prefix=side)}</body>'
        for side, y in (("left_", ".3"), ("right_", "-.3"))
    )
)
FREE_OBJECT_BESIDE = world(
    '<body name="cup" pos="1 0 .1"><freejoint/><geom size=".03" mass=".2"/></body>'
    + serial_bodies((Z, Y, X))
    + '<body name="door" pos="0 1 0"><joint name="door_hinge" axis="0 0 1"/>'
    '<geom type="box" size=".3 .01 .5" mass="4"/></body>'
)
MASSLESS_TIP = serial_arm(
    (Z, Y, X, Z),
    tip='<body name="flange" pos="0 0 .05" quat="1 0 .4 0"><geom size=".02" mass=".1"/><body '
    'name="tool" pos=".02 0 .1" quat="1 .2 0 0"><geom type="box" size=".02 .03 .05" mass=".6"/>'
    "</body></body>",
    tip_inertial="",
)
TILTED_GRAVITY = serial_arm(option='gravity="3 -4 8"')
NO_GRAVITY = THREE.replace("<option />", '<option><flag gravity="disable"/></option>')
IN_WATER = serial_arm(option='density="1000" viscosity=".1" wind="1 2 0"')
ARMATURE = serial_arm(joint='range="-2.5 2.5" armature=".3"')
DRY_FRICTION = serial_arm(joint='range="-2 2" frictionloss="1.5" damping="2"')
SPRINGS = serial_arm(joint='range="-2 2" stiffness="30" springref=".7" damping=".5"')
TENDON_SPRING = serial_arm(
    extra='<tendon><fixed stiffness="25" springlength=".2" damping="3"><joint joint="joint1" '
    'coef="1"/><joint joint="joint2" coef="-.5"/></fixed></tendon>'
)
SHARED_MOTOR = serial_arm(
    extra='<tendon><fixed armature=".03" damping=".4" frictionloss="1.5"><joint joint="joint1" '
    'coef="1"/><joint joint="joint2" coef="-2"/></fixed></tendon>'
)
EQUALITY_ON_CHAIN = serial_arm(
    extra='<equality><joint joint1="joint1" polycoef=".3 0 0 0 0"/></equality>'
)
HOME_KEYFRAME = serial_arm(
    (Z, Y, X, Z),
    tip=fingers(),
    extra='<keyframe><key name="other" qpos="0 0 0 0 0 0"/>'
    '<key name="home" qpos=".1 .2 .3 .4 .03 .01"/></keyframe>',
)
NONLINEAR_DAMPING = serial_arm(joint='range="-2 2" damping=".5 .3 .2"')

MODELS = {
    "seven": SEVEN,
    "three": THREE,
    "slide in chain": SLIDE_IN_CHAIN,
    "shared bodies": SHARED_BODIES,
    "unlimited": UNLIMITED,
    "nameless": NAMELESS,
    "coupled fingers": COUPLED_FINGERS,
    "free object beside": FREE_OBJECT_BESIDE,
    "massless tip": MASSLESS_TIP,
    "tilted gravity": TILTED_GRAVITY,
    "no gravity": NO_GRAVITY,
    "gravity compensated": THREE.replace("<body ", '<body gravcomp="1" '),
    "in water": IN_WATER,
    "armature": ARMATURE,
    "dry friction": DRY_FRICTION,
    "springs": SPRINGS,
    "tendon spring": TENDON_SPRING,
    "equality on chain": EQUALITY_ON_CHAIN,
    "limits violated": serial_arm(joint='range=".5 .6"'),
    "home keyframe": HOME_KEYFRAME,
    "discrete inverse": THREE.replace(
        "<option />",
        '<option integrator="implicitfast"><flag invdiscrete="enable"/></option>',
    ),
}
# Attributes that came with later releases of MuJoCo; older ones refuse these models.
NEWER_MODELS = {
    "nonlinear damping": NONLINEAR_DAMPING,
    "nonlinear spring": serial_arm(
        joint='range="-2 2" stiffness="5 2 1" springref=".3"'
    ),
    "tendon armature": TENDON_SPRING.replace("<fixed ", '<fixed armature=".2" '),
    "shared motor": SHARED_MOTOR,
    "actuator armature": serial_arm(
        extra='<actuator><motor joint="joint2" armature=".05" damping=".4"/></actuator>'
    ),
}


def compile_xml(xml):
    """The compiled MuJoCo model of an XML string."""
    return mujoco.MjModel.from_xml_string(xml)


def robot_of(xml, joint=None, max_velocity=2.0, keyframe=None):
    """RobotModel of an XML string or a compiled model."""
    mj_model = compile_xml(xml) if isinstance(xml, str) else xml
    return load_robot_model(mj_model, None, joint, max_velocity, keyframe)


def composite_theta(mj_model, qpos, body_id):
    """Parameters (10,) of a body and all below it together, in its frame, at ``qpos``."""
    return sum_theta(subtree_bodies(mj_model, qpos, body_id))


def with_link(robot, theta):
    """The model with theta (10,) as its terminal body, and the composite theta (10,)."""
    model = copy.copy(robot.mj_model)
    write_body(model, robot.body_id, theta)
    return model, composite_theta(model, robot.reference_qpos, robot.body_id)


def random_motion(rng, joints, samples, speed=2.0):
    """(q, qd, qdd), each (samples, joints), without any relation between them."""
    q, qd, qdd = rng.normal(size=(3, samples, joints))
    return q, speed * qd, speed**2 * qdd


def seeded_motion(seed, n_joints, n_samples=20):
    """A motion whose q, qd and qdd (n_samples, n_joints) are independent random numbers."""
    columns = random_motion(np.random.default_rng(seed), n_joints, n_samples)
    return Motion(np.arange(float(n_samples)), *columns)


def rows_and_rest(robot, motion):
    """Rows (N, n, 10) of the terminal link and the torque (N, n) of the rest of the arm."""
    arm = LastLinkTerms(robot, friction=())
    q, qd, qdd = motion
    still = Recording(np.arange(len(q)), q, qd, np.zeros_like(q), qdd)
    rows = Rows(exact_recording(still), slice(None))
    equations, _ = arm.equations(rows, arm.start())
    # The right-hand side of a torque of zero is the torque that is known; friction is added to it.
    return equations[:, :, :-1], -equations[:, :, -1] - robot.friction.torque(qd)


def random_rotation(rng):
    """(3, 3) rotation matrix."""
    return Rotation.from_quat(np.roll(rng.normal(size=4), -1)).as_matrix()


def random_theta(rng, mass=1.0, size=0.1, spread=1.0):
    """theta of a random rigid body of this mass [kg] and size [m], anywhere near its origin.

    A small ``spread`` flattens it.
    """
    factor = rng.normal(size=(4, 4))
    pseudo = factor @ factor.T + 0.02 * np.eye(4)
    scale = np.diag([spread * size, size, size, 1.0])
    pseudo = scale @ pseudo @ scale
    return spatial.theta_from_pseudo_inertia(mass / pseudo[3, 3] * pseudo)


SEEDS = st.integers(0, 2**32 - 1)


@st.composite
def rigid_bodies(draw):
    """theta of a body that can exist: of 1 g to 50 kg, thin as a needle or round, near or far."""
    rng = np.random.default_rng(draw(SEEDS))
    mass = draw(st.floats(-3.0, 1.7).map(lambda exponent: 10.0**exponent))
    gyration = [draw(st.floats(-4.0, -0.5).map(lambda e: 10.0**e)) for _ in range(3)]
    distance = draw(st.sampled_from([0.0, 1e-3, 0.1, 1.0]))
    rotation = random_rotation(rng)
    second = mass * rotation @ np.diag(np.square(gyration)) @ rotation.T
    inertia = np.trace(second) * np.eye(3) - second
    return spatial.theta_from_com(mass, distance * rng.normal(size=3), inertia)


def vector_text(values):
    """Return numbers as the text of an attribute, with all digits."""
    return " ".join(f"{value:.17g}" for value in values)


def _random_axis(rng, axis_law):
    if axis_law == "parallel":
        return np.array([0.0, 0.0, 1.0])
    if axis_law == "nearly parallel":
        return np.array([0.0, 0.0, 1.0]) + 1e-6 * rng.normal(size=3)
    if axis_law == "aligned":
        return np.eye(3)[rng.integers(3)]
    return rng.normal(size=3)


def _random_joint(rng, axis_law, slide):
    axis = vector_text(_random_axis(rng, axis_law))
    origin = vector_text(0.2 * rng.normal(size=3) * rng.integers(0, 2))
    return (
        f'<joint type="{"slide" if slide else "hinge"}" axis="{axis}" pos="{origin}"/>'
    )


def _random_inertial(rng):
    theta = random_theta(rng, rng.uniform(0.1, 5.0))
    mass, com, inertia = spatial.com_from_theta(theta)
    full = vector_text(spatial.fullinertia_from_symmetric(inertia))
    return (
        f'<inertial pos="{vector_text(com)}" mass="{mass:.17g}" fullinertia="{full}"/>'
    )


@st.composite
def random_chain(draw, axes=("any", "any", "parallel", "nearly parallel")):
    """XML of a serial arm: any axes, hinges and slides, several joints per body, any gravity."""
    rng = np.random.default_rng(draw(SEEDS))
    axis_law = draw(st.sampled_from(axes))
    bodies = draw(
        st.lists(
            st.lists(st.booleans(), min_size=1, max_size=3), min_size=1, max_size=5
        )
    )
    tips = ["", fingers(), f"<body>{_random_inertial(rng)}</body>"]
    content = draw(st.sampled_from(tips))
    for slides in reversed(bodies):
        pos = vector_text(0.3 * rng.normal(size=3))
        quat = vector_text(rng.normal(size=4))
        joints = [_random_joint(rng, axis_law, slide) for slide in slides]
        inertial = _random_inertial(rng)
        content = link("".join(joints), content, "", pos, quat, inertial)
    gravities = [np.zeros(3), np.array([0, 0, -9.81]), 9.81 * rng.normal(size=3)]
    gravity = draw(st.sampled_from(gravities))
    return world(content, f'gravity="{vector_text(gravity)}"')
