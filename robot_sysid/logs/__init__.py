"""Recordings of real arms, read into ``Recording`` records; here the options of reading them.

The options are apart from ``logs.reader``, so that a run without logs need not import that module.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from robot_sysid.records.option_fields import (
    Columns,
    Factors,
    OptionRecord,
    check_factor,
    option,
)

CHECKS = {
    "torque-scale": "torque in another unit, on the motor's side of the gear, or scaled",
    "torque-unit": "torque that is not in N·m, each joint's by another factor",
    "gravity": "torque without gravity, or external torque only",
    "computed": "torque that was computed, not measured",
    "sign": "sign of a position or torque",
    "order": "columns of joints exchanged",
    "angle-unit": "degrees for radians or the other way round",
    "zero": "zero of a joint's position",
    "model": "model of another arm, or with another tool",
    "tilt": "base tilted against the model's",
    "clock": "clock that jumps or drifts, a wrong time base, or samples lost or repeated",
    "delay": "torque delayed against position",
    "saturated": "torque sensor at its end",
    "held": "torque that stands still while the arm moves",
    "contact": "contact, a collision or a moving gripper",
    "force": "constant force, a spring, a hose, or a hand that carries a part",
    "payload-step": "payload that changes within the log",
    "coupling": "one motor that turns with two joints",
    "crosstalk": "torque that holds a part of its neighbour's",
    "friction": "friction that changes as gears warm up, or grows with the load",
    "unexplained": "torque that nothing explains",
    "too-little": "too few independent samples",
    "rollout": "new model that does not move more like the arm than the old one",
}
"""Name of every check of a log, as ``--accept`` takes it, to the fault that it looks for."""


@dataclass(frozen=True)
class LogOptions(OptionRecord):
    """How logs of the real arm are read: what their columns are, and in which units.

    ``commanded`` is no option of a command: whether commanded positions are read in place of
    torques, as the identification of servos needs them.
    """

    columns: Optional[Columns] = option(
        None,
        "which column is what: a line such as 'position = A*', or a file of such lines",
        "COLUMNS",
        default_text="recognised",
    )
    units: Optional[str] = option(
        None,
        "units of the log, such as deg,ms, mm or 4096/rev",
        "UNITS",
        default_text="SI",
    )
    torque_scale: Optional[Factors] = option(
        None,
        "divide torques by this: a number, one per joint, or a file",
        "SCALE",
        check=check_factor,
    )
    torque_constants: Optional[Factors] = option(
        None,
        "the log holds motor currents: torque at the joint per ampere, gear included; a number, "
        "one per joint, or a file",
        "K [N·m/A]",
        check=check_factor,
    )
    topic: Optional[str] = option(
        None, "topic of a ROS bag, where several fit", "TOPIC", default_text="found"
    )
    episode: tuple[int, ...] = option(
        (),
        "episode of a LeRobot data set; may be repeated",
        "N",
        repeats=True,
        default_text="all",
    )
    accept: tuple[str, ...] = option(
        (),
        "go on in spite of the doubts of this check; may be repeated",
        "CHECK",
        choices=tuple(CHECKS),
        repeats=True,
    )
    commanded: bool = False


@dataclass(frozen=True)
class FittedLogOptions(LogOptions):
    """Which logs an arm is identified from (``measurements``), and which one only tests that."""

    measurements: tuple[Path, ...] = option(
        (),
        "recording of the real arm; its positions and torques may be two files",
        "LOG",
        flag="measurements",
        takes_many=True,
    )
    validation_measurements: tuple[Path, ...] = option(
        (),
        "another log, which only tests the result; may be repeated, as for a pair of files",
        "LOG",
        repeats=True,
    )
