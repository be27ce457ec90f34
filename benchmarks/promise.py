"""How well a model file keeps what ``identify`` promises of it on motions that nobody recorded.

Run from the checkout; ``--write`` puts the tables into docs/evidence.md:

    OMP_NUM_THREADS=1 python -m benchmarks.promise [PART...] [--files 100] [--first-seed 0]
        [--rows FILE] [--write]

Parts, all by default:

simulated  arms of public models, drawn as rigs.wrong_arms draws them, with logs of 3 to 60 s: the
           usual motion; that at 0.3 times its speed, or its size; three joints alone; motions all
           over the range. A third has torque sensors with offsets.
real       logs of real arms: a file of one judged on another, or on the end of the same. Its
           promise is that for the motion on which it is judged.
second     a second log of those simulated arms, of the motion that the first result proposes
plan       what ``plan`` promises before there is a log, and the file of a log of its motion

MuJoCo's inverse dynamics judges the file that is named first, and the model as it came, against the
torque of the drawn arm as its sensors read it: on ten motions all over the range, as fast as the
limits or 2 rad/s, others than those that promises are made of. Errors are over the torque, of all
joints together. As in the promise, a joint's mean error is taken out or left in, whichever is
worse.

Every result is a line of FILE; those in it already are not made again. Public models and logs lie
in ../shared beside the checkout.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.answers import bare_model_text, identify_logs, write_log
from benchmarks.real_logs import file_torque
from benchmarks.speed_table import rewrite
from rigs import wrong_arms
from rigs.places import MODELS, ROOT
from rigs.wrong_arms import RATE, WrongArm, draw_arm, noise_samples
from robot_sysid.motion.elsewhere import made_up_motions, within_range
from robot_sysid.motion.trajectories import at_speed
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, RobotModel
from robot_sysid.records.file_access import curved_in, models_in
from robot_sysid.trajectory import generate_excitation_trajectory, random_sinusoids

PAGE = ROOT / "docs" / "evidence.md"
BEGIN = "<!-- promise: python -m benchmarks.promise -->"
END = "<!-- end of promise -->"
ARMS = {
    **wrong_arms.ARMS,
    "panda with its hand": "franka_panda/panda.xml",
    "wxai": "trossen/wxai/wxai_follower.xml",
}
SENSOR_ARMS = ("iiwa14", "panda", "panda with its hand", "fr3")
"""Arms whose torque sensors sit behind the gears."""
DEVIATIONS = {"real": 0.6, "bent": 0.2, "priors": 0.2}
"""Deviation of ``draw_arm`` to its share of the arms."""
DURATIONS = (3.0, 60.0)
"""Of the shortest and of the longest log [s]; their logarithms are uniform."""
SLOWER = 0.3
"""Speed of slow logs, and size of small ones, over the usual."""
OFFSET = 0.04
"""Standard deviation of a torque sensor's offset, over the largest torque of its joint."""
FASTEST = 2.0
"""Highest speed of the motions on which files are judged, where no limit is lower [rad/s]."""
JUDGES = 1000
"""Seed of the motions on which files are judged; promises are made of those of 0."""
SLOWEST = 0.2
"""Least speed of motions that are as slow as a log [rad/s]."""
AFTER = ("after", "at_log_speeds")
"""Names of errors of a file: on fast motions, and on those as slow as its log."""
WITHIN = (0.5, 1.5)
"""Ratios of actual to promised errors between which a promise is kept."""
Row = dict[str, Any]
"""A result, as a line of JSON."""


class Errors(NamedTuple):
    """Errors of a model over the torque, each joint's mean error taken out and left in."""

    out: float
    left_in: float


