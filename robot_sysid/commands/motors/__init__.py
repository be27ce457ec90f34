"""``robot-sysid motors``: inspect Damiao motors, play on them, rehearse, set them up, map them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from robot_sysid.commands import PROGRAM
from robot_sysid.commands.arguments import Parser, parse_command
from robot_sysid.commands.motors.mapping import MapOptions, map_joints
from robot_sysid.commands.motors.session import (
    Session,
    check_lines,
    confirm,
    motor_table,
    play_step,
    run_lines,
    step_after_play,
)
from robot_sysid.commands.motors.setup import (
    MonitorOptions,
    SetupOptions,
    monitor,
    setup,
)
from robot_sysid.damiao import preflight
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.execution import run
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import Permissions, PlaySettings, RecordingOptions
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import EXIT_CODES, InputError, SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.motion import LimitOptions
from robot_sysid.records.option_fields import OptionRecord, option, record_from

INTERRUPTED = "interrupted; no motor is enabled"


@dataclass(frozen=True)
class PlayChoices(OptionRecord):
    """Whether ``motors play`` asks a person."""

    yes: bool = option(False, "do not ask for confirmation", short="-y")


def check(session: Session) -> int:
    """Print what forbids to play; return 0 where nothing does, else 1.

    Without a channel only the trajectory is judged.
    """
    console = session.console
    plan = session.plan()
    checks = session.checks(plan)
    if session.address.channel:
        with session.open_guarded() as link:
            inspection = inspect_bus(link)
        checks += session.inspection_checks(plan, inspection)
        motors = inspection.motors.values()
        console.stage(*motor_table(motors, plan.trajectory.joints))
    console.stage(*check_lines(checks))
    faults = len(preflight.stops(checks))
    if faults:
        session.verdict = (f"Not usable: {faults} to change before playing",)
        return 1
    session.conclude("Usable: ready to play", play_step(session, plan))
    return 0


def play(session: Session, is_real: bool = True) -> int:
    """Check a plan on inspected motors, ask the user, play it, and print how it ended.

    Returns the exit code 0. When the user has confirmed, the motors are inspected and checked once
    more.

    Args:
        session: run of the command.
        is_real: whether to play on real motors, not on a simulated arm in simulated time.

    Raises:
        HardwareAbort: a check forbids the run, or the run was stopped.
        InputError: the user does not confirm, there is no --channel for real motors, or a recording
            would replace a file.
    """
    console = session.console
    plan = session.plan()
    checks = session.checks(plan)
    opened = session.open_guarded() if is_real else session.open_simulated(plan)
    with opened as link:
        inspection = inspect_bus(link)
        checks += session.inspection_checks(plan, inspection, real=is_real)
        table = motor_table(inspection.motors.values(), plan.trajectory.joints)
        console.stage(*table, *check_lines(checks))
        preflight.require_playable(checks)
        if is_real and not record_from(PlayChoices, session.values).yes:
            if not confirm():
                raise InputError("not confirmed; nothing was moved")
            # The arm may have moved or been touched in the meantime.
            inspection = inspect_bus(link)
            checks = session.inspection_checks(plan, inspection)
            preflight.require_playable(checks)
        holding = session.holding(plan)
        report = run(link, plan, inspection, StopRequest(), console.stage, holding)
        console.stage(*run_lines(report))
    verdict = "Done: played, and all motors are disabled"
    if plan.recording.record is not None:
        verdict = (
            "Usable: played, and all motors are disabled; recorded to "
            f"{plan.recording.record}"
        )
    session.conclude(verdict, step_after_play(session, plan, is_real))
    return 0


class MotorCommand(NamedTuple):
    """One subcommand of motors.

    Attributes:
        run: runs the command and returns the exit code.
        example: words that follow the command's name in an example.
        description: description of the command in its help.
        groups: classes of option records that other commands lack, by heading in the help.
    """

    run: Callable[[Session], int]
    example: str
    description: str
    groups: Mapping[str, Sequence[type]]


# Groups of option classes that several commands have, by heading in the help.
_MOTION = {"motion and limits": (PlaySettings,), "what to allow": (Permissions,)}
_RECORDED = {**_MOTION, "recording": (RecordingOptions,)}
# Commands that take a trajectory, and all commands, by name.
_PLAYED = {
    "simulate": MotorCommand(
        partial(play, is_real=False),
        "damiao_trajectory.csv --model arm.xml --record measured.csv",
        "Play a trajectory on the arm of a model with simulated Damiao motors, in simulated time "
        "and without a bus, with all checks of play.",
        _RECORDED,
    ),
    "check": MotorCommand(
        check,
        "damiao_trajectory.csv --channel can0",
        "Ask every id from 1 to 15, print what the motors say, and tell what has to change before "
        "a trajectory can be played; without --channel only what the file itself needs. Enables no "
        "motor and writes nothing.",
        _MOTION,
    ),
    "play": MotorCommand(
        play,
        "damiao_trajectory.csv --channel can0 --speed 0.3 --record measured.csv",
        "Go through all checks, ask for confirmation, enable the motors, move slowly to the first "
        "point, play, come to rest, and disable. A disabled arm sinks: support it or park it where "
        "it cannot fall.",
        {**_RECORDED, "asking": (PlayChoices,)},
    ),
}
COMMANDS: Mapping[str, MotorCommand] = {
    **_PLAYED,
    "setup": MotorCommand(
        setup,
        "--channel can0 --motor 1 --new-id 2 --new-master-id 0x12 --mit --watchdog 0.1 --store",
        "List the motors on a bus, or change one: ids, mode, watchdog, bit rate, zero, error. "
        "Never while it is enabled.",
        {"setup": (SetupOptions,)},
    ),
    "monitor": MotorCommand(
        monitor,
        "--channel can0",
        "Show what the motors measure, again and again. Enables nothing.",
        {"monitor": (MonitorOptions,)},
    ),
    "map": MotorCommand(
        map_joints,
        "--channel can0 --model arm.xml --output joint_map.csv",
        "Find out by hand which motor drives which joint of a model, which way, and where its "
        "zero is. The arm is limp: support it, and move one joint at a time when you are asked.",
        {"map": (MapOptions,)},
    ),
}
# Keys of the main options, which the short help of commands that move an arm has.
_MAIN = (
    "interface",
    "channel",
    "fd",
    "speed",
    "rate",
    "kp",
    "park",
    "record",
    "yes",
    "joint_map",
    "accept_register_limits",
)


def build_parser(command: str, full: bool = True) -> Parser:
    """Return the parser of a subcommand of motors.

    ``command`` is a key of ``COMMANDS``. Without ``full``, the help has the main options only.
    """
    spec = COMMANDS[command]
    is_run = command in _PLAYED
    example = f"{PROGRAM} motors {command} {spec.example}"
    main = _MAIN if is_run and not full else None
    parser = Parser(f"motors {command}", example, spec.description, main, [*EXIT_CODES])
    if is_run:
        parser.add_argument(
            "trajectory", metavar="TRAJECTORY", type=Path, help="damiao_trajectory.csv"
        )
    if is_run or command == "map":
        arm = parser.add("arm", ModelOptions)
        arm.add_argument(
            "--model",
            metavar="MODEL",
            type=Path,
            required=command in ("simulate", "map"),
            help="MJCF or URDF of the arm",
        )
    parser.add("bus", BusAddress, BusTiming)
    for title, records in spec.groups.items():
        parser.add(title, *records)
    if is_run:
        arm.add_argument(
            "--joint-map",
            metavar="FILE",
            type=Path,
            help="how each joint's motor is mounted (see: motors map)",
        )
        # By default only the model limits the motion.
        parser.add("limits", LimitOptions, only=LIMITS, **dict.fromkeys(LIMITS))
    return parser.add_console_options()


def main(arguments: Sequence[str]) -> int:
    """Run the subcommand that the words after ``motors`` give; return its exit code.

    A SysidError that ends the subcommand is raised again when the result has been printed.
    """
    name = arguments[0] if arguments else "--help"
    if name not in COMMANDS:
        overview = Parser(
            "motors",
            f"{PROGRAM} motors setup --channel can0",
            "Inspect Damiao motors, play a trajectory on them and record it, or rehearse "
            "all that with a simulated arm; set motors up, watch them, and map them to a model's "
            "joints. Each command has its own --help.",
            codes=[*EXIT_CODES],
        )
        overview.add_argument("command", metavar="|".join(COMMANDS), help="what to do")
        overview.add_console_options().parse_args(arguments or ["--help"])
        raise InputError(f"unknown command {name!r}; valid: {', '.join(COMMANDS)}")
    session = Session(*parse_command(partial(build_parser, name), arguments[1:]))
    failure: SysidError | None = None
    try:
        code = COMMANDS[name].run(session)
        session.console.stage(*session.verdict)
    except SysidError as error:
        code = error.exit_code
        failure = error
        session.verdict = (f"Not usable: {error}",)
    content = {
        "command": name,
        "exit_code": code,
        "verdict": session.verdict,
        "next_step": session.step and vars(session.step),
        "lines": session.console.json_lines,
    }
    try:
        session.console.result(content)
    finally:
        # An error of printing must not hide what happened to the motors.
        if failure is not None:
            raise failure
    return code
