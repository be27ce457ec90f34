"""JSON files that somebody else wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError

_DIGITS = 300


def read_json(path: Path, remedy: str) -> Any:
    """Return what a JSON file holds; an integer beyond every float is infinite, as 1e999 is.

    Args:
        path: the file.
        remedy: what to do where it cannot be read, for the message.

    Raises:
        InputError: it cannot be read, is not JSON or is nested without end.
    """
    try:
        return json.loads(
            path.read_text(encoding="utf-8-sig"),
            parse_int=lambda digits: int(digits) if len(digits) < _DIGITS else float(digits),
        )
    except OSError as error:
        reason = error.strerror or error
    except (ValueError, RecursionError) as error:
        reason = f"it is not JSON: {error}"
    raise InputError(f"cannot read {path}: {reason}; {remedy}")
