"""How well a model file keeps what ``identify`` promises of it on motions that nobody recorded.

Run from the checkout; ``--write`` puts the tables of these parts into docs/evidence.md:

    OMP_NUM_THREADS=1 python -m benchmarks.trust.promise [PART...] [--files 100] [--first-seed 8000]
        [--rows FILE] [--write]

Parts, all by default:

simulated  arms of public models, drawn as rigs.arms.wrong_arms draws them, with logs of 3 to 60 s:
           the usual motion; that at 0.3 times its speed, or its size; three joints alone; motions
           all over the range. A third has torque sensors with offsets.
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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.accuracy import real_logs
from benchmarks.accuracy.public_arms import AIRBOT, EMPTY, UR10E_MOTION, cut
from benchmarks.accuracy.real_logs import file_torque
from benchmarks.trust.answers import (
    bare_model_text,
    identify_logs,
    run_command,
    write_log,
)
from rigs.arms import wrong_arms
from rigs.arms.wrong_arms import RATE, WrongArm, draw_arm, noise_samples
from rigs.files.page_tables import PageTable
from rigs.files.places import DATA, MODELS, ROOT
from robot_sysid.api.calls import identify, read_log
from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.estimate.terms import DELAY
from robot_sysid.expected.knowledge import knowledge_of
from robot_sysid.expected.motions import grams, made_up_motions, within_range
from robot_sysid.faults.gate import judge as diagnose
from robot_sysid.faults.gate import usable_fit
from robot_sysid.model.compilation import compile_model
from robot_sysid.motion.trajectories import at_speed, load_trajectory
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, Recording, RobotModel
from robot_sysid.records.file_access import curved_file_in, models_in
from robot_sysid.records.levels import LIKE_LOG
from robot_sysid.records.messages import Progress
from robot_sysid.signals.process import FilteredRecording, low_pass_recordings
from robot_sysid.signals.resampling import split_at_gaps
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.trajectory import generate_excitation_trajectory, random_sinusoids

PAGE = ROOT / "docs" / "evidence.md"
TABLES = {
    "simulated": PageTable(
        PAGE, "promise", "python -m benchmarks.trust.promise simulated"
    ),
    "real": PageTable(
        PAGE, "promise_of_real_arms", "python -m benchmarks.trust.promise real"
    ),
    "second": PageTable(
        PAGE, "promise_of_two_logs", "python -m benchmarks.trust.promise second"
    ),
    "plan": PageTable(
        PAGE, "promise_of_plans", "python -m benchmarks.trust.promise plan"
    ),
}
"""Part of the benchmark to its table."""
ARMS = {
    **wrong_arms.ARMS,
    "panda with its hand": "franka_panda/panda.xml",
    "wxai": "trossen/wxai/wxai_follower.xml",
}
SENSOR_ARMS = ("iiwa14", "panda", "panda with its hand", "fr3")
"""Arms whose torque sensors sit behind the gears."""
DEVIATIONS = {"real": 0.45, "bent": 0.15, "priors": 0.15, "straight": 0.25}
"""Deviation of ``draw_arm`` to its share of the arms."""
DURATIONS = (3.0, 60.0)
"""Of the shortest and of the longest log [s]; their logarithms are uniform."""
FRICTIONS = (0.03, 0.3)
"""Least and largest Coulomb friction of a joint over its largest torque; their logarithms are
uniform. Catalogue models of real arms, which mostly lack friction, are 5 to 90 % off in torque."""
SLOWER = 0.3
"""Speed of slow logs, and size of small ones, over the usual."""
SENSOR_OFFSET = 0.02
"""Standard deviation of a torque sensor's offset, over the largest torque of its joint: 1 to 7 % of
all torque, as those of real logs (0.5 to 6.5 %)."""
FASTEST = 2.0
"""Highest speed of the motions on which files are judged, where no limit is lower [rad/s]."""
JUDGES = 1000
"""Seed of the motions on which files are judged; promises are made of those of 0."""
SLOWEST = 0.2
"""Least speed of motions that are as slow as a log [rad/s]."""
AFTER = ("after", "at_log_speeds")
"""Names of errors of a file: on fast motions, and on those as slow as its log."""
OTHER_ERRORS = {
    "before": "all, of the model as it came",
    "at_log_speeds": "all, on motions as slow as the log",
}
"""Names of errors that are promised beside that of the file, to words."""
WITHIN = (0.5, 1.5)
"""Ratios of actual to promised errors between which a promise is kept."""
FIRST_SEED = 8000
"""Of the first arm, drawn after all numbers of the promise were set: these were chosen by the arms
of 3000 to 3099, 5000 to 5099, 6000 to 6099 and 7000 to 7099."""
NARROW = ("slow", "small", "three joints")
"""Kinds of logs to which a second one is added."""
EXTREMES = 4
"""Number of the largest, and of the smallest ratios of which the cause is found."""
FEW = 12
"""Most second logs, and plans: a plan takes as long as ten logs."""
PLANS = ((), ("--speed", "0.3"), ("--duration", "5"))
"""Options of the plans in turn."""
Row = dict[str, Any]
"""A result, as a line of JSON."""


class Errors(NamedTuple):
    """Errors of a model over the torque, each joint's mean error taken out and left in."""

    out: float
    left_in: float


