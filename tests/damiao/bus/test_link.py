"""The guard that every frame goes through."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.protocol.frames import Frame
from robot_sysid.errors import SysidError
from tests.support.motor_bench import Bench


def test_a_refused_frame_does_not_reach_the_bus():
    bench = Bench()
    with pytest.raises(SysidError):
        bench.link.send(Frame(1, b"\xff" * 7 + b"\xfe"))
    assert bench.bus.sent == []
