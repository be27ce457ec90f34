"""What right logs are accused of: motions as people record them, of arms as they are.

    python -m benchmarks.trust.right_logs MODELS_FOLDER [--arms ur5e ...] [--motions sines ...]
        [--arms-each 3] [--seeds 2] [--deviations real exact] [--answers 2]
        [--rows FILE] [--public LOGS_FOLDER] [--write]

Each log is of another arm, drawn as in ``benchmarks.trust.real_arms``, and is looked at by the
command ``log``. Beside the motions of this module, there are the right logs under odd conditions of
``benchmarks.trust.confusion_mistakes``. Every motion is played by all arms, or by so many as
``--arms-each`` says, taken in turn. Printed are the logs of which something is said, and per motion
how many are refused, doubted, or noted; at the end a table of each reading's false alarms, which
``--write`` puts into docs/evidence.md. With ``--public``, the logs of real arms of
``benchmarks.accuracy.public_arms`` have a table of their own, in a minute with ``--seeds 0``. Every
``--answers``-th log is given to ``identify`` as well: how many are Usable, and how many of the
numbers lie within 1.96 of their stated errors. What is said of a log becomes a line of FILE; logs
that are in it are not made again.
The whole table of the page, an hour on one core:

    OMP_NUM_THREADS=1 python -m benchmarks.trust.right_logs MODELS_FOLDER --deviations real
        --arms-each 3 --seeds 2 --first-seed 100 --answers 2 --public LOGS_FOLDER --write
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import cycle, islice, product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy.public_arms import PublicLog, public_logs
from benchmarks.trust.answers import (
    bare_model_text,
    identify_logs,
    model_text,
    run_command,
    write_log,
)
from benchmarks.trust.confusion_causes import draw_scene
from benchmarks.trust.confusion_mistakes import RIGHT_LOGS
from benchmarks.trust.real_arms import SENSOR_ARMS, arms_parser, errors_of
from rigs.arms.motions import (
    Move,
    on_limit,
    one_at_a_time,
    pick_and_place,
    planned,
    sines,
    slow,
)
from rigs.arms.wrong_arms import ARMS, RATE, Truth, draw_arm
from rigs.files.page_tables import PageTable
from rigs.files.params import rows
from rigs.files.places import ROOT
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording

MORE_ARMS = {
    "wxai": "trossen/wxai/wxai_follower.xml",
    "panda_hand": "franka_panda/panda.xml",
    "so101": "so101/so101_new_calib.xml",
    "gen3_2023": "kinova_gen3/gen3_7dof_2023.xml",
}
ALL_ARMS = {**ARMS, **MORE_ARMS}
MOTIONS: dict[str, tuple[Move, float, float]] = {
    "one_tone": (lambda p, r: sines(1, p, r), 20.0, 0.04),
    "two_tones": (lambda p, r: sines(2, p, r), 20.0, 0.04),
    "planned": (planned, 20.0, 0.04),
    "slow": (slow, 20.0, 0.04),
    "short": (planned, 6.0, 0.04),
    "pick_and_place": (pick_and_place, 20.0, 0.04),
    "one_at_a_time": (one_at_a_time, 30.0, 0.04),
    "high_friction": (planned, 20.0, 0.25),
    "on_limit": (on_limit, 20.0, 0.04),
    "30_hz": (planned, 20.0, 0.04),
}
"""Motion to its function, its duration [s] and the share of friction in the torque."""
PAGE = ROOT / "docs" / "evidence.md"
TABLE = PageTable(PAGE, "right_logs", "python -m benchmarks.trust.right_logs")
REAL_TABLE = PageTable(
    PAGE,
    "right_logs_of_real_arms",
    "python -m benchmarks.trust.right_logs MODELS_FOLDER --seeds 0 --public LOGS_FOLDER",
)
LEVELS = {"says": "a note", "doubts": "a doubt", "refuses": "a refusal"}
"""Level of a finding to what the page calls it."""
Row = dict[str, Any]
"""What is said of a log, and what is answered to it, as a line of the file of rows has it."""
LOG_DURATION = 20.0
"""Duration of a log under odd conditions that has none of its own [s]."""


def right_log(
    path: Path, arm_name: str, motion: str, deviation: str, seed: int
) -> tuple[Truth, str]:
    """Return a right log, and the text of the model that it is looked at with."""
    if motion in RIGHT_LOGS:
        cause = RIGHT_LOGS[motion]
        duration = cause.duration or LOG_DURATION
        scene = cause.spoil(draw_scene(path, arm_name, deviation, duration, seed))
        text = bare_model_text(path)
        return scene, text if scene.edit is None else model_text(path, scene.edit)
    move, duration, friction = MOTIONS[motion]
    robot = load_robot_model(path)
    has_sensors = arm_name in SENSOR_ARMS
    truth = draw_arm(
        robot, deviation, has_sensors, duration, seed % 2 == 0, seed, move, friction
    )
    if motion == "30_hz":
        step = round(RATE / 30.0)
        log = truth.log
        log = Recording(log.time[::step], log.q[::step], None, log.tau[::step])
        truth = replace(truth, log=log)
    return truth, bare_model_text(path)


def findings_of(
    logs: Sequence[Path], model: Path, options: Sequence[str] = ()
) -> list[dict[str, str]]:
    """Return what the command ``log`` says of the files of a log."""
    code, output, messages = run_command("log", *logs, model, *options, "--json")
    if output.startswith("{"):
        return list(json.loads(output)["findings"])
    return [{"level": "refuses", "about": f"error {code}", "text": messages}]


@dataclass(frozen=True)
class Case:
    """A right log: its motion or condition, its arm, and the seed of both."""

    motion: str
    arm_name: str
    deviation: str
    seed: int

    def look(self, models: Path, is_answered: bool) -> Row:
        """Return what is said of the log, and what ``identify`` answers where that is asked for."""
        path = models / ALL_ARMS[self.arm_name]
        truth, text = right_log(
            path, self.arm_name, self.motion, self.deviation, self.seed
        )
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            log = folder / "log.csv"
            model = folder / "model.xml"
            model.write_text(text)
            write_log(log, truth.robot.joint_names, truth.log)
            row = {"case": asdict(self), "findings": findings_of([log], model)}
            if is_answered:
                row["answer"] = answer_of(truth, identify_logs(folder, model, [log])[0])
        return row


def answer_of(truth: Truth, content: dict[str, Any] | None) -> Row:
    """Return whether an answer, the content of params.json, is Usable, and its numbers' errors over
    their stated ones; None and none where the log is refused.
    """
    if content is None:
        return {"usable": None, "offs": []}
    offs = [
        off / stated
        for _, off, stated, _ in errors_of(truth, rows(content), content["curves"])
        if np.isfinite(stated) and stated > 0.0
    ]
    return {"usable": content["valid"]["trustworthy"], "offs": offs}


def answers_line(found: Sequence[Row]) -> str:
    """Return in words what ``identify`` answers to those logs that were given to it."""
    answers = [row["answer"] for row in found if "answer" in row]
    usable = Counter(each["usable"] for each in answers)
    offs = np.array([off for each in answers for off in each["offs"]])
    within = 100.0 * np.mean(np.abs(offs) < 1.96) if len(offs) else np.nan
    return (
        f"{len(answers)} logs: refused {usable[None]}, Usable {usable[True]}; {within:.1f} % of "
        f"{len(offs)} numbers within 1.96 stated errors"
    )


def alarm_lines(found: Sequence[Row]) -> Iterator[str]:
    """Yield the lines of the table of false alarms: of how many logs a reading says what."""
    counts = Counter(
        pair
        for row in found
        for pair in {(each["about"], each["level"]) for each in row["findings"]}
    )
    silent = sum(not row["findings"] for row in found)
    yield f"| Said of {len(found)} right logs | {' | '.join(LEVELS.values())} |"
    yield "| --- | --- | --- | --- |"
    for about in sorted({about for about, _ in counts}):
        cells = " | ".join(str(counts[about, level]) for level in LEVELS)
        yield f"| `{about}` | {cells} |"
    yield f"| nothing | {silent} | | |"


def short(text: str, most: int = 300) -> str:
    """Return the beginning of a text, in one line."""
    return text.replace("\n", " ")[:most]


def public_lines(root: Path) -> Iterator[str]:
    """Yield the lines of the table of logs of real arms in a folder."""
    yield "| Log of a real arm | What is said of it | What is known to be wrong |"
    yield "| --- | --- | --- |"
    for log in public_logs():
        yield public_line(root, log)


def public_line(root: Path, log: PublicLog) -> str:
    """Return the row of a log of a real arm."""
    found = findings_of(
        [root / each for each in log.files], root / log.model, log.options
    )
    for each in found:
        print(
            f"  {log.files[0]} {each['level']}: {each['about']}: {short(each['text'])}"
        )
    said = ", ".join(
        dict.fromkeys(f"{LEVELS[each['level']]} (`{each['about']}`)" for each in found)
    )
    name = " and ".join(f"`{each.parent.name}/{each.name}`" for each in log.files)
    return f"| {name} | {said or 'nothing'} | {log.known or 'nothing'} |"


def cases_of(options: argparse.Namespace) -> Iterator[list[Case]]:
    """Yield the logs of each motion; arms are taken in turn."""
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    in_turn = cycle(options.arms)
    most = options.arms_each or len(options.arms)
    for motion in [*MOTIONS, *RIGHT_LOGS]:
        arms = [*islice(in_turn, most)]
        # A part of the motions has the same logs as all of them have.
        if motion in options.motions:
            every = product(seeds, options.deviations, arms)
            yield [Case(motion, arm, deviation, seed) for seed, deviation, arm in every]


def right_rows(options: argparse.Namespace) -> list[Row]:
    """Look at all right logs that the file of rows lacks, and print what is said of each."""
    kept = kept_rows(options.rows)
    found: list[Row] = []
    for cases in cases_of(options):
        of_motion: list[Row] = []
        for case in cases:
            number = len(found) + len(of_motion)
            is_answered = bool(options.answers) and number % options.answers == 0
            row = kept.get(case, {})
            if not row or (is_answered and "answer" not in row):
                row = case.look(options.models, is_answered)
                keep_row(options.rows, row)
            of_motion.append(row)
            for each in row["findings"]:
                line = f"{each['level']}: {each['about']}: {short(each['text'])}"
                print(f"  {case.arm_name} {case.deviation} {case.seed} {line}")
        levels = Counter(each["level"] for row in of_motion for each in row["findings"])
        line = f"{cases[0].motion:<18} {len(cases)} logs: {dict(levels)}"
        answered = f" | {answers_line(of_motion)}" if options.answers else ""
        print(f"{line}{answered}", flush=True)
        found += of_motion
    return found


def kept_rows(path: Path | None) -> dict[Case, Row]:
    """Return the rows of a file, the last of each log; none where there is no file."""
    if path is None or not path.exists():
        return {}
    kept = map(json.loads, path.read_text().splitlines())
    return {Case(**row["case"]): row for row in kept}


def keep_row(path: Path | None, row: Row) -> None:
    """Write a row to the end of a file, if there is to be one."""
    if path is not None:
        with path.open("a") as file:
            file.write(f"{json.dumps(row)}\n")


def main() -> int:
    """Read the command line, and print the tables."""
    parser = arms_parser(__doc__, ALL_ARMS, ALL_ARMS)
    motions = [*MOTIONS, *RIGHT_LOGS]
    parser.add_argument("--motions", nargs="+", default=motions, choices=motions)
    parser.add_argument("--arms-each", type=int, default=0)
    parser.add_argument("--deviations", nargs="+", default=["real", "exact"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--answers", type=int, default=0)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--public", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for name in ("models", "rows", "public"):
        path = getattr(options, name)
        setattr(options, name, path and path.resolve())
    with tempfile.TemporaryDirectory() as folder:
        # Commands leave proposed columns where they run.
        os.chdir(folder)
        print_tables(options)
        os.chdir(ROOT)
    return 0


def print_tables(options: argparse.Namespace) -> None:
    """Print the tables that are asked for, and write them where that is."""
    public = [] if options.public is None else [*public_lines(options.public)]
    if public:
        REAL_TABLE.show(public, options.write)
    found = right_rows(options) if options.seeds else []
    if found:
        lines = [*alarm_lines(found)]
        lines += (
            ["", f"`identify` of {answers_line(found)}."] if options.answers else []
        )
        TABLE.show(lines, options.write)


if __name__ == "__main__":
    sys.exit(main())
