"""Pages of small arms, made once; and a machine that draws nothing."""

import pytest

from rigs.files.reports import link_run, page
from robot_sysid.report import studio

__all__ = ["link_run", "no_renderer", "page"]


@pytest.fixture
def no_renderer(monkeypatch):
    """Let MuJoCo find no library that draws without a screen."""
    monkeypatch.setenv("MUJOCO_GL", "none")
    studio.renderer_library.cache_clear()
    yield
    studio.renderer_library.cache_clear()
