"""Recordings of real arms, read into ``Recording`` records; here the options of reading them.

The options are apart from ``logs.reader``, so that a run without logs need not import that module.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional

from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.option_fields import (
    Columns,
    Factors,
    OptionRecord,
    ValueKind,
    check_factor,
    option,
)
from robot_sysid.records.servo_setting import FORM, ServoSetting, parse_servo_setting


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
        "divide torques by this: a number, one per joint, or a file; 1.7+-16% may be so far off, "
        "at all joints together",
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
        choices=tuple(map(str, FaultName)),
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
        "another log, which only tests the result; its positions and torques may be two files",
        "LOG",
        repeats=True,
        takes_many=True,
    )
    servo_setting: tuple[ServoSetting, ...] = option(
        (),
        f"with {{torque_from}}: what servos were recorded with, such as '{FORM}'; once for all "
        "logs, or once for each in their order; may be repeated",
        "SETTING",
        parse=parse_servo_setting,
        kind=ValueKind(
            parse_servo_setting,
            (ServoSetting,),
            f"a text such as '{FORM}'",
            "str | ServoSetting",
        ),
        repeats=True,
        default_text="what the file says",
    )
