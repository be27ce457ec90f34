"""Differences between the halves of real logs, over the standard errors of these differences.

    python -m benchmarks.log_halves

The logs lie in ../shared/data beside the checkout. Each half is fitted with the friction terms,
couplings and priors of its whole log. Printed per log and kind of quantity: the root mean square of
difference over standard error; 1 means that stated errors are right.

Both halves have the same arm and the same priors. With C the covariance of each half, P the
precision of the priors and p - x the error of their means, an estimate is
x + C (Y' W e + P (p - x)), so that the difference of two halves has the error

    noise of the first + noise of the second + (C_1 - C_2) P (p - x).

An error of a prior that affects both halves alike cancels and is left out. Errors by bounds,
filtering and possible bodies count in full, for each half.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from benchmarks.real_logs import EMPTY, KUKA, LOADED, LWR4, TX40, UR10E
from robot_sysid.dynamics.friction import TERMS
from robot_sysid.estimation.answer import Answer
from robot_sysid.estimation.errors import FitErrors, fit_errors
from robot_sysid.estimation.fit import Fit
from robot_sysid.estimation.identify import Piece, answer_link, low_pass_recordings
from robot_sysid.estimation.question import EstimationOptions, Question
from robot_sysid.estimation.unknowns import FRICTION
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_log
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Measurement, RobotModel
from robot_sysid.records.messages import Progress
from tests.support.core_fits import fitter_of
from tests.support.places import DATA

LOGS = (
    *((KUKA, log, start, end) for log, start, end in LWR4),
    (TX40, "tx40/tx40_500Hz.csv", 0.0, 7.66),
    (UR10E, EMPTY, 1.1, 25.3),
    (UR10E, LOADED, 1.1, 25.3),
)
"""Model, log, and the stretch of it in which the arm moves [s]."""
KINDS = ("masses", "first moments", "friction", "rotors")


def stretch(log: Measurement, start: float, end: float) -> Measurement:
    """Return the part of a log between two instants [s]."""
    time = log.time - log.time[0]
    used = (time >= start) & (time < end)
    return Measurement(log.time[used], log.q[used], None, log.tau[used])


def half_fits(robot: RobotModel, log: Measurement) -> Iterator[tuple[Fit, FitErrors]]:
    """Yield the fit of each half of a log, as its whole is fitted, and its errors."""
    answer = answer_of(robot, log)
    signals = answer.fit.columns.datasets[0].signals
    assert signals is not None
    options = EstimationOptions(cutoff=signals.cutoff)
    middle = 0.5 * (log.time[-1] - log.time[0])
    for start, end in ((0.0, middle), (middle, np.inf)):
        datasets, _ = low_pass_recordings(
            robot, [Piece("half", stretch(log, start, end))], options
        )
        fitter = fitter_of(robot, datasets, couplings=answer.fit.columns.couplings)
        fit = fitter.fit(Question(options), answer.fit.choice)
        yield fit, fit_errors(fit)


def answer_of(robot: RobotModel, log: Measurement) -> Answer:
    """Return the answer of a whole log with defaults."""
    options = EstimationOptions()
    datasets, _ = low_pass_recordings(robot, [Piece("log", log)], options)
    return answer_link(robot, datasets, options, Progress(), None)


def difference_errors(
    names: list[str], fits: list[Fit], errors: list[FitErrors], indices: list[Array]
) -> Array:
    """Return standard errors (m,) of the halves' differences; places (m,) of the names in each."""
    squares = np.zeros(len(names))
    for half_errors, at in zip(errors, indices):
        squares += np.diag(half_errors.total.noise)[at]
    priors = {group.cause for fit in fits for group in fit.unknowns.groups}
    for cause in {*errors[0].causes, *errors[1].causes}:
        nothing = np.zeros((0, len(names)))
        one, other = (
            half_errors.causes[cause][:, at] if cause in half_errors.causes else nothing
            for half_errors, at in zip(errors, indices)
        )
        # What is held at its bound in one half alone leaves its prior with other rows.
        if cause in priors and len(one) == len(other):
            squares += np.sum((one - other) ** 2, axis=0)
        else:
            squares += np.sum(one**2, axis=0) + np.sum(other**2, axis=0)
    return np.asarray(np.sqrt(squares))


def kind_of(name: str, links: set[str], nuisances: set[str]) -> str | None:
    """Return which kind of number a parameter is; None where it is of no interest."""
    term = name.partition("[")[0]
    if name in links:
        by_term = {"m": "masses", **dict.fromkeys(("hx", "hy", "hz"), "first moments")}
        return by_term.get(term.partition("(")[0])
    if name in nuisances or term not in TERMS or term == "offset":
        return None
    return "rotors" if term == "armature" else "friction"


def ratios(robot: RobotModel, log: Measurement) -> dict[str, list[float]]:
    """Return kind to differences of a log's halves over their errors."""
    fits, errors = map(list, zip(*half_fits(robot, log)))
    first, second = (fit.unknowns for fit in fits)
    names = [
        name for name in first.estimated_names if name in set(second.estimated_names)
    ]
    indices = [
        np.array([u.estimated_names.index(name) for name in names])
        for u in (first, second)
    ]
    values = [fit.values[fit.unknowns.estimated[at]] for fit, at in zip(fits, indices)]
    stated = difference_errors(names, fits, errors, indices)
    links = {first.names[index] for at, _ in first.bodies.values() for index in at}
    groups = (group for group in first.groups if group.cause == FRICTION)
    nuisances = {name for group in groups for name in group.names}
    table: dict[str, list[float]] = {quantity: [] for quantity in KINDS}
    for name, difference, error in zip(names, values[0] - values[1], stated):
        quantity = kind_of(name, links, nuisances)
        is_visible = all(
            np.isfinite(half_errors.total.standard_errors[at[names.index(name)]])
            for half_errors, at in zip(errors, indices)
        )
        # A number that is a prior's in both halves differs by rounding alone.
        if quantity is not None and is_visible and error > 1e-9:
            table[quantity].append(float(difference / error))
    return table


def main() -> int:
    """Print the table."""
    print(f"{'log':<40}" + "".join(f"{quantity:>16}" for quantity in KINDS))
    every: dict[str, list[float]] = {quantity: [] for quantity in KINDS}
    for model, name, start, end in LOGS:
        robot = load_robot_model(DATA / model)
        path = DATA / name
        log = open_log(
            robot, path, LogOptions(measurements=(path,)), Progress()
        ).samples
        log_ratios = ratios(robot, stretch(log, start, end))
        for quantity in KINDS:
            every[quantity] += log_ratios[quantity]
        print(line(name, log_ratios), flush=True)
    print(line("all", every))
    return 0


def line(name: str, ratios_by_quantity: dict[str, list[float]]) -> str:
    """Return root mean squares and numbers of ratios as a line."""
    cells = (
        f"{np.sqrt(np.mean(np.square(values))):8.2f} of {len(values):<4}"
        if values
        else f"{'-':>8}"
        for values in ratios_by_quantity.values()
    )
    return f"{name:<40}" + "".join(f"{cell:>16}" for cell in cells)


if __name__ == "__main__":
    sys.exit(main())
