"""The line of ``--columns`` that titles and numbers of a log suggest, where titles do not say it.

Columns with one title but for a number or a joint's name, as many as the arm has joints, are a
group; in a log without titles, as many columns that follow each other. Words of its title say what
a group is, and so do numbers: velocities are the derivative of positions, positions keep the
joints' ranges, torques follow the arm's weight. Where both are silent, or contradict each other,
the line has a "?", which is refused until it is filled in.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, permutations

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.errors import InputError
from robot_sysid.logs.column_map import ColumnFinder
from robot_sysid.logs.declarations import column_text, is_plain_title
from robot_sysid.logs.joint_names import are_opposite_sides, split_name
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import (
    TIME_UNITS,
    UNITS,
    Title,
    fit_pattern,
    measured_columns,
    token_set,
)
from robot_sysid.records import Array, RobotModel

BLANK = "?"
"""What stands for a column or a unit that could not be told."""
# Cells of a first row that are numbers, times or empty, or nearly so.
_NUMBER = re.compile(r"[-+\d.,:TZeE ]*|[-+]?(nan|inf)|null|none|n/?a", re.IGNORECASE)
# Words of titles of an encoder's counts, which are positions.
_COUNTS = token_set("ticks counts encoder enc")
# Excess over a joint's range that a zero elsewhere may make (chosen).
_MARGIN = 1.2


@dataclass(frozen=True)
class Group:
    """Columns of one quantity, as it seems: one per joint.

    Attributes:
        text: that stands for them in a line.
        title: of the first one.
        columns: (n,) indices, base to terminal.
        samples: (N, n) the numbers in them.
    """

    text: str
    title: Title
    columns: tuple[int, ...]
    samples: Array

    @property
    def quantity(self) -> str | None:
        """What its title names beside other words: a quantity, or how a torque was not measured."""
        if not _COUNTS.isdisjoint(self.title.tokens):
            return "position"
        kind = self.title.torque_kind
        is_other = kind in ("commanded", "computed")
        return kind if is_other else self.title.quantity_beside_name

    def __str__(self) -> str:
        return f"{self.text} ({self.samples.min():.4g} to {self.samples.max():.4g})"


@dataclass(frozen=True)
class Suggestion:
    """Declarations that a log lacks, found one after the other.

    Attributes:
        finder: of the log's columns, with what was declared.
        samples: (N, C) numbers of all columns.
        groups: of columns.
        entries: key to value of the line.
        units: of the line.
        reasons: sentences on columns, and on what their numbers told.
        further: options that it needs beside.
    """

    finder: ColumnFinder
    samples: Array
    groups: Sequence[Group]
    entries: dict[str, str]
    units: list[str]
    reasons: list[str]
    further: list[str] = field(default_factory=list)

    def find_time(self, columns: Collection[int]) -> Array:
        """Return the times (N,) [s]; numbers of rows where no column is the time.

        It increases steadily, and a plausible rate tells its unit.

        ``columns``: indices of those that could be it.
        """
        finder = self.finder
        titles = finder.titles
        seconds = UNITS["time"]
        clock = np.arange(len(self.samples), dtype=float)
        if finder.choices.rate:
            return clock / finder.choices.rate
        indices = [column.index for column in finder.recognise("time")]
        if not indices:
            steady = [k for k in _steady_columns(self.samples) if k in columns]
            # A column that counts rows is no clock, unless it is called so, or has a unit of time.
            indices = [
                k
                for k in steady
                if titles[k].quantity_beside_name == "time" or titles[k].unit in seconds
            ]
            steps = np.diff(self.samples, axis=0)
            indices = indices or [k for k in steady if np.any(steps[:, k] != 1.0)]
            if len(indices) != 1:
                self.entries["time" if indices else "rate"] = BLANK
                return clock
            self.entries["time"] = column_text(finder.table.titles, indices[0])
            self.reasons.append(f"{titles[indices[0]].text!r} increases steadily")
        unit = titles[indices[0]].unit or finder.choices.time_unit
        clock = self.samples[:, indices[0]] * seconds.get(unit or "s", 1.0)
        if unit:
            return clock
        # Of rates from 10 to 5000 Hz, one unit of time at most makes one.
        period = np.median(np.diff(clock))
        units = [u for u in TIME_UNITS if 2e-4 <= period * seconds[u] <= 0.1] or [BLANK]
        self.units.extend(unit for unit in units if unit != "s")
        return clock * seconds.get(units[0], np.nan)

    def find_motion(self, clock: Array) -> Array | None:
        """Return positions (N, n) [rad], with their units; None where they cannot be told.

        Velocities are the derivative of positions by the clock (N,) [s].
        """
        found = self.finder.recognise("position")
        if found:
            samples = self.samples[:, [column.index for column in found]]
            zeros = [column.zero for column in found]
            factors = [column.factor for column in found]
            return self._find_units((samples - zeros) * factors)
        self.entries["position"] = BLANK
        motions = [
            g for g in self.groups if g.quantity in (None, "position", "velocity")
        ]
        # Columns and their derivatives to the ratio of these.
        ratios = {
            (group.text, other.text): ratio
            for group, other in permutations(motions, 2)
            if (ratio := _derivative_ratio(group.samples, other.samples, clock))
        }
        derived = {text for _, text in ratios}
        candidates = self._of_quantity("position")
        if not candidates:
            integrals = {text for text, _ in ratios} - derived
            candidates = [g for g in motions if g.text in integrals]
        if len(candidates) != 1:
            return None
        position = candidates[0]
        if position.text in derived:
            self.reasons.append(f"{position.text} are the derivative of other columns")
            return None
        self.entries["position"] = position.text
        for group in motions:
            ratio = ratios.get((position.text, group.text), 0.0)
            condition = ""
            if self.entries.get("rate") == BLANK and 10.0 <= ratio <= 5000.0:
                self.entries["rate"] = f"{float(f'{ratio:.3g}'):g}"
                condition = " at that rate, if both are in one unit"
                ratio = 1.0
            unit = group.title.unit
            if abs(ratio - 1.0) < 0.1 and (not unit or unit in UNITS["velocity"]):
                self.entries["velocity"] = group.text
                self.reasons.append(
                    f"{group.text} are the derivative of {position.text}{condition}"
                )
        stated = position.title.unit
        if stated:
            return position.samples * UNITS["position"].get(stated, 1.0)
        return self._find_units(position.samples)

    def _find_units(self, q: Array) -> Array | None:
        """Return positions (N, n) in the units in which they keep the joints' ranges, in SI units.

        None where there are no such units.
        """
        robot = self.finder.robot
        choices = self.finder.choices
        values = UNITS["position"]
        reach = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
        # More than an arm's joints have.
        reach[np.isinf(reach) & ~robot.is_slide] = 4.0 * np.pi
        excess = np.max(np.abs(q), axis=0) / reach
        # Whole numbers may be the counts of an encoder.
        is_whole = np.all(q == np.round(q))
        for is_kind, declared, units in (
            (~robot.is_slide, choices.angle_unit, ["deg", "cdeg"]),
            (robot.is_slide, choices.length_unit, ["mm"]),
        ):
            largest = np.max(excess[is_kind], initial=0.0)
            if declared or largest <= _MARGIN:
                continue
            fitting = [u for u in units if values[u] * largest <= _MARGIN]
            # Near the range, a zero may be elsewhere.
            if is_whole or not fitting or largest < _MARGIN**3:
                self.units.append(BLANK)
                self.reasons.append("positions leave the joints' ranges in SI units")
                return None
            q = np.where(is_kind, values[fitting[0]] * q, q)
            self.units.append(fitting[0])
            self.reasons.append(f"positions keep the joints' ranges in {fitting[0]}")
        return q

    def find_driven(self, position: Array | None) -> None:
        """Find torques, or commanded positions of servos.

        ``position``: (N, n) [rad], which tell torques by the arm's weight.
        """
        driven = self.finder.driven
        if self.finder.recognise(driven):
            return
        quantities = [driven]
        if driven == "torque":
            quantities += ["current", "commanded"]
        candidates = next(filter(None, map(self._of_quantity, quantities)), [])
        if not candidates and driven == "torque" and position is not None:
            for group in self.groups:
                is_free = not group.quantity and group.text not in self.entries.values()
                if is_free and _follows_weight(
                    self.finder.robot, position, group.samples
                ):
                    candidates.append(group)
                    self.reasons.append(f"{group.text} follow the arm's weight")
        quantity = candidates[0].quantity if candidates else None
        if quantity == "current" and driven == "torque":
            self.further.extend(("--torque-constants", "1"))
        if quantity == "commanded":
            self.reasons.append(
                f"{candidates[0].text} were commanded, not measured: they are the arm's torque "
                "only where motors follow closely and gravity is in them"
            )
        key = "torque" if driven == "current" else driven
        self.entries[key] = candidates[0].text if len(candidates) == 1 else BLANK

    def _of_quantity(self, quantity: str) -> list[Group]:
        """Return the groups that titles call a quantity; the measured ones, where some say so."""
        groups = [group for group in self.groups if group.quantity == quantity]
        first_columns = [group.columns[0] for group in groups]
        measured = measured_columns(self.finder.titles, first_columns)
        return [group for group in groups if group.columns[0] in measured]


def suggest_columns(finder: ColumnFinder) -> Suggestion | None:
    """Return the declarations that a log lacks, behind those that were given; None where no columns
    are a group.
    """
    samples = _read_samples(finder.table)
    groups = [*_find_groups(finder, samples)]
    if not groups:
        return None
    titles = finder.table.titles
    grouped = {*chain.from_iterable(group.columns for group in groups)}
    others = [k for k in range(len(titles)) if k not in grouped]
    listed = ", ".join([*map(str, groups), *(titles[k] for k in others)])
    entries = {**finder.choices.entries}
    units = [*filter(None, [entries.get("units")])]
    reasons = [f"its columns are {listed}"]
    suggestion = Suggestion(finder, samples, groups, entries, units, reasons)
    clock = suggestion.find_time(others)
    suggestion.find_driven(suggestion.find_motion(clock))
    if units:
        entries["units"] = ", ".join(units)
    return suggestion


def _read_samples(table: LogTable) -> Array:
    """Return the numbers (N, C) of the first rows of a log, NaN in a column of text.

    What is missing elsewhere is interpolated.
    """
    first_row = table.first_row or [""] * len(table.titles)
    columns = [k for k, cell in enumerate(first_row) if _NUMBER.fullmatch(cell)]
    # 50 000 rows, or 5 million characters.
    cells = table.cells(columns, 5)
    rows = np.arange(len(cells))
    samples = np.full((len(cells), len(table.titles)), np.nan)
    for column, numbers in zip(columns, cells.T):
        known = np.flatnonzero(np.isfinite(numbers))
        if len(known):
            samples[:, column] = np.interp(rows, known, numbers[known])
    return samples


def _find_groups(finder: ColumnFinder, samples: Array) -> Iterator[Group]:
    """Yield the groups of columns of numbers, from left to right.

    Columns of the other arm of two are none, nor are constants, which no sensor of a moving arm
    reads at all joints.
    """
    texts = finder.table.titles
    names = finder.robot.joint_names
    own_pieces = {*chain.from_iterable(map(split_name, names))}
    numbers = np.flatnonzero(np.isfinite(samples).any(axis=0)).tolist()
    found: dict[tuple[int, ...], str] = {}
    if len(names) == 1 or all(text == f"#{k}" for k, text in enumerate(texts, 1)):
        # What is beside full runs of joints is time.
        times = _steady_columns(samples)[: len(numbers) % len(names)]
        others = [k for k in numbers if k not in times]
        for run in zip(*[iter(others)] * len(names)):
            is_run = run[-1] - run[0] == len(names) - 1 > 0
            found[run] = f"#{run[0] + 1}..#{run[-1] + 1}" if is_run else ""
    else:
        for pattern in chain.from_iterable(_patterns(text, names) for text in texts):
            with suppress(InputError):
                columns = tuple(fit_pattern(pattern, texts, names)[0])
                found.setdefault(columns, pattern if is_plain_title(pattern) else "")
    for columns, text in sorted(found.items()):
        if not columns or not {*columns} <= {*numbers}:
            continue
        title = finder.titles[columns[0]]
        values = samples[:, [*columns]]
        is_other_arm = are_opposite_sides({*split_name(title.text)}, own_pieces)
        if np.ptp(values, axis=0).any() and not is_other_arm:
            text = text or ", ".join(column_text(texts, k) for k in columns)
            yield Group(text, title, columns, values)


def _patterns(title: str, joint_names: Sequence[str]) -> list[str]:
    """Return a title with "*" for each of its numbers, or for a joint's name in it."""
    numbers = re.finditer(r"\d+", title)
    patterns = [f"{title[: m.start()]}*{title[m.end() :]}" for m in numbers]
    return patterns + [title.replace(n, "*") for n in joint_names if n in title]


