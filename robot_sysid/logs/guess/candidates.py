"""Columns of a log that may be its time, positions, velocities and torques.

Positions are runs of n columns, one per joint, within the joints' limits; torques are runs that
follow the model's torque of the motion in these positions (``physics``). Titles in English
narrow the choice, wherever they name a quantity or a unit.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np

from robot_sysid.logs.column_map import Column, ColumnChoices
from robot_sysid.logs.guess.physics import (
    Clock,
    TorqueFit,
    average_rows,
    clocks,
    fit_torques,
)
from robot_sysid.logs.titles import DEGREE, UNITS, Title, by_token, token_set
from robot_sysid.records import Array, RobotModel

_CLEAR = 0.45
"""Geometric mean of the misfits of the loaded joints below which columns are the torques."""
_POOR = 0.6
"""Misfit of a loaded joint above which its column is not its torque."""
_LEAST_MISFIT = 1e-3
"""Misfit below which a torque counts as exact."""
_REVERSED = -0.1
"""Direction (``TorqueFit``) below which a torque pushes where friction brakes."""
_EXCHANGED = 0.5
"""Gain of the summed logarithms of two residuals above which two torque columns look exchanged."""
_UNLIMITED = 7.0
"""Largest position of a joint without limits [rad]."""
_SLACK = 0.1
"""Distance by which a position may exceed the joint's limits [rad or m]."""
_LEAST_MOTION = 0.1
"""Least range of the joint that moves most [rad or m]: with less, nothing can be identified."""
_STANDS = 1e-3
"""Range of a position [rad or m] or velocity [rad/s or m/s] of a joint that stands."""
_LARGEST_STRIDE = 8
"""Largest number of columns per joint in a log that lists joint after joint."""
_MOST_GROUPS = 200
"""Number of runs of columns above which positions are not guessed: one would fit by chance."""
_FEWEST_SAMPLES = 20
"""Number of averaged rows below which nothing is compared with the model."""
_OTHER = token_set(
    "temperature temp voltage volt error err std status mode id ext external gravity grav coriolis "
    "model est estimated computed current"
)
"""Words of titles of other quantities, also of such that are computed and not measured."""
_QUANTITY_OF_UNIT = by_token(
    {
        "position": "rad deg degree degrees °",
        "velocity": "radsec rads rads1 degs dps °s rpm",
        "torque": "nm mnm ncm knm",
        "time": "s ms us ns sec",
        "other": "a ma v c °c k w hz rads2",
    }
)
"""Unit in a title to the quantity that it is a unit of."""
Group = tuple[int, ...]
"""Indices of n columns, one per joint, base to terminal."""


@dataclass(frozen=True)
class Candidate:
    """Columns that may be positions and torques.

    Attributes:
        position, torque: the columns.
        unit: "rad" or "deg"; "" where the titles state the unit.
        fit: of all columns as the torques of the motion in these positions.
    """

    position: Group
    torque: Group
    unit: str
    fit: TorqueFit

    @cached_property
    def score(self) -> float:
        """The mean logarithm of the misfits at the joints that links load; the less, the better."""
        return self._mean_logarithm(self.fit.misfit)

    @cached_property
    def any_scale_score(self) -> float:
        """The same with torque scales of any size."""
        return self._mean_logarithm(self.fit.any_scale_misfit)

    def _mean_logarithm(self, misfit: Array) -> float:
        """Return the mean logarithm of a misfit (n, C) at the joints that links load."""
        values = self.fit.of_columns(misfit, self.torque)
        return float(np.mean(np.log(np.maximum(values, _LEAST_MISFIT))))

    @property
    def is_clear(self) -> bool:
        """Whether the torques follow the model's at all joints that links load."""
        # Columns of another quantity fit at few joints by chance, and have signs by chance.
        has_few_faults = 3 * len(self.torque_faults) <= len(self.torque)
        return has_few_faults and self._is_small(self.fit.misfit)

    @property
    def has_other_scale(self) -> bool:
        """Whether the torques would follow the model's if their unit were another one."""
        return self._is_small(self.fit.any_scale_misfit)

    def _is_small(self, misfit: Array) -> bool:
        """Return whether a misfit (n, C) is small at all joints that links load."""
        largest = float(np.max(self.fit.of_columns(misfit, self.torque)))
        return self._mean_logarithm(misfit) <= np.log(_CLEAR) and largest <= _POOR

    @cached_property
    def torque_faults(self) -> dict[int, str]:
        """Joint index to what its torque column could be as well: of another sign, or joint."""
        faults = {}
        joints = np.arange(len(self.torque))
        scale = self.fit.scale[joints, self.torque]
        direction = self.fit.direction[joints, self.torque]
        is_turned = np.where(self.fit.loaded, scale, direction - _REVERSED) < 0.0
        for joint in np.flatnonzero(is_turned).tolist():
            faults[joint] = f"-#{self.torque[joint] + 1}, whose sign is the model's"
        residual = np.log(np.maximum(self.fit.residual[:, self.torque], 1e-12))
        own = np.diag(residual)
        gain = own[:, None] + own - residual - residual.T
        for joint, other in np.argwhere(gain > _EXCHANGED).tolist():
            faults.setdefault(joint, f"#{self.torque[other] + 1}, which fits better")
        return faults


