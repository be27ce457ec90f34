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
from pathlib import Path

from benchmarks.trust.answers import bare_model_text, run_command, write_log
from benchmarks.trust.real_arms import SENSOR_ARMS, arms_parser
from rigs.arms.motions import (
    Move,
    on_limit,
    one_at_a_time,
    pick_and_place,
    planned,
    sines,
    slow,
)
from rigs.arms.wrong_arms import ARMS, RATE, draw_arm
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording

MORE_ARMS = {
    "wxai": "trossen/wxai/wxai_follower.xml",
    "panda_hand": "franka_panda/panda.xml",
    "so101": "so101/so101_new_calib.xml",
    "gen3_2023": "kinova_gen3/gen3_7dof_2023.xml",
}
ALL_ARMS = {**ARMS, **MORE_ARMS}
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
