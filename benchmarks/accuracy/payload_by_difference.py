"""Payloads of imperfect simulated arms: errors of the joint estimate beside the stated ones.

    python -m benchmarks.accuracy.payload_by_difference MODELS [--runs 20] [--scale 0 1]
        [--arms ...] [--drift 5]

MODELS is a folder of public models as in MuJoCo Menagerie. Each run draws an arm with all errors at
once (benchmarks/accuracy/imperfect_arm.py) and four recordings (empty, loaded, loaded, empty) along
one random trajectory, or along four with --different. Printed: rms errors of the payload's mass and
centre of mass, stated errors and coverage; with --single also the error of the difference of two
separate fits. The trajectory moves all joints widely; with --narrow all joints but the last move by
a tenth of their range. With --drift friction changes from log to log, by up to that many per cent.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.arm_results import result_of_logs
from benchmarks.accuracy.imperfect_arm import Imperfections, draw_imperfect_arm
from rigs.arms.core_fits import ORIGIN
from rigs.arms.wrong_arms import ARMS
from robot_sysid import spatial
from robot_sysid.estimate.choose import solve_question
from robot_sysid.estimate.options import EstimationOptions, Priors
from robot_sysid.estimate.payload import written_payload
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.restricted_fit import fit_file
from robot_sysid.model.bodies import find_flange
from robot_sysid.parser import load_robot_model
from robot_sysid.results.payload import payload_result
from robot_sysid.signals.process import low_pass_recordings
from robot_sysid.trajectory import generate_excitation_trajectory

PAYLOAD = spatial.theta_from_com(
    1.0, np.array([0.03, -0.02, 0.08]), np.diag([0.004, 0.005, 0.003])
)
ORDER = (False, True, True, False)
USUAL = EstimationOptions()


WIDER = 5.0
SPEED_SHARE = 0.9
"""Largest factor by which a trajectory is widened, and the used share of speed limits."""


def trajectory(robot, rng, wide):
    """Return a random trajectory within the limits."""
    plan = generate_excitation_trajectory(robot, rng)
    if not wide:
        return plan
    qd = plan.evaluate(np.arange(0.0, plan.duration, 0.01)).qd
    speed = np.max(np.abs(qd), axis=0)
    factor = np.minimum(WIDER, SPEED_SHARE * robot.limits.velocity / speed)
    factor[-1] = 1.0
    return plan.scale_amplitudes(factor)


def turn_body(theta, angle):
    """Return a body (10,) turned about the z axis by an angle [rad]."""
    mass, com, inertia = spatial.com_from_theta(theta)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return spatial.theta_from_com(mass, turn @ com, turn @ inertia @ turn.T)


def recordings(
    robot, arm, rng, different=False, payload=PAYLOAD, wide=True, second=None, drift=0.0
):
    """Return four recordings: empty, loaded, loaded with a second payload, empty.

    Friction changes by a share ``drift`` of itself from one to the next.
    """
    plans = [trajectory(robot, rng, wide) for _ in (ORDER if different else ORDER[:1])]
    records = []
    for k, loaded in enumerate(ORDER):
        carried = payload if second is None or k != 2 else second
        warmer = (1.0 + drift) ** k
        own = replace(arm, coulomb=warmer * arm.coulomb, viscous=warmer * arm.viscous)
        samples = own.record(plans[k % len(plans)], rng, loaded * carried)
        records.append(replace(samples, name=f"log{k}", is_loaded=loaded))
    return records


def weigh(robot, raw, estimation=USUAL, drifts=True, **question_options):
    """Return the result of ``robot-sysid payload`` on recordings."""
    pieces = []
    for recording, position in zip(raw, np.linspace(-1.0, 1.0, len(raw))):
        pieces.append(replace(recording, order=position))
    recordings, _ = low_pass_recordings(robot, pieces)
    question = Question(estimation, loaded=True, drifts=drifts, **question_options)
    weighed = solve_question(robot, recordings, replace(question, known_mass=None))
    fitted, file = weighed, None
    if question.known_mass is None:
        carried, _ = written_payload(weighed)
        file = fit_file(weighed, carried)
    else:
        fitted = solve_question(robot, recordings, question)
    divided = np.ones(robot.n_joints)
    flange = find_flange(robot, "0,0,0")
    return payload_result(fitted, weighed, file, flange, ORIGIN, (), divided)


def single_difference(robot, raw):
    """Return the difference of the terminal link's mass in two separate fits [kg]."""
    exact = ("link", "scale", "zero", "gravity")
    options = EstimationOptions(priors=Priors(**dict.fromkeys(exact, 0.0)))
    masses = []
    for is_loaded in (False, True):
        logs = [piece for piece in raw if piece.is_loaded is is_loaded]
        masses.append(result_of_logs(robot, logs, options).body.mass)
    return masses[1] - masses[0]