def _steady_columns(samples: Array) -> list[int]:
    """Return the columns (indices) that increase from row to row by steps of about one size."""
    step = np.diff(samples, axis=0)
    if len(step) < 10:
        return []
    low, high = np.percentile(step, (10, 90), axis=0)
    is_steady = (np.mean(step > 0.0, axis=0) >= 0.99) & (high < 10.0 * low)
    return np.flatnonzero(is_steady).tolist()


def _derivative_ratio(q: Array, qd: Array, clock: Array) -> float | None:
    """Return by what columns (N, n) are to be divided to be the derivative of others by a clock.

    None where they are not, at a joint that moves, or where the joints disagree.
    """
    from scipy.integrate import cumulative_trapezoid

    # In stretches of 20 rows.
    integrals = np.diff(cumulative_trapezoid(qd, clock, axis=0)[::20], axis=0)
    changes = np.diff(q[1::20], axis=0)
    squares = np.sum(changes**2, axis=0)
    moving = np.flatnonzero(squares > 0.01 * np.max(squares, initial=0.0))
    products = np.sum(changes * integrals, axis=0)[moving]
    norms = np.sqrt(squares * np.sum(integrals**2, axis=0))[moving]
    if not len(moving) or np.any(products <= 0.9 * norms):
        return None
    ratios = products / squares[moving]
    ratio = float(np.median(ratios))
    return ratio if np.ptp(ratios) < 0.1 * ratio else None


def _follows_weight(robot: RobotModel, q: Array, tau: Array) -> bool:
    """Return whether columns (N, n) are nearly the torque that holds the model, or its opposite."""
    rows = np.linspace(0, len(q) - 1, 500).astype(int)
    rest = np.zeros((500, robot.n_joints))
    weight = ArmDynamics(robot).torque(q[rows], rest, rest)
    tau = tau[rows]
    # A constant is no torque: what changes has to agree, too, as far as friction lets it.
    changes = (weight - np.mean(weight, axis=0), tau - np.mean(tau, axis=0))
    for (expected, found), least in (((weight, tau), 0.8), (changes, 0.5)):
        norms = np.linalg.norm(expected) * np.linalg.norm(found)
        if np.abs(np.sum(expected * found)) <= least * norms:
            return False
    return True
