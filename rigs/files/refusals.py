"""Expecting an error of the package: its class, its words, and that it is one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from robot_sysid.errors import InputError, SysidError


@contextmanager
def refused(
    message: str | None = None, error_class: type[SysidError] = InputError
) -> Iterator[pytest.ExceptionInfo[SysidError]]:
    """Expect an error of this class inside the block, whose text is one line that matches."""
    with pytest.raises(error_class, match=message) as caught:
        yield caught
    assert "\n" not in str(caught.value)
