"""What right logs are accused of: motions as people record them, of arms as they are.

    python -m benchmarks.trust.right_logs MODELS_FOLDER [--arms ur5e ...] [--motions sines ...]
        [--seeds 2] [--deviations real exact]

Each log is of another arm, drawn as in ``benchmarks.trust.real_arms``, and is looked at by the
command ``log``. A log of several parts, one joint driven in each, is given to ``identify``. Printed
are the logs of which something is said, and per motion how many are refused, doubted, or noted.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.trust.answers import bare_model_text, run_command, write_log
from benchmarks.trust.real_arms import SENSOR_ARMS, arms_parser
from rigs.arms.wrong_arms import ARMS, RATE, draw_arm
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Motion, MotionPlan, Recording

MORE_ARMS = {
    "wxai": "trossen/wxai/wxai_follower.xml",
    "panda_hand": "franka_panda/panda.xml",
    "so101": "so101/so101_new_calib.xml",
    "gen3_2023": "kinova_gen3/gen3_7dof_2023.xml",
}
ALL_ARMS = {**ARMS, **MORE_ARMS}
Move = Callable[[MotionPlan, np.random.Generator], Motion]
"""Function that returns a motion around that of an excitation."""


def sampled(time: Array, q: Array) -> Motion:
    """Return the motion through positions (N, n) at times (N,), by a spline of degree five."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(time, q, 5)
    return Motion(time, spline(time), spline(time, 1), spline(time, 2))


def ranges(plan: MotionPlan) -> tuple[Array, Array]:
    """Return middle and half range (n,) of the positions of a plan."""
    q = plan.evaluate(np.arange(0.0, plan.duration, 0.02)).q
    return np.mean(q, axis=0), 0.5 * np.ptp(q, axis=0)


def sines(tones: int, plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return sines of one or more tones per joint."""
    middle, half = ranges(plan)
    time = np.arange(round(RATE * plan.duration)) / RATE
    q = np.tile(middle, (len(time), 1))
    for _ in range(tones):
        rates = 2.0 * np.pi * rng.uniform(0.1, 0.4, len(middle))
        phases = rng.uniform(0.0, 2.0 * np.pi, len(middle))
        q += half / tones * np.sin(np.outer(time, rates) + phases)
    return sampled(time, q)


def planned(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation itself."""
    return plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE)


