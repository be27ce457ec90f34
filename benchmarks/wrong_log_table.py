"""Wrong logs of arms with known truth: which are found, by the right name, and what slips through.

Run from the checkout, with the public models beside it:

    python -m benchmarks.wrong_log_table table [SEED ...]     kinds of wrong log x 6 arms
    python -m benchmarks.wrong_log_table clean [SEED ...]     right logs of 10 arms
    python -m benchmarks.wrong_log_table models [SEED ...]    and the models they end with

``table`` writes each log as CSV and runs the whole identification on it. A kind is named where the
right check's name stands in what is printed; a log slips through where the run ends with exit code
0, no check has anything to say, and the mass is off by more than 10 % and by more than three of the
errors that are stated. ``clean`` counts right logs that a check refuses or warns of, ``models``
those that end with a model that predicts held-out torques better than the one before.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.wrong_logs import ARMS, KINDS, robot_of
from robot_sysid.config import SysidConfig
from robot_sysid.diagnosis import Level
from robot_sysid.diagnosis.log_checks import check_against_model
from robot_sysid.errors import SysidError
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.pipeline.stages import identify
from robot_sysid.records.messages import Progress
from tests.support.wrong_logs import truth_of

TABLE_ARMS = ("gen3", "panda", "iiwa14", "ur5e", "xarm7", "openarm")
SCALE = ("torque-scale",)
NAMES = {
    **dict.fromkeys(
        ("millinewtonmetres", "other_unit", "motor_side", "amperes"), SCALE
    ),
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
    **dict.fromkeys(("long_time", "drifting_0.05", "drifting_0.1"), ("[clock]",)),
    "late_joint": ("alone lags",),
    "hum": ("hums",),
    **dict.fromkeys(
        ("times_0.85", "times_1.15", "times_1.25"), ("[torque-scale]", "torque scale")
    ),
    "one_joint_in_millinewtonmetres": SCALE,
    "other_arm": ("[model]", "model of another arm"),
}
"""Kind to what names it rightly, any of them."""


class Listener(Progress):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def note(self, *messages: str) -> None:
        self.said += messages


@dataclass(frozen=True)
class Outcome:
    """How a run on one log ended.

    Attributes:
        code: exit code.
        said: all notes.
        error: of the mass, relative.
        stated: by how many stated standard errors that is.
        file: held-out error of the model before and of the written one, of the torque.
    """

    code: int
    said: str
    error: float | None
    stated: float = 0.0
    file: tuple[float, float] = (1.0, 1.0)


def identified(truth, log, folder: Path) -> Outcome:
    """Run the identification on a log, up to what would be written."""
    file = folder / "log.csv"
    write_measurement_csv(file, truth.robot.joint_names, [log])
    listener = Listener()
    try:
        config = SysidConfig.of(truth.robot.path, measurements=(file,))
        result = identify(config, truth.robot, listener).result
    except SysidError as error:
        return Outcome(error.exit_code, " ".join([*listener.said, str(error)]), None)
    mass = result.links[-1].inertial.mass
    sigma = float(result.links[-1].errors[0])
    code = 0 if result.verdict.is_trustworthy else 1
    off = mass - float(truth.theta[0])
    said = " ".join((*listener.said, *result.reasons))
    file = result.file
    errors = 1.0, 1.0
    if file is not None and file.after is not None:
        errors = file.before.relative_error or 0.0, file.after.relative_error or 0.0
    return Outcome(code, said, off / float(truth.theta[0]), abs(off) / sigma, errors)


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
        found = outcome.code != 0 or any(
            f"[{name}]" in outcome.said for name in _names()
        )
        named = any(name in outcome.said for name in NAMES.get(kind, ()))
        off = (
            outcome.code == 0 and outcome.error is not None and abs(outcome.error) > 0.1
        )
        off = off and outcome.stated > 3.0 and (kind == "right" or not found)
        for place, true in enumerate((True, found, named, off)):
            row[place] += true
        if off or (kind != "right" and not named) or (kind == "right" and found):
            error = (
                ""
                if outcome.error is None
                else f" mass {100.0 * outcome.error:+.1f} % ({outcome.stated:.1f} sigma)"
            )
            tail = outcome.said[-160:] if kind == "right" or found else ""
            print(
                f"  {kind}, {arm}, seed {seed}: exit {outcome.code}{error} {tail}",
                flush=True,
            )
    print(f"{'kind':22s} logs found named slipped through")
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
            total = total + 1
            alarms = alarms + bool(serious)
            for line in serious:
                print(f"  {arm}, seed {1000 + seed}: {line}", flush=True)
    print(
        f"{alarms} of {total} right logs draw an alarm: {100.0 * alarms / total:.1f} %"
    )


def models(seeds: Sequence[int]) -> None:
    """Print how many right logs end with a better model, and each that does not."""
    better = 0
    stated = []
    total = 0
    with tempfile.TemporaryDirectory() as folder:
        for arm in ARMS:
            robot = robot_of(arm)
            for seed in seeds:
                truth = truth_of(robot, 1000 + seed)
                outcome = identified(truth, truth.log, Path(folder))
                before, after = outcome.file
                good = outcome.code == 0 and after < before
                better = better + good
                total = total + 1
                stated.append(outcome.stated)
                line = f"{arm}, seed {1000 + seed}: exit {outcome.code}, file {before:.2%} -> "
                tail = "" if good else outcome.said[-160:]
                print(
                    f"  {line}{after:.2%}, mass off {outcome.stated:.1f} sigma {tail}",
                    flush=True,
                )
    rms = (sum(each**2 for each in stated) / total) ** 0.5
    print(
        f"{better} of {total} right logs end with a better model; mass rms over stated {rms:.2f}"
    )


STUDIES = {"clean": (clean, 20), "table": (table, 5), "models": (models, 5)}

if __name__ == "__main__":
    study, usual = STUDIES[sys.argv[1]]
    study([int(word) for word in sys.argv[2:]] or range(1, usual + 1))
