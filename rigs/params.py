"""The rows of a params.json by what has them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robot_sysid.results.record import FILE


def rows(content: Mapping[str, Any]) -> dict[tuple[str, str], Mapping[str, Any]]:
    """(body or joint, name) to each identified row."""
    found = [row for row in content["quantities"] if row["source"] != FILE]
    return {(row["of"], row["name"]): row for row in found}


def motors(content: Mapping[str, Any]) -> list[str]:
    """The motors that turn several joints."""
    owners = [row["of"] for row in content["quantities"] if row["source"] != FILE]
    return list(dict.fromkeys(owner for owner in owners if "+" in owner))
