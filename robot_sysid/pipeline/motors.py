"""The seam to motors: what the package uses of ``robot_sysid.damiao``, and works without.

The folder, and ``commands/motors`` on top of it, can be taken out, or become a distribution of
their own: only this module finds them, by their names, and only when motors are asked for. Imports
nothing slow: the command-line program begins with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, TextIO

from robot_sysid.errors import InputError

if TYPE_CHECKING:
    from robot_sysid.config import MotorOptions
    from robot_sysid.records import Array, Limits, RobotModel

    MotionChunk = tuple[Array, Array, Array, Array]
    WeightChunk = tuple[Array, Array, Array]

_PACKAGE = "robot_sysid.damiao"
_COMMANDS = "robot_sysid.commands.motors"


class MissingMotorsError(InputError, AttributeError):
    """The package for motors is not installed.

    An AttributeError too, so that ``hasattr(rs, "motors")`` is false then.
    """


@dataclass(frozen=True)
class ArmMotors:
    """What plans know of the motors of an arm.

    Attributes:
        limits: of the motors, base to terminal.
        kept_options: keys of those limits of a plan that a run on the motors is given again.
        write: writes a motion to a file that the motors play, and returns lines on what was
            clamped. The motion comes in stretches: time (N,) [s], positions, speeds and
            feed-forward torques (N, n) [rad, rad/s, N m].
        write_weight: writes what carries and accelerates the arm in that motion, which comes in
            stretches, too: time (N,) [s], and two torques (N, n) as
            ``ArmDynamics.weight_and_inertia`` returns them [N m]; and ``ArmDynamics.weight_slopes``
            (n,) [N m/rad], and the SHA-256 of the motion's file.
    """

    limits: Limits
    kept_options: Sequence[str]
    write: Callable[[Iterable[MotionChunk], TextIO], list[str]]
    write_weight: Callable[[Iterable[WeightChunk], Array, str, TextIO], None]


@contextmanager
def motors_required() -> Iterator[None]:
    """Run a block that imports from the package for motors, or MissingMotorsError says so."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in (_PACKAGE, _COMMANDS):
            raise
        raise MissingMotorsError(
            f"Damiao motors need {error.name}, which is not installed: install robot-sysid whole; "
            "all else works without it"
        ) from None


def motor_package() -> Any:
    """Return the package for motors, which Python programs know as ``rs.motors``."""
    with motors_required():
        return import_module(_PACKAGE)


def arm_motors(options: MotorOptions, robot: RobotModel) -> ArmMotors | None:
    """Return the motors of an arm; None where no option states any.

    InputError where the export is impossible for this arm.
    """
    if not options.are_stated:
        return None
    motors: ArmMotors = motor_package().arm_motors(options, robot)
    return motors
