"""Frames of any content."""

from __future__ import annotations

from hypothesis import strategies as st

from robot_sysid.damiao.protocol.frames import Frame

FRAMES = st.builds(
    lambda identifier, data, fd: Frame(identifier, data, fd=fd),
    st.integers(0, 0x7FF),
    st.binary(max_size=8),
    st.booleans(),
)
