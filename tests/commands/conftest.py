"""What the tests of several commands share."""

from __future__ import annotations

import pytest

from robot_sysid.config import config_from


@pytest.fixture
def asked(request, monkeypatch):
    """Function: the configuration that a command line asks for, without running it.

    The command is what the test module calls ``module``.
    """
    command = request.module.module
    monkeypatch.setattr(command, "identify", lambda values, *_: config_from(**values))
    return lambda *arguments: command.main([*map(str, arguments)])
