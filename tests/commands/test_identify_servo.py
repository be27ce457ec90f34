"""``identify --torque-from position-error``: from commands and positions to the model."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest

from tests.support import schemas, servo_logs
from tests.support.arms import robot_of

MODE = ("--torque-from", "position-error")


@pytest.fixture(scope="module")
def recorded():
    """(time, positions, commands) of the true arm."""
    time, command = servo_logs.commanded()
    return time, servo_logs.positions(robot_of(servo_logs.XML), time, command), command


@pytest.fixture
def log(recorded, tmp_path):
    return servo_logs.write(tmp_path / "log.csv", *recorded)


@pytest.mark.slow
@pytest.mark.timeout(1800)  # 16 s of processor time on two threads; the machine may be busy
def test_servos_friction_and_rotor_inertia_are_found_and_written(command, arm_file, log):
    path = arm_file(servo_logs.XML)
    out = command.run("identify", path, log, *MODE).out
    folder = path.parent / "sysid_output"
    schemas.check(folder / "servo.json")
    content, truth = json.loads((folder / "servo.json").read_text()), servo_logs.TRUTH
    assert "none measured" in content["torque"] and "No torque was measured" in out
    assert content["delay"]["value"] == pytest.approx(truth.delay, abs=0.002)
    terms = {"gain": truth.stiffness, "damping": truth.damping}
    terms.update(frictionloss=truth.frictionloss, armature=truth.armature)
    first = [content["joints"]["joint0"][term]["value"] / terms[term][0] for term in terms]
    # Nothing but small links fix the size of what stands on a vertical axis; ratios are seen.
    assert max(first) < 1.2 * min(first) and "only their ratios" in " ".join(content["notes"])
    for term, values in terms.items():
        found = content["joints"]["joint1"][term]
        assert found["value"] == pytest.approx(values[1], rel=0.05)
        for k, joint in enumerate(("joint0", "joint1")):
            each = content["joints"][joint][term]
            assert abs(each["value"] - terms[term][k]) < 4.0 * each["standard_error"]
    errors = content["rollout"]["errors"]
    assert {error["loop"] for error in errors} == {"closed loop"}
    assert all(3.0 * e["overall"]["after"] < e["overall"]["before"] for e in errors)
    written = mujoco.MjModel.from_xml_path(str(folder / "updated_model.xml"))
    after = [content["joints"][joint]["gain"]["value"] for joint in ("joint0", "joint1")]
    np.testing.assert_allclose(written.actuator_gainprm[:, 0], after, rtol=1e-6)
    whole = written.dof_damping - written.actuator_biasprm[:, 2]
    np.testing.assert_allclose(whole[1], truth.damping[1], rtol=0.05)
    text = (folder / "updated_model.xml").read_text()
    assert text.count("<inertial") == servo_logs.XML.count("<inertial")


def test_what_cannot_be_used_is_said_in_one_line(command, arm_file, recorded, log, tmp_path):
    path, (time, q, asked) = arm_file(servo_logs.XML), recorded
    said = command.run("identify", path, log, code=2).err
    assert "torque" in said and "identify --torque-from position-error" in said
    still = servo_logs.write(tmp_path / "still.csv", time, 0.0 * q, asked)
    assert "at rest" in command.refused("identify", path, still, *MODE)
    one = servo_logs.write(tmp_path / "one.csv", time, q, asked)
    one.write_text(one.read_text().replace("action joint1.pos", "remark"))
    said = command.run("arm", path, one, *MODE, code=2).err
    assert "one command column for each" in said and "joint1" in said
