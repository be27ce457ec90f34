"""The line of ``--columns`` that titles and numbers of a log suggest, where titles do not say it.

It is the match of ``matching`` below certainty: columns alike, as many as the arm has joints, are a
group; in a log without titles, as many columns that follow each other. Words of its title say what
a group is, and so do numbers: velocities are the derivative of positions, positions keep the
joints' ranges, torques follow the arm's weight. Where both are silent, or contradict each other,
the line has a "?", which is refused until it is filled in.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, permutations

import numpy as np

from robot_sysid.dynamics.inverse_dynamics import ArmDynamics
from robot_sysid.logs.column_map import NO_TORQUE, ColumnFinder
from robot_sysid.logs.declarations import column_text
from robot_sysid.logs.joint_names import are_opposite_sides, split_name
from robot_sysid.logs.matching import (
    Match,
    is_certain,
    match_alike,
    match_of_title,
    match_with_spare,
)
from robot_sysid.logs.table import LARGEST_NUMBER, LogTable
from robot_sysid.logs.titles import TIME_UNITS, UNITS
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import count_text
from robot_sysid.signals.filters import integrate
from robot_sysid.signals.sign_bits import decode_signs
from robot_sysid.signals.stamps import is_sampled_motion

BLANK = "?"
"""What stands for a column or a unit that could not be told."""
FILLINGS: Mapping[str, str] = {
    "time": "the column of the time",
    "rate": "rows per second",
    "position": "the listed columns that are positions",
    "torque": "the listed columns that are torques",
    "command": "the listed columns that are commanded positions",
    "units": "their unit, such as deg, or 4096/rev of counts; of the time, such as ms",
}
"""Key of a line to what a person puts into its blank."""
LOWEST_RATE = 10.0
HIGHEST_RATE = 5000.0
"""Sampling rates between which logs of arms lie [Hz]: units of time differ by 1000, so that one of
them at most makes such a rate."""
STEADY_SHARE = 0.99
"""Share of the steps in which a clock increases: recordings may follow each other in a log."""
MOST_UNEVEN = 10.0
"""Ratio of long to short steps (of 90 and 10 % of them) above which no clock was read."""
MOVING_SHARE = 0.01
"""Share of the squared motion of the joint that moves most from which on a joint moves."""
DERIVATIVE_CORRELATION = 0.9
"""Correlation above which columns are the derivative of others; noise takes little from it, as
changes over 20 rows are compared."""
RATIO_TOLERANCE = 0.1
"""Share by which the ratio of a derivative to its columns may differ from one, and between joints;
another unit changes it by a factor of six at least."""
WEIGHT_CORRELATION = 0.8
CHANGE_CORRELATION = 0.5
"""Correlations with the arm's weight above which columns are its torques, and so are their changes,
which friction is a larger part of."""
MOST_DELAY = 200
"""Rows by which measured positions may be later than commanded ones, at most a tenth of a log."""
ALIKE_SHARE = 0.1
"""Share of a motion by which measured positions deviate from commanded ones of that time, at most:
servos sag, and lag behind."""
DECISIVE_RATIO = 2.0
"""Ratio of deviations, or of noise, from which on one of two positions is earlier, or smoother."""
MOST_MOTIONS = 24
"""Groups among which derivatives are looked for; more are no log of one arm's joints."""
MOST_LISTED = 24
"""Groups, and further columns, that a message lists."""
DYNAMICS_CORRELATION = 0.8
"""Correlation with the torque that the model needs, averaged over joints by what they carry, above
which torques tell positions: most arms have more with positions, and none has with velocities,
accelerations, temperatures or other torques in their place."""
SMOOTHED_TIME = 0.1
"""Window that smooths positions before they are differentiated [s]."""
# Cells of a first row that are numbers, times or empty, or nearly so.
_NUMBER = re.compile(r"[-+\d.,:TZeE ]*|[-+]?(nan|inf)|null|none|n/?a", re.IGNORECASE)
# Excess over a joint's range that a zero elsewhere may make (chosen).
_MARGIN = 1.2
# Units of angles that a log may have in place of radians, the likelier one first.
_ANGLES = ("deg", "cdeg")


