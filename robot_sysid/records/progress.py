"""How a long run tells how far it is, without knowing who listens."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any


class Detail(str):
    """A line, or a note, on how something was done: the console prints it with --verbose only.

    Files and Python programs have it in any case.
    """


class Progress:
    """How a long stage tells how far it is: here to nobody, the command line's console shows it."""

    def stage(self, *messages: str) -> None:
        """Announce a stage, or tell what came of it."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Pass items through and tell how many; one line says that all have passed."""
        for done, item in enumerate(items, start=1):
            yield item
            self.advance(label, done, total, "")
        self.stage(f"{label}: 100%")

    def advance(self, label: str, done: float, total: float, text: str) -> None:
        """Tell that ``done`` of ``total`` of something long are done, and how it stands."""

    def note(self, *messages: str) -> None:
        """Tell the user things that do not stop the run."""
