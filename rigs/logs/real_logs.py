"""Logs of real arms, as they lie in a folder beside the checkout, and parts of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot_sysid.records import Array, Recording

AIRBOT_RATE = 100.0
"""Rate of the logs of that arm, which have no time [Hz]."""
JUDGED_BELOW = 5.0
"""Frequency below which a file is judged on a log [Hz]."""
MIDDLE_OF_30_HZ = 3.0
"""The same of a log of 30 samples a second [Hz]."""


def read_table(path: Path) -> tuple[tuple[str, ...], Array]:
    """Return the titles and the numbers (N, columns) of a CSV file."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    titles = table.dtype.names or ()
    return titles, np.stack([table[title] for title in titles], axis=1)


def numbered(titles: tuple[str, ...], start: str) -> list[int]:
    """Return the places of titles that are a start and a number."""
    return [
        place
        for place, title in enumerate(titles)
        if title.startswith(start) and title[len(start) :].isdigit()
    ]


def read_one_file(path: Path) -> Recording:
    """Return the log of a file with the columns time, q1..qn and tau1..taun."""
    titles, rows = read_table(path)
    time = rows[:, titles.index("time")]
    q = rows[:, numbered(titles, "q")]
    tau = rows[:, numbered(titles, "tau")]
    return Recording(time, q, None, tau)


def read_airbot(folder: Path) -> Recording:
    """Return a log whose positions are in one file and whose torques are in another one."""
    _, q = read_table(folder / "q_chirp_empty.csv")
    _, tau = read_table(folder / "tau_chirp_empty.csv")
    count = min(len(q), len(tau))
    return Recording(np.arange(count) / AIRBOT_RATE, q[:count], None, tau[:count])


@dataclass(frozen=True)
class RealLog:
    """A log of a real arm.

    Attributes:
        name: of the log.
        model: file of the arm's model, in the folder of all logs.
        path: file or folder of the log, in the same folder.
        read: returns the log of its path.
        options: with which commands read the model.
        cut: frequency below which a file is judged on it [Hz].
    """

    name: str
    model: str
    path: str
    read: Callable[[Path], Recording] = read_one_file
    options: tuple[str, ...] = ()
    cut: float = JUDGED_BELOW


KUKA = "kuka_lwr4/kuka_lwr4.urdf"
UR10E = "ur10e_payload/ur10e.urdf"
AIRBOT = "published/airbot"
AR5 = "published/ar5"
GEN3 = "kinova_gen3"
LOGS = (
    RealLog("kuka1", KUKA, "kuka_lwr4/lwr4_hw1_200Hz.csv"),
    RealLog("kuka2", KUKA, "kuka_lwr4/lwr4_hw2_200Hz.csv"),
    RealLog("kuka3", KUKA, "kuka_lwr4/lwr4_hw3_200Hz.csv"),
    RealLog("ur10e", UR10E, "ur10e_payload/empty_100Hz.csv"),
    RealLog("ur10e_loaded", UR10E, "ur10e_payload/loaded_2p805kg_100Hz.csv"),
    RealLog("tx40", "tx40/tx40.urdf", "tx40/tx40_500Hz.csv"),
    RealLog("airbot", f"{AIRBOT}/airbot.urdf", AIRBOT, read_airbot),
    RealLog(
        "ar5",
        f"{AR5}/ar5.urdf",
        f"{AR5}/real.csv",
        options=("--gravity", "1", "0", "0"),
    ),
    RealLog("med7", "med7/med7.urdf", "med7/med7_100Hz.csv"),
    RealLog("gen3", f"{GEN3}/gen3.urdf", f"{GEN3}/gen3_1kHz.csv"),
    RealLog(
        "panda",
        "panda_30hz/panda.urdf",
        "panda_30hz/panda_30Hz.csv",
        cut=MIDDLE_OF_30_HZ,
    ),
)
"""Logs of real arms that are right."""
NAMES = tuple(log.name for log in LOGS)


def part_of(log: Recording, first: float, last: float) -> Recording:
    """Return the part of a log between two shares of its rows."""
    count = len(log)
    return log[int(first * count) : int(last * count)]


def write_real_log(path: Path, log: Recording) -> Path:
    """Write a log as CSV with the columns time, q1..qn and tau1..taun; return its path."""
    joints = range(1, log.q.shape[1] + 1)
    titles = ["time", *(f"q{j}" for j in joints), *(f"tau{j}" for j in joints)]
    rows = np.concatenate([log.time[:, None], log.q, log.tau], axis=1)
    np.savetxt(path, rows, "%.8g", ",", header=",".join(titles), comments="")
    return path
