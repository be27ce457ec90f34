"""Drawn arms behind servos: do stated errors hold, and what is a dead zone worth in the fit?

    OMP_NUM_THREADS=1 python -m benchmarks.trust.drawn_servos [ARMS] [limited]

Each arm is an SO-101 with links 10 to 20 % off its file (one of them 40 %), servos, rotors, damping
and Coulomb friction of its own, and friction that fades with speed, which no file knows. Half of
the joints of every second arm have a dead zone of 0.2 to 1 degree. 40 s of sines and steps are
logged at 25 to 200 Hz by encoders of 4096 steps a turn; commands act up to 0.1 s late. Torques have
no limit, or that of the file. The arm is stepped by ``ArmStepper``, which shares no code with what
fits it.

The first half is fitted, as it is and as if servos had no dead zones; the second half is played in
windows of 1 s. An error counts in stated ones.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.accuracy import servo_arm
from rigs.arms.wrong_arms import write_link, wrong_links
from rigs.files.places import MODELS
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel
from robot_sysid.servo import equations
from robot_sysid.servo.fit import ServoFit, fit_servos
from robot_sysid.servo.loop import rms
from robot_sysid.servo.result import UNITS
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import ServoRollouts

FILE = MODELS / "so101/so101_new_calib.xml"
TIP = "wrist_roll"
ARMS = 24
SECONDS = 40.0
RATES = (25.0, 50.0, 100.0, 200.0)
ENCODER = 2.0 * np.pi / 4096
BANDWIDTH = (12.0, 32.0)
"""Frequencies of servos without damping [rad/s]; samples resolve nearly all of them."""
DAMPING = (0.4, 1.2)
"""Damping over the critical one."""
COULOMB = (0.03, 0.1)
FADING = (0.0, 0.3)
"""Friction at rest beyond Coulomb's, as a share of it."""
ROTOR = (0.5, 1.5)
"""Rotor inertia over the file's."""
LARGEST_DELAY = 0.1
DEAD_ZONE = np.radians((0.2, 1.0))
NONE = np.array([1e-9])
"""Dead zones that are tried where there are to be none: one that explains nothing [rad]."""
FAR = 2.5
"""Stated errors beyond which an error is counted."""


@dataclass(frozen=True)
class Drawn:
    """A drawn arm and its log.

    Attributes:
        arm: the arm as it is.
        log: its log.
    """

    arm: servo_arm.ServoArm
    log: Recording


def draw(robot: RobotModel, seed: int, limit: np.ndarray) -> Drawn:
    """Return an arm with torque limits (n,) and its log; those of odd seeds have dead zones."""
    rng = np.random.default_rng(seed)
    n = robot.n_joints
    model = robot.mj_model.__copy__()
    for link, theta in zip(robot.links, wrong_links(robot, rng)):
        write_link(model, link, theta)
    rotor = rng.uniform(*ROTOR, n) * robot.armature
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature + rotor
    bandwidth = rng.uniform(*BANDWIDTH, n)
    damping = 2.0 * rng.uniform(*DAMPING, n) * bandwidth * inertia
    has_dead_zone = (rng.uniform(size=n) < 0.5) & (seed % 2 == 1)
    arm = servo_arm.ServoArm(
        robot=replace(robot, mj_model=model),
        stiffness=inertia * bandwidth**2,
        damping=damping,
        servo_damping=np.zeros(n),
        coulomb=rng.uniform(*COULOMB, n),
        armature=rotor,
        # The arm acts on commands at whole milliseconds.
        delay=round(rng.uniform(0.0, LARGEST_DELAY), 3),
        limit=limit,
        dead_zone=has_dead_zone * rng.uniform(*DEAD_ZONE, n),
        fading=rng.uniform(*FADING, n),
    )
    rate = float(rng.choice(RATES))
    time, command = servo_arm.commands(robot, rng, SECONDS, rate)
    sent = ENCODER * np.round(command / ENCODER)
    q = ENCODER * np.round(arm.play(time, sent) / ENCODER)
    return Drawn(arm, Recording(time, q, None, sent - q, command=sent))


