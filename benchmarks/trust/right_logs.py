"""What right logs are accused of: motions as people record them, of arms as they are.

    python -m benchmarks.trust.right_logs MODELS_FOLDER [--arms ur5e ...] [--motions sines ...]
        [--arms-each 3] [--seeds 2] [--deviations real exact] [--answers 2]
        [--public LOGS_FOLDER] [--write]

Each log is of another arm, drawn as in ``benchmarks.trust.real_arms``, and is looked at by the
command ``log``. Beside the motions of this module, there are the right logs under odd conditions of
``benchmarks.trust.confusion_mistakes``. Every motion is played by all arms, or by so many as
``--arms-each`` says, taken in turn. Printed are the logs of which something is said, and per motion
how many are refused, doubted, or noted; at the end a table of each reading's false alarms, which
``--write`` puts into docs/evidence.md. With ``--public``, the logs of real arms of
``benchmarks.accuracy.public_arms`` stand below it. Every ``--answers``-th log is given to
``identify`` as well: how many are Usable, and how many of the numbers lie within 1.96 of their
stated errors. The whole table of the page, an hour on one core:

    OMP_NUM_THREADS=1 python -m benchmarks.trust.right_logs MODELS_FOLDER --deviations real
        --arms-each 3 --seeds 2 --first-seed 100 --answers 2 --public LOGS_FOLDER --write
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
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
TABLE = PageTable(
    ROOT / "docs" / "evidence.md", "right logs", "python -m benchmarks.trust.right_logs"
)
LEVELS = ("says", "doubts", "refuses")
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


@dataclass
class Alarms:
    """What is said of right logs.

    Attributes:
        count, silent: numbers of logs, and of those of which nothing is said.
        of_reading: reading (what a finding is about) to level to number of logs.
    """

    count: int = 0
    silent: int = 0
    of_reading: dict[str, Counter[str]] = field(
        default_factory=lambda: defaultdict(Counter)
    )

    def add(self, found: Sequence[dict[str, str]]) -> None:
        """Count the findings of a log."""
        self.count += 1
        self.silent += not found
        for about, level in {(each["about"], each["level"]) for each in found}:
            self.of_reading[about][level] += 1

    def lines(self) -> Iterator[str]:
        """Yield the lines of their table."""
        yield f"| Said of {self.count} right logs | a note | a doubt | a refusal |"
        yield "| --- | --- | --- | --- |"
        for about, levels in sorted(self.of_reading.items()):
            cells = " | ".join(str(levels[level]) for level in LEVELS)
            yield f"| `{about}` | {cells} |"
        yield f"| nothing | {self.silent} | | |"


@dataclass
class Answers:
    """What ``identify`` answers to logs.

    Attributes:
        count, refused, usable: numbers of logs.
        offs: numbers' errors over their stated ones.
    """

    count: int = 0
    refused: int = 0
    usable: int = 0
    offs: list[float] = field(default_factory=list)

    def add(self, truth: Truth, content: dict[str, Any] | None) -> None:
        """Count an answer, the content of params.json; None where the log is refused."""
        self.count += 1
        if content is None:
            self.refused += 1
            return
        self.usable += content["valid"]["trustworthy"]
        errors = errors_of(truth, rows(content), content["curves"])
        self.offs += [
            off / stated
            for _, off, stated, _ in errors
            if np.isfinite(stated) and stated > 0.0
        ]

    def __str__(self) -> str:
        """Return them in words."""
        within = 100.0 * np.mean(np.abs(self.offs) < 1.96) if self.offs else np.nan
        return (
            f"refused {self.refused}, usable {self.usable} of {self.count}; {within:.1f} % of "
            f"{len(self.offs)} numbers within 1.96 stated errors"
        )


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
    said = ", ".join(f"{each['level']} `{each['about']}`" for each in found)
    name = " and ".join(f"`{each.name}`" for each in log.files)
    return f"| {name} | {said or 'nothing'} | {log.known or 'nothing'} |"


def cases_of(options: argparse.Namespace) -> dict[str, list[tuple[int, str, str]]]:
    """Return motion to (seed, deviation, arm) of its logs; arms are taken in turn."""
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    in_turn = cycle(options.arms)
    most = options.arms_each or len(options.arms)
    return {
        motion: [*product(seeds, options.deviations, [*islice(in_turn, most)])]
        for motion in options.motions
    }


def right_lines(options: argparse.Namespace) -> list[str]:
    """Look at all right logs, print what is said of each, and return the lines of their table."""
    alarms = Alarms()
    answers = Answers()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.csv"
        model = folder / "model.xml"
        for motion, cases in cases_of(options).items():
            counts: Counter[str] = Counter()
            for seed, deviation, arm_name in cases:
                path = options.models / ALL_ARMS[arm_name]
                truth, text = right_log(path, arm_name, motion, deviation, seed)
                model.write_text(text)
                write_log(log, truth.robot.joint_names, truth.log)
                found = findings_of([log], model)
                counts.update({f["level"] for f in found})
                for finding in found:
                    print(
                        f"  {arm_name} {deviation} {seed} {finding['level']}: "
                        f"{finding['about']}: {short(finding['text'])}",
                        flush=True,
                    )
                alarms.add(found)
                if options.answers and alarms.count % options.answers == 0:
                    content, _ = identify_logs(folder, model, [log])
                    answers.add(truth, content)
            line = f"{motion:<18} {len(cases)} logs: {dict(counts)}"
            print(f"{line} | {answers}" if options.answers else line, flush=True)
    lines = [*alarms.lines()]
    return [*lines, "", f"`identify`: {answers}."] if options.answers else lines


def main() -> int:
    """Print the table; write it where that is asked for."""
    parser = arms_parser(__doc__, ALL_ARMS, ALL_ARMS)
    motions = [*MOTIONS, *RIGHT_LOGS]
    parser.add_argument("--motions", nargs="+", default=motions, choices=motions)
    parser.add_argument("--arms-each", type=int, default=0)
    parser.add_argument("--deviations", nargs="+", default=["real", "exact"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--answers", type=int, default=0)
    parser.add_argument("--public", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    public = [] if options.public is None else [*public_lines(options.public)]
    lines = right_lines(options)
    lines += ["", *public] if public else []
    print("\n".join(lines))
    if options.write:
        TABLE.write(lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