@dataclass(frozen=True)
class ColumnCandidates:
    """The columns of one log that may be its quantities.

    Attributes:
        robot: the arm.
        titles: in English; empty ones where the log has none.
        recognised: quantity to the columns that titles determine.
        choices: units that are declared.
        rows: (N, C) numbers of the log's columns, NaN where they are no numbers.
    """

    robot: RobotModel
    titles: Sequence[Title]
    recognised: Mapping[str, tuple[Column, ...]]
    choices: ColumnChoices
    rows: Array

    @cached_property
    def quantities(self) -> list[str]:
        """The quantity that each title may stand for, see ``quantity_of``."""
        return list(map(quantity_of, self.titles))

    @cached_property
    def clocks(self) -> list[Clock]:
        """The columns that may be the time."""
        candidates = clocks(self.rows)
        names = self.quantities
        if "time" in self.recognised:
            (time,) = self.recognised["time"]
            candidates = [c for c in candidates if c.column == time.index]
        else:
            candidates = [c for c in candidates if names[c.column] in ("", "time")]
        named = [c for c in candidates if names[c.column] == "time"]
        uneven = [c for c in candidates if not c.counts]
        return named or uneven or candidates

    @cached_property
    def samples(self) -> tuple[Array, float | None]:
        """The averaged rows (N, C), and the time between two of them [s], None if not known."""
        if self.clocks:
            return average_rows(self.rows, self.clocks[0].period)
        # Without a time, a usual rate; only gravity is looked at then.
        samples, _ = average_rows(self.rows, 0.01)
        return samples, None

    def groups(self, quantity: str) -> list[Group]:
        """Return the runs of n columns that may hold a quantity of each joint."""
        if quantity in self.recognised:
            return [tuple(column.index for column in self.recognised[quantity])]
        closed = {clock.column for clock in self.clocks}
        closed.update(column.index for column in chain(*self.recognised.values()))
        closed.update(np.flatnonzero(np.isnan(self.rows).any(axis=0)).tolist())
        possible = []
        for k, name in enumerate(self.quantities):
            if k not in closed and name in ("", quantity):
                possible.append(k)
        named = [k for k in possible if self.quantities[k] == quantity]
        n = self.robot.n_joints
        return list(_runs(named if len(named) >= n else possible, self.titles, n))

    @cached_property
    def pairs(self) -> list[Candidate]:
        """Positions and torques that may belong together, the torque in any unit."""
        samples, period = self.samples
        is_chance = len(self.groups("position")) > _MOST_GROUPS
        if is_chance or len(samples) < _FEWEST_SAMPLES:
            return []
        torques = self.groups("torque")
        units = [UNITS["torque"].get(title.unit, 1.0) for title in self.titles]
        pairs = []
        for position, unit, factors in self._moving_positions():
            q = samples[:, position] * factors
            fit = fit_torques(self.robot, q, samples * units, period)
            for torque in torques:
                pair = Candidate(position, torque, unit, fit)
                is_apart = not set(position) & set(torque)
                is_likely = is_apart and (pair.is_clear or pair.has_other_scale)
                if is_likely and not self._is_motion(torque, q):
                    pairs.append(pair)
        return pairs

    def _moving_positions(self) -> Iterator[tuple[Group, str, Array]]:
        """Yield columns that may be positions of a motion, their unit and its factors (n,)."""
        samples, _ = self.samples
        for position in self.groups("position"):
            for unit, factors in self.units_of(position).items():
                ranges = np.ptp(samples[:, position] * factors, axis=0)
                if np.max(ranges) >= _LEAST_MOTION:
                    yield position, unit, factors

    def units_of(self, position: Group) -> dict[str, Array]:
        """Return the units that positions may have, each with its factors (n,) to SI units.

        The unit is "" where the titles state it. Without rows, there are none.
        """
        if not len(self.rows):
            return {}
        stated = [self.titles[k].unit for k in position]
        if any(stated):
            units = UNITS["position"]
            return {"": np.array([units.get(unit, 1.0) for unit in stated])}
        slides = self.robot.is_slide
        factors = {"rad": np.ones(len(slides)), "deg": np.where(slides, 1.0, DEGREE)}
        if self.choices.angle_unit:
            return {self.choices.angle_unit: factors[self.choices.angle_unit]}
        limits = self.robot.limits
        lower = np.nan_to_num(limits.lower, neginf=-_UNLIMITED) - _SLACK
        upper = np.nan_to_num(limits.upper, posinf=_UNLIMITED) + _SLACK
        # Few rows may be faulty.
        lowest, highest = np.quantile(self.rows[:, position], (0.01, 0.99), axis=0)
        possible = {}
        for unit, factor in factors.items():
            if np.all((lowest * factor > lower) & (highest * factor < upper)):
                possible[unit] = factor
        return possible

    def velocity_groups(self, pair: Candidate) -> list[Group]:
        """Return the runs of columns that are the derivatives of a pair's positions."""
        samples, period = self.samples
        if period is None:
            return []
        factors = self.units_of(pair.position)[pair.unit]
        qd = np.gradient(samples[:, pair.position], period, axis=0) * factors
        # Velocities without a unit have that of the positions, if no title states it.
        default = factors if pair.unit else np.ones(len(factors))
        groups = []
        for group in self.groups("velocity"):
            if set(group) & {*pair.position, *pair.torque}:
                continue
            si_factors = []
            for column, factor in zip(group, default.tolist()):
                unit = self.titles[column].unit
                si_factors.append(UNITS["velocity"].get(unit, 0.0) if unit else factor)
            if _follow(samples[:, group] * si_factors, qd, 0.9):
                groups.append(group)
        return groups

    def are_twins(self, first: Group, second: Group) -> bool:
        """Return whether two groups have the same values, as a command and its measurement."""
        samples, _ = self.samples
        return first != second and _follow(samples[:, first], samples[:, second], 0.98)

    def _is_motion(self, columns: Group, q: Array) -> bool:
        """Return whether columns repeat positions q (N, n) [rad] or are their derivatives."""
        samples, period = self.samples
        qd = np.gradient(q, period or 1.0, axis=0)
        values = samples[:, columns]
        for si_values in (values, values * DEGREE):
            if _follow(si_values, q, 0.99) or _follow(si_values, qd, 0.9):
                return True
        return False


