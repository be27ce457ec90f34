"""The first table of docs/evidence.md: what one command makes of every public arm.

Run from the checkout, a few minutes on one core; nothing is fetched, the logs lie in a folder of
yours. ``--write`` puts the table into the page:

    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.public_arms FOLDER [--write]

Every command is run as it is printed, in a folder with the same names. "Before -> after" are its
own errors, on data that did not make the file. Elsewhere, MuJoCo's inverse dynamics judges the
file alone on another log; where there is none, on the last fifth of the motion, with a file that
the same options make of the first four fifths.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy.real_logs import file_error
from rigs.files.command_line import COMMANDS
from rigs.files.page_tables import PageTable
from rigs.files.places import ROOT
from robot_sysid.api.calls import identify, payload, read_log
from robot_sysid.cli import main as run_command
from robot_sysid.records import Recording
from robot_sysid.records.file_access import curved_file_in
from robot_sysid.signals.process import low_pass_recordings

TABLE = PageTable(
    ROOT / "docs" / "evidence.md", "arms", "python -m benchmarks.accuracy.public_arms"
)
OUT = Path("sysid_output")
LOGS = ("measurements", "empty", "loaded", "validation_measurements")
"""Values of a command that are logs."""
READING = ("columns", "gravity")
"""Options that the command ``log`` takes as well."""


@dataclass(frozen=True)
class PublicArm:
    """A row of the table.

    Attributes:
        name: the arm, with the address of its logs.
        command: what is typed.
        published: what others print of it.
        judge: the log on which the file is judged elsewhere; "" for the last fifth of its own.
        motion: beginning and end of the log's motion [s].
        fitted: part of its own motion that makes the file that the remaining part judges.
        known: what is known to be wrong with its logs or its model; "" for nothing.
    """

    name: str
    command: str
    published: str
    judge: str = ""
    motion: tuple[float, float] = (0.0, np.inf)
    fitted: float = 0.8
    known: str = ""


@dataclass(frozen=True)
class PublicLog:
    """A log of a public arm, and the words by which commands read it.

    Attributes:
        files: of the log; its positions and its torques, where these are apart.
        model: the arm's model.
        options: how they are read.
        known: what is known to be wrong with it or its model; "" for nothing.
    """

    files: tuple[Path, ...]
    model: Path
    options: tuple[str, ...]
    known: str


UR10E = "ur10e_payload/ur10e.urdf"
UR10E_EMPTY = "ur10e_payload/empty_100Hz.csv"
UR10E_MOTION = (1.1, 25.3)
OLD_LINKS = "masses and centres of mass of an old table"
AIRBOT = "published/airbot"
EMPTY = f"{AIRBOT}/q_chirp_empty.csv {AIRBOT}/tau_chirp_empty.csv"
LOADED = f"{AIRBOT}/q_chirp_loaded.csv {AIRBOT}/tau_chirp_loaded.csv"
ARMS = (
    PublicArm(
        "KUKA LWR4+, [FloBaRoID](https://github.com/kjyv/FloBaRoID)",
        "robot-sysid identify kuka_lwr4/kuka_lwr4.urdf kuka_lwr4/lwr4_hw1_200Hz.csv "
        "--validation-measurements kuka_lwr4/lwr4_hw3_200Hz.csv",
        "3.3 to 4.1 % of a fit",
        "kuka_lwr4/lwr4_hw2_200Hz.csv",
    ),
    PublicArm(
        "Stäubli TX40, [FIGAROH's examples](https://github.com/thanhndv212/figaroh-examples)",
        "robot-sysid identify tx40/tx40.urdf tx40/tx40_500Hz.csv",
        "5.2 % of a fit",
        motion=(0.0, 7.66),
    ),
    PublicArm(
        "UR10e, [dynamic_calibration](https://github.com/shamilmamedov/dynamic_calibration)",
        f"robot-sysid identify {UR10E} {UR10E_EMPTY}",
        "not published",
        motion=UR10E_MOTION,
        known=OLD_LINKS,
    ),
    PublicArm(
        "the same with a block of 2.805 kg",
        f"robot-sysid payload {UR10E} --empty {UR10E_EMPTY} "
        "--loaded ur10e_payload/loaded_2p805kg_100Hz.csv",
        "not published",
        motion=UR10E_MOTION,
        known=OLD_LINKS,
    ),
    PublicArm(
        "TIAGo, [FIGAROH's examples](https://github.com/thanhndv212/figaroh-examples)",
        "robot-sysid identify tiago/tiago.urdf tiago/tiago_100Hz.csv",
        "not published",
        known="efforts without a unit",
    ),
    PublicArm(
        "AIRBOT Play, [figaroh_kinova](https://github.com/liuyurong129/figaroh_kinova)",
        f"robot-sysid identify {AIRBOT}/airbot.urdf {EMPTY} --columns 'rate = 100'",
        "not published",
        fitted=0.7,
    ),
    PublicArm(
        "the same with 0.48 kg",
        f"robot-sysid payload {AIRBOT}/airbot.urdf --empty {EMPTY} --loaded {LOADED} "
        "--columns 'rate = 100'",
        "not published",
        fitted=0.7,
    ),
    PublicArm(
        "ROKAE AR5, "
        "[Dynamics_identification_Frank](https://github.com/FrankJIE09/Dynamics_identification_Frank)",
        "robot-sysid identify published/ar5/ar5.urdf published/ar5/real.csv --gravity 1 0 0",
        "0.63 N·m on the last fifth",
        fitted=0.7,
    ),
    PublicArm(
        "Damiao AM-D02, one joint driven, [Friction-Identification-for-Manipulators]"
        "(https://github.com/YIZHIXIAOCANGSHU/Friction-Identification-for-Manipulators)",
        "robot-sysid identify published/damiao_am_d02/am_d02.urdf "
        "published/damiao_am_d02/real_friction_identification_joint_6.npz",
        "Coulomb friction 0.168 N·m, which explains 22 % of the variance",
        known="short and coarse",
    ),
)


def public_logs() -> Iterator[PublicLog]:
    """Yield every log of the rows, each once."""
    seen = set()
    for arm in ARMS:
        name, *words = shlex.split(arm.command)[1:]
        values = COMMANDS[name].parse(words)[0]
        sets = [values.get(key) for key in LOGS]
        sets += [[Path(arm.judge)]] if arm.judge else []
        options: list[str] = []
        for key in READING:
            if key in values:
                options += [f"--{key}", *words_of_value(values[key])]
        for files in map(tuple, filter(None, sets)):
            if files not in seen:
                seen.add(files)
                yield PublicLog(files, values["path"], tuple(options), arm.known)


def words_of_value(value: str | Sequence[float]) -> list[str]:
    """Return the words of an option's value on a command line."""
    return [value] if isinstance(value, str) else [f"{x:g}" for x in value]