class Judge:
    """A drawn arm's true torques on motions all over its range, and the errors of models there.

    Args:
        arm: as it is, with what its sensors add to torques and positions.
        speeds: (n,) highest ones of the motions [rad/s]; None for the usual.
    """

    def __init__(self, arm: WrongArm, speeds: Array | None = None) -> None:
        robot = arm.robot
        if speeds is None:
            speeds = highest_speeds(robot)
        motions = [*made_up_motions(robot, speeds, np.random.default_rng(JUDGES))]
        self._robot = robot
        self._motions = motions
        self._torque = np.concatenate([read_torque(arm, motion) for motion in motions])
        self._offset = arm.offset

    def errors(self, model: Path) -> Errors:
        """Return the errors of a model file."""
        files = [file_torque(model, self._robot, motion) for motion in self._motions]
        off = self._torque - np.concatenate(files)
        size = np.linalg.norm(self._torque)
        return Errors(
            float(np.linalg.norm(off - np.mean(off, axis=0)) / size),
            float(np.linalg.norm(off + self._offset) / size),
        )


def highest_speeds(robot: RobotModel) -> Array:
    """Return the highest speeds (n,) of motions all over an arm's range [rad/s]."""
    return np.minimum(robot.limits.velocity, FASTEST)


def read_torque(arm: WrongArm, motion: Motion) -> Array:
    """Return what an arm's torque sensors read (N, n) where its encoders read a motion.

    Their offsets, noise and delay are left out.
    """
    true = replace(motion, q=motion.q - arm.zeros)
    rigid, friction = arm.torques(true)
    return arm.scales * rigid + friction


# ---- simulated logs


def all_over(robot: RobotModel, time: Array, rng: np.random.Generator) -> Motion:
    """Return a motion all over an arm's range at times (N,) [s]."""
    shape = random_sinusoids(robot.n_joints, time, rng)
    return within_range(robot, shape, highest_speeds(robot), rng)


def usual(robot: RobotModel, time: Array, rng: np.random.Generator) -> Motion:
    """Return the motion of an excitation."""
    return generate_excitation_trajectory(robot, rng, time[-1]).evaluate(time)


def slow(robot: RobotModel, time: Array, rng: np.random.Generator) -> Motion:
    """Return that of a shorter excitation, played slowly."""
    plan = generate_excitation_trajectory(robot, rng, SLOWER * time[-1])
    return at_speed(plan, SLOWER).evaluate(time)


def small(robot: RobotModel, time: Array, rng: np.random.Generator) -> Motion:
    """Return that of an excitation of small amplitudes."""
    plan = generate_excitation_trajectory(robot, rng, time[-1])
    return plan.scale_amplitudes(SLOWER).evaluate(time)


def three_joints(robot: RobotModel, time: Array, rng: np.random.Generator) -> Motion:
    """Return that of an excitation in which all joints but three stand still."""
    plan = generate_excitation_trajectory(robot, rng, time[-1])
    moved = np.zeros(robot.n_joints)
    moved[rng.permutation(robot.n_joints)[:3]] = 1.0
    return plan.scale_amplitudes(moved).evaluate(time)


KINDS: dict[str, Callable[[RobotModel, Array, np.random.Generator], Motion]] = {
    "usual": usual,
    "slow": slow,
    "small": small,
    "three joints": three_joints,
    "wide": all_over,
}
"""Kind of a log to its motion. New ones change which seed has which."""


