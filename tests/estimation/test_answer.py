"""Base parameters: their number is that of textbooks, and they are found within their errors."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimation.answer import base_parameters, structural_base
from robot_sysid.estimation.errors import fit_errors
from robot_sysid.estimation.question import EstimationOptions, Priors
from tests.support import arms
from tests.support.core_fits import fit_recordings
from tests.support.payload_logs import TrueArm, add_noise, four_joint_arm, wide_motion


@pytest.mark.parametrize(
    ("axes", "rank"), [((arms.Z,), 1), ((arms.Z, arms.Y, arms.X), 15)]
)
def test_structural_rank_is_that_of_textbooks(axes, rank):
    """A vertical first axis shows one parameter, an arm of three crossing ones fifteen."""
    assert structural_base(arms.robot_of(arms.serial_arm(axes))).rank == rank


def evaluate(combination, value_of):
    """Return the value of a combination such as "m + 0.5*hz(link1)"."""
    total = 0.0
    for term in combination.replace("- ", "-").replace("+ ", "").split():
        factor, _, name = term.lstrip("-").rpartition("*")
        total += (
            (-1.0 if term[0] == "-" else 1.0) * float(factor or 1.0) * value_of[name]
        )
    return total


@pytest.mark.parametrize("link", [5.0, 0.0])
def test_base_parameters_are_found_whatever_the_prior_of_links(link):
    robot = four_joint_arm()
    arm = TrueArm(robot, 3, model_error=0.0)
    recording = add_noise(arm.recording(wide_motion(3), False), 0.01, 0)
    options = EstimationOptions(priors=Priors(link=link))
    fit = fit_recordings(robot, [recording], options)
    base = base_parameters(fit, fit_errors(fit))
    assert len(base.values) == base.structural_rank == structural_base(robot).rank
    value_of = dict(zip(fit.columns.names, arm.values(fit.columns)))
    truth = [evaluate(combination, value_of) for combination in base.combinations]
    assert np.all(np.abs(base.values - truth) < 4.0 * base.standard_errors + 1e-3)
    leading = [combination.split()[0] for combination in base.combinations]
    is_essential = dict(zip(leading, base.essential))
    # A rotor is confounded with some of the inertia, which is therefore not missed.
    assert is_essential["m"] and is_essential["Ixx"] and is_essential["Izz"]
    assert not is_essential["Izz(link0)"]
