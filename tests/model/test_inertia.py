"""Inertia of bodies and of what hangs on them, against MuJoCo's own dynamics."""

from __future__ import annotations

import mujoco

from robot_sysid.model.inertia import subtree_bodies
from tests.support.model_files import ARM

MODEL = mujoco.MjModel.from_xml_string(ARM)


def test_what_is_fixed_to_a_finger_is_not_welded_to_the_link():
    """Whatever lies behind a joint moves against the link, however it is fastened there."""
    inertial = '<inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>'
    pad = f'<body name="pad">{inertial}<body name="screw">{inertial}</body></body>'
    finger = '<body name="finger" pos="0 0.05 0.1">'
    model = mujoco.MjModel.from_xml_string(ARM.replace(finger, finger + pad))
    bodies = subtree_bodies(model, model.qpos0, model.body("link2").id)
    welded = {b.name: b.welded for b in bodies}
    assert welded == {"link2": True, "tool": True, "finger": False, "pad": False, "screw": False}
