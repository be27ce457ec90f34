"""What the joints of the written model get."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robot_sysid.identify.arm.run import _joint_change
from robot_sysid.mjcf.documents import read_document
from robot_sysid.mjcf.joints import joint_edits
from robot_sysid.mjcf.markup import apply_edits
from robot_sysid.records.whole_arm import FrictionCurve, HeldFriction
from tests.support import arms

VALUES = {"coulomb": 0.5, "viscous": 0.01, "quadratic": 0.0, "cubic": 0.2, "armature": 0.1}
JOINT = 'range="-2 2" damping="0.3"'


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "dof_dampingpoly"), reason="MuJoCo before 3.7")
@pytest.mark.parametrize("kept", [(), ("viscous",)])
@pytest.mark.parametrize("joint", [JOINT, 'range="-2 2"'])
def test_nonlinear_damping_is_written_also_where_the_linear_one_stays(arm_file, kept, joint):
    path = arm_file(arms.serial_arm((arms.Z,), joint=joint))
    before = mujoco.MjModel.from_xml_path(str(path))
    errors = dict.fromkeys(VALUES, 0.001)
    held = HeldFriction(VALUES, errors, kept, {}, FrictionCurve(*[np.zeros(0)] * 6))
    change = _joint_change(before.joint(0).name, held, False, float(before.dof_damping[0]))
    document = read_document(path)
    edits = [edit for _, edit in joint_edits(document, change)]
    text = apply_edits(document.root.file.text, edits).decode()
    written = mujoco.MjModel.from_xml_string(text)
    assert written.dof_dampingpoly[0].tolist() == [0.0, 0.2]
    assert written.dof_damping[0] == (before.dof_damping[0] if kept else 0.01)


def test_a_wanted_offset_is_written_unless_friction_is_kept(arm_file):
    values = {"coulomb": 0.5, "viscous": 0.01, "armature": 0.1, "offset": -0.2}
    held = HeldFriction(
        values, dict.fromkeys(values, 0.001), (), {}, FrictionCurve(*[np.zeros(0)] * 6)
    )
    change = _joint_change("j", held, False, 0.0)
    assert change.offset == -0.2 and "offset -0.2 ± 0.001" in change.words
    assert _joint_change("j", held, True, 0.0).offset is None
