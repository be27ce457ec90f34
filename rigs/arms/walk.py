"""A person who follows every printed command, beside a simulated arm that plays what is asked.

The walk begins with one command. The command of the next step is run as it is printed, in the same
folder, and so on until there is no next step. A command that is refused names the one to run in its
place. Recordings that a command names and that do not exist yet are made beforehand: the true arm
plays the planned motion of that folder.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from rigs.arms.wrong_arms import truth_of, typical_torque
from robot_sysid.cli import main
from robot_sysid.commands.arguments import Command
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.motion.trajectories import load_trajectory
from robot_sysid.records import Array, MotionPlan, RobotModel
from robot_sysid.records.servo_setting import parse_servo_setting

_WRONG_LINKS = 0.06
"""Standard deviation of the links' masses from the model's, relative to them."""
MOST_STEPS = 8
"""Number of commands within which a walk has to end."""
RATE = 200.0
KNOWN_MASS = 1.0
"""Mass of the weight that the program asks to bolt on [kg]."""
REFUSED = 2
"""Exit code of a command that was refused because of its input."""
_PUNCTUATION = set("();<>|&")
"""Characters that mean something to a shell where they are not quoted."""
HASTE = ("--excitation-time-budget", "1e-6", "--seed", "1")
"""Options of somebody who plans in a hurry: the first motion that keeps all limits is played, which
is the same one on any machine."""


class TrueArm:
    """An arm whose truth is known, and whose log is written for any motion and load.

    Args:
        robot: what the model says.
        seed: draws what differs.
        constants: torque per recorded ampere [N m/A]; 1 records torques.
        carries: whether something is on its last link that the model lacks.

    Attributes:
        noise: (n,) standard deviation of the torque noise [N m].
    """

    def __init__(
        self,
        robot: RobotModel,
        seed: int = 1,
        constants: Array | float = 1.0,
        carries: bool = True,
    ) -> None:
        self.robot = robot
        self._constants = constants
        self._rng = np.random.default_rng(seed)
        self.tool_mass = 0.05 * robot.mass
        first = truth_of(robot, seed, _WRONG_LINKS)
        self.first_plan = first.plan
        typical = typical_torque(first.rigid)
        self.noise = 0.01 * typical
        coulomb = typical * self._rng.uniform(0.03, 0.1, robot.n_joints)
        thetas = first.arm.thetas.copy()
        if not carries:
            thetas[-1] = robot.thetas[-1]
        friction = {"coulomb": coulomb, "viscous": coulomb, "stribeck": 0.0}
        self._arm = replace(first.arm, thetas=thetas, **friction)

    def record(self, path: Path, plan: MotionPlan, load: float) -> None:
        """Write the log of a motion with a load of this mass on the terminal link [kg]."""
        motion = plan.evaluate(np.arange(round(RATE * plan.duration)) / RATE)
        noise = self.noise * self._rng.standard_normal(motion.q.shape)
        last = self._arm.thetas[-1]
        log = self._arm.log(motion, noise, load / last[0] * last)
        log = replace(log, qd=motion.qd, tau=log.tau / self._constants)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_measurement_csv(path, self.robot.joint_names, [log])


@dataclass(frozen=True)
class Step:
    """A command that was run: the line that was printed, its exit code, and its output."""

    line: str
    code: int
    output: str


def in_haste(words: list[str]) -> list[str]:
    """Return the words of a command; those of a plan with ``HASTE``."""
    return [*words, *HASTE] if words[0] == "plan" else words


def run_here(
    line: str, commands: Sequence[Command] = (), is_hasty: bool = False
) -> tuple[int, str]:
    """Run a command line in this process; return its exit code and all that it printed.

    The code is 127, as of a shell, where the line is none that a shell takes for one command.

    Args:
        line: as it is typed.
        commands: those of ``cli.main``.
        is_hasty: whether plans are hardly searched for, because only what is printed counts.
    """
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    if any(word and set(word) <= _PUNCTUATION for word in lexer):
        return 127, "syntax error"
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        words = shlex.split(line)[1:]
        code = main(in_haste(words) if is_hasty else words, commands)
    return code, output.getvalue()


def commands_in(output: str) -> tuple[list[str], list[str]]:
    """Return the commands of an output: those of the next step, and those of other remedies."""
    next_commands = []
    remedies = []
    before = ""
    for line in output.splitlines():
        if line.startswith("  robot-sysid ") and before.startswith("Next"):
            next_commands.append(line.strip())
        elif line.startswith("  robot-sysid "):
            remedies.append(line.strip())
        before = line
    return next_commands, remedies


class Walk:
    """Runs a command and every command that follows from it.

    Args:
        arm: the arm that is recorded.
        runs_remedies: whether commands that are no next step are run, too.
        record_again: writes the recording of the first log's motion, in its form, with a load of
            this mass on the terminal link [kg].
        has_tool: whether the arm of the first log carries something that can be taken off.

    Attributes:
        steps: the commands of the path that were run.
        refused: those of them that were refused and printed the command to run in their place.
        remedies: the other commands that were run.
    """

    def __init__(
        self,
        arm: TrueArm,
        runs_remedies: bool = True,
        record_again: Callable[[Path, float], None] | None = None,
        has_tool: bool = True,
    ) -> None:
        self.arm = arm
        self._has_tool = has_tool
        self._record_again = record_again
        self._runs_remedies = runs_remedies
        self._plan: MotionPlan = arm.first_plan
        self.steps: list[Step] = []
        self.refused: list[Step] = []
        self.remedies: list[Step] = []

    def follow(self, line: str) -> Sequence[Step]:
        """Run a command line and each next step, at most ``MOST_STEPS``; return what was run.

        Other commands that are printed on the way are run, too, and lead nowhere.
        """
        waiting = [line]
        while waiting and len(self.steps) < MOST_STEPS:
            line = waiting.pop(0)
            self.record_missing(line)
            self.steps.append(Step(line, *run_here(line, is_hasty=True)))
            output = self.steps[-1].output
            for path in re.findall(r"^  mujoco\.\S+\((.*)\)$", output, re.MULTILINE):
                mujoco.MjModel.from_xml_path(json.loads(path))
            next_commands, remedies = commands_in(output)
            if "Next, if it can be taken off" in output and not self._has_tool:
                next_commands = []
            if self.steps[-1].code == REFUSED and remedies:
                # Of several commands, the first: each is for another arm or topic.
                self.refused.append(self.steps[-1])
                next_commands = remedies[:1]
                remedies = []
            waiting += next_commands
            for remedy in remedies if self._runs_remedies else ():
                self.record_missing(remedy)
                self.remedies.append(Step(remedy, *run_here(remedy, is_hasty=True)))
        self.steps += [Step(line, 125, "not reached") for line in waiting]
        return self.steps

    def record_missing(self, line: str) -> None:
        """Make the recordings that a command line names and that do not exist."""
        loads = {"empty": 0.0, "empty_again": 0.0, "weight": KNOWN_MASS}
        words = shlex.split(line)
        stated = [
            parse_servo_setting(word).load_mass
            for option, word in zip(words, words[1:])
            if option == "--servo-setting"
        ]
        # The last one is that of the log that is missing.
        loads["weighed"] = stated[-1] or 0.0 if stated else 0.0
        for word in words:
            path = Path(word)
            saved = path.with_name("trajectory.json")
            if path.exists():
                continue
            if self._record_again and path.stem == "weight" and not saved.exists():
                self._record_again(path, KNOWN_MASS)
                continue
            if path.suffix != ".csv":
                continue
            if saved.exists():
                self._plan = load_trajectory(saved).plan
            self.arm.record(path, self._plan, loads.get(path.stem, self.arm.tool_mass))
