"""The log of all frames."""

from __future__ import annotations

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.bus.can_log import RawFrameLog
from robot_sysid.damiao.bus.clock import SimulatedClock
from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import InputError
from tests.support.can_frames import FRAMES


@given(st.lists(st.tuples(FRAMES, st.booleans()), min_size=1, max_size=20))
def test_the_frame_log_is_lossless(tmp_path_factory, frames):
    path = tmp_path_factory.mktemp("raw") / "measured.log"
    clock = SimulatedClock()
    log = RawFrameLog(path, clock, ["can0"])
    for k, (frame, sent) in enumerate(frames):
        log(frame._replace(time=0.001 * k), sent)
    log.write(log.taken())
    with can.LogReader(path) as reader:
        messages = list(reader)
    log.close()
    assert len(messages) == len(frames)
    for message, (frame, sent) in zip(messages, frames):
        assert message.arbitration_id == frame.id and bytes(message.data) == frame.data
        assert message.is_fd == frame.fd and message.is_rx == (not sent)
    stamps = np.array([message.timestamp for message in messages])
    np.testing.assert_allclose(np.diff(stamps), 0.001, atol=2e-6)


def test_frames_are_logged_in_the_order_of_their_time(tmp_path):
    clock = SimulatedClock()
    log = RawFrameLog(tmp_path / "measured.log", clock, ["can0"])
    for stamp in (0.3, 0.1, 0.2):
        log(Frame(round(10 * stamp), b"", stamp), False)
    log.write(log.taken())
    log.close()
    with can.LogReader(tmp_path / "measured.log") as reader:
        assert [message.arbitration_id for message in reader] == [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "words"), [("x.unknown", "cannot log frames"), ("no/folder.log", "cannot write")]
)
def test_a_frame_log_that_cannot_be_made_is_said(tmp_path, name, words):
    with pytest.raises(InputError, match=words):
        RawFrameLog(tmp_path / name, SimulatedClock(), ["can0"])