@dataclass(frozen=True)
class Draw:
    """An arm with one log of it, all from a seed.

    Attributes:
        name: of the arm's model.
        arm: as it is.
        noise: (n,) standard deviation of the torque's noise [N m].
        white: whether that noise has no memory.
        about: what the row says of it.
        rng: for the log.
    """

    name: str
    arm: WrongArm
    noise: Array
    white: bool
    about: Row
    rng: np.random.Generator

    @classmethod
    def of(cls, seed: int) -> Draw:
        """Return the arm of a seed; its friction is that of an arm used all over its range."""
        rng = np.random.default_rng([seed, JUDGES])
        name = str(rng.choice([*ARMS]))
        deviation = str(rng.choice([*DEVIATIONS], p=[*DEVIATIONS.values()]))
        duration = float(np.exp(rng.uniform(*np.log(DURATIONS))))
        robot = load_robot_model(MODELS / ARMS[name])
        has_sensors = name in SENSOR_ARMS
        white = bool(rng.integers(2))

        def move(plan: Any, rng: np.random.Generator) -> Motion:
            return all_over(robot, np.arange(0.0, 20.0, 0.1), rng)

        truth = draw_arm(robot, deviation, has_sensors, 12.0, white, seed, move)
        largest = np.max(np.abs(truth.rigid), axis=0)
        has_offsets = bool(rng.random() < 1.0 / 3.0)
        offset = OFFSET * has_offsets * largest * rng.standard_normal(robot.n_joints)
        friction = truth.arm.coulomb / (0.1 if has_sensors else 1.0)
        about = {
            "seed": seed,
            "arm": name,
            "deviation": deviation,
            "kind": [*KINDS][seed % len(KINDS)],
            "duration": duration,
            "has_offsets": has_offsets,
        }
        arm = replace(truth.arm, offset=offset)
        return cls(name, arm, wrong_arms.NOISE * friction, white, about, rng)

    def motion(self) -> Motion:
        """Return the motion of its log."""
        time = np.arange(round(RATE * self.about["duration"])) / RATE
        return KINDS[self.about["kind"]](self.arm.robot, time, self.rng)

    def write_log(self, path: Path, motion: Motion) -> None:
        """Write a log of a motion."""
        noise = self.noise * noise_samples(self.rng, motion.q.shape, self.white)
        write_log(path, self.arm.robot.joint_names, self.arm.log(motion, noise))

    def write_model(self, folder: Path) -> Path:
        """Write the model as the user has it, without shapes; return its path."""
        path = folder / "model.xml"
        path.write_text(bare_model_text(MODELS / ARMS[self.name]))
        return path


def judged(
    folder: Path, model: Path, logs: Sequence[Path], judge: Judge, like_log: Judge
) -> Row:
    """Return what ``identify`` promises of its file, and what judges find.

    Args:
        folder: for the results.
        model: as it came.
        logs: of its arm.
        judge, like_log: on the usual motions, and on those as slow as the logs.
    """
    answer, said = identify_logs(folder, model, logs)
    row: Row = {"before": judge.errors(model), "refused": ""}
    written = [*(folder / "results").glob("*.xml")]
    models = models_in(written)
    if answer is None or not models:
        row["refused"] = said.rpartition("error: ")[2].strip()
        return row
    curved = curved_in(written)
    path = curved or models[0]
    file = answer["file"]["curved"] if curved else answer["file"]
    elsewhere = file.get("elsewhere")
    row.update(
        trusted=answer["valid"]["trustworthy"],
        after=judge.errors(path),
        at_log_speeds=like_log.errors(path),
        held_out=[file[name]["relative_error"] for name in ("before", "after")],
        promised={
            name: elsewhere[name]["relative_error"] for name in ("before", *AFTER)
        }
        if elsewhere
        else None,
        next=elsewhere and elsewhere.get("next"),
    )
    return row


def simulated(seed: int) -> Row:
    """Return what is promised of the file of a seed's log, and how well it keeps that."""
    draw = Draw.of(seed)
    motion = draw.motion()
    highest = highest_speeds(draw.arm.robot)
    fastest = np.clip(np.max(np.abs(motion.qd), axis=0), SLOWEST, highest)
    judges = Judge(draw.arm), Judge(draw.arm, fastest)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.csv"
        draw.write_log(log, motion)
        row = judged(folder, draw.write_model(folder), [log], *judges)
    return {**draw.about, **row}


# ---- tables


def is_kept(ratios: Array) -> Array:
    """Return which ratios of actual to promised errors keep the promise."""
    return (ratios >= WITHIN[0]) & (ratios <= WITHIN[1])


def ratio_cells(pairs: Sequence[tuple[float, float]]) -> str:
    """Return cells of a table on pairs of actual and promised errors."""
    if not pairs:
        return "| | | | "
    ratios = np.array([actual / promised for actual, promised in pairs])
    low, median, high = np.percentile(ratios, (5.0, 50.0, 95.0))
    return (
        f"| {100.0 * np.mean(is_kept(ratios)):.0f} % | {median:.2f} "
        f"| {low:.2f} to {high:.2f} | {np.max(ratios):.2f} "
    )


