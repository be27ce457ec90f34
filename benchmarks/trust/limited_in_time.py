"""What a fault that lasts a moment costs: is it left out, is the rest used, and is that right?

    python -m benchmarks.trust.limited_in_time MODELS_FOLDER [--arms gen3 ur5e panda] [--seeds 10]
        [--kinds push ...] [--duration 20] [--no-answers]

Arms are those of ``benchmarks.trust.real_arms``, off as real ones are. A log has one fault, from
0.3 to 3 s long, at a random time. It is read from a file like a user's. Per kind of fault are
counted: logs that are used, logs of which every moment of the fault is left out and at most 1.5 s
beside it, the median of what is left out beside it, and the last link's mass: how many are within
two stated errors, the largest error in stated ones, and how many may be trusted. "right" are logs
without a fault: of these no row should be left out.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import robot_sysid
from benchmarks.trust.confusion_causes import Scene, draw_scene
from benchmarks.trust.real_arms import arms_parser
from rigs.arms.wrong_arms import ARMS, resting_torque
from rigs.logs.log_files import open_log
from robot_sysid.diagnosis.gate import judge, usable_fit
from robot_sysid.errors import SysidError
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.options import EstimationOptions
from robot_sysid.estimate.questions import Question
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records import Array
from robot_sysid.records.file_access import temporary_folder
from robot_sysid.records.messages import Progress

_STREAM = 54
_BESIDE = 1.5
"""Time beside a fault that may be left out with it [s]."""
Span = tuple[float, float]


def force_torque(scene: Scene, link: int, force: Array) -> Array:
    """Return the joints' torque (N, n) that holds a force (3,) at a link's origin [N, N m]."""
    thetas = np.zeros_like(scene.robot.thetas)
    thetas[link, 0] = 1.0
    return resting_torque(scene.robot, scene.motion.q, thetas, force)


def draw_span(scene: Scene, shortest: float, longest: float) -> Span:
    """Return the begin and end of a fault [s]."""
    length = scene.rng.uniform(shortest, longest)
    start = scene.rng.uniform(0.5, scene.log.time[-1] - length - 0.5)
    return start, start + length


def draw_force(scene: Scene, share: float) -> Array:
    """Return a force (3,) in a random direction, as a share of the arm's weight [N]."""
    direction = scene.rng.normal(size=3)
    return share * scene.weight * direction / np.linalg.norm(direction)


def bump(scene: Scene, span: Span) -> Array:
    """Return half a sine wave over a span, zero elsewhere (N, 1)."""
    phase = (scene.log.time - span[0]) / (span[1] - span[0])
    wave = np.where((phase > 0.0) & (phase < 1.0), np.sin(np.pi * phase), 0.0)
    return wave[:, None]


def touched(scene: Scene, spans: list[Span], link: int, share: float) -> Scene:
    """Return the scene with pushes on a link, each of a share of the arm's weight."""
    for span in spans:
        torque = force_torque(scene, link, draw_force(scene, share))
        scene = scene.with_more_torque(bump(scene, span) * torque)
    return scene


