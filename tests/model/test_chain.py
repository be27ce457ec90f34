"""Which joint is the arm's last one: recognised, named, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rigs.arms import small_arms
from rigs.arms.small_arms import (
    TIP,
    X,
    Y,
    Z,
    compile_xml,
    fingers,
    hinge,
    link,
    robot_of,
    serial_arm,
    serial_bodies,
    world,
)
from rigs.files.refusals import refused
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.errors import AmbiguousJointError, ModelError
from robot_sysid.model import chain as module
from robot_sysid.parser import load_robot_model


def terminal_of(xml):
    model = compile_xml(xml)
    return module.joint_label(model, module.find_terminal_joint(model))


def candidates(xml):
    with pytest.raises(AmbiguousJointError) as caught:
        module.find_terminal_joint(compile_xml(xml))
    return [joint for joint, _ in caught.value.candidates]


def refusal(xml):
    with refused(error_class=ModelError) as caught:
        model = compile_xml(xml)
        module.chain_to(model, module.find_terminal_joint(model))
    return str(caught.value)


def long_finger(side, y):
    """A finger of three joints."""
    axes = (X, Y, Y)
    inner = serial_bodies(axes, prefix=f"{side}_finger_")
    return f'<body name="{side}_palm" pos="0 {y} 0">{inner}</body>'


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("seven", "joint6"),
        ("slide in chain", "roll"),
        ("shared bodies", "spin"),
        ("nameless", "#2"),
        ("coupled fingers", "joint5"),
        ("free object beside", "joint2"),
        ("massless tip", "joint3"),
    ],
)
def test_the_last_joint_before_the_tree_branches_is_found(name, expected):
    assert terminal_of(small_arms.MODELS[name]) == expected


HAND = long_finger("left", 0.1) + long_finger("right", -0.1)
HEAD = f"<body>{serial_bodies((Z, Y), prefix='head_')}</body>"
WHEELS = "".join(
    f'<body pos="0 {y} 0">{hinge(f"wheel{y}", Y)}<geom size=".1" mass="1"/></body>'
    for y in (0.3, -0.3)
)


@pytest.mark.parametrize(
    ("xml", "expected"),
    [
        (serial_arm((Z,), tip=fingers('axis="1 0 0"')), "joint0"),
        (serial_arm(tip=HAND), "joint2"),
        (
            world(
                link(hinge("waist", Z), HEAD + serial_bodies((Z, Y, Z, Y, X)), "torso")
            ),
            "joint4",
        ),
        (world(WHEELS + serial_bodies((Z, Y, X, Z))), "joint3"),
        (serial_arm().replace('name="link2"', 'name="gripper_base_link"'), "joint2"),
    ],
)
def test_fingers_head_and_wheels_are_not_the_arm(xml, expected):
    assert terminal_of(xml) == expected


def test_two_arms_on_one_torso_are_doubt():
    both = "".join(
        f'<body name="{side}shoulder">{serial_bodies((Z, Y, X), prefix=side)}</body>'
        for side in ("left_", "right_")
    )
    xml = world(link(hinge("waist", Z), both, "torso"))
    assert candidates(xml) == ["left_joint2", "right_joint2"]


def jaw(joint, body, content=""):
    """A body that the joint of this name moves."""
    return f'<body name="{body}">{hinge(joint, X)}<geom size=".02"/>{content}</body>'


@pytest.mark.parametrize(
    "tip",
    [
        jaw("Jaw", "end"),
        jaw("m6", "moving_jaw"),
        jaw("knuckle", "a", jaw("fingertip", "b")),
        jaw("gripper", "hand", fingers('axis="1 0 0"')),
    ],
)
def test_a_jaw_in_line_with_the_arm_is_not_its_last_joint(tip):
    assert terminal_of(serial_arm((Z, Y, X, Z), tip=tip)) == "joint3"


def test_a_joint_that_may_turn_the_whole_gripper_is_doubt():
    tip = jaw("gripper_roll", "hand")
    assert candidates(serial_arm((Z, Y, X, Z), tip=tip)) == ["joint3", "gripper_roll"]


def test_jaws_decide_between_a_hand_and_the_arm_but_not_between_two_arms():
    hands = HAND.replace("left_palm", "palm").replace("right_palm", "palm2")
    assert terminal_of(serial_arm((Z, Y), tip=hands)) == "joint1"
    both = ""
    for side in ("left_", "right_"):
        arm = serial_bodies((Z, Y, X), prefix=side)
        gripper = jaw(f"{side}gripper", f"{side}hand")
        both += f"<body>{arm.replace('</body>', f'{gripper}</body>', 1)}</body>"
    assert candidates(world(both)) == ["left_joint2", "right_joint2"]


def test_a_hand_alone_is_still_doubt():
    assert candidates(world(HAND)) == ["left_finger_joint2", "right_finger_joint2"]


def motors(*joints):
    return f'<actuator>{"".join(f"""<motor joint="{name}"/>""" for name in joints)}</actuator>'


def test_a_last_joint_without_a_motor_behind_joints_with_motors_is_doubt():
    xml = serial_arm((Z, Y, X, Y), extra=motors("joint0", "joint1", "joint2"))
    assert candidates(xml) == ["joint2", "joint3"]


@pytest.mark.parametrize(
    "drive",
    [
        '<tendon><fixed name="t"><joint joint="joint3" coef="1"/></fixed></tendon>'
        '<actuator><motor joint="joint0"/><motor tendon="t"/></actuator>',
        motors("joint3"),
    ],
)
def test_a_last_joint_driven_by_tendon_coupling_or_motor_is_no_doubt(drive):
    assert terminal_of(serial_arm((Z, Y, X, Y), extra=drive)) == "joint3"


BALL = '<joint name="socket" type="ball"/>'


@pytest.mark.parametrize("behind", [0, 1, 2])
def test_a_ball_joint_behind_the_longest_run_is_refused_too(behind):
    hand = serial_bodies((X, Y)[:behind], prefix="hand_") if behind else ""
    xml = serial_arm((Z, Y), tip=link(BALL, hand, "wrist"))
    assert "ball joint socket" in refusal(xml)
    assert "--joint joint1" in refusal(xml)


def test_a_ball_joint_behind_the_joint_asked_for_is_held():
    model = compile_xml(serial_arm((Z, Y), tip=link(BALL, "", "wrist")))
    assert module.chain_to(model, module.resolve_joint(model, "joint1")) == (0, 1)


def test_a_floating_base_is_refused():
    floating = world(link('<freejoint name="root"/>', serial_bodies((Z, Y, X)), "base"))
    assert "free joint root" in refusal(floating)


def test_a_joint_that_is_not_the_last_of_its_body_is_refused_and_the_last_named():
    with refused("choose roll", ModelError):
        module.resolve_joint(compile_xml(small_arms.SHARED_BODIES), "yaw")


PLANE = (("slide", X), ("slide", Y), ("hinge", Z))


def on_base(base_joints, attributes="", axes=(Z, Y, X, Y)):
    joints = "".join(
        f'<joint name="base{i}" type="{joint_type}" axis="{axis}" {attributes}/>'
        for i, (joint_type, axis) in enumerate(base_joints)
    )
    inertial = '<inertial pos="0 0 .1" mass="20" diaginertia="1 1 1"/>'
    return world(f'<body name="base">{inertial}{joints}{serial_bodies(axes)}</body>')


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 0, 1)])
def test_a_mobile_base_is_held_and_named(order):
    robot = robot_of(on_base([PLANE[i] for i in order]))
    assert robot.joint_names == ("joint0", "joint1", "joint2", "joint3")
    assert any("joint0: base0, base1, base2" in note for note in robot.notes)


@pytest.mark.parametrize(
    ("joints", "attributes", "axes"),
    [
        (PLANE, 'range="-1 1"', (Z, Y, X, Y)),  # a gantry: its travel ends somewhere
        (PLANE, "", (Z, Y)),  # too little of an arm remains
        ((("slide", X), ("slide", Y), ("slide", Z)), "", (Z, Y, X, Y)),
        (PLANE[:2], "", (Z, Y, X, Y)),
    ],
)
def test_other_joints_at_the_root_belong_to_the_arm(joints, attributes, axes):
    robot = robot_of(on_base(joints, attributes, axes))
    assert robot.n_joints == len(joints) + len(axes)
    assert not any("mobile base" in note for note in robot.notes)


ALL = (0, 1, 2)
UNSTATED = (None, None, None)


def speed_limits(joint, max_velocity):
    model = compile_xml(serial_arm(joint=joint))
    return module.joint_limits(model, ALL, max_velocity, UNSTATED).velocity


@pytest.mark.parametrize(
    ("max_velocity", "slide"), [(2.0, module.DEFAULT_SLIDE_VELOCITY), (0.1, 0.1)]
)
def test_slides_have_a_speed_of_their_own_but_never_more_than_asked(
    max_velocity, slide
):
    slides = speed_limits('type="slide" range="-1 1"', max_velocity)
    assert_array_equal(slides, [slide] * 3)
    assert_array_equal(speed_limits("", max_velocity), [max_velocity] * 3)


def on_free_base(axes=(Z, Y, X)):
    inertial = '<inertial pos="0 0 .1" mass="20" diaginertia="1 1 1"/>'
    return compile_xml(
        world(
            f'<body name="base" pos="0 0 1">{inertial}<freejoint name="root"/>'
            f"{serial_bodies(axes)}</body>"
        )
    )


def test_a_free_base_is_refused_with_the_option_that_welds_it():
    with refused("free joint root carries the arm.*--fix-base", ModelError) as caught:
        robot_of(on_free_base())
    assert caught.value.options == (("--fix-base",),)


def test_a_welded_base_stands_where_the_model_has_it():
    model = on_free_base()
    robot = load_robot_model(model, fix_base=True)
    assert robot.joint_names == ("joint0", "joint1", "joint2")
    assert any(note.endswith("joint0: root") for note in robot.notes)
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 4, 3))
    fixed = load_robot_model(compile_xml(world(serial_bodies((Z, Y, X)))))
    expected = LinkDynamics(fixed).motion(q, qd, qdd).torque(fixed.thetas)
    torque = LinkDynamics(robot).motion(q, qd, qdd).torque(robot.thetas)
    assert torque == pytest.approx(expected)


def test_joints_before_the_first_one_are_held():
    model = compile_xml(world(serial_bodies((Z, Y, X, Y, Z))))
    robot = load_robot_model(model, first_joint="joint2")
    assert robot.joint_names == ("joint2", "joint3", "joint4")
    with refused("joint9: no such joint; the model has: joint0", ModelError):
        load_robot_model(model, first_joint="joint9")
    with refused("joint3: it does not carry joint joint2; these do", ModelError):
        load_robot_model(model, first_joint="joint3", joint="joint2")


@pytest.mark.parametrize(("mass", "is_base"), [(1e-6, True), (5.0, False)])
def test_a_base_whose_slides_move_nothing_is_no_gantry(mass, is_base):
    """Its travel may end somewhere."""
    dummy = f'<inertial pos="0 0 0" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/>'
    content = serial_bodies((Z, Y, X, Y))
    for number, (kind, axis) in reversed([*enumerate(PLANE)]):
        inertial = dummy if kind == "slide" else TIP
        content = (
            f'<body>{inertial}<joint name="base{number}" type="{kind}" axis="{axis}" '
            f'range="-1 1"/>{content}</body>'
        )
    robot = load_robot_model(compile_xml(world(content)))
    assert robot.n_joints == (4 if is_base else 7)


@pytest.mark.parametrize(
    ("beside", "is_play"),
    [
        (hinge("play", Z, 'range="-.009 .009"'), True),
        (hinge("play", Y, 'range="-.009 .009"'), False),
        (hinge("play", Z), False),
        (hinge("play", Z, ""), False),
        ("", False),
    ],
    ids=["play", "another axis", "a wide range", "no range", "none"],
)
@pytest.mark.parametrize("motors", [1, 2])
def test_joints_that_are_the_play_of_others_are_told(beside, is_play, motors):
    """One with a motor of its own is none, however little it may turn."""
    names = ["turn", "play"][: motors if beside else 1]
    actuators = "".join(f'<motor joint="{name}"/>' for name in names)
    extra = f"<actuator>{actuators}</actuator>"
    model = compile_xml(world(link(hinge("turn", Z) + beside), extra=extra))
    if is_play and motors == 1:
        with refused(
            "play: the model has a joint for the play of its gears", ModelError
        ):
            module.refuse_play(model)
    else:
        module.refuse_play(model)
