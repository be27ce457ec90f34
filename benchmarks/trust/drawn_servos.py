"""Drawn arms behind servos: how far off is what is found of them, and do stated errors hold?

    OMP_NUM_THREADS=1 python -m benchmarks.trust.drawn_servos [FIRST] [BEYOND] [--write]

Each arm is an SO-101 with links 10 to 20 % off its file (one of them 40 %), and servos, rotors,
damping and Coulomb friction of its own. All have a limit of voltage beside which damping stands (of
every third arm, a part of it), friction that grows with load, friction at rest that fades over 0.05
to 0.3 rad/s, and a lag; half of the joints of every second arm have a dead zone of 0.2 to 1 degree.
40 s of sines and steps are logged at 25 to 200 Hz by encoders of 4096 steps a turn; commands act up
to 0.1 s late. The arm is stepped by ``ArmStepper``, which shares no code with what fits it.

The first half is fitted; the second half is played by the numbers of the file in windows of 5 s. An
error counts in stated ones.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.accuracy import servo_arm
from rigs.arms.wrong_arms import write_link, wrong_links
from rigs.files.page_tables import PageTable
from rigs.files.places import MODELS, ROOT
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Recording, RobotModel
from robot_sysid.records.messages import Progress
from robot_sysid.records.servo_setting import UNKNOWN
from robot_sysid.servo.derived import absolute_numbers, derived_numbers, largest_weights
from robot_sysid.servo.fit import ServoFit, fit_servos
from robot_sysid.servo.loop import rms
from robot_sysid.servo.windows import ServoProblem
from robot_sysid.simulation.playback import servos_in_model

TABLE = PageTable(
    ROOT / "docs" / "evidence.md", "drawn", "python -m benchmarks.trust.drawn_servos"
)
FILE = MODELS / "so101/so101_new_calib.xml"
TIP = "wrist_roll"
ARMS = 40
SECONDS = 40.0
RATES = (25.0, 50.0, 100.0, 200.0)
ENCODER = 2.0 * np.pi / 4096
BANDWIDTH = (12.0, 32.0)
"""Frequency of an arm's servos without damping, at its median inertia [rad/s]."""
GAIN_SPREAD = 0.4
"""Standard deviation of the logarithm of gains within an arm, whose servos are of one kind."""
DAMPING = (0.4, 1.2)
"""Damping over the critical one."""
COULOMB = (0.03, 0.1)
STRIBECK = (0.0, 1.0)
"""Friction at rest beyond Coulomb's, over it."""
LOAD_SHARE = (0.0, 0.25)
LOAD_STRIBECK = (0.0, 0.2)
SLIP_SPEED = (0.05, 0.3)
ROTOR = (0.5, 1.5)
"""Rotor inertia over the file's."""
REACH = (0.15, 0.6)
"""Position error at which the torque is at its limit [rad]."""
LARGEST_DELAY = 0.1
LARGEST_LAG = 0.02
DEAD_ZONE = np.radians((0.2, 1.0))
OF_WEIGHT = ("sag", "torque_over_weight")
"""Numbers that joints without weight do not have."""
LEAST_WEIGHT = 1e-3
"""Weight that is none [N m]."""
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


def draw(robot: RobotModel, seed: int) -> Drawn:
    """Return an arm and its log; those of odd seeds have dead zones, and the servos of every third
    command damping within their limits.
    """
    rng = np.random.default_rng(seed)
    n = robot.n_joints
    model = robot.mj_model.__copy__()
    links = []
    for link, theta in zip(robot.links, wrong_links(robot, rng)):
        write_link(model, link, theta)
        links.append(replace(link, theta=theta))
    rotor = rng.uniform(*ROTOR, n) * robot.armature
    inertia = robot.mj_model.dof_M0[robot.dof_index] - robot.armature + rotor
    gain = np.median(inertia) * rng.uniform(*BANDWIDTH) ** 2
    gain = gain * np.exp(GAIN_SPREAD * rng.standard_normal(n))
    bandwidth = np.sqrt(gain / inertia)
    damping = 2.0 * rng.uniform(*DAMPING, n) * bandwidth * inertia
    coulomb = rng.uniform(*COULOMB, n)
    stribeck = rng.uniform(*STRIBECK, n) * coulomb
    load_share = rng.uniform(*LOAD_SHARE, n)
    load_stribeck = rng.uniform(*LOAD_STRIBECK, n)
    slip_speed = float(np.exp(rng.uniform(*np.log(SLIP_SPEED))))
    limited = (seed % 3 == 0) * rng.uniform(size=n)
    has_dead_zone = (rng.uniform(size=n) < 0.5) & (seed % 2 == 1)
    dead_zone = has_dead_zone * rng.uniform(*DEAD_ZONE, n)
    limit = gain * rng.uniform(*REACH, n)
    lag = float(rng.uniform(0.0, LARGEST_LAG))
    arm = servo_arm.ServoArm(
        robot=replace(robot, mj_model=model, links=tuple(links)),
        stiffness=gain,
        damping=damping,
        servo_damping=limited * damping,
        coulomb=coulomb,
        armature=rotor,
        # The arm acts on commands at whole milliseconds.
        delay=round(rng.uniform(0.0, LARGEST_DELAY), 3),
        limit=limit,
        dead_zone=dead_zone,
        stribeck=stribeck,
        load_share=load_share,
        load_stribeck=load_stribeck,
        slip_speed=slip_speed,
        lag=lag,
    )
    rate = float(rng.choice(RATES))
    at, command = servo_arm.commands(robot, rng, SECONDS, rate)
    sent = ENCODER * np.round(command / ENCODER)
    q = ENCODER * np.round(arm.play(at, sent) / ENCODER)
    return Drawn(arm, Recording(at, q, None, sent - q, command=sent))


