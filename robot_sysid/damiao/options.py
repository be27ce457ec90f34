"""The options of ``robot-sysid-damiao``, and the records they turn into."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

import numpy as np

from robot_sysid.damiao.bus.can_bus import INTERFACES
from robot_sysid.damiao.play.preflight import Permissions
from robot_sysid.damiao.play.settings import PlaySettings, default_gains, per_joint
from robot_sysid.damiao.protocol.bus_load import BusTiming, default_rate
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.simulated.faults import FAULT_KINDS
from robot_sysid.errors import InputError

PROGRAM = "robot-sysid-damiao"


class _Parser(argparse.ArgumentParser):
    """Argument parser that reports a usage error as one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} ({self.prog} --help lists all options)")


def build_parser(version: str) -> argparse.ArgumentParser:
    """Return the parser of the command line with its three commands."""
    parser = _Parser(
        prog=PROGRAM,
        description="Look at Damiao motors, play a trajectory on them and record it, or rehearse "
        "all that with a simulated arm.",
        epilog="Exit codes: 0 done, 1 something has to change before playing, 2 bad input, 3 the "
        "run was refused or stopped, 130 interrupted.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {version}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_check(commands)
    _add_play(commands)
    _add_simulate(commands)
    return parser


def bus_timing(options: argparse.Namespace) -> BusTiming:
    """Return the bit rates that were asked for."""
    if not (options.bitrate > 0 and options.data_bitrate > 0):
        raise InputError("--bitrate and --data-bitrate must be above 0")
    return BusTiming(options.fd, options.bitrate, options.data_bitrate)


def play_settings(
    options: argparse.Namespace, joints: tuple[DamiaoJoint, ...], timing: BusTiming
) -> PlaySettings:
    """Return gains and limits of a run, with defaults that suit the motors and the bus."""
    kp, kd = default_gains([joint.spec for joint in joints])
    rate = default_rate(len(joints), timing) if options.rate is None else options.rate
    return PlaySettings(
        kp=per_joint(options.kp, kp, "--kp"),
        kd=per_joint(options.kd, kd, "--kd"),
        rate=rate,
        speed=options.speed,
        approach_speed=options.approach_speed,
        start_tolerance=options.start_tolerance,
        max_tracking_error=options.max_tracking_error,
        max_temperature=options.max_temperature,
        start_temperature=min(PlaySettings.start_temperature, options.max_temperature),
        max_missed=options.max_missed,
        max_lateness=1e-3 * options.max_lateness_ms,
    )


def permissions(options: argparse.Namespace) -> Permissions:
    """Return what was allowed on purpose."""
    if options.set_watchdog is not None and not 0.0 < options.set_watchdog < np.inf:
        raise InputError("--set-watchdog must be a positive number of seconds")
    return Permissions(options.accept_register_limits, options.force_bus_load, options.set_watchdog)


def _add_check(commands: argparse._SubParsersAction[_Parser]) -> None:
    check = commands.add_parser(
        "check",
        help="find the motors and read their registers; enables nothing",
        description="Ask every id from 1 to 15, print what the motors say, and tell what has to "
        "change before a trajectory can be played. Enables no motor and writes nothing.",
        allow_abbrev=False,
    )
    check.add_argument(
        "trajectory",
        nargs="?",
        type=Path,
        metavar="TRAJECTORY",
        help="damiao_trajectory.csv to compare the motors with",
    )
    _add_bus_options(check, channel_required=True)
    _add_play_options(check)
    _add_debug(check)


def _add_play(commands: argparse._SubParsersAction[_Parser]) -> None:
    play = commands.add_parser(
        "play",
        help="play a trajectory on the motors and record it",
        description="Go through the pre-flight list, ask for confirmation, enable the motors, move "
        "slowly to the first point, play, come to rest, and disable. A disabled arm sinks: support "
        "it or park it where it cannot fall.",
        allow_abbrev=False,
    )
    play.add_argument("trajectory", type=Path, metavar="TRAJECTORY", help="damiao_trajectory.csv")
    play.add_argument(
        "--dry-run",
        action="store_true",
        help="stop after the pre-flight list; without --channel only what needs no bus",
    )
    _add_bus_options(play, channel_required=False)
    _add_play_options(play)
    _add_record_options(play)
    play.add_argument("-y", "--yes", action="store_true", help="do not ask for confirmation")
    _add_debug(play)


def _add_simulate(commands: argparse._SubParsersAction[_Parser]) -> None:
    simulate = commands.add_parser(
        "simulate",
        help="put a simulated arm on a bus, to rehearse without hardware",
        description="Simulate the arm of a model with Damiao motors. By default it sits behind a "
        "pseudo-terminal that looks like a serial CAN adapter; the line to give to 'play' is "
        "printed. With --play the trajectory is played at once, in this process.",
        allow_abbrev=False,
    )
    add = simulate.add_argument
    add("trajectory", type=Path, metavar="TRAJECTORY", help="names the motors and where to start")
    add("--model", type=Path, required=True, metavar="MODEL", help="MuJoCo XML or URDF of the arm")
    add("--mesh-dir", type=Path, metavar="DIR", help="folder of the meshes")
    add("--joint", metavar="NAME", help="terminal joint, where it is not found automatically")
    add("--play", action="store_true", help="play the trajectory here and now (interface virtual)")
    add("--for", dest="lifetime", type=float, metavar="SECONDS", help="end after this time")
    add(
        "--watchdog",
        type=float,
        default=0.1,
        metavar="SECONDS",
        help="watchdog of the simulated motors (default: 0.1)",
    )
    add(
        "--fault",
        action="append",
        default=[],
        metavar="KIND:JOINT[=VALUE][@SECONDS]",
        help="let something go wrong, SECONDS after the motors were enabled; may be repeated. "
        f"Kinds: {', '.join(FAULT_KINDS)}",
    )
    _add_bus_options(simulate, channel_required=False, interface="terminal")
    _add_play_options(simulate)
    _add_record_options(simulate)
    _add_debug(simulate)


def _add_bus_options(
    parser: argparse.ArgumentParser, channel_required: bool, interface: str = "socketcan"
) -> None:
    add = parser.add_argument_group("bus").add_argument
    choices = [*INTERFACES, "terminal"] if interface == "terminal" else list(INTERFACES)
    add(
        "--interface",
        choices=choices,
        default=interface,
        metavar="NAME",
        help=f"kind of adapter: {', '.join(choices)} (default: {interface})",
    )
    add(
        "--channel",
        required=channel_required,
        metavar="CHANNEL",
        help="what the adapter calls the bus, for instance can0 or /dev/ttyACM0",
    )
    add("--fd", action="store_true", help="use CAN-FD frames")
    add("--bitrate", type=float, default=1e6, metavar="BIT/S", help="nominal (default: 1000000)")
    add(
        "--data-bitrate",
        type=float,
        default=5e6,
        metavar="BIT/S",
        help="of the data part of CAN-FD frames (default: 5000000)",
    )


def _add_play_options(parser: argparse.ArgumentParser) -> None:
    motion = parser.add_argument_group("motion").add_argument
    motion(
        "--rate",
        type=float,
        metavar="HZ",
        help="control cycles per second (default: 250, with --fd 500, less where the bus is full)",
    )
    motion("--speed", type=float, default=1.0, help="1 plays as exported, 0.3 slower (default: 1)")
    motion(
        "--kp",
        type=float,
        nargs="+",
        metavar="KP",
        help="stiffness in N m/rad, one for all or one per joint (default: by motor type)",
    )
    motion(
        "--kd",
        type=float,
        nargs="+",
        metavar="KD",
        help="damping in N m s/rad, above 0, one for all or one per joint (default: kp/20)",
    )
    motion("--approach-speed", type=float, default=0.2, metavar="RAD/S", help="(default: 0.2)")
    _add_limits(parser)
    _add_permissions(parser)


def _add_limits(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("when to stop").add_argument
    for option, default, unit, text in (
        ("--start-tolerance", 0.5, "RAD", "how far a joint may be from the first point"),
        ("--max-tracking-error", 0.2, "RAD", "how far a joint may leave its path"),
        ("--max-temperature", 80.0, "DEGC", "of power stage and winding"),
        ("--max-lateness-ms", 20.0, "MS", "how late a control cycle may be"),
    ):
        help_text = f"{text} (default: {default:g})"
        add(option, type=float, default=default, metavar=unit, help=help_text)
    add(
        "--max-missed",
        type=int,
        default=3,
        metavar="N",
        help="unanswered commands in a row (default: 3)",
    )


def _add_permissions(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("what to allow").add_argument
    add(
        "--accept-register-limits",
        action="store_true",
        help="use the motors' own PMAX, VMAX, TMAX where they differ from the motor type's",
    )
    add(
        "--set-watchdog",
        type=float,
        metavar="SECONDS",
        help="set the motors' watchdogs for this run; nothing is stored in them",
    )
    add("--force-bus-load", action="store_true", help="go above 70 %% bus load")
    add(
        "--no-half-step",
        action="store_true",
        help="do not add half a quantisation step to measured values (motors drop the fraction)",
    )
    add(
        "--no-centring",
        action="store_true",
        help="record torques as measured at the end of each cycle, not centred on its step",
    )


def _add_record_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("recording").add_argument
    add("--record", type=Path, metavar="FILE", help="write the measurement CSV")
    add(
        "--raw-log",
        type=Path,
        metavar="FILE",
        help="write every frame, format by suffix: .log .asc .blf .trc (default: beside --record)",
    )
    add("--overwrite", action="store_true", help="replace existing recordings")


def _add_debug(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--debug", action="store_true", help="show a traceback with an error")
