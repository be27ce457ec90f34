"""What stops an identification, and what does not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.diagnosis.finding import Finding, Level, require_acceptable
from robot_sysid.errors import InputError, SysidError
from robot_sysid.logs.options import CHECKS

FINDINGS = st.lists(
    st.builds(Finding, st.sampled_from(sorted(CHECKS)), st.sampled_from(Level), st.just("words")),
    max_size=6,
)


@given(FINDINGS, st.sets(st.sampled_from(sorted(CHECKS))))
def test_refusals_and_warnings_that_nobody_accepts_stop(found, accepted):
    refused = any(f.level is Level.REFUSE for f in found)
    warned = any(f.level is Level.WARN and f.name not in accepted for f in found)
    if not refused and not warned:
        require_acceptable("log.csv", found, accepted)
        return
    with pytest.raises(SysidError) as caught:
        require_acceptable("log.csv", found, accepted)
    assert isinstance(caught.value, InputError) == refused
    assert str(caught.value).startswith("log.csv: words")
    if not refused:
        names = {f.name for f in found if f.level is Level.WARN} - accepted
        assert all(f"--accept {name}" in str(caught.value) for name in names)


def test_a_line_says_level_and_name():
    assert Finding("zero", Level.WARN, "off").line() == "warn: off [zero]"
