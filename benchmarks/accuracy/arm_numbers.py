"""The tables of docs/gallery.md: friction, rotors and torque offsets of public arms.

Run from the checkout, two minutes on one core; nothing is fetched, the logs lie in a folder of
yours. ``--write`` puts the tables into the page:

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.arm_numbers FOLDER [--write]

Every command is run as it is printed, in a folder with the same names. Numbers are those of the
written model (straight friction, which everything reads); offsets, which no model file holds, those
of the fit. The table at the end has the same arms from other logs.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.public_arms import (
    AIRBOT,
    EMPTY,
    LOADED,
    OUT,
    UR10E,
    UR10E_EMPTY,
    link_folder,
    run_silently,
)
from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from robot_sysid.dynamics.friction import (
    COULOMB,
    OFFSET,
    ROTOR,
    TOP_OVER_FASTEST,
    VISCOUS,
)
from robot_sysid.records.levels import SURE
from robot_sysid.records.messages import percent, with_error
from robot_sysid.records.quantities import BOUND, CURVED, FILE

TABLE = PageTable(
    ROOT / "docs" / "gallery.md", "gallery", "python -m benchmarks.accuracy.arm_numbers"
)
KUKA = "kuka_lwr4/kuka_lwr4.urdf"
KUKA_LOG = "kuka_lwr4/lwr4_hw{}_200Hz.csv"
UR10E_LOADED = "ur10e_payload/loaded_2p805kg_100Hz.csv"
NO_LICENCE = "none stated"
OTHER_LOGS = "The same arm, another log"
"""Heading of the last table."""
Numbers = Mapping[tuple[str, str], Mapping[str, Any]]
"""(joint, name) to the row of a number."""
COLUMNS = (COULOMB.name, VISCOUS.name, ROTOR.name, OFFSET.name)
"""Names of the rows of a joint, in the order of the columns."""


@dataclass(frozen=True)
class Arm:
    """An arm of the page.

    Attributes:
        name: its maker and type.
        source: address of its logs.
        licence: of the repository that has the logs, as it says.
        torque: what the log's torque is.
        command: what is typed.
        other: the same on another log of this very arm; "" where there is none.
    """

    name: str
    source: str
    licence: str
    torque: str
    command: str
    other: str = ""


ARMS = (
    Arm(
        "KUKA LWR4+",
        "https://github.com/kjyv/FloBaRoID",
        "LGPL 3.0",
        "measured behind the gears: rotors and the friction of gears are not in it",
        f"robot-sysid identify {KUKA} {' '.join(map(KUKA_LOG.format, (1, 2, 3)))}",
    ),
    Arm(
        "Stäubli TX40",
        "https://github.com/thanhndv212/figaroh-examples",
        "Apache 2.0",
        "motor current times gear ratio and motor constant; its owners do not say when it was "
        "recorded, or whether on the arm",
        "robot-sysid identify tx40/tx40.urdf tx40/tx40_500Hz.csv",
    ),
    Arm(
        "Universal Robots UR10e",
        "https://github.com/shamilmamedov/dynamic_calibration",
        NO_LICENCE,
        "motor current times the controller's constants; by a known mass it reads 3 % too little "
        "at lift and elbow and 6 % too much at the wrist",
        f"robot-sysid identify {UR10E} {UR10E_EMPTY}",
        f"robot-sysid identify {UR10E} {UR10E_LOADED}",
    ),
    Arm(
        "AIRBOT Play",
        "https://github.com/liuyurong129/figaroh_kinova",
        NO_LICENCE,
        "as the arm reports it",
        f"robot-sysid identify {AIRBOT}/airbot.urdf {EMPTY} --columns 'rate = 100'",
        f"robot-sysid identify {AIRBOT}/airbot.urdf {LOADED} --columns 'rate = 100' "
        "--accept torque-scale",
    ),
    Arm(
        "ROKAE AR5",
        "https://github.com/FrankJIE09/Dynamics_identification_Frank",
        NO_LICENCE,
        "as the arm reports it",
        "robot-sysid identify published/ar5/ar5.urdf published/ar5/real.csv --gravity 1 0 0",
    ),
    Arm(
        "Damiao AM-D02, its sixth motor",
        "https://github.com/YIZHIXIAOCANGSHU/Friction-Identification-for-Manipulators",
        NO_LICENCE,
        "as the motor reports it",
        "robot-sysid identify published/damiao_am_d02/am_d02.urdf "
        "published/damiao_am_d02/real_friction_identification_joint_6.npz",
    ),
    Arm(
        "PAL TIAGo",
        "https://github.com/thanhndv212/figaroh-examples",
        "Apache 2.0",
        "efforts without a unit",
        "robot-sysid identify tiago/tiago.urdf tiago/tiago_100Hz.csv",
    ),
)


def content_of(command: str) -> tuple[dict[str, Any] | None, str]:
    """Run a command in the working folder; return its params.json, or None and what is refused."""
    code, error = run_silently(command)
    if code != 0:
        return None, error
    return json.loads((OUT / "params.json").read_text(encoding="utf-8")), ""


def numbers_of(content: Mapping[str, Any]) -> Numbers:
    """Return (joint, name) to the row of the number that the written model has.

    Its ± is the larger one of the fit and of the file: a fit's friction terms trade with one
    another, a file's allow for what its few terms miss. Where the file has no row, because it keeps
    the model's number or cannot hold any, it is the fit's.
    """
    found: dict[tuple[str, str], Mapping[str, Any]] = {}
    for row in content["quantities"]:
        key = (row["of"], row["name"])
        if row["name"] not in COLUMNS or row["source"] == CURVED:
            continue
        if row["source"] != FILE:
            found[key] = row
        elif row["name"] != ROTOR.name:
            errors = [e for e in (row["error"], found[key]["error"]) if e is not None]
            source = found[key]["source"] if row["value"] == 0.0 else FILE
            found[key] = {**row, "error": max(errors, default=None), "source": source}
    return found


def cell(row: Mapping[str, Any] | None) -> str:
    """Return a number with its ±; "0, bound" of one that would be negative."""
    if row is None:
        return ""
    if row["source"] == BOUND or row["error"] is None:
        return "0, bound"
    return with_error(row["value"], row["error"])


def joint_rows(content: Mapping[str, Any]) -> list[str]:
    """Return a row of the table for each joint, and for each motor that turns several."""
    numbers = numbers_of(content)
    lines = []
    for owner in dict.fromkeys(of for of, _ in numbers):
        top = content["friction_tops"].get(owner)
        speed = "" if top is None else f"{top / TOP_OVER_FASTEST:.2g}"
        cells = [cell(numbers.get((owner, name))) for name in COLUMNS]
        lines.append(f"| {owner} | {' | '.join(cells)} | {speed} |")
    return lines


def section(arm: Arm) -> list[str]:
    """Return the lines of an arm: source, command, and a table of its joints."""
    repository = arm.source.removeprefix("https://github.com/")
    lines = [
        f"### {arm.name}",
        "",
        f"Log: [{repository}]({arm.source}), licence: {arm.licence}. Torque: {arm.torque}.",
        "",
        "```text",
        arm.command,
        "```",
        "",
    ]
    content, error = content_of(arm.command)
    if content is None:
        return [*lines, f"No numbers: {error}.", ""]
    file = content["file"]
    before = file["before_as_used"]["relative_error"]
    after = file["after_as_used"]["relative_error"]
    lines.append(
        f"Torque error of the model as it came {percent(before)}, with these {percent(after)}."
    )
    bent = [curve["of"] for curve in content["curves"]]
    if bent:
        lines.append(
            f"Friction bends with speed ({', '.join(bent)}): the line is the nearest straight one."
        )
    lines += [
        "",
        "| Joint | Coulomb friction, N·m | viscous friction, N·m·s/rad | rotor inertia, kg·m² | "
        "torque offset, N·m | up to, rad/s |",
        "| --- | --- | --- | --- | --- | --- |",
        *joint_rows(content),
        "",
    ]
    return lines


def differences(first: Numbers, second: Numbers, name: str) -> list[float]:
    """Return by which share of itself each number of a name differs in another result.

    Numbers that are less than ``SURE`` of their errors from zero say nothing.
    """
    shares = []
    for key, row in first.items():
        error = row["error"]
        if key[1] != name or key not in second or not error:
            continue
        if row["value"] > SURE * error:
            shares.append(abs(second[key]["value"] / row["value"] - 1.0))
    return shares


def changes(arm: Arm) -> str:
    """Return the row of an arm in the table of other logs: by how much numbers differ."""
    results = []
    for command in (arm.command, arm.other):
        content, error = content_of(command)
        assert content is not None, error
        results.append(numbers_of(content))
    cells = [arm.name]
    for name in (COULOMB.name, VISCOUS.name, ROTOR.name):
        shares = differences(*results, name)
        text = "none"
        if shares:
            largest = percent(max(shares))
            text = f"{percent(float(np.median(shares)))}, {largest} ({len(shares)})"
        cells.append(text)
    return f"| {' | '.join(cells)} |"


def page_lines(root: Path) -> list[str]:
    """Return the lines of the page between its marks."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        link_folder(root)
        for arm in ARMS:
            lines += section(arm)
            print("\n".join(lines[-12:]), file=sys.stderr)
        lines += [
            f"### {OTHER_LOGS}",
            "",
            "| Arm | Coulomb friction | viscous friction | rotor inertia |",
            "| --- | --- | --- | --- |",
            *[changes(arm) for arm in ARMS if arm.other],
        ]
    return lines


def main(folder: str, *options: str) -> None:
    """Print the tables; write them where that is asked for."""
    TABLE.show(page_lines(Path(folder).resolve()), "--write" in options)


if __name__ == "__main__":
    main(*sys.argv[1:])