def slow(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation at a third of its speed."""
    motion = plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE / 3.0)
    time = np.arange(len(motion.q)) / RATE
    return Motion(time, motion.q, motion.qd / 3.0, motion.qdd / 9.0)


def pick_and_place(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return moves between poses, with rests of half a second."""
    middle, half = ranges(plan)
    poses = middle + half * rng.uniform(-1.0, 1.0, (8, len(middle)))
    time = np.arange(round(RATE * plan.duration)) / RATE
    period = plan.duration / 7.0
    part = np.minimum((time / period).astype(int), 6)
    share = np.clip((time - part * period) / (period - 0.5), 0.0, 1.0)
    s = (10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5)[:, None]
    rate = ((30.0 * share**2 - 60.0 * share**3 + 30.0 * share**4) / (period - 0.5))[
        :, None
    ]
    bend = ((60.0 * share - 180.0 * share**2 + 120.0 * share**3) / (period - 0.5) ** 2)[
        :, None
    ]
    step = np.diff(poses, axis=0)[part]
    return Motion(time, poses[part] + s * step, rate * step, bend * step)


def one_at_a_time(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return a motion in which one joint after the other swings, and the others stand."""
    middle, half = ranges(plan)
    n = len(middle)
    time = np.arange(round(RATE * plan.duration)) / RATE
    span = plan.duration / n
    q = np.tile(middle, (len(time), 1))
    qd, qdd = np.zeros((2, *q.shape))
    rate = 2.0 * np.pi * 2.0 / span
    for joint in range(n):
        own = (time >= joint * span) & (time < (joint + 1) * span)
        phase = rate * (time[own] - joint * span)
        # Two swings that begin and end at rest.
        q[own, joint] += 0.5 * half[joint] * (1.0 - np.cos(phase))
        qd[own, joint] = 0.5 * half[joint] * rate * np.sin(phase)
        qdd[own, joint] = 0.5 * half[joint] * rate**2 * np.cos(phase)
    return Motion(time, q, qd, qdd)


def on_limit(plan: MotionPlan, rng: np.random.Generator) -> Motion:
    """Return the excitation with one joint that lies on its limit now and then."""
    motion = planned(plan, rng)
    joint = int(rng.integers(motion.q.shape[1]))
    limit = np.quantile(motion.q[:, joint], 0.75)
    lies = motion.q[:, joint] > limit
    q, qd, qdd = motion.q.copy(), motion.qd.copy(), motion.qdd.copy()
    q[lies, joint] = limit
    qd[lies, joint] = qdd[lies, joint] = 0.0
    return Motion(motion.time, q, qd, qdd)


MOTIONS: dict[str, tuple[Move, float, float]] = {
    "one_tone": (lambda p, r: sines(1, p, r), 20.0, 0.04),
    "two_tones": (lambda p, r: sines(2, p, r), 20.0, 0.04),
    "planned": (planned, 20.0, 0.04),
    "slow": (slow, 20.0, 0.04),
    "short": (planned, 6.0, 0.04),
    "pick_and_place": (pick_and_place, 20.0, 0.04),
    "one_at_a_time": (one_at_a_time, 30.0, 0.04),
    "high_friction": (planned, 20.0, 0.25),
    "on_limit": (on_limit, 20.0, 0.04),
    "30_hz": (planned, 20.0, 0.04),
}
"""Motion to its function, its duration [s] and the share of friction in the torque."""


def findings_of(
    arm_name: str, motion: str, deviation: str, seed: int, models: Path, folder: Path
) -> list[dict[str, str]]:
    """Return what the command ``log`` says of a right log."""
    path = models / ALL_ARMS[arm_name]
    robot = load_robot_model(path)
    move, duration, friction = MOTIONS[motion]
    has_sensors = arm_name in SENSOR_ARMS
    arm = draw_arm(
        robot, deviation, has_sensors, duration, seed % 2 == 0, seed, move, friction
    )
    log = arm.log
    if motion == "30_hz":
        step = round(RATE / 30.0)
        log = Recording(log.time[::step], log.q[::step], None, log.tau[::step])
    model = folder / f"model_{arm_name}.xml"
    if not model.exists():
        model.write_text(bare_model_text(path))
    write_log(folder / "log.csv", robot.joint_names, log)
    code, output, messages = run_command("log", folder / "log.csv", model, "--json")
    if output.startswith("{"):
        return list(json.loads(output)["findings"])
    return [{"level": "refuses", "about": f"error {code}", "text": messages}]


def main() -> int:
    """Print the table."""
    parser = arms_parser(__doc__, ALL_ARMS, ALL_ARMS)
    parser.add_argument(
        "--motions", nargs="+", default=list(MOTIONS), choices=list(MOTIONS)
    )
    parser.add_argument("--deviations", nargs="+", default=["real", "exact"])
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    with tempfile.TemporaryDirectory() as name:
        for motion in options.motions:
            counts: Counter[str] = Counter()
            total = 0
            for arm_name in options.arms:
                for deviation in options.deviations:
                    for seed in seeds:
                        found = findings_of(
                            arm_name,
                            motion,
                            deviation,
                            seed,
                            options.models,
                            Path(name),
                        )
                        total += 1
                        counts.update({f["level"] for f in found})
                        for finding in found:
                            text = finding["text"].replace("\n", " ")[:150]
                            print(
                                f"  {arm_name} {deviation} {seed} {finding['level']}: "
                                f"{finding['about']}: {text}"
                            )
            print(f"{motion:<16} {total} logs: {dict(counts)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
