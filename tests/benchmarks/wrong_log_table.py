"""Wrong logs of arms with known truth: which are found, by the right name, and what slips through.

Run from the checkout, with the public models beside it:

    python -m tests.benchmarks.wrong_log_table table [SEED ...]     kinds of wrong log x 6 arms
    python -m tests.benchmarks.wrong_log_table clean [SEED ...]     right logs of 10 arms

``table`` writes each log as CSV and runs the whole identification on it. A kind is named where the
right check's name stands in what is printed; a log slips through where the run ends with exit code
0 and a mass more than 10 % off. ``clean`` counts right logs that a check refuses or warns of.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from robot_sysid.checks.finding import Level
from robot_sysid.checks.run import check_against_model
from robot_sysid.errors import SysidError
from robot_sysid.estimation.options import EstimationOptions
from robot_sysid.identify.measured import identify_logs
from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import write_measurement_csv
from robot_sysid.records.progress import Progress
from tests.support.wrong_logs import ARMS, KINDS, robot_of, truth_of

TABLE_ARMS = ("gen3", "panda", "iiwa14", "ur5e", "xarm7", "openarm")
SCALE = ("torque-scale",)
NAMES = {
    **dict.fromkeys(("millinewtonmetres", "other_unit", "motor_side", "amperes"), SCALE),
    **dict.fromkeys(("per_cent", "times_two_or_more"), SCALE),
    **dict.fromkeys(("gravity_compensated", "external"), ("gravity",)),
    **dict.fromkeys(("torque_sign", "position_sign"), ("sign", "opposite sign")),
    **dict.fromkeys(("exchanged", "reversed_order"), ("order",)),
    "computed": ("computed",),
    "degrees_as_radians": ("angle-unit", "--units deg"),
    "radians_as_degrees": ("angle-unit",),
    "position_offset": ("[zero]",),
    "dropped_samples": ("clock",),
    "milliseconds": ("--units ms",),
    "saturated": ("saturated",),
    "held": ("held",),
    "collision": ("contact",),
    "late_torque": ("delay",),
    "clock_jump": ("clock",),
    "other_arm": ("[model]", "model of another arm"),
}
"""Kind to what names it rightly, any of them."""


class Listener(Progress):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def note(self, message: str) -> None:
        self.said.append(message)


@dataclass(frozen=True)
class Outcome:
    """How a run on one log ended: exit code, what was said, relative error of the mass."""

    code: int
    said: str
    error: float | None


def identified(truth, log, folder: Path) -> Outcome:
    """Run the identification on a log, up to what would be written."""
    file = folder / "log.csv"
    write_measurement_csv(file, truth.robot.joint_names, [log])
    listener, options = Listener(), LogOptions(measurements=(file,))
    try:
        found = identify_logs(truth.robot, options, None, EstimationOptions(), listener)
    except SysidError as error:
        return Outcome(error.exit_code, " ".join([*listener.said, str(error)]), None)
    estimate = found.identification.estimate
    mass, code = estimate.inertial.mass, 0 if estimate.status.is_trustworthy else 1
    return Outcome(code, " ".join(listener.said), mass / float(truth.theta[0]) - 1.0)


def cases(seeds: Sequence[int]) -> Iterator[tuple[str, str, int, Outcome]]:
    """Yield (kind, arm, seed, outcome); "right" for a log with nothing wrong."""
    with tempfile.TemporaryDirectory() as folder:
        for arm in TABLE_ARMS:
            robot = robot_of(arm)
            for seed in seeds:
                for kind in ("right", *KINDS):
                    truth = truth_of(robot, seed)
                    log = KINDS[kind](truth) if kind != "right" else truth.log
                    yield kind, arm, seed, identified(truth, log, Path(folder))


def table(seeds: Sequence[int]) -> None:
    """Print one line per kind, and every log that was not named or slipped through."""
    counts = {kind: [0, 0, 0, 0] for kind in ("right", *KINDS)}
    for kind, arm, seed, outcome in cases(seeds):
        row = counts[kind]
        found = outcome.code != 0 or any(f"[{name}]" in outcome.said for name in _names())
        named = any(name in outcome.said for name in NAMES.get(kind, ()))
        off = outcome.code == 0 and outcome.error is not None and abs(outcome.error) > 0.1
        for place, true in enumerate((True, found, named, off)):
            row[place] += true
        if off or (kind != "right" and not named) or (kind == "right" and found):
            error = "" if outcome.error is None else f" mass {100.0 * outcome.error:+.1f} %"
            tail = outcome.said[-160:] if kind == "right" or found else ""
            print(f"  {kind}, {arm}, seed {seed}: exit {outcome.code}{error} {tail}", flush=True)
    print(f"{'kind':22s} logs found named exit 0 and mass > 10 % off")
    for kind, row in counts.items():
        print(f"{kind:22s} {row[0]:4d} {row[1]:5d} {row[2]:5d} {row[3]:5d}")
    wrong = [row for kind, row in counts.items() if kind != "right"]
    total, named, off = (sum(row[k] for row in wrong) for k in (0, 2, 3))
    print(f"named {100.0 * named / total:.1f} % of {total}; slipped through {off}")


def _names() -> set[str]:
    return {name.strip("[]") for names in NAMES.values() for name in names}


def clean(seeds: Sequence[int]) -> None:
    """Print how many right logs draw a warning or a refusal."""
    alarms = total = 0
    for arm in ARMS:
        robot = robot_of(arm)
        for seed in seeds:
            found = check_against_model(robot, [truth_of(robot, 1000 + seed).log])
            serious = [each.line() for each in found if each.level is not Level.NOTE]
            total, alarms = total + 1, alarms + bool(serious)
            for line in serious:
                print(f"  {arm}, seed {1000 + seed}: {line}", flush=True)
    print(f"{alarms} of {total} right logs draw an alarm: {100.0 * alarms / total:.1f} %")


if __name__ == "__main__":
    study, usual = (clean, 20) if sys.argv[1] == "clean" else (table, 5)
    study([int(word) for word in sys.argv[2:]] or range(1, usual + 1))
