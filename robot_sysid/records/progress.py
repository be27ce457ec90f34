"""How a long run tells how far it is, without knowing who listens."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol


class Progress(Protocol):
    """How a long stage tells how far it is; the command line shows it, libraries ignore it."""

    def stage(self, message: str) -> None:
        """Announce a stage."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Pass items through and count them."""

    def advance(self, label: str, done: int, total: int, text: str) -> None:
        """Tell that ``done`` of ``total`` steps of a search are done, and how it stands."""

    def note(self, message: str) -> None:
        """Tell the user something that does not stop the run."""

    def detail(self, message: str) -> None:
        """Tell something that is only of interest when a result looks odd."""


class Silent:
    """Progress that says nothing."""

    def stage(self, message: str) -> None:
        """Ignore the announcement."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Pass the items through."""
        return items

    def advance(self, label: str, done: int, total: int, text: str) -> None:
        """Ignore the step."""

    def note(self, message: str) -> None:
        """Ignore the note."""

    def detail(self, message: str) -> None:
        """Ignore the detail."""