@dataclass(frozen=True)
class Suggestion:
    """A line of declarations that a log lacks, as far as it is known.

    Attributes:
        entries: key to value of the line; units are those below, at the place of those given here.
        units: of the line.
        reasons: sentences on columns, and on what their numbers told.
        further: options that it needs beside.
        command: the only command that has these; "" where every one has them.
    """

    entries: Mapping[str, str]
    units: tuple[str, ...]
    reasons: tuple[str, ...]
    further: tuple[str, ...] = ()
    command: str = ""

    def declare(self, key: str, value: str, *reasons: str) -> Suggestion:
        """Return the suggestion with an entry more, and sentences on it."""
        entries = {**self.entries, key: value}
        return replace(self, entries=entries, reasons=self.reasons + reasons)

    def measure(self, *units: str) -> Suggestion:
        """Return the suggestion with units more."""
        return replace(self, units=self.units + units)

    def explain(self, *reasons: str) -> Suggestion:
        """Return the suggestion with sentences more."""
        return replace(self, reasons=self.reasons + reasons)

    @property
    def _all_entries(self) -> Mapping[str, str]:
        """Key to value of the line."""
        units = {"units": ", ".join(self.units)} if self.units else {}
        return {**self.entries, **units}

    @property
    def line(self) -> str:
        """The declarations as ``--columns`` takes them."""
        entries = self._all_entries.items()
        return ", ".join(f"{key} = {value}" for key, value in entries)

    @property
    def unit_words(self) -> tuple[str, ...]:
        """The units as an option; () where there are none, or one could not be told."""
        is_told = self.units and BLANK not in self.units
        return ("--units", ",".join(self.units)) if is_told else ()

    @property
    def blanks(self) -> list[str]:
        """The keys of which something could not be told."""
        entries = self._all_entries.items()
        return [k for k, value in entries if BLANK in value.replace(",", " ").split()]

    @property
    def fillings(self) -> str:
        """What a person puts into the blanks; a joint's own one is explained by its reason."""
        listed = [f"{key}: {FILLINGS[key]}" for key in self.blanks if key in FILLINGS]
        return f" ({'; '.join(listed)})" if listed else ""


@dataclass(frozen=True)
class Evidence:
    """What a log shows beside certain titles.

    Attributes:
        finder: of the log's columns, with what was declared.
        samples: (N, C) numbers of all columns.
        groups: columns alike, one per joint, from left to right.
    """

    finder: ColumnFinder
    samples: Array
    groups: Sequence[Match]

    def numbers(self, match: Match) -> Array:
        """Return the numbers (N, n) in columns."""
        return self.samples[:, [*match.columns]]

    def unit(self, match: Match) -> str:
        """Return the unit in the title of the first of columns; "" for none."""
        return self.finder.titles[match.columns[0]].unit

    def describe(self, match: Match) -> str:
        """Return columns with the range of their numbers, for a sentence."""
        numbers = self.numbers(match)
        return f"{match.text} ({numbers.min():.4g} to {numbers.max():.4g})"


def find_time(
    evidence: Evidence, suggestion: Suggestion, columns: Collection[int]
) -> tuple[Array, Suggestion]:
    """Return the times (N,) [s], numbers of rows where no column is the time; and the suggestion
    with them.

    Time increases steadily, and a plausible rate tells its unit.

    ``columns``: indices of those that could be it.
    """
    finder = evidence.finder
    samples = evidence.samples
    titles = finder.titles
    seconds = UNITS["time"]
    clock = np.arange(len(samples), dtype=float)
    if finder.choices.rate:
        return clock / finder.choices.rate, suggestion
    indices = [column.index for column in finder.recognise("time")]
    if not indices:
        steady = [k for k in _steady_columns(samples) if k in columns]
        # A column that counts rows is no clock, unless it is called so, or has a unit of time.
        indices = [
            k
            for k in steady
            if titles[k].likely_quantity == "time" or titles[k].unit in seconds
        ]
        steps = np.diff(samples, axis=0)
        indices = indices or [k for k in steady if np.any(steps[:, k] != 1.0)]
        if not indices:
            return find_rate(evidence, suggestion, columns)
        if len(indices) != 1:
            return clock, suggestion.declare("time", BLANK)
        text = column_text(finder.table.titles, indices[0])
        reason = f"{titles[indices[0]].text!r} increases steadily"
        suggestion = suggestion.declare("time", text, reason)
    unit = titles[indices[0]].unit or finder.choices.time_unit
    clock = samples[:, indices[0]] * seconds.get(unit or "s", 1.0)
    if unit or not any(is_sampled_motion(evidence.numbers(m)) for m in evidence.groups):
        # Rows of postures have no rate.
        return clock, suggestion
    unit = plausible_unit(float(np.median(np.diff(clock)))) or BLANK
    if unit != "s":
        suggestion = suggestion.measure(unit)
    return clock * seconds.get(unit, np.nan), suggestion


