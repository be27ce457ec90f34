"""--torque-scale and --torque-constants act where torque is read."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.logs.options import LogOptions
from robot_sysid.logs.reader import torque_factor
from tests.support.log_files import JOINTS, motion, read_measurements, table, write

POSITIVE = st.lists(st.floats(1e-2, 1e2), min_size=3, max_size=3).map(tuple)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scale=POSITIVE, constants=POSITIVE)
def test_torque_is_divided_by_scale_and_multiplied_with_constants(tmp_path, scale, constants):
    path = tmp_path / "log.csv"
    if not path.exists():
        write(path, table(motion(20)))
    log = read_measurements(path, JOINTS, torque_scale=scale, torque_constants=constants)
    expected = motion(20).tau * constants / np.array(scale)
    np.testing.assert_allclose(log.samples.tau, expected, rtol=1e-14)
    np.testing.assert_array_equal(log.samples.q, motion(20).q)


def test_without_options_there_is_no_factor_and_with_one_it_is_said(tmp_path):
    assert torque_factor(LogOptions(), JOINTS) is None
    path = write(tmp_path / "log.csv", table(motion(20)))
    notes = " ".join(read_measurements(path, JOINTS, torque_scale=2.0).notes)
    assert "'tau1', 'tau2', 'tau3' (each x 0.5)" in notes


@pytest.mark.parametrize("option", ["torque_scale", "torque_constants"])
def test_what_cannot_be_a_factor_is_refused(option):
    from robot_sysid.errors import InputError

    for wrong in (0.0, -1.0, float("nan"), (1.0, float("inf"))):
        with pytest.raises(InputError, match="must be positive"):
            LogOptions(**{option: wrong})