RATIO_TITLES = f"| {WITHIN[0]} to {WITHIN[1]} | median | 5 to 95 % | largest "


def simulated_table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on simulated logs."""
    groups: dict[str, list[Row]] = {"all": [*rows]}
    for key in ("kind", "deviation"):
        for row in rows:
            groups.setdefault(row[key], []).append(row)
    groups["with offsets"] = [row for row in rows if row["has_offsets"]]
    lines = [f"| Logs | error | files {RATIO_TITLES}|", "| --- " * 7 + "|"]
    for group, members in groups.items():
        promised = [row for row in members if row.get("promised")]
        for name in ("before", *AFTER):
            pairs = [(max(row[name]), row["promised"][name]) for row in promised]
            lines.append(f"| {group} | {name} | {len(pairs)} {ratio_cells(pairs)}|")
        answered = [row for row in members if "after" in row]
        pairs = [(max(row["after"]), row["held_out"][1]) for row in answered]
        title = "after, over the one held out"
        lines.append(f"| {group} | {title} | {len(pairs)} {ratio_cells(pairs)}|")
    return [*lines, "", *unpromised_lines(rows)]


def unpromised_lines(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how many logs have no promise, and how bad the files of such logs are."""
    refused = [row for row in rows if row["refused"]]
    yield f"Refused, without a file: {len(refused)} of {len(rows)} logs."
    others = [row for row in rows if not row["refused"] and not row["promised"]]
    if others:
        before, after = np.transpose(
            [(max(row["before"]), max(row["after"])) for row in others]
        )
        yield (
            f"With a file and without a promise: {len(others)}; their errors are "
            f"{percents(np.median(before), np.median(after))} in the median, at worst "
            f"{percents(before[np.argmax(after)], np.max(after))}."
        )


def percents(before: float, after: float) -> str:
    """Return a pair of fractions in per cent."""
    return f"{100.0 * before:.3g} -> {100.0 * after:.3g} %"


def line_of(row: Row) -> str:
    """Return a line on a simulated result: what is promised, what is so, and their ratio."""
    words = f"{row['seed']:4d} {row['kind']:<13}{row['arm']:<20}{row['deviation']:<7}"
    words += f"{row['duration']:5.1f} s"
    if row["refused"]:
        return f"{words}  refused: {row['refused'][:90]}"
    before, after = max(row["before"]), max(row["after"])
    words += (
        f"  is {percents(before, after)}, held out {100.0 * row['held_out'][1]:.3g} %"
    )
    if row["promised"]:
        promised = row["promised"]
        words += f", promised {percents(promised['before'], promised['after'])}"
        words += f", ratio {after / promised['after']:.2f}"
    return words


class Results:
    """Results by part and key, each a line of a file if there is one.

    Args:
        path: of the file; None for none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path and path.exists() else []
        rows = map(json.loads, lines)
        self._rows = {(row["part"], row["key"]): row for row in rows}

    def of(self, part: str, key: Any, make: Callable[[], Row]) -> Row:
        """Return a result, which is made where the file lacks it."""
        if (part, key) not in self._rows:
            text = json.dumps({"part": part, "key": key, **make()})
            self._rows[part, key] = json.loads(text)
            if self._path:
                with self._path.open("a") as file:
                    file.write(f"{text}\n")
        return self._rows[part, key]


def main() -> int:
    """Print the tables; write them where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", default=["simulated"])
    parser.add_argument("--files", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    results = Results(options.rows)
    rows = []
    for seed in range(options.first_seed, options.first_seed + options.files):
        rows.append(results.of("simulated", seed, lambda seed=seed: simulated(seed)))
        print(line_of(rows[-1]), file=sys.stderr, flush=True)
    lines = simulated_table(rows)
    print("\n".join(lines))
    if options.write:
        rewrite(PAGE, BEGIN, END, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
