"""Results of long benchmarks as lines of JSON, so that one that was killed goes on where it was."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Row = dict[str, Any]
"""One result; its ``key`` says of what."""


class RowFile:
    """Rows by their keys, in a file where there is one.

    Args:
        path: of the file; None keeps rows in memory only.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._rows: dict[str, Row] = {}
        if path is not None and path.exists():
            for line in path.read_text().splitlines():
                # The last line of a killed run may be a part of one.
                if line.endswith("}"):
                    row = json.loads(line)
                    self._rows[row["key"]] = row

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> Row:
        return self._rows[key]

    def rows(self) -> list[Row]:
        """Return all rows."""
        return [*self._rows.values()]

    def add(self, row: Row) -> None:
        """Keep a row, and write it to the end of the file."""
        self._rows[row["key"]] = row
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(f"{json.dumps(row)}\n")