def plausible_unit(period: float) -> str:
    """Return the unit of time in which steps of such a size make the rate of a log; "" for none.

    Of such rates, one unit at most makes one.
    """
    rates = {unit: 1.0 / (period * UNITS["time"][unit]) for unit in TIME_UNITS}
    units = [u for u, rate in rates.items() if LOWEST_RATE <= rate <= HIGHEST_RATE]
    return units[0] if units else ""


def find_rate(
    evidence: Evidence, suggestion: Suggestion, columns: Collection[int]
) -> tuple[Array, Suggestion]:
    """Return the times (N,) of a log without a column of the time [s], and the suggestion with its
    rate: by a column of the steps of time, where it has one; else numbers of rows.

    ``columns``: indices of those that could be it.
    """
    samples = evidence.samples
    titles = evidence.finder.titles
    clock = np.arange(len(samples), dtype=float)
    steps = [
        k for k in columns if titles[k].is_time_step and np.all(samples[:, k] > 0.0)
    ]
    if len(steps) != 1:
        return clock, suggestion.declare("rate", BLANK)
    title = titles[steps[0]]
    period = float(np.mean(samples[:, steps[0]]))
    unit = title.unit or evidence.finder.choices.time_unit or plausible_unit(period)
    if unit not in UNITS["time"]:
        return clock, suggestion.declare("rate", BLANK)
    period *= UNITS["time"][unit]
    reason = f"{title.text!r} is a step of {1e3 * period:.4g} ms"
    return clock * period, suggestion.declare("rate", f"{1.0 / period:.6g}", reason)


def find_motion(
    evidence: Evidence, suggestion: Suggestion, clock: Array
) -> tuple[Array | None, Suggestion]:
    """Return positions (N, n) in SI units, None where they cannot be told, and the suggestion with
    them, with their units and with velocities.

    Velocities are the derivative of positions by the clock (N,) [s].
    """
    finder = evidence.finder
    candidates = finder.matches("position", evidence.groups)
    if is_certain(candidates):
        columns = finder.recognise("position")
        samples = evidence.samples[:, [column.index for column in columns]]
        zeros = [column.zero for column in columns]
        constants = [column.constant for column in columns]
        factors = [column.factor for column in columns]
        return find_units(finder, suggestion, (samples - zeros) * factors + constants)
    standing = find_standing(finder)
    if standing:
        return None, ask_where(finder, suggestion, standing)
    suggestion = suggestion.declare("position", BLANK)
    motions = [
        m for m in evidence.groups if m.quantity in (None, "position", "velocity")
    ][:MOST_MOTIONS]
    # Columns and their derivatives to the ratio of these.
    ratios = {}
    for match, other in permutations(motions, 2):
        numbers = evidence.numbers(match)
        ratio = _derivative_ratio(numbers, evidence.numbers(other), clock)
        if ratio:
            ratios[match.text, other.text] = ratio
    derived = {text for _, text in ratios}
    if not candidates:
        integrals = {text for text, _ in ratios} - derived
        candidates = [m for m in motions if m.text in integrals]
    if not candidates:
        free = [m for m in motions if m.quantity is None and m.text not in derived]
        candidates, suggestion = find_moved(evidence, suggestion, free, clock)
    if len(candidates) == 2:
        candidates, suggestion = find_measured(evidence, suggestion, candidates)
    if len(candidates) != 1:
        return None, suggestion
    position = candidates[0]
    if position.text in derived:
        reason = f"{position.text} are the derivative of other columns"
        return None, suggestion.explain(reason)
    suggestion = suggestion.declare("position", position.text)
    for match in motions:
        ratio = ratios.get((position.text, match.text), 0.0)
        condition = ""
        if suggestion.entries.get("rate") == BLANK and (
            LOWEST_RATE <= ratio <= HIGHEST_RATE
        ):
            suggestion = suggestion.declare("rate", f"{float(f'{ratio:.3g}'):g}")
            condition = " at that rate, if both are in one unit"
            ratio = 1.0
        unit = evidence.unit(match)
        if abs(ratio - 1.0) < RATIO_TOLERANCE and (
            not unit or unit in UNITS["velocity"]
        ):
            reason = f"{match.text} are the derivative of {position.text}{condition}"
            suggestion = suggestion.declare("velocity", match.text, reason)
    samples = evidence.numbers(position)
    stated = evidence.unit(position)
    if stated:
        return samples * UNITS["position"].get(stated, 1.0), suggestion
    return find_units(finder, suggestion, samples)


