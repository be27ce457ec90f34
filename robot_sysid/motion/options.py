"""What a motion has to obey, and how one is designed: options, each checked once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.motion.information import CRITERIA
from robot_sysid.motion.obstacles import HalfSpace, box_half_spaces, plane_half_space
from robot_sysid.motion.trajectories import FourierBasis
from robot_sysid.records.arm import DEFAULT_MAX_VELOCITY
from robot_sysid.records.options import (
    OptionRecord,
    PerJoint,
    levels,
    option,
    processors,
    whole_number,
)

EXCITATIONS = ("sines", "optimal")
ENDS = ("faded", "periodic")
LONGEST_FADE = 1.5
"""Fade of a faded trajectory [s]; shorter where the trajectory is short."""
TOP_FREQUENCY_HZ = 0.6
"""Highest harmonic where --harmonics leaves the choice to us: that of the random sinusoids.

Full speed at this frequency takes the usual acceleration limit.
"""
FEWEST_HARMONICS = 3
LONGEST_PERIOD = 60.0
"""A longer motion repeats itself, so that a search costs in proportion to its length [s]."""
WORTH_WORKERS = 5.0
"""Time budget from which on it pays to start other processes [s]."""
FEWEST_POSES = 5
"""Poses that tell a payload's mass and centre of mass, with something left to check them by."""


@dataclass(frozen=True)
class LimitOptions(OptionRecord):
    """What every motion has to obey beside the model's own limits."""

    NEEDS: ClassVar[str] = "motion"
    max_velocity: PerJoint = option(
        DEFAULT_MAX_VELOCITY,
        "speed limit of hinge joints, one number or one per joint",
        "V [rad/s] > 0",
        parse=levels,
    )
    max_acceleration: float | None = option(
        None,
        "acceleration limit of hinge joints",
        "A [rad/s²] > 0",
        usual="none; for a new motion, what full speed at 0.6 Hz needs, or at its top frequency "
        "if lower",
    )
    max_torque: PerJoint | None = option(
        None,
        "torque limit beside the model's own, one number or one per joint",
        "T [N·m] > 0",
        parse=levels,
        usual="the model's own",
    )
    ignore_torque_limit: tuple[str, ...] = option(
        (), "joint whose torque limit is not obeyed; may be repeated", "JOINT", repeats=True
    )
    payload_reserve: float = option(
        0.0,
        "leave torque for an unknown load up to this mass at the tip of the tool",
        "KG [kg] >= 0",
    )
    max_tool_speed: float | None = option(
        None, "speed limit of the tool's fastest point", "V [m/s] > 0", usual="none"
    )
    workspace: tuple[float, ...] | None = option(
        None,
        "box that the terminal link stays in",
        unit="m",
        metavar=("XMIN", "XMAX", "YMIN", "YMAX", "ZMIN", "ZMAX"),
    )
    keep_out: tuple[tuple[float, ...], ...] = option(
        (),
        "plane that no moving part crosses: points x with N·x ≥ OFFSET are allowed",
        unit="m",
        metavar=("NX", "NY", "NZ", "OFFSET"),
        repeats=True,
    )
    clearance: float = option(
        0.01, "least distance between parts that are apart at rest", "D [m] >= 0"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.half_spaces()  # Refused here, before any work, where the numbers make none.

    def half_spaces(
        self, moving: Sequence[int] = (), link: Sequence[int] = ()
    ) -> tuple[HalfSpace, ...]:
        """Return what moving bodies (planes) and those of the terminal link (box) stay in."""
        planes = [plane_half_space(plane, self.clearance, moving) for plane in self.keep_out]
        box = () if self.workspace is None else box_half_spaces(self.workspace, link)
        return (*planes, *box)


@dataclass(frozen=True)
class ExcitationOptions(OptionRecord):
    """How a trajectory is found.

    Attributes:
        draws: number of random trajectories to begin with.
        starts: how many of the best are improved; None takes two per minute of budget, at least 2.
        rounds: improvement rounds per start.
        iterations: of the optimiser per round.
        workers: processes to use; 1 stays in this one, None takes one per processor.
    """

    kind: str = option(
        "sines",
        "random sinusoids, or a trajectory designed to tell as much as possible",
        flag="--excitation",
        choices=EXCITATIONS,
        needs="motion",
    )
    criterion: str = option(
        "D",
        "what the design makes small: summed variances (A), their joint volume (D), or the "
        "condition number",
        choices=tuple(CRITERIA),
        needs="design",
    )
    time_budget: float = option(
        60.0,
        "stop designing after this time and keep the best",
        "S [s] > 0",
        flag="--excitation-time-budget",
        needs="design",
    )
    harmonics: int | None = option(
        None, "harmonics of a designed trajectory", "K", usual="up to 0.6 Hz", needs="design"
    )
    base_frequency: float | None = option(
        None, "first harmonic", "F [Hz] > 0", usual="one period, of at most 60 s", needs="design"
    )
    ends: str = option(
        "faded",
        "come to rest by a fade, or by the trajectory's own shape",
        flag="--excitation-ends",
        choices=ENDS,
        needs="design",
    )
    draws: int = 300
    starts: int | None = None
    rounds: int = 8
    iterations: int = 120
    workers: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in {"draws": 1, "rounds": 0, "iterations": 1, "workers": 1}.items():
            chosen = getattr(self, name)
            if chosen is not None and chosen < value:
                raise InputError(f"{name} must be at least {value} (got {chosen})")

    def basis(self, duration: float) -> FourierBasis:
        """Return the Fourier basis of a designed trajectory of this duration [s]."""
        periods = max(1, int(np.ceil(duration / LONGEST_PERIOD)))
        base = periods / duration if self.base_frequency is None else self.base_frequency
        reaching = int(np.floor(TOP_FREQUENCY_HZ / base + 1e-9))
        chosen = max(FEWEST_HARMONICS, reaching) if self.harmonics is None else self.harmonics
        fade = min(LONGEST_FADE, 0.25 * duration) if self.ends == "faded" else 0.0
        return FourierBasis(duration, base, chosen, fade)

    @property
    def n_starts(self) -> int:
        """How many of the best random trajectories are improved."""
        per_budget = 2 * max(1, round(self.time_budget / 60.0))
        return max(1, per_budget if self.starts is None else self.starts)

    @property
    def n_workers(self) -> int:
        """Number of processes; more than there are starts would idle after the draws.

        A short search takes one: starting others would take longer than they help.
        """
        if self.workers is None and self.time_budget < WORTH_WORKERS:
            return 1
        return min(self.workers or processors(), max(2, self.n_starts))


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
        "N",
        parse=whole_number,
        check=_enough,
        needs="static plan",
    )
    dwell: float = option(
        1.5, "with --static, how long each rest lasts", "S [s] > 0", needs="static plan"
    )

    @property
    def sets_its_time(self) -> bool:
        """Whether the motion is as long as it takes: resting poses, or sweeps."""
        return self.static or self.purpose == "friction"
