"""What an identification will make of a recording of a planned motion, before there is one.

The planned motion is treated like a log of it would be: its ends are cut off, all columns pass the
low-pass, and moments in which a joint is too slow are left out. What is left is less than all
samples could tell (``motion.prediction``). Torque noise is all that is counted: errors of the
model, which an identification states too, do not become smaller by moving more cleverly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.dynamics.equations import TERMINAL_FRICTION, Equations, friction_per_joint
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimation.algebra.identifiability import analyse_identifiability
from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.choices import CANDIDATES
from robot_sysid.estimation.dataset import DecimatedSamples, decimated_equations
from robot_sysid.estimation.identify import Piece, answer_link, filtered
from robot_sysid.logs.reader import join_measurements
from robot_sysid.motion.prediction import Prediction, Seen, predict
from robot_sysid.motion.problem import ExcitationProblem
from robot_sysid.records import Array, Measurement, MotionPlan
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import process
from robot_sysid.simulator import collect_sysid_data, simulate_inverse
from robot_sysid.trajectory import motion_chunks, sample_count

COUNTED = "torque noise alone, after the ends are cut off and all signals are low-passed"
UNUSABLE = "if all samples could be used, but they cannot"
HIGHEST_RATE_HZ = 200.0
"""Rate at which the motion is processed: far above its band. Noise is scaled to it."""
MOST_SHOWN = 20_000
"""Samples of a motion that the regressor is looked at with."""
MOST_SAMPLES = 200_000
"""Samples beyond which processing a motion beforehand would take too long."""


def expect(
    problem: ExcitationProblem, plan: MotionPlan, sample_rate: float, options: EstimationOptions
) -> Prediction:
    """Predict what an identification of a recording of a motion will deliver.

    Args:
        problem: the arm, its limits, and the torque noise.
        sample_rate: at which it will be recorded, with independent noise in each sample [Hz].
        options: how it will be identified.
    """
    rate = min(sample_rate, HIGHEST_RATE_HZ)
    # What the model's own simulation along the motion says of the link's equations.
    friction = friction_per_joint(problem.robot, "terminal", TERMINAL_FRICTION)
    motions = motion_chunks(plan, min(rate, MOST_SHOWN / plan.duration))
    equations = Equations(problem.robot, problem.torques, friction)
    simulated = simulate_inverse(problem.robot, motions)
    shown = analyse_identifiability(collect_sysid_data(equations, simulated))
    sigma = problem.sigma * np.sqrt(rate / sample_rate)
    given = options if options.friction else replace(options, friction_model=CANDIDATES[0])
    try:
        recording = _rehearsal(problem, plan, rate, sigma)
        prediction = predict(problem, plan, sample_rate, _seen(problem, recording, sigma, given))
    except InputError as error:
        prediction = predict(problem, plan, sample_rate)
        return replace(prediction, counted=f"{UNUSABLE}: {error}", shown=shown)
    prediction = replace(prediction, counted=COUNTED, shown=shown)
    try:
        datasets, _ = filtered(problem.robot, [Piece("", recording)], given)
        answer = answer_link(problem.robot, datasets, given, Progress(), None)
    except SysidError:
        return prediction
    return replace(prediction, stated=answer.errors.whole.standard_errors[:10])


def _rehearsal(
    problem: ExcitationProblem, plan: MotionPlan, rate: float, sigma: Array
) -> Measurement:
    """Return what a recording of the motion at ``rate`` [Hz] would look like, with noise [N m]."""
    if sample_count(plan.duration, rate) > MOST_SAMPLES:
        raise InputError(f"only motions up to {MOST_SAMPLES / rate:.0f} s are processed beforehand")
    exact = join_measurements(simulate_inverse(problem.robot, motion_chunks(plan, rate)))
    tau = exact.tau.copy()
    noise = np.random.default_rng(0).normal(size=(len(tau), len(problem.rows)))
    tau[:, list(problem.rows)] += sigma * noise
    return replace(exact, tau=tau, qd=None, qdd=None)


def _seen(
    problem: ExcitationProblem, recording: Measurement, sigma: Array, options: EstimationOptions
) -> Seen:
    """Return the information that a recording with noise sigma holds for its identification."""
    robot, band = problem.robot, options.velocity_deadband
    signals = process(recording, robot.joint_names, options.cutoff, band)
    assert options.friction is not None
    friction = friction_per_joint(robot, problem.torques, options.friction)
    samples = decimated_equations(Equations(robot, problem.torques, friction), signals)
    # The rows are slow: what counts of white noise that passed the filter is its density at low
    # frequencies, which the filter leaves alone, spread over the samples each row stands for.
    noise = sigma / np.sqrt(signals.low_pass.step)
    return _without_friction(samples, noise, problem.scale)


def _without_friction(samples: DecimatedSamples, noise: Array, scale: Array) -> Seen:
    """Return what equations tell about theta in units of ``scale``, friction eliminated."""
    size = len(samples.names)
    normal = np.zeros((size, size))
    for (_, rows, tau), columns, sigma in zip(samples, samples.columns, noise):
        rows = rows[np.isfinite(tau)]
        normal[np.ix_(columns, columns)] += rows.T @ rows / sigma**2
    link, cross, own = normal[:10, :10], normal[:10, 10:], normal[10:, 10:]
    units = np.outer(scale, scale)
    left = link - cross @ np.linalg.pinv(own, rcond=1e-12, hermitian=True) @ cross.T
    return units * left, float(np.trace(units * link))