class LogErrors(NamedTuple):
    """Errors of a model on a log over the torque of all joints, of all and of each joint alone.

    The latter are those with each joint's mean error taken out.
    """

    errors: Errors
    of_joints: list[float]


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
        self._arm = arm
        self._robot = robot
        self._motions = motions
        self._torque = np.concatenate([read_torque(arm, motion) for motion in motions])
        self._offset = arm.offset

    def _missing(self, model: Path, motions: Iterable[Motion]) -> Array:
        """Return the torque (N, n) that a model file lacks in motions, but for offsets [N m]."""
        missing = [
            read_torque(self._arm, motion) - file_torque(model, self._robot, motion)
            for motion in motions
        ]
        return np.concatenate(missing)

    def parts(self, model: Path) -> list[tuple[str, float]]:
        """Return what makes a file's error, in words, and the error of each, the largest first.

        Friction changes its sign with the speed, weight is what is left at rest, and inertia the
        rest; each joint's mean error is taken out.
        """
        motions = self._motions
        whole = self._missing(model, motions)
        back = self._missing(model, (replace(m, qd=-m.qd) for m in motions))
        rest = (replace(m, qd=0.0 * m.qd, qdd=0.0 * m.qdd) for m in motions)
        weight = self._missing(model, rest)
        even = (whole + back) / 2.0
        of_kind = {
            "friction": whole - even,
            "weight": weight,
            "inertia and rotor": even - weight,
        }
        size = np.linalg.norm(self._torque)
        parts = []
        for kind, torque in of_kind.items():
            errors = np.linalg.norm(torque - np.mean(torque, axis=0), axis=0) / size
            parts += [
                (f"{kind} at {joint}", float(error))
                for joint, error in zip(self._robot.joint_names, errors)
            ]
        return sorted(parts, key=lambda part: -part[1])

    def errors(self, model: Path) -> Errors:
        """Return the errors of a model file."""
        off = self._missing(model, self._motions)
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

        share = float(np.exp(rng.uniform(*np.log(FRICTIONS))))
        truth = draw_arm(robot, deviation, has_sensors, 12.0, white, seed, move, share)
        largest = np.max(np.abs(truth.rigid), axis=0)
        has_offsets = bool(rng.random() < 1.0 / 3.0)
        offset = (
            SENSOR_OFFSET * has_offsets * largest * rng.standard_normal(robot.n_joints)
        )
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
    folder: Path, model: Path, logs: Sequence[Path], judges: Mapping[str, Judge]
) -> Row:
    """Return what ``identify`` promises of its file, and what judges find.

    Args:
        folder: for the results.
        model: as it came.
        logs: of its arm.
        judges: name of each error of a file in ``AFTER``, to who finds it.
    """
    answer, said = identify_logs(folder, model, logs)
    row: Row = {"before": judges["after"].errors(model), "refused": ""}
    path = written_file(folder)
    if answer is None or path is None:
        row["refused"] = said.rpartition("error: ")[2].strip()
        return row
    file = said_of_file(answer, path)
    elsewhere = file.get("elsewhere")
    for name, judge in judges.items():
        row[name] = judge.errors(path)
    row["trusted"] = answer["valid"]["trustworthy"]
    row["held_out"] = file["after"]["relative_error"]
    row["promised"] = elsewhere and {
        name: elsewhere[name]["relative_error"] for name in ("before", *AFTER)
    }
    row["next"] = elsewhere and elsewhere["next"]
    return row