@dataclass(frozen=True)
class Answer:
    """What a fit found of a drawn arm.

    Attributes:
        fit: as found.
        held_out: root mean square position error of what it plays [rad].
    """

    fit: ServoFit
    held_out: float


def answer(robot: RobotModel, rollouts: ServoRollouts, log: Recording) -> Answer:
    """Fit the first half of a log and play the other."""
    half = len(log) // 2
    fit = fit_servos(robot, [log[:half]])
    errors = ServoProblem(rollouts, [log[half:]], fit.delay).errors(fit)
    return Answer(fit, rms(errors))


def offs(drawn: Drawn, fit: ServoFit) -> dict[str, np.ndarray]:
    """Return errors in stated ones by quantity, of joints that show it."""
    arm = drawn.arm
    truth = np.array([arm.stiffness, arm.damping, arm.coulomb, arm.armature])
    at = fit.is_known & ~fit.is_fast
    off = (fit.numbers - truth)[:, at] / fit.errors[:, at]
    # A delay that is not known, at torque limits, is not right either.
    off_delay = np.array([fit.delay - arm.delay]) / fit.delay_error
    rows = {"delay": off_delay[np.isfinite([fit.delay_error])]}
    rows.update(zip(UNITS, off))
    found = fit.dead_zones > 0.0
    missed = (fit.dead_zones - arm.dead_zone)[found]
    rows["dead zone"] = missed / fit.dead_zone_errors[found]
    return rows


def line(title: str, values: np.ndarray) -> str:
    """Return a row on errors in stated ones."""
    sizes = np.abs(values)
    return (
        f"  {title}: root mean square {rms(values):.2f}, largest {np.max(sizes):.1f}, "
        f"{np.sum(sizes > FAR)} of {len(values)} beyond {FAR:g}"
    )


def report(title: str, cases: list[tuple[Drawn, Answer]]) -> None:
    """Print errors of one group of arms."""
    median = 1e3 * np.median([found.held_out for _, found in cases])
    print(f"{title}: held-out error {median:.2f} mrad in the median")
    parts = [offs(drawn, found.fit) for drawn, found in cases]
    for name in parts[0]:
        values = np.concatenate([part[name] for part in parts])
        if len(values):
            print(line(name, values))
    has = np.array([drawn.arm.dead_zone > 0.0 for drawn, _ in cases])
    found = np.array([answer.fit.dead_zones > 0.0 for _, answer in cases])
    print(
        f"  dead zones: {np.sum(has & found)} of {np.sum(has)} found, {np.sum(found & ~has)} of "
        f"{np.sum(~has)} other joints are said to have one"
    )


def main(count: str = str(ARMS), limited: str = "") -> None:
    """Print rows with the term and without it, of arms with dead zones and of others."""
    robot = load_robot_model(FILE, joint=TIP)
    rollouts = ServoRollouts(robot)
    if not limited:
        rollouts.actuators.limit[:] = np.inf
    limit = rollouts.actuators.limit
    tried = equations.DEAD_ZONES
    rows: dict[str, list[tuple[Drawn, Answer]]] = {}
    for seed in range(int(count)):
        drawn = draw(robot, seed, limit)
        group = "with dead zones" if np.any(drawn.arm.dead_zone) else "without any"
        for word, zones in {"as it is": tried, "without the term": NONE}.items():
            equations.DEAD_ZONES = zones
            case = (drawn, answer(robot, rollouts, drawn.log))
            rows.setdefault(f"arms {group}, {word}", []).append(case)
        equations.DEAD_ZONES = tried
    for title, cases in rows.items():
        report(title, cases)


if __name__ == "__main__":
    main(*sys.argv[1:])
