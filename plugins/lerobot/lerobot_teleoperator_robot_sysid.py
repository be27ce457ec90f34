"""A LeRobot teleoperator that plays the goals that ``robot-sysid plan --for servos`` has written.

LeRobot imports this module because its distribution is called like it, and makes ``RobotSysid``
of ``RobotSysidConfig``, whose fields are its options (``--teleop.plan=goals.csv``). A teleoperator
does not see the robot: where the arm stands is said by an option, or by a person who moves it
there.
"""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from robot_sysid.motion.goals import GoalPlayer, load_goals

UNITS = {"degrees": math.degrees(1.0), "radians": 1.0}
"""Unit in which the robot takes positions, to how many of it are a radian."""

logger = logging.getLogger(__name__)


@TeleoperatorConfig.register_subclass("robot_sysid")
@dataclass
class RobotSysidConfig(TeleoperatorConfig):
    """Options of the teleoperator.

    Attributes:
        plan: goals.csv of ``robot-sysid plan --for servos``.
        start: where motors stand when recording starts, in the robot's units. The arm goes slowly
            from there to the motion, and back at the end. A motor that the plan does not have,
            such as a gripper, is held at it.
        speed: factor on the speed of the plan, at most 1: play it slowly first.
        unit: in which the robot takes positions, "degrees" or "radians".
    """

    plan: Path
    start: dict[str, float] = field(default_factory=dict)
    speed: float = 1.0
    unit: str = "degrees"

    def __post_init__(self) -> None:
        if self.unit not in UNITS:
            raise ValueError(
                f"--teleop.unit is {' or '.join(UNITS)}, not {self.unit}; a robot that takes per "
                "cent of each joint's range has to take degrees (--robot.use_degrees=true)"
            )


class RobotSysid(Teleoperator):
    """Plays goals by the clock, from a pose and back to it, then holds the last one."""

    config_class = RobotSysidConfig
    name = "robot_sysid"

    def __init__(
        self, config: RobotSysidConfig, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(config)
        self.config = config
        goals = load_goals(config.plan)
        per_si = UNITS[config.unit]
        self._per_si = {
            name: 1.0 if slides else per_si
            for name, slides in zip(goals.joint_names, goals.is_slide)
        }
        start = {
            name: config.start[name] / factor
            for name, factor in self._per_si.items()
            if name in config.start
        }
        self._held = {
            f"{name}.pos": position
            for name, position in config.start.items()
            if name not in self._per_si
        }
        self._player = GoalPlayer(goals, start, config.speed, clock)
        self._is_connected = False
        self._has_said_end = False

    @property
    def action_features(self) -> dict[str, type]:
        """The actions: a position of each joint of the plan and of each motor that is held."""
        names = [*(f"{name}.pos" for name in self._per_si), *self._held]
        return dict.fromkeys(names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """There is no feedback."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the plan is being played."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Say what will be played, and have a person bring the arm to the start of the motion.

        The person is asked only where ``start`` lacks a joint of the plan. LeRobot calls this
        before it connects the robot, whose motors are limp until then.
        """
        player = self._player
        logger.info(
            "robot_sysid plays %s: %.0f s to the motion, %.0f s of it, and back. Record %d s or "
            "more (--dataset.episode_time_s). Further motors, such as a gripper, are held where "
            "--teleop.start says: %s. Keep a hand at the power switch: the way there and back is "
            "a straight line in joint space that nothing checks.",
            self.config.plan,
            player.approach_time,
            player.motion_time,
            math.ceil(player.duration) + 1,
            self._held or "none",
        )
        unknown = [name for name in self._per_si if name not in self.config.start]
        if unknown:
            self._ask_to_move(unknown)
        self._is_connected = True

    def _ask_to_move(self, names: list[str]) -> None:
        """Wait until a person has brought joints to the first pose of the motion."""
        first = dict(zip(self._player.goals.joint_names, self._player.goals.q[0]))
        pose = ", ".join(
            f"{name} {first[name] * self._per_si[name] + 0.0:.1f}" for name in names
        )
        try:
            input(
                f"Move the arm by hand to where the motion starts ({self.config.unit}): {pose}. "
                "It goes there at once when its motors are switched on. Then press ENTER.... "
            )
        except EOFError:
            raise ConnectionError(
                "nobody is there to move the arm to the start of the motion; say where it stands "
                f"with --teleop.start='{{{', '.join(f'{name}: 0' for name in names)}}}' "
                f"({self.config.unit})"
            ) from None

    def calibrate(self) -> None:
        """Do nothing: there is no device."""

    def configure(self) -> None:
        """Do nothing: there is no device."""

    def get_action(self) -> dict[str, float]:
        """Return the goals of this instant in the robot's unit."""
        if not self._is_connected:
            raise ConnectionError("robot_sysid is not connected; call connect() first")
        pose = self._player.pose()
        if self._player.has_ended and not self._has_said_end:
            self._has_said_end = True
            logger.info(
                "robot_sysid: the motion has ended; the last pose is held. LeRobot asked for goals "
                "%.2f times per second, and counts frames for time stamps: if this is not "
                "--dataset.fps within one per cent, record again with a lower one, or on a "
                "computer that does less beside.",
                self._player.call_rate,
            )
        action = {
            f"{name}.pos": float(position) * self._per_si[name]
            for name, position in zip(self._player.goals.joint_names, pose)
        }
        return {**action, **self._held}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: there is no device that could show any."""

    def disconnect(self) -> None:
        """Stop playing."""
        self._is_connected = False
