"""The first day with an arm, as docs/motors.md tells it, with its commands on simulated motors.

The motors are mounted otherwise than the joints of the model: some turn the other way, and each has
its zero elsewhere. A person beside the arm does what the commands ask for.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rigs.arms import small_arms
from rigs.arms.walk import Step, run_here
from rigs.files import pages
from rigs.files.places import MODELS, ROOT
from rigs.motors.damiao_rig import COARSE_STEP, MotorBus
from rigs.motors.person import Person
from robot_sysid.commands import motors
from robot_sysid.damiao.joints import DamiaoJoint, damiao_joints
from robot_sysid.parser import load_robot_model
from robot_sysid.simulation.plant import ArmStepper
from robot_sysid.simulation.usual_arm import usual_arm

PAGE = ROOT / "docs" / "motors.md"
MODEL_NAME = "my_arm.xml"
"""Name of the arm's model on the page."""
DIRECTIONS = 1, -1
OFFSETS = 0.2, -0.3, 0.1
"""Mounting of the first motors, base first, and then again from the beginning [rad]."""
WATCHDOG = 0.1
"""Timeout of the motors' watchdogs, as the page sets it [s]."""


@dataclass(frozen=True)
class DayArm:
    """The arm of a day.

    Attributes:
        model: file of its model, or its text.
        types: of its motors, base first.
        joint: option that names the terminal joint; "" where the model has one arm.
    """

    model: Path | str
    types: tuple[str, ...]
    joint: str = ""

    @property
    def is_there(self) -> bool:
        """Whether the model is at hand."""
        return isinstance(self.model, str) or self.model.exists()

    @property
    def variables(self) -> Mapping[str, str]:
        """What the page's variables are for this arm."""
        types = " ".join(f"--motor-type {name}" for name in self.types)
        return {"ARM": f"{MODEL_NAME} {self.joint}".strip(), "MOTORS": types}

    def write(self, folder: Path) -> None:
        """Write the model to a folder, under the name that the page gives it."""
        path = folder / MODEL_NAME
        if isinstance(self.model, str):
            path.write_text(self.model, encoding="utf-8")
            return
        for other in self.model.parent.iterdir():
            if other.is_dir():
                (folder / other.name).symlink_to(other)
        shutil.copy(self.model, path)


_FIVE = small_arms.serial_arm(
    (small_arms.Z, small_arms.Y, small_arms.Y, small_arms.Y, small_arms.X),
    joint='range="-2.5 2.5" armature=".03" damping=".3" frictionloss=".2"',
    extra='<keyframe><key name="home" qpos=".1 .2 .2 .2 .1"/></keyframe>',
)
ARMS = {
    "five joints": DayArm(_FIVE, ("DM8009",) * 3 + ("DM4340",) * 2),
    "OpenArm": DayArm(
        MODELS / "openarm_v2" / "openarm_bimanual.xml",
        ("DM8009",) * 2 + ("DM4340",) * 2 + ("DM4310",) * 2 + ("DM3507",),
        "--joint openarm_left_joint7",
    ),
}
"""Arms whose days are tried, by name."""


class Day:
    """A folder with a model, motors on a bus, and a person beside the arm.

    Args:
        arm: the arm.
        folder: working folder, to which the model is written.

    Attributes:
        bus: with the motors.
        steps: commands that were run.
    """

    def __init__(self, arm: DayArm, folder: Path) -> None:
        arm.write(folder)
        words = arm.joint.split()
        robot = load_robot_model(folder / MODEL_NAME, joint=words[1] if words else None)
        joints = damiao_joints(arm.types, len(arm.types))
        rated = np.array([joint.spec.rated_torque for joint in joints])
        truth = usual_arm(robot, rated, np.random.default_rng(1))
        self.bus = MotorBus(
            [self._mounted(k, joint) for k, joint in enumerate(joints)],
            ArmStepper(truth, robot.reference, COARSE_STEP),
            watchdog=WATCHDOG,
            echo=True,
        )
        self.bus.arm.takes_whole_steps = True
        self._person = Person(self.bus, robot)
        self._alone = MotorBus(joints[:1], watchdog=WATCHDOG, echo=True)
        self.steps: list[Step] = []

    @staticmethod
    def _mounted(number: int, joint: DamiaoJoint) -> DamiaoJoint:
        """Return a joint whose motor is mounted otherwise than the model's joint."""
        direction = DIRECTIONS[number % len(DIRECTIONS)]
        return replace(
            joint, direction=direction, offset=OFFSETS[number % len(OFFSETS)]
        )

    def run(self, line: str, *further: str) -> Step:
        """Run a command line with further words behind it, the person beside the arm."""
        # New motors are given their ids one by one.
        bus = self._alone if "--new-id" in line else self.bus
        commands = motors.commands_with(bus.equipment)
        words = shlex.join(further)
        with self._person.at_terminal():
            step = Step(line, *run_here(f"{line} {words}".strip(), commands))
        self.steps.append(step)
        return step


def page_commands(arm: DayArm) -> Iterator[tuple[str, str, int]]:
    """Yield the page's commands for an arm, in their order.

    Each is (the heading that it stands under, the line, its exit code); the headings of the day's
    steps begin with a number.
    """
    text = PAGE.read_text(encoding="utf-8")
    for section in re.split("^##+ ", text, flags=re.MULTILINE):
        heading = section.partition("\n")[0]
        for language, block in pages.blocks_of(section, arm.variables):
            if language != "bash":
                continue
            for words, code in pages.commands(block):
                if words[0] == "robot-sysid":
                    yield heading, shlex.join(words), code