def find_standing(finder: ColumnFinder) -> str:
    """Return the one joint without which the titles name a position of each; "" for none."""
    names = finder.robot.joint_names
    complete = [
        name
        for name in names
        if finder.declaring(f"position.{name}", "0").recognise("position")
    ]
    return complete[0] if len(complete) == 1 and len(names) > 2 else ""


def ask_where(finder: ColumnFinder, suggestion: Suggestion, joint: str) -> Suggestion:
    """Return the suggestion with the one column that is left over for a joint, or else with a blank
    for where it stood still.
    """
    left = left_over(finder, joint)
    if left:
        at = finder.robot.joint_names.index(joint)
        listed = " and ".join(texts[at] for texts in left.values())
        for quantity, texts in left.items():
            suggestion = suggestion.declare(quantity, ", ".join(texts))
        return suggestion.explain(f"{listed} are left over, for {joint}")
    reason = f"if {joint} stood still, and has no column, state where"
    suggestion = suggestion.declare(f"position.{joint}", BLANK, reason)
    at_rest = finder.declaring(f"position.{joint}", "0")
    without_torque = at_rest.declaring(f"torque.{joint}", "none")
    if not at_rest.recognise("torque") and without_torque.recognise("torque"):
        suggestion = suggestion.declare(f"torque.{joint}", "none")
    return suggestion


def left_over(finder: ColumnFinder, joint: str) -> dict[str, list[str]]:
    """Return position and torque to their columns, base first, where one of each is left over for a
    joint, whose name in the log may be another one; {} elsewhere.
    """
    names = finder.robot.joint_names
    others = finder.declaring(f"position.{joint}", "0")
    others = others.declaring(f"torque.{joint}", "none")
    texts = finder.table.titles
    found: dict[str, list[str]] = {}
    for quantity in ("position", "torque"):
        used = [column.index for column in others.recognise(quantity)]
        free = [
            index
            for index, title in enumerate(finder.titles)
            if title.quantity_beside_name == quantity and index not in used
        ]
        if not used or len(free) != 1:
            return {}
        used[names.index(joint)] = free[0]
        found[quantity] = [column_text(texts, index) for index in used]
    return found