def contact(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log with half a second of contact at the tip."""
    spans = [draw_span(scene, 0.5, 0.5)]
    return touched(scene, spans, scene.robot.n_joints - 1, 0.3), spans


def pushes(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log with two pushes at the tip."""
    middle = 0.5 * scene.log.time[-1]
    spans = []
    for shift in (0.0, middle):
        start = shift + scene.rng.uniform(0.5, middle - 2.5)
        spans.append((start, start + scene.rng.uniform(0.5, 2.0)))
    return touched(scene, spans, scene.robot.n_joints - 1, 0.15), spans


def hit_elbow(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which something hits the elbow."""
    spans = [draw_span(scene, 0.3, 0.6)]
    return touched(scene, spans, scene.robot.n_joints // 2, 0.3), spans


def resting_hand(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which a hand rests on the tip and takes a twelfth of the arm's weight."""
    span = draw_span(scene, 2.0, 3.0)
    time = scene.log.time
    fade = np.clip(np.minimum(time - span[0], span[1] - time) / 0.2, 0.0, 1.0)
    force = np.array([0.0, 0.0, -0.08 * scene.weight])
    torque = force_torque(scene, scene.robot.n_joints - 1, force)
    return scene.with_more_torque(fade[:, None] * torque), [span]


def with_torque_in(scene: Scene, span: Span, joint: int | None, value: float) -> Scene:
    """Return the scene with one torque in a span, of one joint or all; NaN repeats the first."""
    rows = rows_of(scene, span)
    tau = scene.log.tau.copy()
    block = tau[rows] if joint is None else tau[rows, joint : joint + 1]
    block[:] = block[0] if np.isnan(value) else value
    return replace(scene, log=replace(scene.log, tau=tau))


def rows_of(scene: Scene, span: Span) -> slice:
    """Return the rows of a span."""
    first, last = np.searchsorted(scene.log.time, span)
    return slice(int(first), int(last))


def loaded_joint(scene: Scene) -> int:
    """Return one of the joints with a fair share of the torque."""
    load = scene.usual_torque
    return int(scene.rng.choice(np.flatnonzero(load >= 0.1 * np.max(load))))


def torque_zero(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which the torque of one joint, or of all, is zero for a while."""
    span = draw_span(scene, 0.3, 3.0)
    joint = None if scene.rng.random() < 0.5 else loaded_joint(scene)
    return with_torque_in(scene, span, joint, 0.0), [span]


def torque_stuck(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which the torque of one joint keeps its value for a while."""
    span = draw_span(scene, 0.3, 3.0)
    return with_torque_in(scene, span, loaded_joint(scene), np.nan), [span]


def torque_saturated(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which the torque of one joint is at the end of its range for a while."""
    span = draw_span(scene, 0.3, 3.0)
    joint = loaded_joint(scene)
    end = 1.2 * float(np.max(np.abs(scene.log.tau[:, joint])))
    return with_torque_in(scene, span, joint, end), [span]


def frozen_positions(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log in which the position of one joint, or of all, stands for a while."""
    span = draw_span(scene, 0.3, 2.0)
    rows = rows_of(scene, span)
    q = scene.log.q.copy()
    if scene.rng.random() < 0.5:
        q[rows] = q[rows.start]
    else:
        joint = loaded_joint(scene)
        q[rows, joint] = q[rows.start, joint]
    return replace(scene, log=replace(scene.log, q=q)), [span]


def gap(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return a log that lacks a stretch."""
    span = draw_span(scene, 0.3, 3.0)
    rows = rows_of(scene, span)
    kept = {}
    for name, values in vars(scene.log).items():
        kept[name] = values if values is None else np.delete(values, rows, axis=0)
    return replace(scene, log=type(scene.log)(**kept)), [span]


def right(scene: Scene) -> tuple[Scene, list[Span]]:
    """Return the scene as it is."""
    return scene, []


Kind = Callable[[Scene], "tuple[Scene, list[Span]]"]
KINDS: dict[str, Kind] = {
    kind.__name__: kind
    for kind in (
        right,
        contact,
        pushes,
        hit_elbow,
        resting_hand,
        torque_zero,
        torque_stuck,
        torque_saturated,
        frozen_positions,
        gap,
    )
}


def check_scene(
    scene: Scene, path: Path, answered: bool
) -> tuple[Fit, tuple[float, bool]]:
    """Return the fit of a scene's log, and the error of the last link's mass and its verdict.

    The error is in stated ones. SysidError where the log is refused.

    Args:
        scene: with a fault in its log.
        path: of the file that the log is written to.
        answered: whether the arm is identified; if not, the error is NaN.
    """
    write_measurement_csv(path, scene.robot.joint_names, [scene.log])
    log = open_log(scene.robot, path)
    judged = judge(scene.robot, [log], Question(EstimationOptions()), Progress())
    fitted, _ = usable_fit(judged, (), Progress())
    if not answered:
        return fitted, (np.nan, False)
    result = robot_sysid.identify(scene.path, path)
    error = (result.theta[0] - scene.theta[0]) / result.standard_errors["m"]
    return fitted, (float(error), result.trustworthy)


def beside(scene: Scene, spans: list[Span], fitted: Fit) -> float:
    """Return the time that is left out beside a fault [s]; NaN where a part of it is used."""
    time = np.concatenate([each.motion.time for each in fitted.recordings])
    is_used = np.concatenate([np.any(each.used, axis=1) for each in fitted.recordings])
    used = time[is_used]
    step = float(np.median(np.diff(time)))
    missing = step * (len(time) - len(used))
    for start, end in spans:
        if np.any((used > start + 2.0 * step) & (used < end - 2.0 * step)):
            return np.nan
        missing -= end - start
    return max(missing, 0.0)


def line_of(kind: str, besides: list[float], count: int, answers: Array) -> str:
    """Return the words of one kind: numbers of logs, and answers (m, 2)."""
    beside_time = np.array(besides)
    covered = int(np.sum(beside_time <= _BESIDE))
    exposed = int(np.sum(np.isnan(beside_time)))
    median = float(np.nanmedian(beside_time)) if np.any(beside_time >= 0.0) else np.nan
    worst = float(np.nanmax(beside_time)) if np.any(beside_time >= 0.0) else np.nan
    text = (
        f"{kind:<18}{len(besides):4d} of {count:3d} used, {covered:3d} left out well, "
    )
    text += f"{exposed:3d} in part; beside {median:5.2f} s (at most {worst:5.2f})"
    if np.any(np.isfinite(answers[:, 0])):
        z = np.abs(answers[:, 0])
        text += f"; mass: {np.sum(z < 2.0):3d} of {len(z):3d} within two errors, "
        text += f"largest {np.max(z):.2f}, trusted {int(np.sum(answers[:, 1]))}"
    return text


def main() -> int:
    """Print the table."""
    parser = arms_parser(__doc__, ("gen3", "ur5e", "panda"))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--no-answers", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    for kind in options.kinds:
        besides = []
        answers = []
        for arm, seed in itertools.product(options.arms, seeds):
            path = options.models / ARMS[arm]
            scene = draw_scene(path, arm, "real", options.duration, seed)
            rng = np.random.default_rng([seed, list(KINDS).index(kind), _STREAM])
            scene, spans = KINDS[kind](replace(scene, rng=rng))
            try:
                with temporary_folder() as folder:
                    path = folder / "log.csv"
                    log, answer = check_scene(scene, path, not options.no_answers)
            except SysidError as error:
                print(f"    {arm} {seed}: {error}"[:240], flush=True)
                continue
            answers.append(answer)
            besides.append(beside(scene, spans, log))
            if np.isnan(besides[-1]) or besides[-1] > _BESIDE:
                print(f"    {arm} {seed} {spans}: {besides[-1]:.2f} s beside")
        count = len(options.arms) * len(seeds)
        print(line_of(kind, besides, count, np.array(answers)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
