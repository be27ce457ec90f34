"""Tables of pages that a benchmark prints and writes: the text between two marks of a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class PageTable:
    """A table between ``<!-- NAME: COMMAND -->`` and ``<!-- end of NAME -->``.

    Attributes:
        page: the file that has it.
        name: what the page calls it.
        command: what prints it, as typed.
    """

    page: Path
    name: str
    command: str

    @property
    def begin(self) -> str:
        """The line above the table."""
        return f"<!-- {self.name}: {self.command} -->"

    @property
    def end(self) -> str:
        """The line below the table."""
        return f"<!-- end of {self.name} -->"

    def read(self) -> str:
        """Return what stands between the marks."""
        text = self.page.read_text(encoding="utf-8")
        return text.partition(self.begin)[2].partition(self.end)[0]

    def show(self, lines: Sequence[str], is_written: bool) -> None:
        """Print lines, and put them between the marks where that is asked for."""
        print("\n".join(lines))
        if is_written:
            self.write(lines)

    def write(self, lines: Sequence[str]) -> None:
        """Put lines between the marks."""
        text = self.page.read_text(encoding="utf-8")
        head, _, tail = text.partition(self.begin)
        tail = tail.partition(self.end)[2]
        middle = "\n".join([self.begin, "", *lines, "", self.end])
        self.page.write_text(head + middle + tail, encoding="utf-8")
