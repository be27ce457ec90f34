"""What a report draws comes from the equations that the result was made with."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.estimation.answer import traces_of
from robot_sysid.estimation.identify import answer_link
from robot_sysid.records.progress import Progress
from tests.support.core_fits import BASIC, datasets_of


@pytest.mark.parametrize("kept", [None, ()])
def test_the_residual_is_that_of_the_fit(plant, robot, noisy, kept):
    """Of the file, where there is one."""
    datasets, options = datasets_of(robot, noisy, friction_model=BASIC)
    answer = answer_link(robot, datasets, options, Progress(), kept)
    fit, traces = answer.fit if answer.file is None else answer.file.fit, traces_of(answer)
    squares = fit.evidence.whole.squared_residuals(fit.values)
    # Near a reversal the low-pass takes from friction's jump.
    moves = np.isfinite(traces.measured[:, -1]) & (np.abs(traces.qd[:, -1]) > 0.3)
    assert traces.joints == robot.joint_names
    np.testing.assert_allclose(np.nansum(traces.residual**2, axis=0), squares, rtol=1e-9)
    # The guess is clearly worse, and dry friction is most of what friction makes at low speed.
    worse = np.nanstd(traces.measured - traces.before, axis=0)
    assert np.all(worse > 2.0 * np.nanstd(traces.residual, axis=0))
    speed, friction = (np.abs(each[moves, -1]) for each in (traces.qd, traces.friction))
    offset = abs(fit.value("offset[joint2]"))
    np.testing.assert_allclose(friction, 0.3 + 0.2 * speed, atol=0.05 + offset)
