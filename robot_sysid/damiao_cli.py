"""The command ``robot-sysid-damiao``: look at motors, play on them, or rehearse."""

from __future__ import annotations

import argparse
import contextlib
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from robot_sysid import __version__
from robot_sysid.damiao.bus.can_bus import open_bus
from robot_sysid.damiao.bus.can_log import RawFrameLog
from robot_sysid.damiao.bus.clock import SystemClock
from robot_sysid.damiao.bus.inspection import inspect_bus
from robot_sysid.damiao.bus.link import GuardedLink, Link
from robot_sysid.damiao.bus.slcan import SlcanTerminal
from robot_sysid.damiao.options import (
    PROGRAM,
    build_parser,
    bus_timing,
    permissions,
    play_settings,
)
from robot_sysid.damiao.play.player import StopRequest
from robot_sysid.damiao.play.preflight import Finding, general_findings, stops
from robot_sysid.damiao.play.run import (
    Audience,
    Plan,
    RecordingChoice,
    look,
    make_plan,
    perform,
)
from robot_sysid.damiao.protocol.bus_load import BusTiming, default_rate
from robot_sysid.damiao.report_lines import finding_lines, load_line, motor_table, run_lines
from robot_sysid.damiao.simulated.arm import SimulatedArm
from robot_sysid.damiao.simulated.faults import parse_fault
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.damiao.simulated.server import serve, served_in_background
from robot_sysid.damiao.trajectory.csv_file import read_damiao_trajectory
from robot_sysid.errors import HardwareAbort, InputError, SysidError

INTERRUPTED = 130
# Coarse enough for an ordinary computer to keep up with.
_REAL_TIME_STEP = 1e-3
_VIRTUAL_CHANNEL = "robot-sysid"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0 done; 1 something has to change before playing; 2 bad input or usage; 3 the run was refused
    or stopped; 130 interrupted before anything moved.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    try:
        options = build_parser(__version__).parse_args(arguments)
        return _COMMANDS[options.command](options)
    except SysidError as error:
        return _report(str(error), error.exit_code, debug)
    except KeyboardInterrupt:
        return _report("interrupted; nothing was moved", INTERRUPTED, debug)
    except Exception as error:
        hint = "this is a defect in robot-sysid; run again with --debug and report it"
        return _report(f"{type(error).__name__}: {error} ({hint})", 1, debug)


def _check(options: argparse.Namespace) -> int:
    timing, clock = bus_timing(options), SystemClock()
    plan = _plan(options, timing) if options.trajectory else None
    with _bus(options, timing, clock) as link:
        if plan:
            inspection, findings = look(link, clock, plan)
            findings = plan.judge() + findings
        else:
            inspection = inspect_bus(link, clock)
            findings = general_findings(inspection)
    if not inspection.motors:
        _print([*finding_lines(findings), "no motor answers: check power, wiring and bit rate"])
        return 1
    motors = len(inspection.motors)
    rate = options.rate or default_rate(motors, timing)
    _print(motor_table(inspection, plan.trajectory.joints if plan else ()))
    _print(["", load_line(motors, rate, timing), *finding_lines(findings)])
    to_change = len(stops(findings))
    _print(["", f"{to_change} to change before playing" if to_change else "ready to play"])
    return 1 if to_change else 0


def _play(options: argparse.Namespace) -> int:
    timing, clock = bus_timing(options), SystemClock()
    plan = _plan(options, timing)
    if options.channel is None:
        return _judge_without_bus(options, plan)
    with _bus(options, timing, clock) as link:
        return _play_on(link, clock, plan, options)


def _simulate(options: argparse.Namespace) -> int:
    timing, clock = bus_timing(options), SystemClock()
    plan = _plan(options, timing)
    arm = _simulated_arm(options, plan)
    if options.play:
        return _rehearse(arm, plan, options, timing, clock)
    stop = StopRequest()
    link = _simulated_end(options, timing, clock)
    ends = clock.now() + options.lifetime if options.lifetime else float("inf")
    try:
        with stop.on_signals():
            left_out = serve(arm, link, clock, lambda: not stop.count and clock.now() < ends)
    finally:
        link.close()
    if left_out > 0.0:
        _print([f"this computer was too slow by {left_out:.1f} s in all"])
    return 0


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "check": _check,
    "play": _play,
    "simulate": _simulate,
}


def _judge_without_bus(options: argparse.Namespace, plan: Plan) -> int:
    if not options.dry_run:
        raise InputError("play needs --channel, for instance --channel can0 (or --dry-run)")
    findings = plan.judge()
    _print(finding_lines(findings))
    return _verdict(findings)


def _play_on(link: GuardedLink, clock: SystemClock, plan: Plan, options: argparse.Namespace) -> int:
    inspection, findings = look(link, clock, plan)
    findings = plan.judge() + findings
    _print([*motor_table(inspection, plan.trajectory.joints), *finding_lines(findings)])
    if options.dry_run:
        return _verdict(findings)
    forbidden = stops(findings)
    if forbidden:
        raise HardwareAbort(f"not played: {forbidden[0]}")
    if not options.yes:
        _ask_for_confirmation()
        # The arm may have moved or been touched in the meantime.
        inspection, _ = look(link, clock, plan)
    stop = StopRequest()
    with contextlib.ExitStack() as stack:
        stack.enter_context(stop.on_signals())
        recording = _recording(options, clock, link)
        audience = Audience(lambda sentence: _print([sentence]), _progress(plan))
        report = perform(link, clock, plan, inspection, stop, recording, audience)
    _print(run_lines(report))
    if options.record:
        _print([f"recorded to {options.record}"])
    _print(["all motors are disabled"])
    return 0