def run(robot, seed, off, different, single, wide, second, drift):
    """Return errors of mass (true, stated, by noise), centre of mass, and difference."""
    rng = np.random.default_rng([seed, 77])
    arm = draw_imperfect_arm(robot, rng, off)
    change = drift * np.random.default_rng([seed, 78]).uniform(-1.0, 1.0)
    raw = recordings(robot, arm, rng, different, wide=wide, second=second, drift=change)
    result = weigh(robot, raw)
    body = result.payload
    difference = single_difference(robot, raw) if single else np.nan
    return (
        body.mass - PAYLOAD[0],
        body.errors[0],
        body.budget["noise"][0],
        np.linalg.norm(body.com - PAYLOAD[1:4] / PAYLOAD[0]),
        difference - PAYLOAD[0],
        float(result.verdict.is_trustworthy),
    )


def rms(values):
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(np.square(values))))


def main():
    """Print a line per arm and torque scale."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument(
        "--scale", type=float, nargs="+", default=[0.0, 1.0], help="per cent"
    )
    parser.add_argument(
        "--arms", nargs="+", default=["gen3", "panda"], choices=list(ARMS)
    )
    parser.add_argument(
        "--noise", type=float, default=0.3, help="of a strong joint, N m"
    )
    parser.add_argument("--narrow", action="store_true", help="joints move little")
    parser.add_argument(
        "--different", action="store_true", help="four trajectories, not one"
    )
    parser.add_argument(
        "--turned", type=float, default=0.0, help="second loaded log, degrees"
    )
    parser.add_argument(
        "--heavier", type=float, default=0.0, help="second loaded log, per cent"
    )
    parser.add_argument(
        "--single", action="store_true", help="difference of two fits as well"
    )
    parser.add_argument(
        "--drift", type=float, default=0.0, help="of friction from log to log, per cent"
    )
    options = parser.parse_args()
    second = (1.0 + 0.01 * options.heavier) * turn_body(
        PAYLOAD, np.radians(options.turned)
    )
    for name in options.arms:
        robot = load_robot_model(options.models / ARMS[name])
        for scale in options.scale:
            rows = []
            for seed in range(options.runs):
                choices = options.different, options.single, not options.narrow, second
                choices += (0.01 * options.drift,)
                off = Imperfections(scale=0.01 * scale, noise=options.noise)
                rows.append(run(robot, seed, off, *choices))
                print(
                    f"  {name} {scale:g} % run {seed}: {rows[-1][0]:+.4f} kg",
                    file=sys.stderr,
                )
            error, stated, noise, com, difference, trusted = np.array(rows).T
            covered = np.mean(np.abs(error) < 1.96 * stated)
            print(
                f"{name}, noise {options.noise:g} N·m, torque scale {scale:g} %, "
                f"{options.runs} runs: mass rms "
                f"{100.0 * rms(error):.2f} % (stated {100.0 * rms(stated):.2f}, noise alone "
                f"{100.0 * rms(noise):.2f}, 95 % covers {100.0 * covered:.0f} %, "
                f"over stated {rms(error / stated):.2f}), centre of mass "
                f"{1e3 * rms(com):.1f} mm, trusted {100.0 * np.mean(trusted):.0f} %, difference of "
                f"two single fits {100.0 * rms(difference):.1f} %",
                flush=True,
            )


if __name__ == "__main__":
    main()
