"""Torque prediction on logs of real arms by the fit of one log, by cut-off and friction model.

Run from the checkout:  python -m benchmarks.real_logs [DATA]

DATA is the folder that holds ``kuka_lwr4`` and ``tx40``; default: ../shared/data beside the
checkout. Relative error: norm(measured - predicted) / norm(measured), all joints stacked. Published
fits of the same logs are printed beside it. Written files are judged by ``whole_arm``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.whole_arm import KUKA_CUTOFF, described, percent, read
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.identify import Piece, answer_link, filtered, tested
from robot_sysid.parser import load_robot_model
from robot_sysid.records.progress import Progress
from tests.support.places import DATA

KUKA_PAIRS = ((1, 2, "1.82 %"), (2, 1, ""), (1, 3, "13.1 %"), (3, 1, ""))
FRICTION = ("coulomb-viscous-offset", "coulomb-viscous-offset-armature-sqrt", "auto")


def main(data: Path = DATA) -> None:
    """Print both arms' tables."""
    kuka(data / "kuka_lwr4")
    tx40(data / "tx40")


def kuka(folder: Path) -> None:
    """Fit one run, predict another."""
    robot = load_robot_model(folder / "kuka_lwr4.urdf")
    logs = {k: read(robot, folder / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)}
    print("KUKA LWR4+: relative torque error on a run that was not fitted")
    for cutoff in (KUKA_CUTOFF, 8.0):
        options = EstimationOptions(cutoff=cutoff)
        for fitted, other, published in KUKA_PAIRS:
            fit = answer_of(robot, logs[fitted], options).fit
            datasets, _ = filtered(robot, [Piece("", logs[other])], options)
            test = tested(fit, datasets, str(other))
            error = f"{percent(test.relative_error)}, {test.rmse:.3f} N m"
            print(
                f"  run {fitted} -> run {other}: {error}; cut-off {cutoff:.2g} Hz, "
                f"{described(fit)}  {published}"
            )


def tx40(folder: Path) -> None:
    """Each fifth predicted from the others, with several friction models."""
    robot = load_robot_model(folder / "tx40.urdf")
    log = read(robot, folder / "tx40_500Hz.csv")
    print("TX40: published fits reach 5.2 % on the fitted motion, 4.7 to 6.1 % on held-out folds")
    for friction in FRICTION:
        answer = answer_of(robot, log, EstimationOptions(friction_model=friction))
        test = answer.validation
        print(
            f"  {friction}: held-out fifths {test.rmse:.2f} N m ({percent(test.relative_error)}); "
            f"{described(answer.fit)}"
        )


def answer_of(robot, log, options):
    """The answer from one log, without a file."""
    datasets, _ = filtered(robot, [Piece("", log)], options)
    return answer_link(robot, datasets, options, Progress(), None)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