def run_silently(command: str) -> tuple[int, str]:
    """Run a command in the working folder; return its exit code and what is refused."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = run_command(shlex.split(command)[1:])
    error = output.getvalue().rpartition("error: ")[2].partition(": ")[2]
    return code, re.split("[:;(]|, and", error)[0].strip()


def percents(before: float, after: float) -> str:
    """Return a pair of fractions in per cent."""
    return f"{100.0 * before:.3g} -> {100.0 * after:.3g} %"


def own_errors() -> str:
    """Return the errors that the run states, on data that did not make the file."""
    content = json.loads((OUT / "params.json").read_text(encoding="utf-8"))
    # Of the file that is named first.
    file = content["file"]["curved"] or content["file"]
    tests = [*file["others"], file][0]
    shares = [tests[name]["relative_error"] for name in ("before", "after")]
    text = percents(*shares)
    if content["payload"] is not None:
        rows = {(row["of"], row["name"]): row for row in content["quantities"]}
        mass = rows["payload", "mass"]
        text += f"; payload {mass['value']:.3f} ± {mass['error']:.3f} kg"
    return text


def cut(recording, begin: float, end: float) -> dict:
    """Return the samples of a recording between two times [s]."""
    use = (recording.time >= begin) & (recording.time < end)
    return {
        "time": recording.time[use],
        "q": recording.q[use],
        "tau": recording.tau[use],
    }


def elsewhere(arm: PublicArm) -> str:
    """Return the errors of the model and of a written file on a log that did not make it."""
    program, name, *words = shlex.split(arm.command)
    values = COMMANDS[name].parse(words)[0]
    model = values.pop("path")
    logs = values.pop("loaded", None) or values.pop("measurements")
    reading = {"columns": values.pop("columns")} if "columns" in values else {}
    with tempfile.TemporaryDirectory() as folder:
        if arm.judge:
            result = identify(model, logs[0])
            test = read_log(arm.judge, result.robot)
        else:
            log = read_log(logs, model, **reading)
            begin, end = arm.motion
            end = min(end, log.time[-1])
            middle = begin + arm.fitted * (end - begin)
            first = cut(log, begin, middle)
            if name == "payload":
                empty = read_log(values["empty"], model, **reading)
                result = payload(model, cut(empty, 0.0, np.inf), first)
            else:
                result = identify(model, first, **values)
            last = cut(log, middle, end)
            test = Recording(last["time"], last["q"], None, last["tau"])
        models = [p for p in result.save(folder) if p.suffix in (".xml", ".urdf")]
        file = curved_file_in(models) or models[0]
        signals = low_pass_recordings(result.robot, [test], result.cutoff)[0][0]
        shares = [
            file_error(judged, result.robot, signals)
            for judged in (copy(result.robot.mj_model), file)
        ]
    return percents(*shares)


def row(arm: PublicArm) -> str:
    """Return an arm's row of the table."""
    code, error = run_silently(arm.command)
    if code != 0:
        return f"| {arm.name} | refused ({code}): {error} | | {arm.published} |"
    return f"| {arm.name} | {own_errors()} | {elsewhere(arm)} | {arm.published} |"


def link_folder(root: Path) -> None:
    """Show the contents of a folder in the working one."""
    for path in root.iterdir():
        Path(path.name).symlink_to(path)


def table(root: Path) -> list[str]:
    """Return the lines of the table, and the commands below it."""
    lines = [
        "| Arm and source of its logs | Before -> after | Elsewhere | Published |",
        "| --- | --- | --- | --- |",
    ]
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        link_folder(root)
        for arm in ARMS:
            lines.append(row(arm))
            print(lines[-1], file=sys.stderr)
    return [*lines, "", "```text", *[arm.command for arm in ARMS], "```"]


def main(folder: str, *options: str) -> None:
    """Print the table; write it where that is asked for."""
    TABLE.show(table(Path(folder).resolve()), "--write" in options)


if __name__ == "__main__":
    main(*sys.argv[1:])
