"""A guess which column of a log is what, where its titles do not say it.

Titles in other languages are translated; what they leave open is guessed from the numbers
(``candidates``). A guess is never used silently: it becomes a draft of a columns file, in
which a line holds ``?`` where two guesses are equally good.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_draft import BLANK, DraftLine, draft, join_ranges
from robot_sysid.logs.column_map import (
    Column,
    ColumnChoices,
    ColumnFinder,
    parse_columns,
)
from robot_sysid.logs.guess.candidates import Candidate, ColumnCandidates, Group
from robot_sysid.logs.guess.physics import read_numbers
from robot_sysid.logs.guess.words import translate
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.titles import UNITS, read_title
from robot_sysid.records import RobotModel

_RIVAL = 0.7
"""Difference of two scores within which two guesses are equally good."""
_MOST_LISTED = 4
"""Largest number of groups of columns in a comment."""


def guess_columns(
    table: LogTable,
    robot: RobotModel,
    choices: ColumnChoices,
    currents: bool = False,
    commanded: bool = False,
) -> str:
    """Return a columns file with what titles and numbers show, ``?`` for what they leave open.

    Args:
        table: the log.
        robot: the arm, whose joints the columns are for.
        choices: units that are declared.
        currents: whether columns of motor currents are read in place of torques.
        commanded: whether commanded positions are read in place of torques.
    """
    # Numbers stand in the place of missing titles.
    has_titles = table.titles[:1] != ("#1",)
    english = [translate(text) if has_titles else "" for text in table.titles]
    recognised: dict[str, tuple[Column, ...]] = {}
    for texts in (english, table.titles) if has_titles else ():
        finder = ColumnFinder.of(texts, robot, choices, currents, commanded)
        with contextlib.suppress(InputError):
            finder.find_all(table.first_row)
        recognised.update(filter(itemgetter(1), finder.recognised.items()))
    rows = np.empty((0, len(english)))
    with contextlib.suppress(InputError):
        rows = read_numbers(table)
    titles = list(map(read_title, english))
    candidates = ColumnCandidates(robot, titles, recognised, choices, rows)
    lines = _Guesser(candidates, table.titles, commanded).lines()
    guess = draft(table.titles, robot.joint_names, lines)
    if any(line.is_open for line in lines):
        return guess
    try:
        guessed = choices.over(parse_columns(guess, table.path, robot.joint_names))
        finder = ColumnFinder.of(table.titles, robot, guessed, currents, commanded)
        finder.find_all(table.first_row)
    except InputError:
        # Velocities are not needed; several may be ambiguous, or of an unknown unit.
        lines = [line for line in lines if line.key != "velocity"]
        reason = "not needed, and its titles are not understood"
        lines.append(DraftLine("velocity", ("none",), reason))
        guess = draft(table.titles, robot.joint_names, lines)
    return guess


@dataclass(frozen=True)
class _Guesser:
    """Writes the lines of the draft for one log.

    Attributes:
        candidates: the columns that may be its quantities.
        texts: its titles as the file has them, from which those of the candidates are translated.
        commanded: whether commanded positions are read in place of torques.
    """

    candidates: ColumnCandidates
    texts: Sequence[str]
    commanded: bool

    def lines(self) -> list[DraftLine]:
        """Return the lines of the draft."""
        time = self._line("time", self._guess_time)
        position = self._line("position", self._guess_position)
        lines = [time, position]
        has_velocity = len(self._velocities) == 1 and not position.is_open
        if has_velocity or "velocity" in self.candidates.recognised:
            lines.append(self._line("velocity", self._guess_velocity))
        if self.commanded:
            lines.append(self._line("command", self._guess_command))
        else:
            lines.append(self._line("torque", self._guess_torque))
        units = self._units()
        if units:
            reason = "by the joints' limits, and by the time from row to row"
            lines.append(DraftLine("units", units, reason))
        return lines

    @cached_property
    def _clear(self) -> list[Candidate]:
        """The candidates whose torques follow the model's."""
        pairs = [] if self.commanded else self.candidates.pairs
        return [pair for pair in pairs if pair.is_clear]

    @cached_property
    def _best(self) -> Candidate | None:
        """The candidate with the best score; None where none is clear."""
        return min(self._clear, key=lambda pair: pair.score, default=None)

    @cached_property
    def _velocities(self) -> list[Group]:
        """The columns that are the derivatives of the best candidate's positions."""
        return self.candidates.velocity_groups(self._best) if self._best else []

    def _line(self, quantity: str, guess: Callable[[], DraftLine]) -> DraftLine:
        """Return the line of a quantity by the titles, or a guess where they are not enough."""
        columns = self.candidates.recognised.get(quantity)
        if columns is None:
            return guess()
        group = [column.index for column in columns]
        return self._columns_line(quantity, group, "by the titles")

    def _columns_line(
        self, quantity: str, columns: Iterable[int], reason: str
    ) -> DraftLine:
        """Return a line with columns, and a factor where only a title in English says the unit."""
        values = []
        for column in columns:
            value = f"#{column + 1}"
            unit = self.candidates.titles[column].unit
            factor = UNITS[quantity].get(unit, 1.0)
            if factor != 1.0 and unit != read_title(self.texts[column]).unit:
                value = f"{factor:.9g} * {value}"
            values.append(value)
        return DraftLine(quantity, tuple(values), reason)

    def _open_line(self, quantity: str, reason: str) -> DraftLine:
        """Return a line with a ? for each joint."""
        count = self.candidates.robot.n_joints
        return DraftLine(quantity, (BLANK,) * count, reason)

    def _guess_time(self) -> DraftLine:
        """Return the line of the time, or of the rate where no column may be the time."""
        clocks = self.candidates.clocks
        if not clocks:
            reason = "no column grows evenly: put the samples per second here [Hz]"
            return DraftLine("rate", (BLANK,), reason)
        listed = _list_groups((clock.column,) for clock in clocks)
        if len(clocks) > 1:
            return DraftLine("time", (BLANK,), f"each grows as a time does: {listed}")
        is_named = self.candidates.quantities[clocks[0].column] == "time"
        if clocks[0].counts and not is_named:
            reason = f"{listed} counts rows or ms; 'rate = 200' may stand in its place"
            return DraftLine("time", (BLANK,), reason)
        period = f"{1e3 * clocks[0].period:.4g} ms"
        return DraftLine("time", (listed,), f"grows evenly, by {period} per row")

    def _units(self) -> tuple[str, ...]:
        """Return the units of angles and time that are not rad and s, where nothing states them."""
        choices = self.candidates.choices
        clocks = self.candidates.clocks
        units = []
        position_units = [self._best.unit] if self._best else []
        if not self._best and "position" in self.candidates.recognised:
            (position,) = self.candidates.groups("position")
            position_units = list(self.candidates.units_of(position))
        if position_units == ["deg"] and not choices.angle_unit:
            units.append("deg")
        if len(clocks) == 1 and not choices.time_unit:
            (clock,) = clocks
            if clock.unit != "s" and not self.candidates.titles[clock.column].unit:
                units.append(clock.unit)
        return tuple(units)

    def _guess_position(self) -> DraftLine:
        """Return the line of the positions."""
        best = self._best
        if best is None:
            return self._unconfirmed_position()
        rivals = [pair for pair in self._clear if pair.score < best.score + _RIVAL]
        groups = dict.fromkeys([best.position, *(pair.position for pair in rivals)])
        for group in self.candidates.groups("position"):
            if self.candidates.are_twins(group, best.position):
                groups[group] = None
        listed = _list_groups(groups)
        if len(groups) > 1:
            lag = self._lag_text(*list(groups)[:2])
            return self._open_line("position", f"equally good: {listed}; {lag}")
        if len({pair.unit for pair in rivals}) > 1:
            return self._open_line("position", f"in rad or in deg: {listed}")
        reason = "within the joints' limits; the torque is the model's for this motion"
        return self._columns_line("position", best.position, reason)

    def _unconfirmed_position(self) -> DraftLine:
        """Return the line of the positions where no torque confirms any."""
        groups = self.candidates.groups("position")
        possible = list(filter(self.candidates.units_of, groups))
        reason = "no run of columns stays within the joints' limits"
        if possible:
            reason = f"no torque confirms one of {_list_groups(possible)}"
        return self._open_line("position", reason)

    def _lag_text(self, first: Group, second: Group) -> str:
        """Return which of two groups of positions comes after the other, for a comment."""
        samples, period = self.candidates.samples
        q = samples[:, first]
        qd = np.gradient(q, period or 1.0, axis=0)
        lag = float(np.sum((q - samples[:, second]) * qd) / np.sum(qd**2))
        late, early = (second, first) if lag > 0.0 else (first, second)
        text = f"{_list_groups([late])} comes after {_list_groups([early])}"
        if period:
            text += f" by {1e3 * abs(lag):.3g} ms"
        return f"{text}, as a measurement does after its command"

    def _guess_velocity(self) -> DraftLine:
        """Return the line of the velocities, of which there is one group."""
        reason = "the derivatives of the positions"
        return self._columns_line("velocity", self._velocities[0], reason)

    def _guess_torque(self) -> DraftLine:
        """Return the line of the torques."""
        best = self._best
        if best is None:
            return self._unconfirmed_torque()
        groups = {best.torque: None}
        for pair in self._clear:
            is_apart = not set(pair.torque) & set(best.torque)
            is_rival = is_apart or pair.score < best.score + _RIVAL
            if pair.position == best.position and is_rival:
                groups[pair.torque] = None
        if len(groups) > 1:
            reason = f"each is the model's torque: {_list_groups(groups)}; one may be "
            return self._open_line("torque", f"{reason}a command, or computed")
        joint_names = self.candidates.robot.joint_names
        loaded = [joint_names[j] for j in np.flatnonzero(best.fit.loaded)]
        reason = f"{_ratio_text(best)} the model's torque at {', '.join(loaded)}"
        line = self._columns_line("torque", best.torque, reason)
        values = list(line.values)
        reasons = [reason]
        for joint, alternative in best.torque_faults.items():
            reasons.append(f"{joint_names[joint]}: {values[joint]} or {alternative}")
            values[joint] = BLANK
        return DraftLine("torque", tuple(values), "; ".join(reasons))

    def _unconfirmed_torque(self) -> DraftLine:
        """Return the line of torques where no columns follow the model's."""
        scaled = [pair for pair in self.candidates.pairs if pair.has_other_scale]
        if scaled:
            best = min(scaled, key=lambda pair: pair.any_scale_score)
            reason = f"{_list_groups([best.torque])} is {_ratio_text(best)} the model's torque: in "
            reason += "another unit (such as 0.001 * TITLE), or motor current "
            return self._open_line("torque", f"{reason}(--torque-constants)")
        reason = "no columns follow the model's torque"
        groups = self.candidates.groups("torque")
        if groups:
            reason += f", of {_list_groups(groups)}"
        return self._open_line("torque", reason)

    def _guess_command(self) -> DraftLine:
        """Return the line of commanded positions."""
        groups = self.candidates.groups("command")
        named = [g for g in groups if self.candidates.quantities[g[0]] == "command"]
        if len(named) == 1:
            return self._columns_line("command", named[0], "by words in the titles")
        return self._open_line("command", f"one of {_list_groups(groups)}")


def _ratio_text(pair: Candidate) -> str:
    """Return the range of the ratios of torques to the model's at the joints that links load."""
    ratios = pair.fit.of_columns(pair.fit.scale, pair.torque)
    return f"{np.min(ratios):.2g} to {np.max(ratios):.2g} times"


def _list_groups(groups: Iterable[Group]) -> str:
    """Return groups of columns for a comment, at most ``_MOST_LISTED`` of them."""
    texts = []
    for group in groups:
        numbers = join_ranges([f"#{k + 1}" for k in group])
        texts.append(numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})")
    if not texts:
        return "no columns"
    more = " and others" if len(texts) > _MOST_LISTED else ""
    return " or ".join(texts[:_MOST_LISTED]) + more
