"""Which logs are read: apart from the reader, which a run without logs does not wait for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from robot_sysid.records.options import OptionRecord, option
from robot_sysid.records.torque_scale import Factors, factors_in, usable_factor


@dataclass(frozen=True)
class LogOptions(OptionRecord):
    """Which logs of the real arm, and what their columns are."""

    NEEDS: ClassVar[str] = "log"
    measurements: tuple[Path, ...] = option(
        (),
        "identify from this log of the real arm; may be repeated",
        metavar="LOG.csv",
        repeats=True,
        needs="estimate",
    )
    append: Path | None = option(None, "also use the logs of an earlier run", metavar="PARAMS.json")
    columns: Path | None = option(
        None, "file that says which column is what", metavar="FILE", usual="recognised"
    )
    units: str | None = option(
        None, "units of the log, such as deg or deg,ms", metavar="UNITS", usual="SI"
    )
    torque_scale: Factors | None = option(
        None,
        "divide torques by this: a number, one per joint, or a file",
        metavar="SCALE",
        parse=factors_in,
        check=usable_factor,
    )
    torque_constants: Factors | None = option(
        None,
        "the log holds motor currents: torque at the joint per ampere, gear included; a number, "
        "one per joint, or a file",
        unit="N·m/A",
        metavar="K",
        parse=factors_in,
        check=usable_factor,
    )
    topic: str | None = option(
        None, "topic of a ROS bag, where several fit", metavar="TOPIC", usual="found"
    )
    episode: tuple[int, ...] = option(
        (),
        "episode of a LeRobot data set; may be repeated",
        metavar="N",
        repeats=True,
        usual="all",
    )
    validation_measurements: Path | None = option(
        None, "another log that only tests the result", metavar="LOG.csv"
    )
