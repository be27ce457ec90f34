"""A model that was identified and written, moved by MuJoCo, is identified as itself."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.identify.arm.fit import BASIC, fit_arm
from robot_sysid.identify.arm.result import estimate_of, structural_base
from robot_sysid.logs.reader import write_measurement_csv
from robot_sysid.parser import load_robot_model
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import process
from tests.support import arms
from tests.support.measured_logs import JOINT, log_of, plan_of

MODELS = {"upright": (arms.Z, arms.Y, arms.X), "planar": (arms.Y, arms.Y, arms.Z)}


@pytest.mark.slow
@pytest.mark.parametrize("axes", MODELS.values(), ids=MODELS)
def test_a_written_model_is_identified_as_itself_from_its_own_motion(command, arm_file, axes):
    path = arm_file(arms.serial_arm(axes, joint=JOINT))
    plant = load_robot_model(path)
    write_measurement_csv(
        path.parent / "log.csv", plant.joint_names, [log_of(plant, noise_torque=0.02)]
    )
    guess = path.parent / "guess.xml"
    loose = JOINT.replace(".3", ".1").replace(".2", ".05").replace('armature=".05"', "")
    guess.write_text(arms.serial_arm(axes, joint=loose))
    words = ("--cutoff", "8", "--friction-model", BASIC, "--model-weight", "1")
    command.run("arm", guess, "log.csv", *words)
    folder = path.parent / "sysid_output"
    assert json.loads((folder / "arm.json").read_text())["status"] == "OK"
    written = load_robot_model(folder / "updated_model.xml")
    log = log_of(written, plan_of(written, seed=3), simulation="forward")
    signals = [process(log, written.joint_names, 8.0)]
    options = ArmOptions(cutoff=8.0, friction=BASIC, model_weight=1.0)
    estimate = estimate_of(written, fit_arm(load_robot_model(guess), signals, options, Progress()))
    for index, joint in enumerate(written.joint_names):
        found = [estimate.value(f"{term}[{joint}]") for term in ("coulomb", "viscous")]
        own = written.friction.coulomb[index], written.friction.viscous[index]
        assert found == pytest.approx(own, rel=0.05, abs=0.01)
    base = structural_base(written).matrix
    own = np.array([link.theta for link in written.links]).ravel()
    scale = np.abs(base) @ np.abs(own)
    assert base @ estimate.thetas.ravel() == pytest.approx(base @ own, abs=0.01 * np.max(scale))
