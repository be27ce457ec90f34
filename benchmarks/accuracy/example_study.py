"""The noise study of the Kinova example, with functions that only benchmarks need."""

from __future__ import annotations

import importlib
import sys

import numpy as np

from rigs.files.places import EXAMPLE
from robot_sysid.records.messages import Progress

sys.path.insert(0, str(EXAMPLE))
noise_study = importlib.import_module("noise_study")
sys.path.remove(str(EXAMPLE))

Noise = noise_study.Noise
NoiseStudy = noise_study.NoiseStudy
random_plan = noise_study.random_plan


def designed_plan(robot, seed=1):
    """Return the trajectory that ``--excitation optimal`` designs; it takes about 20 s."""
    from robot_sysid.estimate.options import EstimationOptions
    from robot_sysid.expected.recording import prior_knowledge
    from robot_sysid.motion import ExcitationOptions, LimitOptions
    from robot_sysid.motion.problem import build_problem
    from robot_sysid.motion.search import Design, design_excitation
    from robot_sysid.trajectory import TrajectoryOptions

    problem = build_problem(robot, LimitOptions())
    knowledge = prior_knowledge(problem, EstimationOptions(), "link")
    design = Design(problem, ExcitationOptions(), TrajectoryOptions(), knowledge)
    return design_excitation(design, np.random.default_rng(seed), Progress())


def friction_errors(study, estimate):
    """Return the largest relative errors of (mass, Coulomb friction, viscous friction)."""
    error = np.abs(study.errors(estimate))
    worst = [error[0] / study.truth[0]]
    for term in ("coulomb", "viscous"):
        of_term = [k for k, name in enumerate(study.names) if name.startswith(term)]
        worst.append(np.max(error[of_term] / study.truth[of_term]))
    return worst
