"""Torque prediction on logs of real arms, by a model of which only the terminal link is fitted.

Run from the checkout:  python -m tests.benchmarks.real_logs [DATA]

DATA is the folder that holds ``kuka_lwr4`` and ``tx40``; default: ../shared/data beside the
checkout. Relative error: norm(measured - predicted) / norm(measured), all joints stacked. What is
fitted: ten parameters of the terminal link and the friction of every joint; all other links keep
the numbers of the URDF. Published whole-arm fits of the same logs are printed beside it: they fit
all links' base parameters, so they follow the fitted motion more closely.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from robot_sysid.estimation.options import CHOSEN, EstimationOptions
from robot_sysid.identify.fit import fit_measured, validate_on
from robot_sysid.parser import load_robot_model
from robot_sysid.records.progress import Progress
from tests.support.log_files import read_measurements
from tests.support.places import DATA

AUTO = EstimationOptions(friction_model=CHOSEN)
KUKA_PAIRS = ((1, 2, "1.82 % (whole arm)"), (2, 1, ""), (1, 3, "13.1 % (whole arm)"), (3, 1, ""))


def main(data: Path = DATA) -> None:
    """Print both arms' tables."""
    kuka(data / "kuka_lwr4")
    tx40(data / "tx40")


def kuka(folder: Path) -> None:
    """Fit one run, predict another."""
    robot = load_robot_model(folder / "kuka_lwr4.urdf")
    logs = {k: read(robot, folder / f"lwr4_hw{k}_200Hz.csv") for k in (1, 2, 3)}
    print("KUKA LWR4+: relative torque error on a run that was not fitted")
    for cutoff in (None, 8.0):
        options = replace(AUTO, validate=0.0, cutoff=cutoff)
        for fitted, tested, published in KUKA_PAIRS:
            fit = fit_measured(robot, [logs[fitted]], options, Progress())
            test = validate_on(robot, logs[tested], options, fit, str(tested))
            error = f"{100 * test.relative_error:5.2f} %, {test.rmse:.3f} N m"
            how = f"cut-off {fit.cutoff:.2g} Hz, {fit.friction.name}"
            print(f"  run {fitted} -> run {tested}: {error}; {how}  {published}")


def tx40(folder: Path) -> None:
    """Fit the first 80 %, predict the rest, with several friction models."""
    robot = load_robot_model(folder / "tx40.urdf")
    log = read(robot, folder / "tx40_500Hz.csv")
    print(
        "TX40: whole-arm fits reach 5.2 % on the fitted motion and 4.7 to 6.1 % on held-out folds"
    )
    for friction in ("coulomb-viscous-offset", "coulomb-viscous-offset-armature-sqrt", "auto"):
        fit = fit_measured(robot, [log], replace(AUTO, friction_model=friction), Progress())
        estimate, test = fit.estimate, fit.validation
        print(
            f"  {friction}: fitted {estimate.rmse:.2f} N m, last 20 % {test.rmse:.2f} N m "
            f"({100 * test.relative_error:.1f} %); cut-off {fit.cutoff:.3g} Hz, {fit.friction.name}"
        )


def read(robot, path: Path):
    """The whole log."""
    slides = robot.is_slide.tolist()
    return read_measurements(path, robot.joint_names, robot.limits, is_slide=slides).samples


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
