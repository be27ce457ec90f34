"""Whether a motion is shown: options, each checked once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.records.options import OptionRecord, option

SUFFIXES = (".mp4", ".gif")


def film_path(text: str) -> Path:
    """Return the path of a film."""
    path = Path(text)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{text!r} is no film; its name ends in {' or '.join(SUFFIXES)}")
    return path


@dataclass(frozen=True)
class PreviewOptions(OptionRecord):
    """Whether a motion is shown."""

    view: bool = option(False, "play the motion in MuJoCo's viewer")
    video: Path | None = option(
        None,
        "render the motion as a film (.mp4 or .gif), with limits, clearance and torque over time",
        "FILE",
        parse=film_path,
    )
