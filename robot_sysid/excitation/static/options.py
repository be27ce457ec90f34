"""What a plan is for, and which poses it rests in."""

from __future__ import annotations

from dataclasses import dataclass

from robot_sysid.records.options import OptionRecord, option, positive, whole_number

FEWEST_POSES = 5
"""Poses that tell a payload's mass and centre of mass, with something left to check them by."""


def _enough(value: int) -> str | None:
    return None if value >= FEWEST_POSES else f"must be at least {FEWEST_POSES} (got {value})"


@dataclass(frozen=True)
class PoseOptions(OptionRecord):
    """What a plan is for, and which poses it rests in."""

    purpose: str = option(
        "link",
        "what the motion is to identify: the terminal link, a payload by difference, friction "
        "alone (each joint slowly back and forth at constant speeds), or all links and rotors",
        flag="--for",
        choices=("link", "payload", "friction", "arm"),
        needs="plan",
    )
    static: bool = option(
        False,
        "with --for payload: resting poses, each approached from both sides, for an arm that may "
        "not move fast",
        needs="payload plan",
    )
    poses: int = option(
        12,
        "with --static, number of poses",
        metavar="N",
        parse=whole_number,
        check=_enough,
        needs="static plan",
    )
    dwell: float = option(
        1.5,
        "with --static, how long each rest lasts",
        unit="s",
        metavar="S",
        check=positive,
        needs="static plan",
    )

    @property
    def sets_its_time(self) -> bool:
        """Whether the motion is as long as it takes: resting poses, or sweeps."""
        return self.static or self.purpose == "friction"
