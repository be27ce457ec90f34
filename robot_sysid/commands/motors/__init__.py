"""``robot-sysid motors``: inspect Damiao motors, play on them, rehearse, set them up, map them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import Command
from robot_sysid.commands.motors.following import (
    play_step,
    step_at_arm,
    steps_after_play,
)
from robot_sysid.commands.motors.holding import hold
from robot_sysid.commands.motors.mapping import MapOptions, map_joints
from robot_sysid.commands.motors.moving import move
from robot_sysid.commands.motors.session import (
    PlayChoices,
    Session,
    check_and_run,
    conclude_on_reports,
    findings,
)
from robot_sysid.commands.motors.setup import (
    MonitorOptions,
    SetupOptions,
    monitor,
    setup,
)
from robot_sysid.damiao.adapters import BusAddress
from robot_sysid.damiao.bus import inspect_bus
from robot_sysid.damiao.checks.after_run import judge_run, recorded_plan
from robot_sysid.damiao.checks.preflight import direction_checks, stops
from robot_sysid.damiao.execution import (
    COMPUTER,
    LIMIT_OPTIONS,
    SIMULATED_OPTIONS,
    ArmFiles,
    Equipment,
    RunOptions,
)
from robot_sysid.damiao.protocol import BusTiming
from robot_sysid.damiao.settings import (
    ARM_OPTIONS,
    HOLD_SETTINGS,
    HoldOptions,
    MoveOptions,
    PlaySettings,
    RecordingOptions,
)
from robot_sysid.errors import EXIT_CODES, InputError, SysidError
from robot_sysid.model import ModelOptions
from robot_sysid.records.option_fields import (
    Option,
    OptionRecord,
    options_of_all,
    record_from,
)
from robot_sysid.wording import option_name


def check(session: Session) -> int:
    """Print what forbids to play; return 0 where nothing does, else 1.

    Without a channel only the trajectory is judged.
    """
    plan = session.plan()
    inspection = None
    if session.options.address.channel:
        with session.open_guarded() as link:
            inspection = inspect_bus(link)
    faults = len(stops(findings(session, plan, inspection)))
    if faults:
        session.verdict = (f"Not usable: {faults} to change before playing",)
        is_mapped = session.options.files.joint_map is not None
        unverified = stops([*direction_checks(plan, session.holding(plan))])
        if inspection is not None and not is_mapped and unverified:
            session.conclude(*session.verdict, step_at_arm(session))
        return 1
    ready = "Usable: ready to play"
    if inspection is None:
        ready += (
            f", as far as the file tells; no motor was asked ({option_name('channel')})"
        )
    session.conclude(ready, play_step(session, plan))
    return 0


def play(session: Session, is_real: bool = True) -> int:
    """Play a trajectory and print how it ended; return the exit code.

    It is 1 where a motor reported a fault again and again, or where the recording contradicts
    itself, or the model by more than models are usually off; and else 0. ``is_real`` tells whether
    to play on real motors, not on a simulated arm in simulated time. Errors are those of
    ``check_and_run``; InputError without --channel for real motors.
    """
    plan = session.plan()
    opened = session.open_guarded() if is_real else session.open_simulated(plan)
    with recorded_plan(plan) as recorded:
        with opened as link:
            report = check_and_run(session, link, recorded, inspect_bus(link), is_real)
        # The motors are off, and the bus is closed.
        said = judge_run(recorded, session.options.files.model, session.options.model)
    session.console.stage(*said.lines)
    if conclude_on_reports(session, report, plan.trajectory.joints):
        return 1
    record = plan.recording.record
    done = "played, and all motors are disabled"
    if record:
        done += f"; recorded to {record}"
    if said.differs:
        sentence = f"Not usable as it is, the arm is not what it should be: {done}"
        session.step = None
        session.verdict = (sentence, *filter(None, [said.remedy]))
        return 1
    steps = steps_after_play(session, plan, is_real)
    session.conclude(f"{'Usable' if record else 'Done'}: {done}", *steps)
    return 0


def run_command(
    action: Callable[..., int],
    own_options: Sequence[type[OptionRecord]],
    name: str,
    values: Mapping[str, Any],
    console: Console,
    equipment: Equipment = COMPUTER,
) -> int:
    """Run a command on motors, print its verdict and its result; return its exit code.

    A SysidError that ends the command is raised again when the result has been printed.

    Args:
        action: what the command does: called with the session and its own options.
        own_options: records of the options that no other command has.
        name: of the command, without "motors".
        values: of the options, by key.
        console: prints what happens.
        equipment: clock and adapters.
    """
    session: Session | None = None

    def print_result(code: int, verdict: Sequence[str]) -> None:
        """Print what came of the command that ends with an exit code."""
        content = {
            "command": name,
            "exit_code": code,
            "verdict": verdict,
            "next_step": session and session.step,
            "lines": console.json_lines,
        }
        console.result(content)

    try:
        choices = record_from(PlayChoices, values)
        session = Session(RunOptions.of(values), console, choices, equipment)
        code = action(session, *(record_from(each, values) for each in own_options))
        console.stage(*session.verdict)
    except SysidError as error:
        # An error of printing must not hide what happened to the motors.
        with contextlib.suppress(Exception):
            print_result(error.exit_code, (f"Not usable: {error}",))
        raise
    print_result(code, session.verdict)
    return code


_BUS = {"bus": options_of_all(BusAddress, BusTiming)}
_ARM = options_of_all(ModelOptions, ArmFiles)
# Options of commands that take a trajectory, by heading in the help.
_CHECKED = {
    "arm": _ARM,
    **_BUS,
    "motion and limits": options_of_all(PlaySettings),
    "limits": LIMIT_OPTIONS,
}
# Of commands that hold and move an arm without a trajectory.
_STANDING_ARM = [option for option in _ARM if option.key != "trajectory"]
_MODEL = [*options_of_all(ModelOptions), *options_of_all(ArmFiles, only=("model",))]
_RECORDED = {**_CHECKED, "recording": options_of_all(RecordingOptions)}
_ASKING = {"asking": options_of_all(PlayChoices)}
# What a simulated arm is, where it is not the usual one.
_PLANT = {"simulated arm": SIMULATED_OPTIONS}


def _command(
    name: str,
    action: Callable[..., int],
    example: str,
    description: str,
    groups: Mapping[str, Iterable[Option]],
    main: str = "",
    required: Collection[str] = (),
    own_options: Sequence[type[OptionRecord]] = (),
) -> Command:
    """Return the command ``motors NAME``; the arguments are those of ``Command``.

    The keys of ``main`` have blanks between them; ``own_options`` are those of ``run_command``.
    """
    return Command(
        f"motors {name}",
        f"motors {name} {example}",
        description,
        groups,
        partial(run_command, action, own_options, name),
        main.split(),
        required,
        EXIT_CODES,
        interrupted="interrupted; no motor is enabled",
    )


# Keys of the main options of commands that move an arm, as far as a command has them.
_MAIN = (
    "model interface channel fd speed rate kp park record yes joint_map plant_model float for_ "
    "motor_type simulate pose to"
)
_PLAYED = (
    _command(
        "simulate",
        partial(play, is_real=False),
        "damiao_trajectory.csv --model arm.xml --record measured.csv",
        "Play a trajectory on the arm of a model with simulated Damiao motors, in simulated time "
        "and without a bus, with all checks of play.",
        {**_RECORDED, **_PLANT},
        main=_MAIN,
        required=("model",),
    ),
    _command(
        "check",
        check,
        "damiao_trajectory.csv --channel can0",
        "Ask every id from 1 to 15, print what the motors say, and tell what has to change before "
        "a trajectory can be played; without --channel only what the file itself needs. Enables no "
        "motor and writes nothing.",
        _CHECKED,
        main=_MAIN,
    ),
    _command(
        "play",
        play,
        "damiao_trajectory.csv --channel can0 --speed 0.3 --record measured.csv",
        "Go through all checks, ask for confirmation, enable the motors, move slowly to the first "
        "point, play, come to rest, and disable. A disabled arm sinks: support it or park it where "
        "it cannot fall.",
        {**_RECORDED, **_ASKING},
        main=_MAIN,
    ),
    _command(
        "hold",
        hold,
        "--model arm.xml --channel can0 --float",
        "Hold an arm where it is, with the torque of its model's gravity; with --float take the "
        "stiffness away, and measure how fast the joints drift, hands off. An arm that falls is "
        "caught. A disabled arm sinks: support it.",
        {
            "arm": _STANDING_ARM,
            "holding": options_of_all(HoldOptions),
            **_PLANT,
            **_BUS,
            **_ASKING,
            "how it is held": options_of_all(PlaySettings, only=HOLD_SETTINGS),
            "recording": options_of_all(RecordingOptions),
        },
        main=_MAIN,
        required=("model",),
    ),
    _command(
        "move",
        move,
        "--to home --model arm.xml --channel can0",
        "Move an arm from where it stands to a pose of its model, slowly and on a straight line of "
        "the joints, with all checks of play along the whole way; hold it there for a moment, and "
        "disable it. A disabled arm sinks: support it.",
        {
            "arm": _STANDING_ARM,
            "moving": [
                *options_of_all(MoveOptions),
                *options_of_all(HoldOptions, only=ARM_OPTIONS),
            ],
            **_PLANT,
            **_BUS,
            **_ASKING,
            "how it is held": options_of_all(PlaySettings, only=HOLD_SETTINGS),
            "limits": LIMIT_OPTIONS,
            "recording": options_of_all(RecordingOptions),
        },
        main=_MAIN,
        required=("model", "to"),
        own_options=(MoveOptions,),
    ),
    _command(
        "setup",
        setup,
        "--channel can0 --motor 1 --new-id 2 --new-master-id 0x12 --mit --watchdog 0.1 --store",
        "List the motors on a bus, or change one: ids, mode, watchdog, error. "
        "Never while it is enabled.",
        {**_BUS, "arm": _MODEL, "setup": options_of_all(SetupOptions)},
        main="interface channel fd bitrate model motor new_id new_master_id mit watchdog "
        "clear_error store",
        own_options=(SetupOptions,),
    ),
    _command(
        "monitor",
        monitor,
        "--channel can0",
        "Show what the motors measure, again and again. Enables nothing.",
        {**_BUS, "monitor": options_of_all(MonitorOptions)},
        own_options=(MonitorOptions,),
    ),
    _command(
        "map",
        map_joints,
        "--channel can0 --model arm.xml --output joint_map.csv",
        "Find out by hand which motor drives which joint of a model, which way, and where its "
        "zero is. The arm is limp: support it, and move one joint at a time when you are asked.",
        {"arm": _MODEL, **_BUS, "map": options_of_all(MapOptions)},
        required=("model",),
        own_options=(MapOptions,),
    ),
)


def commands_with(equipment: Equipment) -> list[Command]:
    """Return the commands on motors that run with other equipment than this computer's.

    A program that has a bus of its own hands them to ``cli.main``.
    """

    def with_it(command: Command) -> Command:
        run: Callable[..., int] = command.run
        return replace(command, run=partial(run, equipment=equipment))

    return [*map(with_it, _PLAYED)]


_NAMES = [command.name.split()[1] for command in _PLAYED]


def refuse_unknown_command(values: Mapping[str, Any], console: Console) -> int:
    """Raise InputError for a word behind ``motors`` that is no command."""
    raise InputError(
        f"unknown command {values['command']!r}; valid: {', '.join(_NAMES)}"
    )


COMMANDS = (
    Command(
        "motors",
        "motors setup --channel can0",
        "Inspect Damiao motors, play a trajectory on them and record it, or rehearse all that with "
        "a simulated arm; set motors up, watch them, and map them to a model's joints. Each "
        "command has its own --help.",
        {"": (Option("command", "what to do", metavar="|".join(_NAMES)),)},
        refuse_unknown_command,
        codes=[*EXIT_CODES],
    ),
    *_PLAYED,
)
