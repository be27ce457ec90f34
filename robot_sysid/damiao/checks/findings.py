"""The findings that the checks of a run yield."""

from __future__ import annotations

from functools import partial

from robot_sysid.records.messages import Level, Remark

note = partial(Remark, Level.SAYS, "")
"""Return a finding, by its text, that the user should know."""
stop = partial(Remark, Level.REFUSES, "")
"""Return a finding, by its text with the remedy, that forbids to play."""
