"""Designing a motion: the options of its limits, search and purpose. Light to import."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Optional

from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import (
    DEFAULT_MAX_VELOCITY,
    TOP_FREQUENCY_HZ,
    OptionRecord,
    PerJoint,
    joint_values,
    option,
)
from robot_sysid.wording import option_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robot_sysid.records import HalfSpace, Limits

EXCITATIONS = ("sines", "optimal")
WEIGHT = "weight"
"""Purpose of the slow first motion of an arm that may be heavier than its model says."""
SERVOS = "servos"
"""Purpose of the motion of an arm with position servos and without torque sensors."""


@dataclass(frozen=True)
class LimitOptions(OptionRecord):
    """Limits that every motion has to keep in addition to the limits of the model.

    Raises InputError where a keep-out plane or the workspace box is not valid.
    """

    max_velocity: PerJoint = option(
        DEFAULT_MAX_VELOCITY,
        "speed limit of hinge joints, one number or one per joint",
        "V [rad/s] > 0",
    )
    max_acceleration: Optional[float] = option(
        None,
        "acceleration limit of hinge joints",
        "A [rad/s²] > 0",
        default_text="none; for a new motion, what full speed at "
        f"{TOP_FREQUENCY_HZ:g} Hz needs",
    )
    max_torque: Optional[PerJoint] = option(
        None,
        "torque limit beside the model's own, one number or one per joint",
        "T [N·m] > 0",
        default_text="the model's own",
    )
    payload_reserve: float = option(
        0.0,
        "leave torque for an unknown load up to this mass at the tip of the tool",
        "KG [kg] >= 0",
    )
    max_tool_speed: Optional[float] = option(
        None,
        "speed limit of the tool's fastest point",
        "V [m/s] > 0",
        default_text="none",
    )
    workspace: Optional[tuple[float, ...]] = option(
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
    below_base: bool = option(
        False,
        "allow parts to get below what carries the arm; they stay above it otherwise, but for an "
        "arm that is below it at rest",
    )
    clearance: float = option(
        0.01, "least distance between parts that are apart at rest", "D [m] >= 0"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # Raises InputError for a plane or a box that is no half-space, before any work is done.
        self.half_spaces()

    def limits(
        self,
        is_slide: Sequence[bool] | NDArray[np.bool_],
        moving: Sequence[int] = (),
        link: Sequence[int] = (),
    ) -> Limits:
        """Return the limits that the user gives for n joints, and for what they carry.

        Args:
            is_slide: (n,) whether each joint is a slide, whose acceleration no option limits.
            moving, link: as in ``half_spaces``.

        Raises:
            InputError: an option has neither one number nor one per joint.
        """
        import numpy as np

        from robot_sysid.records.limits import LARGEST, Limits

        numbers = {}
        for quantity in LARGEST:
            key = f"max_{quantity}"
            limit = getattr(self, key) or np.inf
            numbers[quantity] = joint_values(limit, len(is_slide), option_name(key))
        numbers["acceleration"][is_slide] = np.inf
        return Limits(
            **numbers,
            tool_speed=self.max_tool_speed or np.inf,
            clearance=self.clearance,
            spaces=self.half_spaces(moving, link),
        )

    def half_spaces(
        self, moving: Sequence[int] = (), link: Sequence[int] = ()
    ) -> tuple[HalfSpace, ...]:
        """Return the half-spaces of keep-out planes and of the sides of the workspace box.

        Args:
            moving: MuJoCo ids of the bodies that keep-out planes hold for.
            link: MuJoCo ids of the bodies that the box holds for.

        Raises:
            InputError: a plane or the box is not valid.
        """
        spaces = [
            _plane(plane, self.clearance, tuple(moving)) for plane in self.keep_out
        ]
        if self.workspace is not None:
            spaces += _box(self.workspace, tuple(link))
        return tuple(spaces)


def _plane(
    values: Sequence[float], clearance: float, bodies: tuple[int, ...]
) -> HalfSpace:
    """Return the allowed side of the plane of ``--keep-out NX NY NZ OFFSET``: points x with
    N . x >= OFFSET.

    Args:
        values: the four numbers; the normal may have any length, OFFSET is in multiples of it.
        clearance: distance that the bodies have to keep from the plane [m].
        bodies: MuJoCo ids of the bodies that stay on this side.

    Raises:
        InputError: there are not four finite numbers, or the normal is zero.
    """
    import numpy as np

    from robot_sysid.records import HalfSpace

    length = math.hypot(*values[:3]) if len(values) == 4 else 0.0
    if not (length > 0.0 and math.isfinite(length) and math.isfinite(values[3])):
        raise InputError(
            f"{option_name('keep_out')} takes four numbers NX NY NZ OFFSET with a normal that is "
            "not zero; 0 0 1 0 keeps the arm above the floor"
        )
    *normal, offset = (float(v) / length for v in values)
    label = f"the keep-out plane {[round(v, 3) for v in normal]} at {offset:g} m"
    return HalfSpace(np.array(normal), offset, clearance, bodies, label)


def _box(sides: Sequence[float], bodies: tuple[int, ...]) -> Iterator[HalfSpace]:
    """Yield a half-space per finite side of the box of ``--workspace`` in the world, with zero
    clearance: the sides may be touched.

    Args:
        sides: XMIN, XMAX, YMIN, YMAX, ZMIN, ZMAX [m]; infinite for a side that is open.
        bodies: MuJoCo ids of the bodies that stay in the box.

    Raises:
        InputError: there are not six numbers, or a minimum is not below its maximum.
    """
    import numpy as np

    from robot_sysid.records import HalfSpace

    lows = sides[0::2]
    highs = sides[1::2]
    if len(sides) != 6 or not all(low < high for low, high in zip(lows, highs)):
        raise InputError(
            f"{option_name('workspace')} takes six numbers, XMIN XMAX YMIN YMAX ZMIN ZMAX, each "
            f"minimum below its maximum, not {' '.join(f'{side:g}' for side in sides)}"
        )
    for number, bound in enumerate(sides):
        axis, is_maximum = divmod(number, 2)
        if math.isfinite(bound):
            sign = 1.0 - 2.0 * is_maximum
            side = ("xmin", "xmax", "ymin", "ymax", "zmin", "zmax")[number]
            label = f"the workspace's {side} = {bound:g} m"
            inward = sign * np.eye(3)[axis]
            yield HalfSpace(inward, sign * bound, 0.0, bodies, label)


@dataclass(frozen=True)
class Effort:
    """How long a search looks for a motion, whatever computer it runs on.

    Attributes:
        draws: number of random trajectories to begin with.
        rounds: largest number of rounds by which a random trajectory is improved.
        iterations: largest number of iterations of the optimiser per round, each of which has to
            gain a share for another one to follow.
    """

    draws: int
    rounds: int
    iterations: int


USUAL = Effort(draws=24, rounds=40, iterations=25)
"""Most of what a search gains: the thorough one takes longer for little more."""
THOROUGH = Effort(draws=60, rounds=20, iterations=60)
"""A search until long rounds gain next to nothing."""


@dataclass(frozen=True)
class ExcitationOptions(OptionRecord):
    """How a trajectory is made: random sinusoids, or a search for an informative trajectory.

    Attributes:
        kind: "sines" for random sinusoids, "optimal" for a designed trajectory.
        thorough: whether to search until hardly anything is gained.
        time_budget: longest duration of the search [s]; None for as long as rounds gain.
        effort: of the search; None for what ``thorough`` says.
    """

    kind: str = option(
        "optimal",
        "a trajectory designed to tell as much as possible, or random sinusoids",
        flag="--excitation",
        choices=EXCITATIONS,
    )
    thorough: bool = option(
        False,
        "search until hardly anything is gained: up to twice as long, for an error to expect that "
        "is up to 1.5 % smaller",
    )
    time_budget: Optional[float] = option(
        None,
        "design for at most this time",
        "S [s] > 0",
        flag="--excitation-time-budget",
        default_text="until it hardly gets better",
    )
    effort: Optional[Effort] = None

    @property
    def search_effort(self) -> Effort:
        """How long the search looks for a motion."""
        return self.effort or (THOROUGH if self.thorough else USUAL)


@dataclass(frozen=True)
class AimOptions(OptionRecord):
    """What a plan is for.

    Attributes:
        purpose: "arm", "link", "payload", "weight" or "servos".
        goal_rate: rows per second of the table of goal positions [Hz].
    """

    purpose: str = option(
        "arm",
        "what the motion is for: the written file of the whole arm, links, friction and rotors; "
        "the ten numbers of the terminal link alone, whatever it carries; a payload, weighed by "
        "difference; the weight of an arm whose model may be far off: slowly, with half of "
        "the torque; or servos that take goal positions and measure no torque: with stops on the "
        "way and a slow end, also as goals.csv",
        flag="--for",
        choices=("arm", "link", "payload", WEIGHT, SERVOS),
    )
    goal_rate: float = option(
        30.0, "rows per second of the goals.csv of a motion for servos", "RATE [Hz] > 0"
    )

    @property
    def target(self) -> str:
        """What an estimate is to identify: "link", "arm" or "payload"."""
        targets = {"payload": "payload", "link": "link", WEIGHT: "link"}
        return targets.get(self.purpose, "arm")
