"""``robot-sysid motors``: inspect Damiao motors, play on them, rehearse, set them up, map them."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from robot_sysid.commands.arguments import PROGRAM, Parser, parsed
from robot_sysid.commands.motors import setup as motors_setup
from robot_sysid.commands.motors.asked import (
    Asked,
    check_lines,
    motor_table,
    run_lines,
    said_yes,
)
from robot_sysid.commands.motors.directions import DirectionChoices, verify
from robot_sysid.commands.motors.setup import LifetimeOptions
from robot_sysid.damiao import preflight, simulated
from robot_sysid.damiao.adapters import BusAddress, BusLink, import_can, slcan_terminal
from robot_sysid.damiao.bus import GuardedLink, Link, inspect_bus
from robot_sysid.damiao.execution import lengthen_hold
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import BusTiming, default_rate
from robot_sysid.damiao.settings import (
    Permissions,
    PlaySettings,
    RecordingOptions,
    SecondArm,
)
from robot_sysid.damiao.simulated import serve
from robot_sysid.damiao.trajectory import LIMITS
from robot_sysid.errors import HardwareAbort, InputError, SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.motion.plan_options import LimitOptions
from robot_sysid.records.file_access import plan_settings
from robot_sysid.records.option_fields import (
    OptionRecord,
    command_arguments,
    option,
    options_of,
    record_from,
)

INTERRUPTED = "interrupted; no motor is enabled"
_CODES = (0, 1, 2, 3, 130)
# Coarse enough for an ordinary computer to keep up with.
_REAL_TIME_STEP = 1e-3
_FOR_EVER = 1e8
# A simulated arm that is later than this lets answers miss their cycle at 250 Hz [s].
_WORTH_SAYING = 3e-3


@dataclass(frozen=True)
class PlayChoices(OptionRecord):
    """What ``motors play`` does beside playing."""

    dry_run: bool = option(
        False, "stop after the checks; without --channel only those that need no bus"
    )
    yes: bool = option(False, "do not ask for confirmation", short="-y")


@dataclass(frozen=True)
class SimulatedMotorOptions(LifetimeOptions):
    """What ``motors simulate`` puts on the bus, and for how long."""

    play: bool = option(
        False, "play the trajectory at once, in simulated time, without a bus"
    )
    watchdog: float = option(
        simulated.DEFAULT_WATCHDOG, "of the simulated motors", "S [s] > 0"
    )


def check(asked: Asked) -> int:
    """Inspect the motors; return 0 where a trajectory could be played."""
    console = asked.console
    if not asked.address.channel:
        raise InputError("check needs --channel, for instance --channel can0")
    plan = asked.plan() if asked.values.get("trajectory") else None
    if plan is None and asked.values.get("model"):
        raise InputError("--model needs a TRAJECTORY to check")
    checks = asked.checks(plan) if plan else []
    with asked.open_guarded() as link:
        inspection = inspect_bus(link)
    motors = len(inspection.motors)
    if not motors:
        console.stage(*check_lines(checks))
        asked.verdict = (f"Not usable: {motors_setup.SILENT}",)
        return 1
    rate = record_from(PlaySettings, asked.values).rate or default_rate(
        motors, asked.timing
    )
    if plan:
        checks += asked.inspection_checks(plan, inspection)
    else:
        settings = PlaySettings(rate=rate)
        checks += preflight.general_checks(inspection, settings, asked.timing)
    joints = plan.trajectory.joints if plan else ()
    console.stage(*motor_table(inspection, joints), *check_lines(checks))
    to_change = len(preflight.stops(checks))
    if to_change:
        asked.verdict = (f"Not usable: {to_change} to change before playing",)
    elif plan:
        asked.conclude("Usable: ready to play", asked.play_words())
    else:
        asked.conclude(
            "Usable: the motors are in order",
            asked.command("check", trajectory="TRAJECTORY"),
        )
    return 1 if to_change else 0


def play(asked: Asked) -> int:
    """Play a trajectory on the motors."""
    choices = record_from(PlayChoices, asked.values)
    plan = asked.plan()
    checks = asked.checks(plan)
    if asked.address.channel:
        with asked.open_guarded() as link:
            if (
                record_from(DirectionChoices, asked.values).verify
                and not choices.dry_run
            ):
                return verify(asked, link, plan)
            return _play_on(link, plan, checks, choices, asked, real=True)
    if not choices.dry_run:
        raise InputError(
            "play needs --channel, for instance --channel can0 (or --dry-run)"
        )
    asked.console.stage(*check_lines(checks))
    return _rehearsed(checks, asked)


def simulate(asked: Asked) -> int:
    """Put a simulated arm on a bus, or play on it at once."""
    options = record_from(SimulatedMotorOptions, asked.values)
    plan = asked.plan()
    checks = asked.checks(plan)
    if options.play:
        with asked.open_simulated(asked.simulated_arm(plan, options.watchdog)) as link:
            return _play_on(link, plan, checks, PlayChoices(yes=True), asked)
    preflight.require_no_stop(checks, "not rehearsed")
    arm = asked.simulated_arm(plan, options.watchdog, _REAL_TIME_STEP)
    system = asked.clock
    stop = StopRequest()
    with contextlib.closing(_simulated_end(asked)) as end, stop.on_signals():
        ends = system.now() + (options.lifetime or float("inf"))
        service = serve(
            arm, end, system, lambda: not stop.count and system.now() < ends
        )
    if service.left_out > 0.0:
        asked.console.stage(
            f"this computer was too slow by {service.left_out:.1f} s in all"
        )
    if service.longest_delay > _WORTH_SAYING:
        late = f"{1e3 * service.longest_delay:.0f} ms"
        asked.console.stage(f"this computer kept commands waiting for up to {late}")
    return 0


def hold(asked: Asked) -> int:
    """Hold the arm where it stands, its weight carried by torques of its model."""
    seconds = record_from(LifetimeOptions, asked.values).lifetime or _FOR_EVER
    choices = record_from(PlayChoices, asked.values)
    with asked.open_guarded() as link:
        plan = asked.hold_plan(inspect_bus(link))
        checks = asked.checks(plan)
        return _play_on(
            link, lengthen_hold(plan, seconds), checks, choices, asked, holds=True
        )


class _Command(NamedTuple):
    """What a subcommand does, an example, what its help says, and its own options by group."""

    run: Callable[[Asked], int]
    example: str
    description: str
    groups: Mapping[str, Sequence[type]]


_MOTION = {"motion and limits": (PlaySettings,), "what to allow": (Permissions,)}
_ASKING = {"asking": (PlayChoices,)}
_PLAYED = {
    "check": _Command(
        check,
        "damiao_trajectory.csv --channel can0",
        "Ask every id from 1 to 15, print what the motors say, and tell what has to change before "
        "a trajectory can be played. Enables no motor and writes nothing.",
        _MOTION,
    ),
    "play": _Command(
        play,
        "damiao_trajectory.csv --channel can0 --speed 0.3 --record measured.csv",
        "Go through all checks, ask for confirmation, enable the motors, move slowly to the first "
        "point, play, come to rest, and disable. A disabled arm sinks: support it or park it where "
        "it cannot fall.",
        {
            **_MOTION,
            "recording": (RecordingOptions,),
            "asking": (PlayChoices, DirectionChoices),
        },
    ),
    "simulate": _Command(
        simulate,
        "damiao_trajectory.csv --model arm.xml --play --record measured.csv",
        "Simulate the arm of a model with Damiao motors. Without --play it sits behind a "
        "pseudo-terminal that acts as a serial CAN adapter, or on the bus of --interface and "
        "--channel; the line to give to 'play' is printed.",
        {
            "simulated motors": (SimulatedMotorOptions,),
            **_MOTION,
            "recording": (RecordingOptions,),
        },
    ),
}
COMMANDS: Mapping[str, _Command] = {
    **_PLAYED,
    "hold": _Command(
        hold,
        "--channel can0 --model arm.xml --park rest",
        "Hold the arm where it stands, stiff, its weight carried by torques of its model. Ctrl-C "
        "lowers it with --park rest, and lets go of it without. All checks of play are made.",
        {
            "holding": (LifetimeOptions,),
            **_MOTION,
            "recording": (RecordingOptions,),
            **_ASKING,
        },
    ),
    "setup": _Command(
        motors_setup.setup,
        "--channel can0 --motor 1 --new-id 2 --new-master-id 0x12 --mit --watchdog 0.1 --store",
        "List the motors on a bus, or change one: ids, mode, watchdog, bit rate, zero, error. "
        "Never while it is enabled.",
        {"setup": (motors_setup.SetupOptions,)},
    ),
    "monitor": _Command(
        motors_setup.monitor,
        "--channel can0",
        "Show what the motors measure, again and again. Enables nothing.",
        {"monitor": (motors_setup.MonitorOptions,)},
    ),
    "map": _Command(
        motors_setup.map_joints,
        "--channel can0 --model arm.xml --output joint_map.csv",
        "Find out by hand which motor drives which joint of a model, which way, and where its "
        "zero is. The arm is limp: support it, and move one joint at a time when you are asked.",
        {"map": (motors_setup.MapOptions,)},
    ),
}
_MAIN = (
    "interface",
    "channel",
    "fd",
    "speed",
    "rate",
    "kp",
    "park",
    "record",
    "dry_run",
    "yes",
    "play",
    "joint_map",
    "accept_register_limits",
    "set_watchdog",
)


def build_parser(command: str, full: bool = True) -> Parser:
    """Return the parser of a subcommand; without ``full``, its help shows the main options only."""
    _, example, description, groups = COMMANDS[command]
    own = (
        name
        for records in groups.values()
        for each in records
        for name in options_of(each)
    )
    main = _MAIN if command in (*_PLAYED, "hold") else (*_MAIN[:3], *own)
    usage = f"{PROGRAM} motors {command} {example}"
    shown = None if full else main
    parser = Parser(f"motors {command}", usage, description, shown, codes=_CODES)
    if command in _PLAYED:
        nargs = "?" if command == "check" else None
        parser.add_argument(
            "trajectory",
            metavar="TRAJECTORY",
            type=Path,
            help="damiao_trajectory.csv",
            nargs=nargs,
        )
    if command in (*_PLAYED, "hold", "map"):
        arms = (ModelOptions,) if command == "map" else (ModelOptions, SecondArm)
        none = () if command in _PLAYED else ("also",)
        group = parser.add("arm", *arms, leave_out=none)
        help_model = "of the arm"
        if command != "map":
            help_model = (
                "MJCF or URDF of the arm; the trajectory is checked against its limits"
            )
            help_map = (
                "how each joint's motor is mounted (see: motors map), or LeRobot's file"
            )
            group.add_argument("--joint-map", metavar="FILE", type=Path, help=help_map)
        needed = command in ("simulate", "hold", "map")
        group.add_argument(
            "--model", metavar="MODEL", type=Path, required=needed, help=help_model
        )
    parser.add("bus", BusAddress, BusTiming)
    for title, records in groups.items():
        parser.add(title, *records)
    if command in _PLAYED:
        # Nothing is limited by default, but by the model.
        parser.add("limits", LimitOptions, only=LIMITS, usual=dict.fromkeys(LIMITS))
    return parser.with_console()


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    name = arguments[0] if arguments else "--help"
    if name not in COMMANDS:
        _overview().parse_args(arguments or ["--help"])
        raise InputError(f"unknown command {name!r}; valid: {', '.join(COMMANDS)}")
    asked = Asked(*parsed(partial(build_parser, name), arguments[1:]))
    failure: SysidError | None = None
    try:
        code = COMMANDS[name].run(asked)
        asked.console.stage(*asked.verdict)
    except SysidError as error:
        code = error.exit_code
        failure = error
        asked.verdict = (f"Not usable: {error}",)
    told = {"verdict": asked.verdict, "lines": asked.console.said}
    try:
        asked.console.result({"command": name, "exit_code": code, **told})
    finally:
        # That nothing can be printed is no reason to leave out what happened to the motors.
        if failure is not None:
            raise failure
    return code


def _overview() -> Parser:
    parser = Parser(
        "motors",
        f"{PROGRAM} motors check --channel can0",
        "Inspect Damiao motors, play a trajectory on them and record it, or rehearse "
        "all that with a simulated arm; set motors up, watch them, and map them to a model's "
        "joints. Each command has its own --help.",
        codes=_CODES,
    )
    parser.add_argument("command", metavar="|".join(COMMANDS), help="what to do")
    return parser.with_console()


def _play_on(
    link: GuardedLink,
    plan: preflight.Plan,
    checks: Sequence[preflight.Check],
    choices: PlayChoices,
    asked: Asked,
    holds: bool = False,
    real: bool = False,
) -> int:
    """Play on ``real`` motors or others; where it ``holds``, until somebody wants it to end."""
    console = asked.console
    inspection = inspect_bus(link)
    checks = [*checks, *asked.inspection_checks(plan, inspection, real)]
    console.stage(
        *motor_table(inspection, plan.trajectory.joints), *check_lines(checks)
    )
    if choices.dry_run:
        return _rehearsed(checks, asked)
    preflight.require_no_stop(checks, "not played")
    asked.require_free(plan)
    if not choices.yes:
        if not said_yes(_WARNING, "; give --yes"):
            raise InputError("not confirmed; nothing was moved")
        # The arm may have moved or been touched in the meantime.
        inspection = inspect_bus(link)
        preflight.require_no_stop(
            asked.inspection_checks(plan, inspection, real), "not played"
        )

    stop = StopRequest()

    def tell(time: float) -> None:
        if not holds:
            console.advance("Playing", time, plan.duration, "")

    def say(phase: str) -> None:
        console.stage(
            "holding; Ctrl-C ends it" if holds and "playing" in phase else phase
        )

    try:
        console.stage(*run_lines(asked.play(link, plan, inspection, stop, say, tell)))
    except HardwareAbort as error:
        # That it has to end is no fault of holding, if all else went well.
        if not holds or str(error) != stop.reason:
            raise
    _conclude(asked, plan, holds, real)
    return 0


def _conclude(asked: Asked, plan: preflight.Plan, held: bool, real: bool) -> None:
    """Say what came of a run, and what to do with it."""
    record = plan.recording.record
    done = f"{'held' if held else 'played'}, and all motors are disabled"
    done = f"{'Done' if record is None else 'Usable'}: {done}"
    done += "" if record is None else f"; recorded to {record}"
    if held:
        asked.verdict = (done,)
    elif record is None or plan.settings.speed < 1.0:
        again = asked.command("play", "speed", record="measured.csv")
        asked.conclude(done, again, " (a recording at full speed, to identify from)")
    else:
        asked.conclude(done, _identify_command(asked, plan, record, real))


def _identify_command(
    asked: Asked, plan: preflight.Plan, record: Path, real: bool
) -> list[str]:
    """Return the command that identifies the arm from a recording of a plan.

    Results go to the folder of the planned motion. The model of a simulated arm stands for the real
    arm, which nobody knows: what is identified then is the model that the motion was planned with.
    """
    arm = asked.values
    model = arm.get("model") or "MODEL"
    settings = (
        None
        if plan.trajectory.has_two_arms
        else plan_settings(plan.trajectory.path.parent)
    )
    folder = () if settings is None else ("--output-dir", str(settings[0].parent))
    if settings is not None and not real:
        arm = settings[1]
        model = arm.get("path", model)
    arm_options = command_arguments(arm, ModelOptions)
    return [PROGRAM, "identify", str(model), str(record), *arm_options, *folder]


def _simulated_end(asked: Asked) -> Link:
    """Open the simulated arm's end of the bus and say how to reach it."""
    interface = asked.address.interface
    channels = asked.address.channel
    if channels:
        link = asked.open_link()
    elif "interface" in asked.values:
        raise InputError("--interface needs --channel")
    else:
        import_can()
        names = asked.channels
        ends = [slcan_terminal() for _ in names or ("",)]
        devices = [device for _, device in ends]
        channels = (
            tuple(map("=".join, zip(names, devices)))
            if len(names) > 1
            else tuple(devices)
        )
        link = BusLink([terminal for terminal, _ in ends], asked.clock)
        interface = "slcan"
    # A simulated arm turns as its model does.
    there = {"interface": interface, "channel": channels, "accept_directions": True}
    words = asked.command("play", **{"record": "measured.csv", **there})
    told = "the simulated arm is parked at the first point until its motors are enabled; Ctrl-C "
    told += "ends it. To play on it, in another terminal:"
    asked.console.stage(told, shlex.join(words))
    return link


_WARNING = (
    "The arm will move. Keep clear of it, keep the emergency stop at hand, and remember that it "
    "sinks when it is disabled."
)


def _rehearsed(checks: Sequence[preflight.Check], asked: Asked) -> int:
    preflight.require_no_stop(checks, "would not be played")
    asked.conclude(
        "Usable: nothing speaks against playing (nothing was enabled)",
        asked.play_words(),
    )
    return 0