def _rehearse(
    arm: SimulatedArm,
    plan: Plan,
    options: argparse.Namespace,
    timing: BusTiming,
    clock: SystemClock,
) -> int:
    """Play on a simulated arm in this process, over python-can's virtual bus."""
    options.dry_run, options.yes = False, True
    channel = options.channel or _VIRTUAL_CHANNEL
    with contextlib.ExitStack() as stack:
        near = open_bus("virtual", channel, timing, clock)
        stack.callback(near.close)
        far = open_bus("virtual", channel, timing, clock)
        stack.enter_context(served_in_background(arm, far, clock))
        return _play_on(GuardedLink(near, clock.now, timing.fd), clock, plan, options)


def _plan(options: argparse.Namespace, timing: BusTiming) -> Plan:
    trajectory = read_damiao_trajectory(options.trajectory)
    settings = play_settings(options, trajectory.joints, timing)
    allowed = permissions(options)
    adjust = not options.no_half_step, not options.no_centring
    return make_plan(trajectory, settings, timing, allowed, *adjust)


def _simulated_arm(options: argparse.Namespace, plan: Plan) -> SimulatedArm:
    # Imported here so that playing on real motors does not wait for MuJoCo.
    from robot_sysid.parser import load_robot_model
    from robot_sysid.simulation.stepper import MujocoPlant

    robot = load_robot_model(options.model, options.mesh_dir, options.joint)
    joints = plan.trajectory.joints
    if robot.n_joints != len(joints):
        raise InputError(
            f"{options.trajectory} has {len(joints)} joints but the chain of {options.model} has "
            f"{robot.n_joints}: {', '.join(robot.joint_names)}"
        )
    motors = [simulated_motor(j.spec, j.can_id, j.master_id, options.watchdog) for j in joints]
    faults = [parse_fault(text) for text in options.fault]
    plant = MujocoPlant(robot, plan.scan.first, _REAL_TIME_STEP)
    return SimulatedArm(plant, motors, faults)


def _simulated_end(options: argparse.Namespace, timing: BusTiming, clock: SystemClock) -> Link:
    """Open the simulated arm's end of the bus and say how to reach it."""
    if options.interface != "terminal":
        if options.channel is None:
            raise InputError("--interface needs --channel")
        link: Link = open_bus(options.interface, options.channel, timing, clock)
        reach = f"--interface {options.interface} --channel {options.channel}"
    else:
        terminal = SlcanTerminal(clock)
        link, reach = terminal, f"--interface slcan --channel {terminal.device}"
    fd = " --fd" if timing.fd else ""
    _print(
        [
            "the simulated arm is parked at the first point until its motors are enabled; Ctrl-C "
            "ends it. To play on it, in another terminal:",
            f"{PROGRAM} play {options.trajectory} {reach}{fd} --record measured.csv",
        ]
    )
    return link


@contextlib.contextmanager
def _bus(
    options: argparse.Namespace, timing: BusTiming, clock: SystemClock
) -> Iterator[GuardedLink]:
    link = open_bus(options.interface, options.channel, timing, clock)
    try:
        yield GuardedLink(link, clock.now, timing.fd)
    finally:
        link.close()


def _recording(
    options: argparse.Namespace, clock: SystemClock, link: GuardedLink
) -> RecordingChoice | None:
    if options.record is None:
        return None
    if options.record.exists() and not options.overwrite:
        raise InputError(f"{options.record} exists; choose another file or give --overwrite")
    raw_path: Path = options.raw_log or options.record.with_suffix(".log")
    raw = RawFrameLog(raw_path, clock, str(options.channel), options.overwrite)
    link.observer = raw
    return RecordingChoice(options.record, raw, options.overwrite)


def _progress(plan: Plan) -> Callable[[float], None] | None:
    """Return a function that shows how far the trajectory is, on a terminal only."""
    if not sys.stderr.isatty():
        return None
    from tqdm import tqdm

    duration = plan.scan.duration / plan.settings.speed
    bar = tqdm(
        total=round(duration, 1), unit="s", leave=False, bar_format="{l_bar}{bar}| {n:.1f} s"
    )

    def show(time: float) -> None:
        bar.update(time - bar.n)

    return show


def _ask_for_confirmation() -> None:
    if not sys.stdin.isatty():
        raise InputError("nobody can confirm: standard input is no terminal; give --yes")
    _print(
        [
            "The arm will move. Keep clear of it, keep the emergency stop at hand, and remember "
            "that it sinks when it is disabled."
        ]
    )
    if input("Type yes to play: ").strip().lower() != "yes":
        raise InputError("not confirmed; nothing was moved")


def _verdict(findings: Sequence[Finding]) -> int:
    forbidden = stops(findings)
    if forbidden:
        raise HardwareAbort(f"would not be played: {forbidden[0]}")
    _print(["nothing speaks against playing (dry run: nothing was enabled)"])
    return 0


def _print(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, flush=True)


def _report(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"{PROGRAM}: error: {' '.join(message.split())}", file=sys.stderr, flush=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