def quantity_of(title: Title) -> str:
    """Return the quantity that a title in English may stand for: "" where it does not say it.

    Words that are not known are passed over. "other" is a quantity that is not looked for.
    """
    quantities = title.quantities - {"acceleration"}
    is_acceleration = "acceleration" in title.quantities
    if _OTHER & {*title.tokens} or is_acceleration or len(quantities) > 1:
        return "other"
    if title.is_commanded:
        return "command" if quantities <= {"position"} else "other"
    if quantities == {"time"} and title.numbers and title.unit == "":
        return ""  # t0, t1, ... may be torques
    if quantities:
        return min(quantities)
    return _QUANTITY_OF_UNIT.get(title.unit, "")


def _follow(values: Array, reference: Array, least: float) -> bool:
    """Return whether values (N, n) are those of a reference (N, n), to 10 %, where it moves.

    ``least``: correlation from which on they are.
    """
    is_moving = np.ptp(reference, axis=0) > _STANDS
    a = (values - np.mean(values, axis=0))[:, is_moving]
    b = (reference - np.mean(reference, axis=0))[:, is_moving]
    product = np.sum(a * b, axis=0)
    norms = np.linalg.norm(a, axis=0) * np.linalg.norm(b, axis=0)
    is_equal = np.abs(product / np.sum(b**2, axis=0) - 1.0) <= 0.1
    return bool(np.any(is_moving) and np.all(is_equal & (product >= least * norms)))


def _runs(columns: Sequence[int], titles: Sequence[Title], n: int) -> Iterator[Group]:
    """Yield the runs of n columns: neighbours, or one of every few where joints come in turn.

    Columns whose titles differ in their numbers alone are a list of their own, by these numbers,
    where they are n or more. All columns together are the list where there is no such one.

    Args:
        columns: indices of the columns that may be in a run.
        titles: of all columns.
        n: number of joints.
    """
    by_pattern: dict[str, list[int]] = defaultdict(list)
    for column in columns:
        by_pattern[re.sub(r"\d+", "#", titles[column].text)].append(column)
    lists = []
    for pattern_columns in by_pattern.values():
        if len(pattern_columns) < n:
            continue
        numbers = {column: titles[column].numbers for column in pattern_columns}
        if len(set(numbers.values())) == len(numbers):
            pattern_columns = sorted(pattern_columns, key=numbers.__getitem__)
        lists.append(pattern_columns)
    for run_columns in lists or [list(columns)]:
        count = len(run_columns)
        strides = (count - 1) // (n - 1) if n > 1 else 1
        for stride in range(1, min(strides, _LARGEST_STRIDE) + 1):
            span = (n - 1) * stride
            for start in range(count - span):
                yield tuple(run_columns[start : start + span + 1 : stride])
