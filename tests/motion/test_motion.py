"""Every excitation option is checked once, with a message that names it."""

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.motion import THOROUGH, USUAL, ExcitationOptions, LimitOptions


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("kind", "best", "--excitation 'best': choose one of sines, optimal"),
        ("time_budget", 0.0, "--excitation-time-budget must be positive"),
        ("max_velocity", np.nan, "--max-velocity must be positive (got nan)"),
        ("max_torque", (5.0, -1.0), "--max-torque must be positive (got -1)"),
        ("clearance", -0.01, "--clearance must be a number that is not negative"),
        ("workspace", (1.0, -1.0, 0.0, 1.0, 0.0, 1.0), "each minimum below"),
        ("keep_out", ((0.0, 0.0, 0.0, 1.0),), "normal that is not zero"),
        ("keep_out", ((0, 0, 1, np.inf),), "normal that is not zero"),
    ],
)
def test_an_invalid_option_is_refused_in_one_line(field, value, message):
    is_search = field in ("kind", "time_budget")
    record = ExcitationOptions if is_search else LimitOptions
    with pytest.raises(InputError) as caught:
        record(**{field: value})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_half_spaces_follow_the_workspace_and_the_planes():
    limits = LimitOptions(
        workspace=(-1.0, np.inf, -2.0, 2.0, 0.0, 3.0), keep_out=((0.0, 0.0, 2.0, 1.0),)
    )
    plane, *box = limits.half_spaces([1, 2], [2])
    assert (*plane.normal, plane.offset, plane.bodies) == (0.0, 0.0, 1.0, 0.5, (1, 2))
    assert plane.clearance == 0.01 and "0.5 m" in plane.label
    assert [side.offset for side in box] == [-1.0, -2.0, -2.0, 0.0, -3.0]
    assert [side.normal.tolist() for side in box[:2]] == [[1, 0, 0], [0, 1, 0]]
    assert all(side.bodies == (2,) and side.clearance == 0.0 for side in box)
    assert LimitOptions().half_spaces([1], [1]) == ()


def test_a_thorough_search_draws_and_improves_more():
    assert ExcitationOptions().search_effort == USUAL
    assert ExcitationOptions(thorough=True).search_effort == THOROUGH
    assert THOROUGH.draws > USUAL.draws
    assert THOROUGH.iterations > USUAL.iterations
