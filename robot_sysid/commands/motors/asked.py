"""One command line of ``robot-sysid motors``, as records, and the bus that it names."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from robot_sysid.commands.console import Console
from robot_sysid.commands.streams import print_line
from robot_sysid.config import ModelOptions
from robot_sysid.damiao.bus import BusAddress, GuardedLink, Link, SystemClock, open_bus
from robot_sysid.damiao.holding import HoldingCheck
from robot_sysid.damiao.preflight import Check, Permissions, Plan, plan_checks
from robot_sysid.damiao.protocol.frames import BusTiming, Frame, refuse_harmful
from robot_sysid.damiao.protocol.joints import DamiaoJoint, mapped, read_joint_map
from robot_sysid.damiao.recorder import RecordingOptions
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.trajectory import DamiaoTrajectory, read_damiao_trajectory
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import Array
from robot_sysid.records.options import given_options, record_from


def answer(prompt: str) -> str:
    """Return what a person types."""
    with contextlib.suppress(EOFError):
        return input(prompt)
    raise InputError("not confirmed: standard input has ended")


def said_yes(question: str, hint: str = "") -> bool:
    """Ask a person, who has to sit at a terminal."""
    if not sys.stdin.isatty():
        raise InputError(f"nobody can confirm: standard input is no terminal{hint}")
    return answer(f"{question} Type yes: ").strip().lower() == "yes"


def _hanging(words: str, last: bool) -> None:
    """Say what hangs, and end the program: its main thread cannot any more."""
    with contextlib.suppress(InputError):
        print_line(f"robot-sysid: {'error' if last else 'note'}: {words}", sys.stderr)
    if last:
        os._exit(HardwareAbort.exit_code)


class Asked:
    """One command line of ``motors``, as records."""

    def __init__(self, values: Mapping[str, Any], console: Console) -> None:
        self.values, self.console, self.clock = values, console, SystemClock()
        self.address = record_from(BusAddress, values)
        self.timing = record_from(BusTiming, values)

    def plan(self) -> Plan:
        """Return the trajectory and how to play it."""
        trajectory = read_damiao_trajectory(self.values["trajectory"])
        trajectory = replace(trajectory, joints=self._mounted(trajectory.joints))
        return Plan(
            trajectory,
            record_from(PlaySettings, self.values),
            self.timing,
            record_from(Permissions, self.values),
            record_from(RecordingOptions, self.values),
            self._inertia(trajectory),
        )

    def _inertia(self, trajectory: DamiaoTrajectory) -> Array | None:
        """Return what each joint moves at the first point, where a model is known [kg m^2]."""
        if self.robot is None or self.robot.n_joints != trajectory.n_joints:
            return None
        from robot_sysid.simulation.forward_dynamics import ArmStepper

        return ArmStepper(self.robot, trajectory.q[0]).moved_inertia()

    def _mounted(self, joints: Sequence[DamiaoJoint]) -> tuple[DamiaoJoint, ...]:
        names = self.robot.joint_names if self.robot else ()
        if self._rows:
            return mapped(joints, self._rows, self.channels, names)
        if len(names) != len(joints):
            return tuple(joints)
        return tuple(replace(joint, name=name) for joint, name in zip(joints, names))

    @cached_property
    def _rows(self) -> tuple[DamiaoJoint, ...]:
        path = self.values.get("joint_map")
        return () if path is None else read_joint_map(path)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the buses: those that were given, or else those of the joint map."""
        mapped_to = dict.fromkeys(row.channel for row in self._rows if row.channel)
        return tuple(self.address.buses or mapped_to)

    def checks(self, plan: Plan) -> list[Check]:
        """Return the checks that need no bus, those of a model of the arm included."""
        if self.robot is None:
            for given in given_options(record_from(ModelOptions, self.values)):
                raise InputError(f"{given.flag} is about a model; add --model")
            return plan_checks(plan)
        # Imported here so that playing on real motors does not wait for MuJoCo.
        from robot_sysid.damiao.model_check import model_checks, torque_checks

        played, settings, robot = plan.trajectory, plan.settings, self.robot
        fits = [*model_checks(played, settings.speed, robot, plan.pose)]
        return [*plan_checks(plan), *fits, *torque_checks(played, settings, robot)]

    def holding(self, plan: Plan) -> HoldingCheck | None:
        """Return what compares the arm, held still, with the model's gravity; None without one."""
        if self.robot is None:
            return None
        from robot_sysid.damiao.model_check import gravity_check

        return gravity_check(self.robot, plan.trajectory.joints)

    @cached_property
    def robot(self) -> Any:
        """The arm of the model file; None without one."""
        if self.values.get("model") is None:
            return None
        from robot_sysid.parser import load_robot_model

        chosen = record_from(ModelOptions, self.values)
        choice = chosen.mesh_dir, chosen.joint, float("inf"), chosen.keyframe
        return load_robot_model(self.values["model"], *choice)

    def arm_words(self) -> list[str]:
        """Return the words of the command line that say which arm it is."""
        chosen = [each.key for each in given_options(record_from(ModelOptions, self.values))]
        keys = [key for key in ("model", "joint_map") if self.values.get(key)] + chosen
        flags = [f"--{key.replace('_', '-')}" for key in keys]
        return [str(w) for flag, key in zip(flags, keys) for w in (flag, self.values[key])]

    def open(self, timing: BusTiming | None = None) -> Link:
        """Open the bus, with other bit rates than those asked for if given."""
        return open_bus(self.address, timing or self.timing, self.clock, _hanging)

    @contextlib.contextmanager
    def bus(
        self, refuse: Callable[[Frame], None] = refuse_harmful, timing: BusTiming | None = None
    ) -> Iterator[GuardedLink]:
        """Open the bus for as long as the block runs; what ``refuse`` raises for is not sent."""
        if not self.address.channel:
            raise InputError("this command needs --channel, for instance --channel can0")
        with contextlib.closing(self.open(timing)) as link:
            yield GuardedLink(link, self.clock, self.timing.fd, self.channels, refuse)