def written_file(folder: Path) -> Path | None:
    """Return the model file that is named first of the results in a folder; None for none."""
    written = [*(folder / "results").glob("*.xml")]
    return curved_file_in(written) or next(iter(models_in(written)), None)


def said_of_file(answer: Row, path: Path) -> Row:
    """Return what an answer says of a model file."""
    curved: Row | None = answer["file"]["curved"]
    is_curved = curved is not None and curved["name"] == path.name
    return curved if curved is not None and is_curved else answer["file"]


def cause(first: Row) -> Row:
    """Return what made the error of a file of ``simulated``, and what was expected to."""
    draw = Draw.of(first["seed"])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.csv"
        draw.write_log(log, draw.motion())
        answer, _ = identify_logs(folder, draw.write_model(folder), [log])
        path = written_file(folder)
        assert answer is not None and path is not None
        parts = Judge(draw.arm).parts(path)
    file = said_of_file(answer, path)
    elsewhere = file["elsewhere"]
    said = [(part["what"], part["relative_error"]) for part in elsewhere["parts"]]
    return {"is": parts[:2], "expected": said[:2], "still": elsewhere["still"]}


def simulated(seed: int) -> Row:
    """Return what is promised of the file of a seed's log, and how well it keeps that."""
    draw = Draw.of(seed)
    motion = draw.motion()
    highest = highest_speeds(draw.arm.robot)
    fastest = np.clip(np.max(np.abs(motion.qd), axis=0), SLOWEST, highest)
    judges = {"after": Judge(draw.arm), "at_log_speeds": Judge(draw.arm, fastest)}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "log.csv"
        draw.write_log(log, motion)
        row = judged(folder, draw.write_model(folder), [log], judges)
    return {**draw.about, **row}


# ---- planned motions


def write_planned(draw: Draw, folder: Path, model: Path, *words: str) -> Row | None:
    """Write the log ``planned.csv`` of a motion of ``plan``, and return that command's answer.

    It is None where the motion is not written.
    """
    path = folder / "planned.json"
    files = ("--save-trajectory", path, "--output-dir", folder / "planned")
    seed = str(draw.about["seed"])
    _, said, _ = run_command("plan", model, *words, "--seed", seed, *files, "--json")
    if not path.exists():
        return None
    plan = load_trajectory(path).plan
    motion = plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE)
    draw.write_log(folder / "planned.csv", motion)
    return json.loads(said)


