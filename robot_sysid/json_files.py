"""JSON files that somebody else wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from robot_sysid.errors import InputError, error_text
from robot_sysid.special_files import refuse_special_file

_DIGITS = 300
_LARGEST = 30_000_000
"""Bytes of a file: of nothing but empty lists these take 0.7 GB."""


def read_json(path: Path, remedy: str) -> Any:
    """Return what a JSON file holds; an integer beyond every float is infinite, as 1e999 is.

    Args:
        path: the file.
        remedy: what to do where it cannot be read, for the message.

    Raises:
        InputError: it cannot be read, is not JSON or is nested without end.
    """
    refuse_special_file(path, remedy)
    try:
        if path.stat().st_size > _LARGEST:
            raise ValueError(f"it is larger than {_LARGEST / 1e6:g} MB")
        return json.loads(
            path.read_text(encoding="utf-8-sig"),
            parse_int=lambda digits: (
                int(digits) if len(digits) < _DIGITS else float(digits)
            ),
        )
    except OSError as error:
        reason = error_text(error)
    except (ValueError, RecursionError) as error:
        reason = f"it is not JSON: {error}"
    raise InputError(f"cannot read {path}: {reason}; {remedy}")
