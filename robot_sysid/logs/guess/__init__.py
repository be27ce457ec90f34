"""A guess which column of a log is what, where its titles do not say it.

Titles in other languages are translated; what they leave open is guessed from the numbers
(``candidates``). A guess is never used silently: it becomes a draft of a columns file, in
which a line holds ``?`` where two guesses are equally good.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import itemgetter

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.logs.column_draft import BLANK, DraftLine, draft, join_ranges
from robot_sysid.logs.column_map import (
    Column,
    ColumnChoices,
    parse_columns,
    recognise_columns,
)
from robot_sysid.logs.guess.candidates import Candidate, ColumnCandidates, Group
from robot_sysid.logs.guess.physics import read_numbers
from robot_sysid.logs.guess.words import translate
from robot_sysid.logs.table import LogTable
from robot_sysid.logs.text import is_number
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
    recognise = partial(
        recognise_columns,
        robot=robot,
        first_row=table.first_row,
        currents=currents,
        commanded=commanded,
    )
    # Numbers stand in the place of missing titles.
    has_titles = table.titles[:1] != ("#1",)
    english = [translate(text) if has_titles else "" for text in table.titles]
    recognised: dict[str, tuple[Column, ...]] = {}
    for texts in (english, table.titles) if has_titles else ():
        by_title: dict[str, tuple[Column, ...]] = {}
        with contextlib.suppress(InputError):
            recognise(texts, choices=choices, recognised=by_title)
        recognised.update(filter(itemgetter(1), by_title.items()))
    cells = table.first_row or ("0",) * len(table.titles)
    rows = np.empty((0, len(cells)))
    with contextlib.suppress(InputError):
        rows = read_numbers(table, list(map(is_number, cells)))
    titles = list(map(read_title, english))
    odd_units = []
    for index, (text, title) in enumerate(zip(table.titles, titles)):
        if read_title(text).unit != title.unit:
            odd_units.append(index)
    candidates = ColumnCandidates(robot, titles, recognised, choices, rows)
    driven = "command" if commanded else "torque"
    lines = _Guesser(candidates, driven, odd_units).lines()
    guess = draft(table.titles, robot.joint_names, lines)
    if any(line.is_open for line in lines):
        return guess
    try:
        guessed = parse_columns(guess, table.path, robot.joint_names)
        recognise(table.titles, choices=choices.over(guessed))
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
        driven: "torque" or "command".
        odd_units: indices of the columns whose unit only the title in English says.
    """

    candidates: ColumnCandidates
    driven: str
    odd_units: Collection[int]

    def lines(self) -> list[DraftLine]:
        """Return the lines of the draft."""
        pairs = [] if self.driven == "command" else self.candidates.pairs
        clear = [pair for pair in pairs if pair.is_clear]
        best = min(clear, key=lambda pair: pair.score, default=None)
        lines = [self._time_line(), self._position_line(best, clear)]
        if "velocity" in self._recognised:
            lines.append(self._line_of_titles("velocity"))
        elif best and not lines[-1].is_open:
            lines += self._velocity_lines(best)
        if self.driven in self._recognised:
            lines.append(self._line_of_titles(self.driven))
        elif self.driven == "command":
            lines.append(self._command_line())
        elif best:
            lines.append(self._torque_line(best, clear))
        else:
            lines.append(self._open_torque_line())
        units = [*self._angle_units(best), *self._time_units()]
        if units:
            reason = "by the joints' limits, and by the time from row to row"
            lines.append(DraftLine("units", tuple(units), reason))
        return lines

    @property
    def _recognised(self) -> Mapping[str, tuple[Column, ...]]:
        return self.candidates.recognised

    def _blanks(self, quantity: str, reason: str) -> DraftLine:
        """Return a line with a ? for each joint."""
        count = self.candidates.robot.n_joints
        return DraftLine(quantity, (BLANK,) * count, reason)

    def _line_of_titles(self, quantity: str) -> DraftLine:
        """Return the line of a quantity whose columns the titles determine."""
        columns = [column.index for column in self._recognised[quantity]]
        return DraftLine(quantity, self._values(quantity, columns), "by the titles")

    def _values(self, quantity: str, columns: Iterable[int]) -> tuple[str, ...]:
        """Return columns as a columns file names them, with a factor for an odd unit."""
        values = []
        for column in columns:
            number = f"#{column + 1}"
            unit = self.candidates.titles[column].unit
            factor = UNITS[quantity].get(unit, 1.0)
            is_odd = column in self.odd_units and factor != 1.0
            values.append(f"{factor:.9g} * {number}" if is_odd else number)
        return tuple(values)

    def _time_line(self) -> DraftLine:
        """Return the line of the time, or of the rate where no column may be the time."""
        if "time" in self._recognised:
            return self._line_of_titles("time")
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

    def _time_units(self) -> Iterator[str]:
        """Yield the unit of the time where it is not s and nothing states it."""
        clocks = self.candidates.clocks
        if len(clocks) == 1 and not self.candidates.choices.time_unit:
            is_stated = self.candidates.titles[clocks[0].column].unit
            if clocks[0].unit != "s" and not is_stated:
                yield clocks[0].unit

    def _angle_units(self, best: Candidate | None) -> Iterator[str]:
        """Yield "deg" where positions are in degrees and nothing states it.

        ``best``: the candidate with the best score; None where none is clear.
        """
        units = [best.unit] if best else []
        if not best and "position" in self._recognised:
            (position,) = self.candidates.groups("position")
            units = list(self.candidates.units_of(position))
        if units == ["deg"] and not self.candidates.choices.angle_unit:
            yield "deg"

    def _position_line(
        self, best: Candidate | None, clear: Sequence[Candidate]
    ) -> DraftLine:
        """Return the line of the positions.

        Args:
            best: the candidate with the best score; None where none is clear.
            clear: the candidates whose torques follow the model's.
        """
        if "position" in self._recognised:
            return self._line_of_titles("position")
        if best is None:
            return self._open_position_line()
        groups = {best.position: None}
        units = {best.unit: None}
        for pair in clear:
            if pair.score < best.score + _RIVAL:
                groups[pair.position] = None
                units[pair.unit] = None
        for group in self.candidates.groups("position"):
            if self.candidates.are_twins(group, best.position):
                groups[group] = None
        listed = _list_groups(groups)
        if len(groups) > 1:
            lag = self._lag_text(*list(groups)[:2])
            return self._blanks("position", f"equally good: {listed}; {lag}")
        if len(units) > 1:
            return self._blanks("position", f"in rad or in deg: {listed}")
        values = self._values("position", best.position)
        reason = "within the joints' limits; the torque is the model's for this motion"
        return DraftLine("position", values, reason)

    def _open_position_line(self) -> DraftLine:
        """Return the line of the positions where no torque confirms any."""
        possible = []
        for group in self.candidates.groups("position"):
            if len(self.candidates.rows) and self.candidates.units_of(group):
                possible.append(group)
        reason = "no run of columns stays within the joints' limits"
        if possible:
            reason = f"no torque confirms one of {_list_groups(possible)}"
        return self._blanks("position", reason)

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

    def _velocity_lines(self, best: Candidate) -> Iterator[DraftLine]:
        """Yield the line of the velocities, none where the log has none or several."""
        groups = self.candidates.velocity_groups(best)
        if len(groups) == 1:
            values = self._values("velocity", groups[0])
            yield DraftLine("velocity", values, "the derivatives of the positions")

    def _torque_line(self, best: Candidate, clear: Sequence[Candidate]) -> DraftLine:
        """Return the line of torques that follow the model's.

        Args:
            best: the candidate with the best score.
            clear: all candidates whose torques follow the model's.
        """
        groups = {best.torque: None}
        for pair in clear:
            is_apart = not set(pair.torque) & set(best.torque)
            is_rival = is_apart or pair.score < best.score + _RIVAL
            if pair.position == best.position and is_rival:
                groups[pair.torque] = None
        if len(groups) > 1:
            reason = f"each is the model's torque: {_list_groups(groups)}; one may be "
            return self._blanks("torque", f"{reason}a command, or computed")
        joint_names = self.candidates.robot.joint_names
        values = list(self._values("torque", best.torque))
        doubts = []
        for joint, alternative in best.torque_faults.items():
            doubts.append(f"{joint_names[joint]}: {values[joint]} or {alternative}")
            values[joint] = BLANK
        loaded = [joint_names[j] for j in np.flatnonzero(best.fit.loaded)]
        reason = f"{_ratio_text(best)} the model's torque at {', '.join(loaded)}"
        return DraftLine("torque", tuple(values), "; ".join([reason, *doubts]))

    def _open_torque_line(self) -> DraftLine:
        """Return the line of torques where no columns follow the model's."""
        scaled = [pair for pair in self.candidates.pairs if pair.has_other_scale]
        if scaled:
            best = min(scaled, key=lambda pair: pair.any_scale_score)
            reason = f"{_list_groups([best.torque])} is {_ratio_text(best)} the model's torque: in "
            reason += "another unit (such as 0.001 * TITLE), or motor current "
            return self._blanks("torque", f"{reason}(--torque-constants)")
        reason = "no columns follow the model's torque"
        groups = self.candidates.groups("torque")
        if groups:
            reason += f", of {_list_groups(groups)}"
        return self._blanks("torque", reason)

    def _command_line(self) -> DraftLine:
        """Return the line of commanded positions."""
        groups = self.candidates.groups("command")
        named = [g for g in groups if self.candidates.quantities[g[0]] == "command"]
        if len(named) == 1:
            values = self._values("command", named[0])
            return DraftLine("command", values, "by words in the titles")
        return self._blanks("command", f"one of {_list_groups(groups)}")


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
