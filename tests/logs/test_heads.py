"""What the head of a log says is found, refused, or suggested as ``heads.txt`` has it."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rigs.arms import small_arms
from rigs.arms.wrong_arms import truth_of
from rigs.files.refusals import refused
from rigs.logs.log_files import (
    arm_of,
    assert_refused,
    assert_samples,
    blocks_of,
    open_log,
    titles_alone,
    write_signals,
)
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import read_columns
from robot_sysid.logs.matching import match_alike
from robot_sysid.logs.titles import read_title
from robot_sysid.records import ColumnMap

HEADS = blocks_of(Path(__file__).with_name("heads.txt"))
Block = Mapping[str, Sequence[str]]
UNITS = {"rad": 1.0, "deg": math.pi / 180, "rev": 2 * math.pi}
JOINT_GROUPS = ("position", "torque", "velocity", "joint_time")


def cells_of(block: Block, key: str, default: str = "") -> list[str]:
    """The columns of a key of a block."""
    (text,) = block.get(key, [default])
    return [cell.strip() for cell in text.split("|")] if text else []


def joints_of(block: Block) -> list[str]:
    return cells_of(block, "joints", "joint0 | joint1 | joint2")


def column_of(text: str) -> tuple[str, float, float]:
    """Title, factor and zero of a column that is written as in "(q1 - 5) x deg/100"."""
    title, _, factor_text = text.partition(" x ")
    unit, _, divisor = factor_text.partition("/")
    factor = UNITS.get(unit) or float(unit or 1.0)
    with_zero = re.fullmatch(r"\((.+) - (\S+)\)", title)
    title, zero = with_zero.groups() if with_zero else (title, 0.0)
    return title, factor / float(divisor or 1.0), float(zero)


def map_of(block: Block, folder: Path) -> ColumnMap:
    """The map of a head, with declarations in a file where they have several lines."""
    joints = joints_of(block)
    lines = block.get("columns", [])
    source: Path | str = "\n".join(lines)
    if len(lines) > 1:
        (folder / "columns.txt").write_text(str(source))
        source = folder / "columns.txt"
    slides = cells_of(block, "slides")
    robot = arm_of(joints, is_slide=[joint in slides for joint in joints])
    table = titles_alone(cells_of(block, "head"), cells_of(block, "row"))
    return ColumnFinder(table, robot, read_columns(source, joints)).find_all()


def check_map(block: Block, folder: Path) -> None:
    columns = map_of(block, folder)
    groups: dict[str, Sequence[Any]] = {q: getattr(columns, q) for q in JOINT_GROUPS}
    groups["time"] = [columns.time] if columns.time else []
    titles = cells_of(block, "head")
    for quantity, group in groups.items():
        expected = cells_of(block, quantity)
        assert len(group) == len(expected), quantity
        for column, text in zip(group, expected):
            number = re.fullmatch(r"(-?[\d.]+)( deg)?", text)
            if text == "none" or number:
                # The number of a joint that stands still.
                place = (
                    float(number[1]) * UNITS["deg" if number[2] else "rad"]
                    if number
                    else 0.0
                )
                assert (column.factor, column.constant) == (0.0, place)
                continue
            title, factor, zero = column_of(text)
            found = column.title, column.index, column.factor, column.zero
            assert found == (title, titles.index(title), factor, zero)
    assert [f"{columns.rate:g}" if columns.rate else ""] == block.get("rate", [""])
    assert list(columns.notes) == list(block.get("note", []))
    declared = cells_of(block, "declared")
    assert columns.angle_declared == ("angle" in declared)
    assert columns.length_declared == ("length" in declared)
    assert all(text in columns.describe() for text in block.get("described", []))


def check_refused_head(block: Block, folder: Path) -> None:
    with refused(block["refused"][0]):
        map_of(block, folder)


def check_refused_file(block: Block, folder: Path) -> None:
    for library in ("rosbags", "pyarrow", "h5py"):
        pytest.importorskip(library)
    path = folder / "log.csv"
    assert_refused("cannot read the log", path)
    content = block["file"][0].encode().decode("unicode_escape")
    path.write_bytes(content.encode("latin-1"))
    assert_refused(block["refused"][0], path)


def check_quantities(block: Block, _: Path) -> None:
    for text in block["title"]:
        title, quantity = map(str.strip, text.split("|"))
        found = read_title(title, joints_of(block)).joint_quantity
        assert (title, found or "none") == (title, quantity)


def check_suggestion(block: Block, folder: Path) -> None:
    arm = small_arms.serial_arm(small_arms.SEVEN_AXES[:4], joint='range="-2.5 2.5"')
    truth = truth_of(small_arms.robot_of(arm), 2)
    robot = truth.robot
    if "joints" in block:
        robot = replace(robot, joint_names=tuple(joints_of(block)))
    cells = [cell.rpartition("=") for cell in cells_of(block, "signals")]
    signals = {title.strip(): name.strip() for title, _, name in cells}
    path = write_signals(folder / "log.csv", truth.log, signals)
    with pytest.raises(InputError) as caught:
        open_log(robot, path, LogOptions(*block.get("given", [])))
    (line,) = block["line"]
    further = [word for text in block.get("options", []) for word in text.split()]
    assert caught.value.options == (("--columns", line, *further),)
    options = LogOptions(line, torque_constants=1.0 if further else None)
    blank = re.search(r"(\w+) = [^=]*\?", line)
    if blank:
        with refused(rf"{blank[1]} = .* is a blank"):
            open_log(robot, path, options)
        return
    log = open_log(robot, path, options)
    log = replace(log, time=log.time - log.time[0])
    # A number of rows is no time.
    is_timed = "rate" in line or not {"t", "ms"}.isdisjoint(signals.values())
    names = ("time", "q", "tau") if is_timed else ("q", "tau")
    assert_samples(truth.log, log, names, atol=2e-5)


CHECKS = {
    "signals": check_suggestion,
    "title": check_quantities,
    "file": check_refused_file,
    "refused": check_refused_head,
    "head": check_map,
}
"""Key of a block to what checks it; the first that a block has counts."""


@pytest.mark.parametrize("name", HEADS)
def test_the_head_of_a_log_is_read_as_the_corpus_says(tmp_path, name):
    block = HEADS[name]
    check = next(check for key, check in CHECKS.items() if key in block)
    check(block, tmp_path)


RECOGNISED = [
    name for name, b in HEADS.items() if "position" in b and "columns" not in b
]


@pytest.mark.parametrize("name", RECOGNISED)
def test_what_is_likely_does_not_contradict_what_is_certain(tmp_path, name):
    """Columns alike that a map has for certain are likely that quantity, of the same joints."""
    block = HEADS[name]
    columns = map_of(block, tmp_path)
    joints = joints_of(block)
    titles = [read_title(title, joints) for title in columns.titles]
    alike = {frozenset(match.columns): match for match in match_alike(titles, joints)}
    for quantity in ("position", "torque", "velocity"):
        indices = tuple(column.index for column in getattr(columns, quantity))
        match = alike.get(frozenset(indices))
        if match:
            assert (match.quantity, match.columns) == (quantity, indices)
