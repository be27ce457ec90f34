"""``robot-sysid arm MODEL LOG...`` is ``identify --links`` by another name, and says so."""

from __future__ import annotations

from robot_sysid.logs.reader import write_measurement_csv
from tests.support import arms
from tests.support.command_line import files_in
from tests.support.measured_logs import JOINT, log_of, true_arm

QUICK = ("--cutoff", "8", "--friction-model", "coulomb-viscous-offset-armature")


def test_it_does_what_identify_does(command, arm_file, tmp_path):
    plant = true_arm()
    write_measurement_csv(
        tmp_path / "log.csv", plant.joint_names, [log_of(plant, noise_torque=0.05)]
    )
    path = arm_file(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT))
    plain = command.run("identify", path, "log.csv", "--links", *QUICK)
    files = files_in(tmp_path)
    same = command.run("arm", path, "log.csv", *QUICK)
    assert same.out == plain.out and "link1 mass  " in same.out
    assert same.err == f"note: arm is identify --links now; both do the same\n{plain.err}"
    assert files_in(tmp_path) == files
    assert "robot-sysid arm --help-all" in command.refused("arm", path)
