"""Two arms of one model on a bus each, played at once on simulated motors, in simulated time."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from robot_sysid.damiao.bus import GuardedLink, SimulatedClock, inspect_bus
from robot_sysid.damiao.execution import run as play_plan
from robot_sysid.damiao.model_check import gravity_check
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import Permissions, Plan, PlaySettings
from robot_sysid.damiao.simulated import SimulatedArm, SimulatedLink, simulated_motor
from robot_sysid.damiao.trajectory import (
    export_damiao_trajectory,
    join_arms,
    read_damiao_trajectory,
)
from robot_sysid.errors import SysidError
from robot_sysid.motion.limit_check import as_one
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulator import ArmTorque
from tests.support.fault_bench import ARMS, PHYSICS_STEP, multi_sine

ELBOW = 3
BENT = 0.6
"""Where both elbows stand in a pose that is symmetric [rad]."""


@dataclass
class PairRun:
    """What came of a run.

    Attributes:
        words: of the error that ended it; "" where it was played to the end.
        phases: when each phase began [s], and its name.
    """

    words: str = ""
    phases: list = field(default_factory=list)


def play_openarms(
    folder: Path, cables_are_exchanged: bool, duration: float = 5.0
) -> PairRun:
    """Play both OpenArms, each with its own motion, from a pose in which they mirror each other."""
    arm = ARMS["openarm"]
    sides = ("left", "right")
    arms = [
        load_robot_model(arm.truth, joint=f"openarm_{side}_joint7") for side in sides
    ]
    pair = as_one(*arms)
    n_joints = arms[0].n_joints
    pose = np.where(np.arange(pair.n_joints) % n_joints == ELBOW, BENT, 0.0)
    time, q, qd, qdd = multi_sine(pose, 3, duration)
    tau = ArmTorque(pair)(Motion(time, q, qd, qdd))
    files = []
    for bus, side in enumerate(sides):
        of_arm = slice(bus * n_joints, (bus + 1) * n_joints)
        rows = (time, q[:, of_arm], qd[:, of_arm], tau[:, of_arm])
        path = folder / f"{side}.csv"
        export_damiao_trajectory([rows], arm.motor_types, path)
        file = read_damiao_trajectory(path)
        named = zip(file.joints, arms[bus].joint_names)
        joints = [
            replace(j, bus=bus, channel=f"can{bus}", name=name) for j, name in named
        ]
        files.append(replace(file, joints=tuple(joints)))
    plan = Plan(
        join_arms(*files),
        PlaySettings(rate=250.0),
        BusTiming(),
        Permissions(directions=True),
    )
    joints = plan.trajectory.joints
    stepper = ArmStepper(pair, plan.trajectory.q[0], PHYSICS_STEP)
    cabled = [replace(j, bus=1 - j.bus) if cables_are_exchanged else j for j in joints]
    clock = SimulatedClock()
    wire = SimulatedLink(
        clock,
        SimulatedArm(stepper, [simulated_motor(j) for j in cabled]),
        BusTiming(),
        echo=True,
    )
    link = GuardedLink(wire, clock, False, ("can0", "can1"))
    record = PairRun()
    try:
        play_plan(
            link, plan, inspect_bus(link), StopRequest(),
            lambda phase: record.phases.append((clock.now(), phase)), lambda time: None,
            gravity_check(pair, joints, False),
        )  # fmt: skip
    except SysidError as error:
        record.words = str(error)
    return record