def second(first: Row) -> Row:
    """Return what a result of ``simulated`` promises of a second log, and what it is then."""
    draw = Draw.of(first["seed"])
    words = first["next"]["plan"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = draw.write_model(folder)
        log = folder / "log.csv"
        draw.write_log(log, draw.motion())
        if write_planned(draw, folder, model, *words) is None:
            return {**draw.about, "words": words, "refused": "no motion"}
        logs = [log, folder / "planned.csv"]
        row = judged(folder, model, logs, {"after": Judge(draw.arm)})
    proposed = first["next"]["relative_error"]
    return {**draw.about, "words": words, "proposed": proposed, **row}


def planned(seed: int) -> Row:
    """Return what ``plan`` promises of the file of a log of its motion, and what it is then."""
    draw = Draw.of(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = draw.write_model(folder)
        words = PLANS[seed % len(PLANS)]
        answer = write_planned(draw, folder, model, *words)
        if answer is None:
            return {**draw.about, "words": words, "refused": "no motion"}
        logs = [folder / "planned.csv"]
        row = judged(folder, model, logs, {"after": Judge(draw.arm)})
    elsewhere = answer.get("elsewhere")
    planned = elsewhere and (elsewhere["least"], elsewhere["after"])
    return {**draw.about, "words": words, "planned": planned, **row}


# ---- logs of real arms


@dataclass(frozen=True)
class Stretch:
    """A part of a log of a real arm.

    Attributes:
        files: of the log.
        begin, end: of the part, as shares of the motion.
        motion: when the motion begins and ends [s].
    """

    files: tuple[str, ...]
    begin: float = 0.0
    end: float = 1.0
    motion: tuple[float, float] = (0.0, np.inf)

    def of(self, model: Path, options: Mapping[str, Any]) -> Row:
        """Return the samples, by name."""
        paths = [DATA / file for file in self.files]
        reading = {key: options[key] for key in ("columns",) if key in options}
        log = read_log(paths if len(paths) > 1 else paths[0], model, **reading)
        start, stop = self.motion[0], min(self.motion[1], log.time[-1])
        edges = (start + share * (stop - start) for share in (self.begin, self.end))
        return cut(log, *edges)


@dataclass(frozen=True)
class Pair:
    """Two logs of a real arm: one makes a file, the other one judges it.

    Attributes:
        name: of the pair.
        model: of the arm.
        first, other: the logs.
        options: of ``identify``.
        is_loaded: whether the arm carries something in the other log alone, which is fitted there.
    """

    name: str
    model: str
    first: Stretch
    other: Stretch
    options: Mapping[str, Any] = field(default_factory=dict)
    is_loaded: bool = False


def parted(
    name: str,
    model: str,
    *files: str,
    share: float = 0.8,
    motion: tuple[float, float] = (0.0, np.inf),
    **options: Any,
) -> Pair:
    """Return the pair of the first share of a log's motion and the rest."""
    first = Stretch(files, 0.0, share, motion)
    return Pair(name, model, first, replace(first, begin=share, end=1.0), options)


RUNS = [Stretch((f"kuka_lwr4/lwr4_hw{run}_200Hz.csv",)) for run in (1, 2, 3)]
PAIRS = (
    *(
        Pair(f"KUKA LWR4+, run {i + 1} on {j + 1}", real_logs.KUKA, RUNS[i], RUNS[j])
        for i, j in permutations(range(3), 2)
    ),
    Pair(
        "UR10e, empty on loaded, the payload fitted",
        real_logs.UR10E,
        Stretch((real_logs.EMPTY,), motion=UR10E_MOTION),
        Stretch((real_logs.LOADED,), motion=UR10E_MOTION),
        is_loaded=True,
    ),
    parted("UR10e", real_logs.UR10E, real_logs.EMPTY, motion=UR10E_MOTION),
    parted("UR10e, loaded", real_logs.UR10E, real_logs.LOADED, motion=UR10E_MOTION),
    parted("TX40", real_logs.TX40, "tx40/tx40_500Hz.csv", motion=(0.0, 7.66)),
    parted(
        "AIRBOT",
        f"{AIRBOT}/airbot.urdf",
        *EMPTY.split(),
        share=0.7,
        columns="rate = 100",
    ),
    parted(
        "AR5",
        "published/ar5/ar5.urdf",
        "published/ar5/real.csv",
        share=0.7,
        gravity=(1.0, 0.0, 0.0),
    ),
)
"""Those that ``benchmarks.accuracy.public_arms`` has too are parted as there."""


def real(pair: Pair) -> Row:
    """Return what is promised of a file on another log, and how well it keeps that."""
    path = DATA / pair.model
    first = pair.first.of(path, pair.options)
    options = {key: value for key, value in pair.options.items() if key != "columns"}
    result = identify(path, first, **options)
    robot = result.robot
    with tempfile.TemporaryDirectory() as folder:
        models = [p for p in result.save(folder) if p.suffix in (".xml", ".urdf")]
        file = compile_model(curved_file_in(models) or models[0]).mj_model
        other = recording_of(pair.other.of(path, pair.options))
        pieces, _ = low_pass_recordings(robot, split_at_gaps(other), result.cutoff)
        before, after = (
            errors_on(model, robot, pieces, pair.is_loaded)
            for model in (copy(robot.mj_model), file)
        )
    promised = promised_on(robot, recording_of(first), pieces, pair.is_loaded)
    elsewhere = (result.file.curved or result.file).elsewhere
    off = np.square(after.of_joints) - np.square(promised.of_joints)
    worst = int(np.argmax(np.abs(off)))
    return {
        "before": before.errors,
        "after": after.errors,
        "promised": promised.errors,
        "joint": robot.joint_names[worst],
        "of_joint": (after.of_joints[worst], promised.of_joints[worst]),
        "elsewhere": elsewhere and elsewhere.after.relative_error,
    }


def recording_of(samples: Row) -> Recording:
    """Return samples as a log."""
    return Recording(samples["time"], samples["q"], None, samples["tau"])


def errors_on(
    model: Any, robot: RobotModel, pieces: Sequence[FilteredRecording], is_loaded: bool
) -> LogErrors:
    """Return the errors of a model on a log that did not make it.

    Args:
        model: compiled by MuJoCo.
        robot: the arm.
        pieces: of the log.
        is_loaded: whether the arm carries something, which is fitted to this log.
    """
    off, torque, payload, constants, joints = [], [], [], [], []
    for piece in pieces:
        use = piece.is_used
        predicted = piece.filter_columns(partial(file_torque, model, robot))
        columns = piece.filter_columns(partial(flange_columns, robot))
        off.append((piece.torque - predicted)[use])
        torque.append(piece.torque[use])
        payload.append(columns[use] * is_loaded)
        ones = np.broadcast_to(np.eye(robot.n_joints), (*use.shape, robot.n_joints))
        constants.append(ones[use])
        joints.append(np.nonzero(use)[1])
    residual = np.concatenate(off)
    carried = np.concatenate(payload)
    size = np.linalg.norm(np.concatenate(torque))
    left = [
        residual - free @ np.linalg.lstsq(free, residual, rcond=None)[0]
        for free in (np.hstack((carried, np.concatenate(constants))), carried)
    ]
    of_joints = np.bincount(np.concatenate(joints), left[0] ** 2, robot.n_joints)
    return LogErrors(
        Errors(*(float(np.linalg.norm(rest) / size) for rest in left)),
        (np.sqrt(of_joints) / size).tolist(),
    )


def flange_columns(robot: RobotModel, motion: Motion) -> Array:
    """Return the torque (N, n, 10) per parameter of the last link."""
    moves = LinkDynamics(robot).motion(motion.q, motion.qd, motion.qdd)
    return moves.columns([robot.n_joints - 1])


def promised_on(
    robot: RobotModel,
    log: Recording,
    pieces: Sequence[FilteredRecording],
    is_loaded: bool,
) -> LogErrors:
    """Return the errors that are promised of a log's file in the motion of another log.

    The noise of that log's torques, which a judgement on it contains, is taken to be that of the
    fit. The arguments are those of ``errors_on``, and the log that makes the file.
    """
    question = Question(EstimationOptions())
    fitted, _ = usable_fit(diagnose(robot, [log], question, Progress()), (), Progress())
    held = fit_file(fitted).by_name
    terms = fitted.arm.of(t for t in fitted.arm.terms.values() if t.cause != DELAY)
    unknown = [piece.using(piece.is_used, tau=0.0 * piece.tau) for piece in pieces]
    sums = terms.sums(unknown, fitted.point, in_blocks=False)
    known = knowledge_of(fitted, sums).after()
    offsets = np.isin(sums.names, [OFFSET.key_of(joint) for joint in sums.joints])
    payload = np.isin(sums.names, PARAMETER_NAMES) & is_loaded
    of_joints = [*grams(sums)]
    gram = sum(of_joints)
    torque = np.append(np.where(offsets, 0.0, known.values), -1.0)
    apart = known.values - [
        0.0 if is_offset else held.get(name, 0.0)
        for name, is_offset in zip(sums.names, offsets)
    ]
    noise = sums.row_counts * fitted.noise**2
    shares = []
    for free in (offsets | payload, payload):
        rows = gram[:-1, :-1]
        left = np.eye(len(rows))
        left[free] -= np.linalg.pinv(rows[free][:, free]) @ rows[free]
        squares = []
        for own, of_noise in zip(of_joints, noise):
            rest = left.T @ own[:-1, :-1] @ left
            squares.append(
                apart @ rest @ apart + np.sum(known.covariance * rest) + of_noise
            )
        shares.append(np.array(squares) / (torque @ gram @ torque))
    errors = Errors(*(float(np.sqrt(np.sum(share))) for share in shares))
    return LogErrors(errors, np.sqrt(shares[0]).tolist())


# ---- tables


RATIO_TITLES = "| {} to {} | above | median | 5 to 95 % | largest ".format(*WITHIN)
RATIO_RULE = "| --- " * 7 + "|"
"""Titles of ``ratio_cells`` behind two columns, and the rule below them."""


def ratio_cells(pairs: Sequence[tuple[float, float]]) -> str:
    """Return cells of a table on the ratios of pairs, actual and promised errors."""
    if not pairs:
        return "| | | | | "
    ratios = np.array([actual / promised for actual, promised in pairs])
    low, median, high = np.percentile(ratios, (5.0, 50.0, 95.0))
    above = np.mean(ratios > WITHIN[1])
    kept = np.mean(ratios >= WITHIN[0]) - above
    return (
        f"| {100.0 * kept:.0f} % | {100.0 * above:.0f} % | {median:.2f} "
        f"| {low:.2f} to {high:.2f} | {np.max(ratios):.3g} "
    )


def simulated_table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on simulated logs."""
    groups: dict[str, list[Row]] = {"all": [*rows]}
    for key in ("kind", "deviation"):
        for row in rows:
            groups.setdefault(row[key], []).append(row)
    groups["with offsets"] = [row for row in rows if row["has_offsets"]]
    lines = [f"| Logs | files {RATIO_TITLES}|", RATIO_RULE]
    lines += [after_row(group, members) for group, members in groups.items()]
    for name, words in OTHER_ERRORS.items():
        pairs = promised_pairs(rows, name)
        lines.append(f"| {words} | {len(pairs)} {ratio_cells(pairs)}|")
    answered = [row for row in rows if "after" in row]
    pairs = [(max(row["after"]), row["held_out"]) for row in answered]
    words = "all, the held-out error in place of the promise"
    lines.append(f"| {words} | {len(pairs)} {ratio_cells(pairs)}|")
    return [*lines, "", *warned_lines(rows), *unpromised_lines(rows)]


def causes_table(rows: Sequence[Row], causes: Sequence[Row]) -> list[str]:
    """Return the lines of the table on the largest and smallest ratios, with their causes."""
    lines = [
        "| Log | is | expected | ratio | most of what is | most of what was expected |",
        "| --- " * 6 + "|",
    ]
    for row, made in zip(rows, causes):
        true = max(row["after"])
        promised = row["promised"]["after"]
        words = (
            f"{row['seed']}: {row['arm']}, {row['deviation']}, {row['kind']}, "
            f"{row['duration']:.0f} s"
        )
        if made["still"]:
            words += f"; {', '.join(made['still'])} stood still"
        cells = [
            words,
            f"{100.0 * true:.3g} %",
            f"{100.0 * promised:.3g} %",
            f"{true / promised:.2f}",
            *(parts_text(made[name]) for name in ("is", "expected")),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def parts_text(parts: Sequence[tuple[str, float]]) -> str:
    """Return parts of an error in words, each with its error."""
    return ", ".join(f"{what} {100.0 * error:.3g} %" for what, error in parts)


def extreme_rows(rows: Iterable[Row]) -> list[Row]:
    """Return the promised rows with the largest and the smallest ratios, the largest first."""
    promised = [row for row in rows if row.get("promised")]
    promised.sort(key=lambda row: -max(row["after"]) / row["promised"]["after"])
    return [*promised[:EXTREMES], *promised[-EXTREMES:]]


def warned_lines(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how many files are hardly better than the model, and of how many the run says so."""
    promised = [row for row in rows if row.get("promised")]
    gains = [
        (
            max(row["after"]) / max(row["before"]),
            row["promised"]["after"] / row["promised"]["before"],
        )
        for row in promised
    ]
    true, said = np.transpose(gains)
    is_said = said > LIKE_LOG
    for words, is_true in (
        ("worse than the model as it came", true > 1.0),
        (
            f"above {LIKE_LOG} of its error, but not worse",
            (true > LIKE_LOG) & (true <= 1.0),
        ),
        ("better than that", true <= LIKE_LOG),
    ):
        yield (
            f"- Files that are {words}: {np.sum(is_true)}; "
            f'"usable for motions like this log": {np.sum(is_said & is_true)}.'
        )


def promised_pairs(rows: Sequence[Row], name: str) -> list[tuple[float, float]]:
    """Return an error of files with a promise, by its name: what it is, and what is promised."""
    promised = [row for row in rows if row.get("promised")]
    return [(max(row[name]), row["promised"][name]) for row in promised]


def unpromised_lines(rows: Sequence[Row]) -> Iterator[str]:
    """Yield how many logs have no promise, and how bad the files of such logs are."""
    refused = [row for row in rows if row["refused"]]
    yield f"- Refused, without a file: {len(refused)} of {len(rows)} logs."
    others = [row for row in rows if not row["refused"] and not row["promised"]]
    if others:
        before, after = np.transpose(
            [(max(row["before"]), max(row["after"])) for row in others]
        )
        yield (
            f"- With a file and without a promise: {len(others)}; their errors are "
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
    words += f"  is {percents(before, after)}, held out {100.0 * row['held_out']:.3g} %"
    if row["promised"]:
        promised = row["promised"]
        words += f", promised {percents(promised['before'], promised['after'])}"
        words += f", ratio {after / promised['after']:.2f}"
    return words


def real_table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on logs of real arms."""
    lines = [
        "| Model file of, judged on | before -> after | promised there | ratio "
        "| offsets left in | promised there | ratio | promised all over the range "
        "| the difference is mostly that of |",
        "| --- " * 9 + "|",
    ]
    for row in rows:
        cells = [row["key"]]
        for place in range(len(Errors._fields)):
            before, after, promised = (
                row[name][place] for name in ("before", "after", "promised")
            )
            cells += [percents(before, after), f"{100.0 * promised:.3g} %"]
            cells.append(f"{after / promised:.2f}")
        share = row["elsewhere"]
        cells.append(f"{100.0 * share:.3g} %" if share else "nothing")
        is_off, expected = row["of_joint"]
        cells.append(
            f"{row['joint']}: {100.0 * is_off:.3g} % for {100.0 * expected:.3g} %"
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def second_table(firsts: Sequence[Row], rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on second logs, ``firsts`` the results before them."""
    both = [(first, row) for first, row in zip(firsts, rows) if not row["refused"]]
    pairs = [(max(row["after"]), row["proposed"]) for _, row in both]
    lines = [
        f"| Files of two logs | files {RATIO_TITLES}|",
        RATIO_RULE,
        f"| as proposed after the first log | {len(pairs)} {ratio_cells(pairs)}|",
        after_row("as promised after both logs", rows),
    ]
    if both:
        gains = [max(row["after"]) / max(first["after"]) for first, row in both]
        said = [row["proposed"] / first["promised"]["after"] for first, row in both]
        lines += [
            "",
            f"Over the error of the first log's file: {np.median(gains):.2f} in the median, "
            f"proposed {np.median(said):.2f}; at most {np.max(gains):.2f}.",
        ]
    return lines


def after_row(words: str, rows: Sequence[Row]) -> str:
    """Return the row of a table on what is promised of files by the logs that made them."""
    pairs = promised_pairs(rows, "after")
    return f"| {words} | {len(pairs)} {ratio_cells(pairs)}|"


def planned_table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the table on what ``plan`` promises, offsets taken out.

    A ratio is that to the nearest error between the two that are promised.
    """
    pairs = [
        (row["after"][0], float(np.clip(row["after"][0], *row["planned"])))
        for row in rows
        if not row["refused"] and row["planned"]
    ]
    lines = [
        f"| Files of planned logs | files {RATIO_TITLES}|",
        RATIO_RULE,
        f"| as the plan promises, to its nearer end, offsets out | {len(pairs)} "
        f"{ratio_cells(pairs)}|",
        after_row("as promised after the log", rows),
    ]
    if pairs:
        ends = np.array([row["planned"] for row in rows if row["planned"]])
        wide = np.median(ends[:, 1] / ends[:, 0])
        within = np.mean([actual == near for actual, near in pairs])
        lines += [
            "",
            f"The larger error of a plan is {wide:.1f} times the smaller one (median); "
            f"{100.0 * within:.0f} % of the files are between both.",
        ]
    return lines


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


def tables(
    parts: Sequence[str], seeds: range, results: Results
) -> Iterator[tuple[str, list[str]]]:
    """Yield each part with the lines of its table."""

    def rows(part: str, keys: Iterable[Any], make: Callable[[Any], Row]) -> list[Row]:
        """Return the results of a part, each of which is printed."""
        found = []
        for key in keys:
            found.append(
                results.of(part, getattr(key, "name", key), partial(make, key))
            )
            if "seed" in found[-1]:
                print(line_of(found[-1]), file=sys.stderr, flush=True)
        return found

    firsts: dict[int, Row] = {}
    if {"simulated", "second"} & {*parts}:
        firsts = dict(zip(seeds, rows("simulated", seeds, simulated)))
    if "simulated" in parts:
        extremes = {row["seed"]: row for row in extreme_rows(firsts.values())}
        causes = rows("cause", extremes, lambda seed: cause(extremes[seed]))
        of_causes = causes_table([*extremes.values()], causes)
        yield "simulated", [*simulated_table([*firsts.values()]), "", *of_causes]
    if "real" in parts:
        yield "real", real_table(rows("real", PAIRS, real))
    if "second" in parts:
        narrow = [
            seed
            for seed, row in firsts.items()
            if row["kind"] in NARROW and row.get("next")
        ][:FEW]
        of_both = rows("second", narrow, lambda seed: second(firsts[seed]))
        yield "second", second_table([firsts[seed] for seed in narrow], of_both)
    if "plan" in parts:
        yield "plan", planned_table(rows("plan", seeds[:FEW], planned))


def main() -> int:
    """Print the tables; write them where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(TABLES))
    parser.add_argument("--files", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--rows", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.files)
    for part, lines in tables(options.parts or [*TABLES], seeds, Results(options.rows)):
        TABLES[part].show([*lines, ""], is_written=False)
        if options.write:
            TABLES[part].write(lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
