"""Recordings of a payload are compared with one another."""

from dataclasses import replace

import numpy as np
import pytest

from rigs.arms.core_fits import fit_recordings
from rigs.logs.payload_logs import PAYLOAD, TrueArm, four_joint_arm
from robot_sysid import spatial
from robot_sysid.estimate.payload import contradiction

ROBOT = four_joint_arm()


def half_turn(theta):
    """Return a body turned by half a turn about the flange's axis."""
    rotation = np.diag([-1.0, -1.0, 1.0])
    mass, com, inertia = spatial.com_from_theta(theta)
    return spatial.theta_from_com(mass, rotation @ com, rotation @ inertia @ rotation)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("index", "change", "names"),
    [
        (2, half_turn, ("log1", "log2")),
        (3, lambda theta: 0.2 * theta, ("log0", "log3")),
    ],
)
def test_clear_differences_between_like_recordings_are_named(
    recordings, index, change, names
):
    """One of the two loaded recordings carries something else, or an empty one anything."""
    arm = TrueArm(ROBOT, 7, model_error=0.03, payload=change(PAYLOAD))
    changed = arm.abba(7, sigma=0.05)
    odd = replace(changed[index if index == 2 else 1], name=f"log{index}")
    logs = [*recordings]
    logs[index] = replace(odd, is_loaded=index == 2)
    fitted = fit_recordings(ROBOT, logs, loaded=True)
    found = contradiction(fitted)
    assert found is not None and {found.recording, *found.others} == {*names}