def find_measured(
    evidence: Evidence, suggestion: Suggestion, candidates: list[Match]
) -> tuple[list[Match], Suggestion]:
    """Return the one of two positions that was measured, or both; and the suggestion with how it
    was told.

    The commanded ones come earlier, or are smoother; where these contradict each other, or neither
    is so, nothing is told.
    """
    first, second = map(evidence.numbers, candidates)
    squares = np.sum(np.diff(first, axis=0) ** 2, axis=0)
    moving = squares > MOVING_SHARE * np.max(squares)
    first = first[:, moving] - np.mean(first[:, moving], axis=0)
    second = second[:, moving] - np.mean(second[:, moving], axis=0)
    most = min(MOST_DELAY, len(first) // 10)
    inner = first[most : len(first) - most]
    # By how much the second ones deviate if they are later by each number of rows.
    deviations = [
        np.linalg.norm(inner - second[k : k + len(inner)]) for k in range(2 * most + 1)
    ]
    least = min(deviations)
    delay = deviations.index(least) - most
    if not least < ALIKE_SHARE * np.linalg.norm(inner):
        return candidates, suggestion
    # Fifth differences of a motion are small beside those of noise.
    noises = [np.linalg.norm(np.diff(q, 5, axis=0)) for q in (first, second)]
    is_earlier = least * DECISIVE_RATIO < deviations[most]
    # Positive where the first of the two is the commanded one.
    order = int(np.sign(delay)) if is_earlier else 0
    smoothness = 0
    if max(noises) > DECISIVE_RATIO * min(noises):
        smoothness = int(np.sign(noises[1] - noises[0]))
    if order * smoothness < 0 or not (order or smoothness):
        return candidates, suggestion
    commanded, measured = candidates
    if order + smoothness < 0:
        commanded, measured = measured, commanded
    how = f"{count_text(abs(delay), 'row')} earlier" if order else "smoother"
    reason = f"{commanded.text} are the commanded positions of {measured.text}, as they are {how}"
    return [measured], suggestion.explain(reason)


def find_moved(
    evidence: Evidence, suggestion: Suggestion, motions: Sequence[Match], clock: Array
) -> tuple[list[Match], Suggestion]:
    """Return the groups of which the log's torques move the model if they are positions, and the
    suggestion with how they were told.

    Args:
        evidence: what the log shows.
        suggestion: as far as it is known.
        motions: groups that no title and no derivative tells.
        clock: (N,) times [s].
    """
    finder = evidence.finder
    groups = evidence.groups
    torques = [m for m in groups if m.quantity in ("torque", "current")]
    loads = [*map(evidence.numbers, torques)]
    certain = finder.recognise("torque")
    if certain:
        loads = [evidence.samples[:, [column.index for column in certain]]]
    moved = []
    for match in motions:
        unit = evidence.unit(match)
        if unit and unit not in UNITS["position"]:
            continue
        q, _ = find_units(finder, suggestion, evidence.numbers(match))
        if q is None:
            continue
        if any(_moves_model(finder.robot, q, tau, clock) for tau in loads):
            moved.append(match)
    if len(moved) == 1:
        reason = f"torques are those that move the model by {moved[0].text}"
        suggestion = suggestion.explain(reason)
    return moved, suggestion


def find_units(
    finder: ColumnFinder, suggestion: Suggestion, q: Array
) -> tuple[Array | None, Suggestion]:
    """Return positions (N, n) in SI units, and the suggestion with the units in which they keep the
    joints' ranges; None where there are no such units.
    """
    robot = finder.robot
    choices = finder.choices
    values = UNITS["position"]
    reach = np.maximum(np.abs(robot.limits.lower), np.abs(robot.limits.upper))
    # More than an arm's joints have.
    reach[np.isinf(reach) & ~robot.is_slide] = 4.0 * np.pi
    for unit in ("rad", *_ANGLES):
        # From zero to a whole turn: what is beyond half of it is on the other side of zero.
        turn = 2.0 * np.pi / values[unit]
        hinges = q[:, ~robot.is_slide]
        most = np.max(hinges, initial=0.0)
        if np.min(hinges, initial=0.0) >= 0.0 and 0.5 * turn < most <= turn:
            q = np.where(~robot.is_slide & (q > 0.5 * turn), q - turn, q)
            break
    excess = np.max(np.abs(q), axis=0) / reach
    # Whole numbers may be the counts of an encoder.
    is_whole = np.all(q == np.round(q))
    for is_kind, declared, units in (
        (~robot.is_slide, choices.angle_unit, _ANGLES),
        (robot.is_slide, choices.length_unit, ("mm",)),
    ):
        largest = np.max(excess[is_kind], initial=0.0)
        if declared or largest <= _MARGIN:
            continue
        fitting = [u for u in units if values[u] * largest <= _MARGIN]
        # Near the range, a zero may be elsewhere.
        if is_whole or not fitting or largest < _MARGIN**3:
            reason = "positions leave the joints' ranges in SI units"
            return None, suggestion.measure(BLANK).explain(reason)
        q = np.where(is_kind, values[fitting[0]] * q, q)
        reason = f"positions keep the joints' ranges in {fitting[0]}"
        suggestion = suggestion.measure(fitting[0]).explain(reason)
    return q, suggestion


def find_driven(
    evidence: Evidence, suggestion: Suggestion, position: Array | None
) -> Suggestion:
    """Return the suggestion with torques, or with commanded positions of servos.

    ``position``: (N, n) in SI units, which tell torques by the arm's weight; None for unknown ones.
    """
    finder = evidence.finder
    driven = finder.driven
    quantities = [driven]
    if driven == "torque":
        quantities += ["current", "commanded"]
    if any(key.partition(".")[0] == driven for key in suggestion.entries):
        return suggestion
    _, without = finder.without_torque
    if without:
        reason = NO_TORQUE.format(joints=", ".join(without))
        for joint in without:
            suggestion = suggestion.declare(f"torque.{joint}", "none")
        return suggestion.explain(reason)
    found = (finder.matches(quantity, evidence.groups) for quantity in quantities)
    candidates = next(filter(None, found), [])
    if is_certain(candidates):
        return suggestion
    if not candidates and driven == "torque" and position is not None:
        taken = suggestion.entries.values()
        for match in evidence.groups:
            is_free = not match.quantity and match.text not in taken
            if is_free and _follows_weight(
                finder.robot, position, evidence.numbers(match)
            ):
                candidates.append(match)
                suggestion = suggestion.explain(f"{match.text} follow the arm's weight")
    quantity = candidates[0].quantity if candidates else None
    if quantity == "current" and driven == "torque":
        suggestion = replace(suggestion, further=("--torque-constants", "1"))
    if quantity == "commanded":
        suggestion = suggestion.explain(
            f"{candidates[0].text} were commanded, not measured: they are the arm's torque "
            "only where motors follow closely and gravity is in them"
        )
    key = "torque" if driven == "current" else driven
    return suggestion.declare(
        key, candidates[0].text if len(candidates) == 1 else BLANK
    )


def shortened(texts: Sequence[str], noun: str) -> list[str]:
    """Return texts, or the first of many and the number of the others."""
    if len(texts) <= MOST_LISTED:
        return [*texts]
    return [*texts[:MOST_LISTED], f"{len(texts) - MOST_LISTED} {noun}"]


def suggest_columns(finder: ColumnFinder) -> Suggestion | None:
    """Return the declarations that a log lacks, behind those that were given; None where no columns
    are a group, and no single joint lacks its own.
    """
    is_of_servos = finder.has_servos
    finder = finder.of_servos if is_of_servos else finder
    samples = _read_samples(finder.table)
    evidence = Evidence(finder, samples, [*_find_groups(finder, samples)])
    groups = evidence.groups
    signed = []
    for group in groups:
        found = decode_signs(evidence.numbers(group))
        if found:
            samples[:, [*group.columns]], way = found
            signed.append(f"{group.text} are numbers as {way}")
    if not (groups or find_standing(finder) or finder.without_torque[1]):
        return None
    titles = finder.table.titles
    grouped = {*chain.from_iterable(group.columns for group in groups)}
    others = [k for k in range(len(titles)) if k not in grouped]
    listed = ", ".join(
        [
            *shortened([*map(evidence.describe, groups)], "more groups"),
            *shortened([titles[k] for k in others], "more columns"),
        ]
    )
    entries = finder.choices.entries
    units = tuple(filter(None, [entries.get("units")]))
    suggestion = Suggestion(entries, units, (f"its columns are {listed}", *signed))
    if is_of_servos:
        suggestion = replace(
            suggestion.explain(
                "no titles name torques, and some name commanded positions, as of servos"
            ),
            further=("--torque-from", "position-error"),
            command="identify",
        )
    clock, suggestion = find_time(evidence, suggestion, others)
    position, suggestion = find_motion(evidence, suggestion, clock)
    suggestion = find_driven(evidence, suggestion, position)
    return require_weight(evidence, suggestion, position)


def require_weight(
    evidence: Evidence, suggestion: Suggestion, position: Array | None
) -> Suggestion:
    """Return the suggestion with blanks for columns that others of a gripper follow, unless the
    torques of those that are taken for the arm's follow its weight.

    ``position``: (N, n) in SI units; None for unknown ones.
    """
    taken = {
        key: match
        for match in evidence.groups
        for key, value in suggestion.entries.items()
        if value == match.text
    }
    with_spare = [key for key, match in taken.items() if match.spare]
    if not with_spare:
        return suggestion
    finder = evidence.finder
    spare = [finder.table.titles[k] for key in with_spare for k in taken[key].spare]
    certain = [column.index for column in finder.recognise("torque")]
    columns = taken["torque"].columns if "torque" in taken else certain
    if position is not None and columns:
        tau = evidence.samples[:, [*columns]]
        if _follows_weight(finder.robot, position, tau):
            reason = (
                f"{', '.join(spare)} are left over, as of a gripper, and torques follow the "
                "arm's weight"
            )
            return suggestion.explain(reason)
    blanks = dict.fromkeys(with_spare, BLANK)
    return replace(suggestion, entries={**suggestion.entries, **blanks})


def _read_samples(table: LogTable) -> Array:
    """Return the numbers (N, C) of the first rows of a log, NaN in a column of text.

    What is missing elsewhere is interpolated.
    """
    first_row = table.first_row or [""] * len(table.titles)
    columns = [k for k, cell in enumerate(first_row) if _NUMBER.fullmatch(cell)]
    # 50 000 rows, or 5 million characters.
    cells = np.ascontiguousarray(table.cells(columns, 5))
    # Rows that are written twice hide what increases steadily.
    texts = cells.view(f"V{max(1, cells.itemsize * cells.shape[1])}")
    _, first = np.unique(texts, return_index=True)
    cells = cells[np.sort(first)]
    rows = np.arange(len(cells))
    samples = np.full((len(cells), len(table.titles)), np.nan)
    for column, numbers in zip(columns, cells.T):
        known = np.flatnonzero(np.isfinite(numbers))
        if len(known):
            samples[:, column] = np.interp(rows, known, numbers[known])
    return samples


def _find_groups(finder: ColumnFinder, samples: Array) -> Iterator[Match]:
    """Yield the groups of columns of numbers, from left to right.

    Columns of the other arm of two are none, nor are constants, which no sensor of a moving arm
    reads at all joints, nor what holds numbers that no sensor reads.
    """
    texts = finder.table.titles
    names = finder.robot.joint_names
    own_pieces = {*chain.from_iterable(map(split_name, names))}
    numbers = np.flatnonzero(np.isfinite(samples).any(axis=0)).tolist()
    if len(names) == 1 or all(text == f"#{k}" for k, text in enumerate(texts, 1)):
        matches = _runs(finder, samples, numbers)
    else:
        matches = chain(
            match_alike(finder.titles, names), match_with_spare(finder.titles, names)
        )
    for match in sorted(matches, key=lambda match: match.columns):
        if not {*match.columns} <= {*numbers}:
            continue
        title = texts[match.columns[0]]
        is_other_arm = are_opposite_sides({*split_name(title)}, own_pieces)
        columns = samples[:, [*match.columns]]
        is_possible = np.abs(columns).max() < LARGEST_NUMBER
        if np.ptp(columns, axis=0).any() and is_possible and not is_other_arm:
            listed = ", ".join(column_text(texts, k) for k in match.columns)
            yield replace(match, text=match.text or listed)


def _runs(
    finder: ColumnFinder, samples: Array, numbers: Sequence[int]
) -> Iterator[Match]:
    """Yield as many columns that follow each other as the arm has joints.

    ``numbers``: indices of the columns of numbers. What is beside full runs of joints is time.
    """
    n_joints = finder.robot.n_joints
    times = _steady_columns(samples)[: len(numbers) % n_joints]
    others = [k for k in numbers if k not in times]
    for run in zip(*[iter(others)] * n_joints):
        is_run = run[-1] - run[0] == n_joints - 1 > 0
        text = f"#{run[0] + 1}..#{run[-1] + 1}" if is_run else ""
        yield match_of_title(finder.titles[run[0]], run, text)


def _steady_columns(samples: Array) -> list[int]:
    """Return the columns (indices) that increase from row to row by steps of about one size."""
    step = np.diff(samples, axis=0)
    if len(step) < 10:
        return []
    low, high = np.percentile(step, (10, 90), axis=0)
    is_rising = np.mean(step > 0.0, axis=0) >= STEADY_SHARE
    is_steady = is_rising & (high < MOST_UNEVEN * low)
    return np.flatnonzero(is_steady).tolist()


def _derivative_ratio(q: Array, qd: Array, clock: Array) -> float | None:
    """Return by what columns (N, n) are to be divided to be the derivative of others by a clock.

    None where they are not, at a joint that moves, or where the joints disagree.
    """
    # In stretches of 20 rows.
    integrals = np.diff(integrate(qd, clock)[1::20], axis=0)
    changes = np.diff(q[1::20], axis=0)
    squares = np.sum(changes**2, axis=0)
    moving = np.flatnonzero(squares > MOVING_SHARE * np.max(squares, initial=0.0))
    products = np.sum(changes * integrals, axis=0)[moving]
    norms = np.sqrt(squares * np.sum(integrals**2, axis=0))[moving]
    if not len(moving) or np.any(products <= DERIVATIVE_CORRELATION * norms):
        return None
    ratios = products / squares[moving]
    ratio = float(np.median(ratios))
    return ratio if np.ptp(ratios) < RATIO_TOLERANCE * ratio else None


def _follows_weight(robot: RobotModel, q: Array, tau: Array) -> bool:
    """Return whether columns (N, n) are nearly the torque that holds the model, or its opposite."""
    rows = np.linspace(0, len(q) - 1, 500).astype(int)
    rest = np.zeros((500, robot.n_joints))
    weight = ArmDynamics(robot).torque(q[rows], rest, rest)
    tau = tau[rows]
    # A constant is no torque: what changes has to agree, too, as far as friction lets it.
    changes = (weight - np.mean(weight, axis=0), tau - np.mean(tau, axis=0))
    return (
        _correlation(weight, tau) > WEIGHT_CORRELATION
        and _correlation(*changes) > CHANGE_CORRELATION
    )


def _moves_model(robot: RobotModel, q: Array, tau: Array, clock: Array) -> bool:
    """Return whether columns (N, n) are nearly the torque that moves the model, or its opposite,
    but for a factor and a constant of each joint.

    ``clock``: (N,) [s].
    """
    from scipy.signal import savgol_filter

    step = float(np.median(np.diff(clock)))
    if not 1.0 / HIGHEST_RATE <= step <= 1.0 / LOWEST_RATE:
        return False
    # A polynomial of third order takes at least five.
    window = max(5, 2 * round(0.5 * SMOOTHED_TIME / step) + 1)
    if len(q) < window:
        return False
    rows = np.linspace(0, len(q) - 1, 500).astype(int)
    smooth = [
        savgol_filter(q, window, 3, deriv=k, delta=step, axis=0)[rows] for k in range(3)
    ]
    expected = ArmDynamics(robot).torque(*smooth)
    changes = expected - np.mean(expected, axis=0)
    found = savgol_filter(tau, window, 3, axis=0)[rows]
    found -= np.mean(found, axis=0)
    correlations = [*map(_correlation, changes.T, found.T)]
    sizes = np.linalg.norm(changes, axis=0)
    return float(np.average(correlations, weights=sizes)) > DYNAMICS_CORRELATION


def _correlation(expected: Array, found: Array) -> float:
    """Return the cosine between arrays, without its sign; zero where one is all zeros."""
    norms = np.linalg.norm(expected) * np.linalg.norm(found)
    return float(np.abs(np.sum(expected * found)) / norms) if norms else 0.0
