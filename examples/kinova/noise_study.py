"""Errors of an identification by torque noise: one motion of the true arm, many draws of noise.

Everything that noise does not change (the simulation, the filtering of positions, the equations) is
computed once. The noise of a draw passes the same low-pass as the torques and is added to them,
which is what would have come out of filtering noisy torques, because a filter is linear. So 200
draws take seconds. The other links are known here; see validate_measurements.py for when they are
not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from validate_regressor import with_link

from robot_sysid.estimate.fit import Fit, Problem
from robot_sysid.estimate.identifiability import square_root, visible_space
from robot_sysid.estimate.options import (
    DEFAULT_FRICTION,
    EstimationOptions,
    Priors,
    friction_terms,
)
from robot_sysid.estimate.questions import Question, arm_question
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import LAST_LINK, ArmTerms
from robot_sysid.parser import load_robot_model
from robot_sysid.records import MotionPlan, RobotModel, join_recordings
from robot_sysid.signals.process import FilteredRecording, low_pass_recordings
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.simulation.plant import plant_measurements
from robot_sysid.simulator import simulate_inverse
from robot_sysid.solver import exact_recording
from robot_sysid.spatial import PARAMETER_NAMES
from robot_sysid.trajectory import generate_excitation_trajectory, motion_chunks

Array = NDArray[np.float64]

MODELS = Path(__file__).resolve().parent / "model"
SAMPLE_RATE = 1000.0
ENCODER_STEP = 1e-4
NORMAL_95 = 1.96
KNOWN = Priors(link=0.0, scale=0.0, zero=0.0, gravity=0.0, delay=0.0, friction=0.0)
"""All that is not noise is known."""


@dataclass(frozen=True)
class Noise:
    """Torque noise of all joints.

    Attributes:
        level: standard deviation [N m], one number or one per joint.
        memory: time constant of its correlation [s]; 0 for white noise.
    """

    level: float | tuple[float, ...]
    memory: float = 0.0

    def draw(self, rng: np.random.Generator, samples: int, joints: int) -> Array:
        """Return noise (samples, joints) [N m]."""
        from scipy.signal import lfilter

        noise = rng.normal(size=(samples, joints))
        if self.memory > 0.0:
            decay = np.exp(-1.0 / (SAMPLE_RATE * self.memory))
            noise[1:] *= np.sqrt(1.0 - decay**2)
            noise = lfilter([1.0], [1.0, -decay], noise, axis=0)
        return np.asarray(self.level) * noise


@dataclass(frozen=True)
class Outcome:
    """Results of many draws of noise.

    Attributes:
        names: (p,) of the parameters.
        errors: (draws, p) estimate minus truth.
        covered: (draws, p) whether the 95 % interval holds the truth.
        plain_covered: the same for the plain estimate, which the standard errors describe; a result
            that was moved to the nearest possible body is usually closer to the truth than it.
        constrained: share of draws whose plain estimate was no possible body.
        impossible: number of results that are no possible body.
    """

    names: tuple[str, ...]
    errors: Array
    covered: NDArray[np.bool_]
    plain_covered: NDArray[np.bool_]
    constrained: float
    impossible: int

    def over_bound(self, bound: Array) -> Array:
        """Return (p,) root mean square error over the Cramer-Rao bound's standard deviation."""
        return np.sqrt(np.mean(self.errors**2, axis=0)) / bound


