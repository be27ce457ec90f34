"""Base parameters: how many any motion shows, and what a log says of them."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimation.algebra.options import EstimationOptions
from robot_sysid.estimation.answer import base_parameters, structural_base
from robot_sysid.estimation.errors import fit_errors
from tests.support import arms
from tests.support.core_fits import fitted
from tests.support.payload_logs import TrueArm, four_joint_arm, noisy, wide_motion


def test_structural_rank_is_that_of_textbooks():
    """A vertical first axis shows one parameter, an arm of three crossing ones fifteen."""
    assert structural_base(arms.robot_of(arms.serial_arm((arms.Z,)))).rank == 1
    assert structural_base(arms.robot_of(arms.THREE)).rank == 15


def combined(words, known):
    """What a combination such as "m + 0.5*hz(link1)" is."""
    total, sign = 0.0, 1.0
    for word in words.split():
        if word in ("+", "-"):
            sign = 1.0 if word == "+" else -1.0
        else:
            weight, _, name = word.rpartition("*")
            total += sign * float(weight or 1.0) * known[name]
    return total


@pytest.mark.parametrize("link_uncertainty", [5.0, 0.0])
def test_what_the_torques_show_is_found_whatever_is_sought(link_uncertainty):
    robot = four_joint_arm()
    arm = TrueArm(robot, 3, wrong=0.0)
    recording = noisy(arm.recording(wide_motion(3), False), 0.01, 0)
    options = EstimationOptions(link_uncertainty=link_uncertainty)
    fit = fitted(robot, [recording], options)
    found = base_parameters(fit, fit_errors(fit))
    assert found.rank == found.structural_rank == structural_base(robot).rank
    known = dict(zip(fit.columns.names, arm.values(fit.columns)))
    truth = np.array([combined(words, known) for words in found.combinations])
    assert np.all(np.abs(found.values - truth) < 4.0 * found.standard_errors + 1e-3)
    kept = dict(zip((words.split()[0] for words in found.combinations), found.essential))
    # Rotors turn as some of the inertia does, so that nobody misses it.
    assert kept["m"] and kept["Ixx"] and kept["Izz"] and not kept["Izz(link0)"]
