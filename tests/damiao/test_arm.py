"""What goes wrong with a simulated arm."""

from __future__ import annotations

import pytest

from robot_sysid.damiao.simulated import FAULT_KINDS, Fault, parse_fault
from robot_sysid.errors import InputError


@pytest.mark.parametrize("text", ["status", "status:x", "status:1=hot", "flood:1", "status:1@soon"])
def test_faults_that_cannot_be_read_are_refused(text):
    with pytest.raises(InputError, match="status, jammed, silent"):
        parse_fault(text)


def test_faults_are_read():
    assert parse_fault("status:2=13@4.5") == Fault("status", 2, 13.0, 4.5)
    assert parse_fault("silent:0") == Fault("silent", 0, 1.0, 0.0)
    assert all(parse_fault(f"{kind}:0").kind == kind for kind in FAULT_KINDS)