class NoiseStudy:
    """One motion of the true arm, read by a real encoder, ready for any torque noise.

    Args:
        plan: the trajectory; None draws one.
        seed: of that trajectory.
    """

    def __init__(self, plan: MotionPlan | None = None, seed: int = 1) -> None:
        self.plant = load_robot_model(MODELS / "kinova_fullinertia.xml")
        guess = load_robot_model(MODELS / "kinova_fullinertia_guess.xml").links[-1]
        self.robot = replace(
            self.plant,
            mj_model=with_link(self.plant, guess.theta),
            links=(*self.plant.links[:-1], guess),
        )
        self.plan = plan or random_plan(self.robot, seed)
        self.recording = self.record()
        self.arm = ArmTerms(self.robot)
        keys = (LAST_LINK, *friction_terms(DEFAULT_FRICTION))
        self.shown = self.arm.of([self.arm.terms[key] for key in keys])
        self.names = self.shown.names
        self.truth = self._true_values()

    def record(self) -> FilteredRecording:
        """Return what the true arm's sensors report of the motion."""
        sensors = SimulatedArmOptions(encoder_resolution=ENCODER_STEP)
        rng = np.random.default_rng(0)
        run = plant_measurements(self.plant, self.plan, sensors, SAMPLE_RATE, rng)
        log = replace(join_recordings(run), name="log")
        (recording,), _ = low_pass_recordings(self.robot, [log])
        return recording

    @property
    def cutoff(self) -> float:
        """Return the cut-off of the low-pass [Hz]."""
        return self.recording.cutoff

    def _true_values(self) -> Array:
        """Return the plant's values (p,) in the order of ``names``."""
        values = dict(zip(PARAMETER_NAMES, self.plant.prior.theta))
        friction = self.plant.friction
        rotors = self.plant.mj_model.dof_armature
        for index, joint in enumerate(self.plant.joint_names):
            values[f"coulomb[{joint}]"] = friction.coulomb[index]
            values[f"viscous[{joint}]"] = friction.viscous[index]
            values[f"armature[{joint}]"] = rotors[self.plant.dof_index[index]]
        return np.array([float(values.get(name, 0.0)) for name in self.names])

    def bound(self, noise: Noise) -> Array:
        """Return the Cramer-Rao bound (p,) of the whole log: exact motion, white noise."""
        exact = simulate_inverse(self.plant, motion_chunks(self.plan, SAMPLE_RATE))
        recording = exact_recording(join_recordings(exact))
        sums = self.shown.sums([recording], self.shown.start())
        level = np.broadcast_to(
            np.asarray(noise.level, dtype=float), (self.robot.n_joints,)
        )
        return np.sqrt(np.diag(cramer_rao_bound(sums, level)))

    def noisy(self, noise: Noise, rng: np.random.Generator) -> FilteredRecording:
        """Return the recording with one draw of noise in its torques."""
        log = self.recording
        drawn = noise.draw(rng, len(log.time), self.robot.n_joints)
        return replace(log, tau=log.tau + drawn)

    def identify(self, recording: FilteredRecording) -> tuple[Fit, Fit]:
        """Return the estimate of the command line, and that before it had to be possible."""
        question = Question(EstimationOptions(priors=KNOWN))
        point = self.arm.start()
        sums = self.arm.sums([recording], point)
        terms = arm_question(self.arm, question, sums.rms_torque)
        problem = Problem(self.arm, (recording,), point, sums, question)
        fitted = problem.fit(terms)
        return fitted, replace(fitted, values=fitted.free)

    def run(self, noise: Noise, draws: int, seed: int = 0) -> Outcome:
        """Identify from many draws of noise."""
        errors = []
        plain_errors = []
        reach = []
        constrained = 0
        impossible = 0
        for draw in range(draws):
            samples = self.noisy(noise, np.random.default_rng([seed, draw]))
            estimate, plain = self.identify(samples)
            errors.append(self.errors(estimate))
            plain_errors.append(self.errors(plain))
            stated = dict(zip(estimate.names, estimate.errors))
            reach.append([NORMAL_95 * stated.get(name, 0.0) for name in self.names])
            constrained += not plain.equations.are_possible_bodies(plain.values)
            impossible += not estimate.equations.are_possible_bodies(estimate.values)
        return Outcome(
            self.names,
            np.array(errors),
            np.abs(errors) < np.array(reach),
            np.abs(plain_errors) < np.array(reach),
            constrained / draws,
            impossible,
        )

    def errors(self, estimate: Fit) -> Array:
        """Return (p,) estimate minus truth."""
        return np.array([estimate.by_name[name] for name in self.names]) - self.truth


def random_plan(robot: RobotModel, seed: int) -> MotionPlan:
    """Return the trajectory the command line would draw with this seed."""
    rng = np.random.default_rng(seed)
    return generate_excitation_trajectory(robot, rng)


def cramer_rao_bound(sums: Sums, noise: Array) -> Array:
    """Return the least covariance (p, p) any unbiased estimate can have: (Y^T Sigma^-1 Y)^-1.

    For white normal noise; the pseudo-inverse where the data shows nothing (Cramer 1946, Rao 1945).

    Args:
        sums: of the equations.
        noise: (joints,) noise standard deviation [N m].
    """
    size = len(sums.names) + 1
    normal = np.zeros((size, size))
    for sigma, at, products in zip(noise, sums.columns, sums.totals):
        normal[at[:, None], at] += products / sigma**2
    return visible_space(square_root(normal[:-1, :-1])).inverse()
