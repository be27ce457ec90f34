"""``robot-sysid check MODEL LOG``: whether an arm is what its model says, or what it was."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import MODEL, Command, LogArgument
from robot_sysid.config import CheckConfig
from robot_sysid.logs import LogOptions
from robot_sysid.model import OF_LOG, ModelOptions
from robot_sysid.records.messages import Detail, aligned_lines, number_text
from robot_sysid.records.option_fields import (
    FileArguments,
    keys_of,
    option,
    options_of_all,
    record_from,
)
from robot_sysid.records.parameters import INERTIAL


@dataclass(frozen=True)
class EarlierLog(FileArguments):
    """What the log is compared with."""

    since: tuple[Path, ...] = option(
        (),
        "earlier log, or the folder of a run on it, of payload on its empty logs; without it the "
        "log is compared with the model",
        "EARLIER",
        takes_many=True,
    )
    same_day: bool = option(
        False,
        "both logs are of one day, with the gears as warm: smaller changes of friction are named",
    )


def run(values: Mapping[str, Any], console: Console) -> int:
    """Print what has changed and return the exit code: 1 where anything has."""
    from robot_sysid.pipeline.comparison import check_log

    log = record_from(LogArgument, values).log
    earlier = record_from(EarlierLog, values)
    since = earlier.since
    own_keys = keys_of(LogArgument, EarlierLog)
    options = {key: value for key, value in values.items() if key not in own_keys}
    config = CheckConfig.of(measurements=log, **options)
    result = check_log(config, since, console, earlier.same_day)
    console.stage(*_table(result.changes, bool(since)))
    console.note(*result.notes)
    console.stage(*result.verdict)
    console.result(vars(result))
    return int(result.has_changed)


def _table(changes: Sequence[Any], since: bool) -> Iterator[str]:
    """Yield a line for each number that was compared; a ``Detail`` where it does not differ."""
    from robot_sysid.pipeline.changes import DIFFERS

    labels = {each.name: each.label for each in INERTIAL}
    headings = ("value", "±", "usual", "shows from")
    rows = [["change of" if since else "differs from the model", "", *headings, ""]]
    for row in changes:
        error = row.error or 0.0
        numbers = (row.value, error, row.usual, row.least)
        texts = [number_text(number, error) for number in numbers]
        name = labels.get(row.name, row.name)
        rows.append([row.of, name, *texts, f"{row.unit} {row.reason}".strip()])
    differs = [row.reason == DIFFERS for row in changes]
    heading, *lines = aligned_lines(rows, headings)
    yield heading if any(differs) else Detail(heading)
    for is_said, line in zip(differs, lines):
        yield line if is_said else Detail(line)


COMMANDS = (
    Command(
        "check",
        "check arm.xml today.csv --since log.csv",
        "Tell whether an arm is what it was, its load, friction, zeros and torque sensors, by a "
        "log of any motion, such as of a task, and an earlier one; without --since, whether it is "
        "what its model says. The exit code is 1 where something has changed, or differs from the "
        "model by more than models usually do.",
        {
            "": (*MODEL, *options_of_all(LogArgument)),
            "earlier log": options_of_all(EarlierLog),
            "model": options_of_all(ModelOptions, only=OF_LOG),
            "log": options_of_all(LogOptions),
        },
        run,
        main=(
            *("since", "same_day", "mesh_dir", "joint", "gravity", "columns", "units"),
            *("torque_scale", "torque_constants", "topic", "accept", "json"),
        ),
        interrupted="interrupted; nothing was written",
    ),
)
