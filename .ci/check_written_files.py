"""Do files that the newest MuJoCo has written load in the oldest one, with equal torques?

    check_written_files.py write FOLDER   identify arms from simulated logs
    check_written_files.py load FOLDER    load the files, in an environment of another MuJoCo

A given model that the other MuJoCo does not load is passed over.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
MODELS = (
    ROOT / "examples" / "kinova" / "model" / "kinova_fullinertia_guess.xml",
    ROOT.parent / "shared" / "models" / "franka_fr3" / "FrankaFR3_7DoF.urdf",
    ROOT.parent / "shared" / "models" / "universal_robots_ur5e" / "ur5e.xml",
)
TOLERANCE = 1e-5
"""Releases before 3.14 find the axes of a full inertia matrix to six digits."""


def write(folder: Path) -> None:
    """Identify every arm from a log in which rotors and a motor of two joints show."""
    sys.path.insert(0, str(ROOT))
    from rigs.arms import small_arms
    from rigs.arms.walk import TrueArm
    from robot_sysid.cli import main
    from robot_sysid.parser import load_robot_model

    small = folder / "small.xml"
    small.write_text(
        small_arms.serial_arm((small_arms.Z, small_arms.Y, small_arms.X, small_arms.Y))
    )
    for model in (small, *filter(Path.exists, MODELS)):
        robot = load_robot_model(model)
        arm = TrueArm(robot)
        output = folder / model.stem
        log = output / "log.csv"
        arm.record(log, arm.first_plan, 0.0)
        add_rotors(log, arm.first_plan, robot.n_joints)
        command = ["identify", str(model), str(log)]
        assert main([*command, "--output-dir", str(output)]) == 0, model
        files = sorted(output.glob("updated_model.*"))
        assert files, model
        torques = {path.name: torque(path).tolist() for path in files}
        content = {"model": str(model), "torques": torques}
        (output / "expected.json").write_text(json.dumps(content))


def add_rotors(log: Path, plan, n_joints: int) -> None:
    """Add rotor inertia and a motor of the last two joints to the torques of a log."""
    header = log.read_text().partition("\n")[0]
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    motion = plan.evaluate(rows[:, 0])
    tau = rows[:, -n_joints:]
    spread = np.std(tau, axis=0)
    tau += 0.2 * spread / np.std(motion.qdd, axis=0) * motion.qdd
    speed = np.sum(motion.qd[:, -2:], axis=1, keepdims=True)
    acceleration = np.sum(motion.qdd[:, -2:], axis=1, keepdims=True)
    acceleration /= np.std(acceleration)
    tau[:, -2:] += 0.5 * np.max(spread[-2:]) * (np.sign(speed) + speed + acceleration)
    np.savetxt(log, rows, "%.9g", ",", header=header, comments="")


def torque(path: Path) -> np.ndarray:
    """Return torques (20, nv) that a model takes at random states, without contacts."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    torques = np.empty((20, model.nv))
    for row in torques:
        data.qpos[:] = model.qpos0 + rng.uniform(-0.5, 0.5, model.nq)
        data.qvel[:], data.qacc[:] = rng.uniform(-1.0, 1.0, (2, model.nv))
        mujoco.mj_inverse(model, data)
        row[:] = data.qfrc_inverse
    friction = [model.dof_damping, model.dof_frictionloss, model.dof_armature]
    friction.append(np.resize(model.tendon_frictionloss, model.nv))
    return np.vstack((torques, friction))


def load(folder: Path) -> None:
    """Compare the torques of every file with those where it was written."""
    for expected in sorted(folder.glob("*/expected.json")):
        content = json.loads(expected.read_text())
        try:
            mujoco.MjModel.from_xml_path(content["model"])
        except ValueError as error:
            reason = str(error).partition("\n")[0]
            sys.stdout.write(f"{content['model']}: passed over, {reason}\n")
            continue
        for name, torques in content["torques"].items():
            difference = np.abs(torque(expected.parent / name) - torques)
            share = float(np.max(difference) / np.max(np.abs(torques)))
            sys.stdout.write(f"{expected.parent.name}/{name}: {share:.1e}\n")
            assert share < TOLERANCE, (expected.parent, name, share)


if __name__ == "__main__":
    task, place = sys.argv[1:]
    {"write": write, "load": load}[task](Path(place).absolute())