def truths(arm: servo_arm.ServoArm) -> dict[str, np.ndarray]:
    """Return the true numbers (n,) of a drawn arm by name."""
    gain = arm.stiffness
    return {
        "sag": largest_weights(arm.robot, arm.robot.thetas)[0] / gain,
        "torque_over_weight": arm.limit
        / np.maximum(largest_weights(arm.robot, arm.robot.thetas)[0], LEAST_WEIGHT),
        "dead_band": (arm.coulomb + arm.stribeck) / gain + arm.dead_zone,
        "friction_over_gain": arm.coulomb / gain,
        "damping_over_gain": arm.damping / gain,
        "even_speed": arm.coulomb / arm.damping,
        "gain": gain,
        "torque_limit": arm.limit,
        "damping": arm.damping,
        "frictionloss": arm.coulomb,
        "armature": arm.armature,
        "stribeck": arm.stribeck,
        "load_share": arm.load_share,
        "load_stribeck": arm.load_stribeck,
        "dead_zone": arm.dead_zone,
        "loop_lag": np.full_like(gain, arm.lag),
    }


@dataclass(frozen=True)
class Answer:
    """What a fit found of a drawn arm.

    Attributes:
        off: name to errors, stated errors and true numbers (3, n), of joints that show it.
        held_out: root mean square position errors of the file before and after [rad].
        seconds: processor time.
    """

    off: dict[str, np.ndarray]
    held_out: tuple[float, float]
    seconds: float


def answer(robot: RobotModel, drawn: Drawn) -> Answer:
    """Fit the first half of a log and play the other."""
    half = len(drawn.log) // 2
    before = time.process_time()
    fit = fit_servos(robot, [drawn.log[:half]], Progress())
    seconds = time.process_time() - before
    problem = ServoProblem(robot, [drawn.log[half:]], UNKNOWN, fit.delay)
    in_model = replace(servos_in_model(robot), delay=fit.delay)
    plays = (in_model, fit.in_file)
    held_out = tuple(rms(problem.errors(servos)) for servos in plays)
    return Answer(offs(robot, drawn.arm, fit), held_out, seconds)


def offs(
    robot: RobotModel, arm: servo_arm.ServoArm, fit: ServoFit
) -> dict[str, np.ndarray]:
    """Return name to errors, stated errors and true numbers (3, n) of a fit."""
    found = {**derived_numbers(robot, fit), **absolute_numbers(fit)}
    late = np.array([[fit.delay - arm.delay], [fit.delay_error], [arm.delay]])
    rows = {"delay": late}
    carries = largest_weights(arm.robot, arm.robot.thetas)[0] > LEAST_WEIGHT
    for name, true in truths(arm).items():
        of = carries if name in OF_WEIGHT else np.ones_like(carries)
        off = found[name].values - true
        rows[name] = np.stack((off[of], found[name].errors[of], true[of]))
    return rows


def lines(answers: list[Answer]) -> list[str]:
    """Return the rows of the table."""
    heads = ("", "error, median", "stated, median", "rms in ±", f"beyond {FAR:g} ±")
    rows = [heads, ("---",) * len(heads)]
    for name in answers[0].off:
        off, stated, true = np.hstack([each.off[name] for each in answers])
        size = np.maximum(np.abs(true), 1e-9)
        in_stated = np.abs(off) / stated
        is_there = true > 0.0
        shares = (
            100.0 * np.median(each[is_there] / size[is_there])
            for each in (np.abs(off), stated)
        )
        error, known = (f"{share:.1f} %" for share in shares)
        far = f"{np.sum(in_stated > FAR)} of {len(off)}"
        rows.append(
            (name.replace("_", " "), error, known, f"{rms(in_stated):.2f}", far)
        )
    held_out = np.array([each.held_out for each in answers])
    before, after = 1e3 * np.median(held_out, axis=0)
    seconds = np.median([each.seconds for each in answers])
    return [
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
        f"{len(answers)} arms: the file's position error over 5 s falls from {before:.0f} to "
        f"{after:.1f} mrad in the median, in {seconds:.0f} s of processor time for 20 s of five "
        "joints.",
    ]


def main() -> None:
    """Print the table, and write it into its page if asked."""
    parser = argparse.ArgumentParser()
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("beyond", type=int, nargs="?", default=ARMS)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    robot = load_robot_model(FILE, joint=TIP)
    answers = []
    for seed in range(options.first, options.beyond):
        answers.append(answer(robot, draw(robot, seed)))
        _, after = answers[-1].held_out
        print(f"arm {seed}: {1e3 * after:.2f} mrad", flush=True)
    TABLE.show(lines(answers), options.write)


if __name__ == "__main__":
    main()
