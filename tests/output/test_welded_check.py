"""A model with one body more passes; whatever else is new in it is named."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.changes import WeldedBody
from robot_sysid.mjcf.inertial import mjcf_inertial
from robot_sysid.output.welded_check import require_one_more_body
from tests.support.model_files import ARM, random_theta

THETA = random_theta(np.random.default_rng(0), 0.7)
BODY = WeldedBody("load", "tool", np.eye(3), np.array([0.0, 0.1, 0.2]), THETA)
NEW = f'<body name="load" pos="0 0.1 0.2">{mjcf_inertial(THETA, principal=True)}</body>'
# Bodies, sites and contacts after the new body: their numbers move on by one.
FULL = ARM.replace("</worldbody>", "<body name='cup'><geom name='g' size='.1'/></body></worldbody>")
FULL = FULL.replace(
    "</mujoco>",
    "<contact><exclude body1='finger' body2='cup'/></contact><sensor><framepos objtype='body' "
    "objname='cup'/></sensor><equality><weld body1='cup' body2='base'/></equality></mujoco>",
)
PLACE = '<inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/>'


def model(new=NEW, before="", after=""):
    text = FULL.replace(PLACE, PLACE + new)
    assert before in text
    return mujoco.MjModel.from_xml_string(text.replace(before, after, 1) if before else text)


def test_one_more_body_is_all_that_is_new():
    require_one_more_body(model(""), model(), BODY)


@pytest.mark.parametrize(
    ("before", "after", "field"),
    [
        ('mass="1.5"', 'mass="1.6"', "body_mass"),
        ('mass="0.1"', 'mass="0.11"', "body_mass"),
        ('pos="0 0.05 0.1"', 'pos="0 0.06 0.1"', "body_pos"),
        ("size='.1'", "size='.1' friction='2'", "geom_friction"),
        ('name="j2" axis', 'name="j2" damping="1" axis', "dof_damping"),
        ("<geom name='g'", "<site/><geom name='g'", "nsite"),
        ("objname='cup'", "objname='base'", "sensor_objid"),
        ("body1='cup' body2='base'", "body1='cup' body2='tool'", "eq_"),
        ('name="grip" type="slide"', 'name="grip" type="hinge"', "jnt_type"),
    ],
)
def test_everything_else_that_is_new_is_named(before, after, field):
    with pytest.raises(ExportError, match=f"new body 'load' changes {field}"):
        require_one_more_body(model(""), model(before=before, after=after), BODY)


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("", "no body 'load'"),
        (NEW.replace('name="load"', 'name="other"'), "no body 'load'"),
        (NEW + '<body name="second"/>', "no body 'load'"),
        (NEW.replace("0.1 0.2", "0.1 0.2001"), "not fixed to 'tool' where it should be"),
        (NEW.replace('pos="0 0.1 0.2"', 'pos="0 0.1 0.2" quat="1 1e-5 0 0"'), "not fixed to"),
        (NEW.replace(str(THETA[0]), str(THETA[0] + 1e-8)), "an inertia that is off"),
    ],
)
def test_a_body_that_is_not_the_wanted_one_is_refused(new, words):
    with pytest.raises(ExportError, match=words):
        require_one_more_body(model(""), model(new), BODY)


def test_a_body_below_another_one_or_with_a_joint_is_refused():
    moved = model("", before='<joint name="grip"', after=f'{NEW}<joint name="grip"')
    with pytest.raises(ExportError, match="not fixed to 'tool'"):
        require_one_more_body(model(""), moved, BODY)
    with pytest.raises(ExportError, match="new body 'load' changes"):
        require_one_more_body(model(""), model(NEW.replace("<inertial", "<joint/><inertial")), BODY)
