"""What joints may do, as models say it."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.model.limits import DEFAULT_SLIDE_VELOCITY, joint_limits
from tests.support.arms import X, Y, Z, compile_xml, serial_arm

ALL = (0, 1, 2)
UNSTATED = (None, None, None)


def limits_of(joint='range="-1 2"', actuators="", max_velocity=2.0, extra=""):
    drive = f"<actuator>{actuators}</actuator>" if actuators else ""
    model = compile_xml(serial_arm((Z, Y, X), joint=joint, extra=extra + drive))
    return joint_limits(model, ALL, max_velocity, UNSTATED)


def torque_of(actuators, joint="", extra=""):
    """Torque limit of joint1."""
    return limits_of(joint, actuators, extra=extra).torque[1]


def test_ranges_of_limited_joints_are_taken():
    limits = limits_of()
    np.testing.assert_array_equal(limits.lower, [-1.0] * 3)
    np.testing.assert_array_equal(limits.upper, [2.0] * 3)


def test_unlimited_joints_have_no_limits_although_their_range_says_zero():
    limits = limits_of("")
    assert np.all(limits.lower == -np.inf)
    assert np.all(limits.upper == np.inf)


def test_a_range_that_is_switched_off_is_no_limit():
    limits = limits_of('range="-1 2" limited="false"')
    assert np.all(limits.upper == np.inf)


def test_degrees_and_default_classes_arrive_in_radians():
    xml = serial_arm((Z, Y, X), joint="").replace('angle="radian"', 'angle="degree"')
    default = '<default><joint range="-90 180"/></default>'
    model = compile_xml(xml.replace("<worldbody>", default + "<worldbody>"))
    limits = joint_limits(model, ALL, 2.0, UNSTATED)
    np.testing.assert_allclose(limits.lower, [-np.pi / 2] * 3)
    np.testing.assert_allclose(limits.upper, [np.pi] * 3)


@pytest.mark.parametrize(("asked", "slide"), [(2.0, DEFAULT_SLIDE_VELOCITY), (0.1, 0.1)])
def test_slides_have_a_speed_of_their_own_but_never_more_than_asked(asked, slide):
    limits = limits_of('type="slide" range="-1 1"', max_velocity=asked)
    np.testing.assert_array_equal(limits.velocity, [slide] * 3)
    np.testing.assert_array_equal(limits_of(max_velocity=asked).velocity, [asked] * 3)


@pytest.mark.parametrize(
    ("actuators", "expected"),
    [
        ("", np.inf),
        ('<motor joint="joint1"/>', np.inf),
        ('<motor joint="joint1" forcerange="-30 30"/>', 30.0),
        ('<motor joint="joint1" forcerange="-30 20"/>', 20.0),
        ('<motor joint="joint1" forcerange="-30 30" gear="2"/>', 60.0),
        ('<motor joint="joint1" forcerange="-30 30" gear="-2"/>', 60.0),
        ('<motor joint="joint1" forcerange="-30 30" forcelimited="false"/>', np.inf),
        ('<motor joint="joint1" ctrlrange="-5 5"/>', 5.0),
        ('<motor joint="joint1" ctrlrange="-1 1" gear="25"/>', 25.0),
        ('<general joint="joint1" ctrlrange="-1 1" gainprm="12"/>', 12.0),
        ('<motor jointinparent="joint1" forcerange="-7 7"/>', 7.0),
        ('<position joint="joint1" kp="100" ctrlrange="-3 3"/>', np.inf),
        ('<position joint="joint1" kp="100" ctrlrange="-3 3" forcerange="-87 87"/>', 87.0),
        ('<velocity joint="joint1" kv="10" ctrlrange="-1 1"/>', np.inf),
        ('<motor joint="joint0" forcerange="-30 30"/>', np.inf),
        ('<motor joint="joint1" forcerange="-3 3"/><motor joint="joint1" forcerange="-4 4"/>', 7.0),
        ('<motor joint="joint1" forcerange="-3 3"/><motor joint="joint1"/>', np.inf),
    ],
)
def test_torque_limit_is_what_the_actuators_can_give(actuators, expected):
    assert torque_of(actuators) == expected


def test_limit_of_the_joint_itself_counts_where_it_is_tighter():
    own = 'actuatorfrcrange="-10 10"'
    assert torque_of('<motor joint="joint1" forcerange="-30 30"/>', own) == 10.0
    assert torque_of('<motor joint="joint1" forcerange="-3 3"/>', own) == 3.0
    assert torque_of("", own) == 10.0


def test_an_actuator_on_a_tendon_does_not_limit_a_joint():
    tendon = '<tendon><fixed name="t"><joint joint="joint1" coef="1"/></fixed></tendon>'
    assert torque_of('<motor tendon="t" forcerange="-1 1"/>', extra=tendon) == np.inf
