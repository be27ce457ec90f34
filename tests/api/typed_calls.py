"""Calls as people write them, and below them mistakes that a type checker has to find.

mypy checks it with the package, pyright where it is installed. Both tell where a comment of a
mistake is not needed, so a mistake that they miss is an error, too.
"""

# pyright: reportUnnecessaryTypeIgnoreComment=true

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional

import numpy as np
from numpy.typing import NDArray

import robot_sysid as rs


def call_rightly(model: Path, arrays: dict[str, NDArray[np.float64]]) -> None:
    """Call each function with options of each kind."""
    result: rs.Result = rs.identify(model, "log.csv", keep="gravity")
    mass: float = result.mass
    failure: Optional[str] = result.failure
    inertia: NDArray[np.float64] = result.inertia
    row: Optional[rs.Quantity] = result.quantity("mass", "link6")
    print(mass, failure, inertia, row)
    rs.identify(
        "arm.xml",
        ["a.csv", "b.csv"],
        validation_measurements=arrays,
        keep=["gravity", "links"],
        priors={"link": 10.0, "scale": [1.0, 2.0]},
        mass_scale="1.69+-16%",
        torque_scale=np.array([1.0, 1.2]),
        accept=("zero",),
        gravity=(0.0, 0.0, -9.81),
        cards="drake",
        joint=None,
    )
    rs.payload(model, arrays, [arrays], order="ABBA", priors=rs.Priors(link=3.0))
    plan: rs.PlanResult = rs.plan(
        model,
        for_="payload",
        max_velocity=[1.0, 2.0],
        keep_out=[(0.0, 0.0, 1.0, -0.5)],
        motor_type=["DM4340"],
        seed=1,
    )
    plan.save("plan.json")
    rs.plan(model, max_velocity=1, keep_out=(0.0, 0.0, 1.0, -0.5), motor_type="DM4340")
    rs.self_test(model, plant_model="truth.xml", noise_torque=0.1)
    changed: bool = rs.check(model, arrays, since="found", same_day=True).has_changed
    log: rs.Recording = rs.read_log("log.csv", model, units="deg,ms", episode=[0, 1])
    arm: rs.RobotModel = rs.load_robot_model(model, joint="joint6")
    Y, tau = rs.joint_torque_regressor(model, log.q, log.q, log.q, keyframe="home")
    report: rs.PlayReport = rs.motors.play(
        plan, simulate=True, kp=[30.0], record="measured.csv", say=print
    )
    print(changed, arm.n_joints, Y, tau, report)


def call_wrongly(model: Path, log: dict[str, Any]) -> None:
    """Make a mistake of each kind at each function."""
    rs.identify(model, log, kep="gravity")  # type: ignore[call-arg]
    rs.identify(model, log, output_dir="found")  # type: ignore[call-arg]
    rs.identify(model, log, keep="gravitation")  # type: ignore[arg-type]
    rs.identify(model, log, units=5)  # type: ignore[arg-type]
    rs.identify(model, log, fix_base="yes")  # type: ignore[arg-type]
    rs.identify(model, log, torque_scale={"joint1": 1.3})  # type: ignore[arg-type]
    rs.identify(model)  # type: ignore[call-arg]
    rs.payload(model, log, log, known_weight=1.0)  # type: ignore[call-arg]
    rs.payload(model, log, log, known_mass="1 kg")  # type: ignore[arg-type]
    rs.plan(model, max_speed=1.0)  # type: ignore[call-arg]
    rs.plan(model, duration="long")  # type: ignore[arg-type]
    rs.self_test(model, plan_model="truth.xml")  # type: ignore[call-arg]
    rs.check(model, log, unit="deg")  # type: ignore[call-arg]
    rs.read_log(log, model, colums="a.toml")  # type: ignore[call-arg]
    rs.load_robot_model(model, joints="joint6")  # type: ignore[call-arg]
    rs.joint_torque_regressor(model, 0, 0, 0, key="home")  # type: ignore[call-arg]
    rs.motors.play("plan.csv", sped=0.3)  # type: ignore[call-arg]
    rs.motors.play("plan.csv", park="away")  # type: ignore[arg-type]
    verdict: int = rs.check(model, log).verdict  # type: ignore[assignment]
    print(verdict)
    print(rs.identify(model, log).masses)  # type: ignore[attr-defined]
