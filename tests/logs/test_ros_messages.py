"""Makers' messages are read in SI units, with names, and with their time of sampling."""

from __future__ import annotations

import numpy as np
import pytest

from rigs.logs.driver_logs import START_NS, kortex_feedback, lbr_states
from rigs.logs.recorded import typestore
from robot_sysid.logs.ros_messages import KORTEX, LBR, READERS, read_stamp
from robot_sysid.records import Recording

ANGLES = np.array([0.1, -0.2, 3.0, -3.0, 0.0, 1.5, -1.5])
DATA = Recording(np.array([0.5]), ANGLES[None], 0.1 * ANGLES[None], 2.0 * ANGLES[None])


@pytest.mark.parametrize(
    ("message_type", "messages", "joint", "stamp"),
    [
        (LBR, lbr_states, "A{}", START_NS + 5 * 10**8),
        (KORTEX, kortex_feedback, "actuator_{}", 0),
    ],
)
def test_a_makers_message_is_read(message_type, messages, joint, stamp):
    ((_, message),) = messages(DATA)(typestore().types)
    sample = READERS[message_type](message)
    for number, angle in enumerate(ANGLES, start=1):
        name = joint.format(number)
        assert sample[name, "position"] == pytest.approx(angle, abs=1e-6)
        assert sample[name, "effort"] == pytest.approx(2.0 * angle, abs=1e-6)
    assert read_stamp(message) == stamp
