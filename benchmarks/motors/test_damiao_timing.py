"""Timing of a run with seven motors: how late control cycles start, and what the codec takes.

    pytest benchmarks/motors/test_damiao_timing.py --benchmark-only -s

The simulated arm (seven pendulums) answers either within the same thread, which shows the player
alone, or from a second thread over python-can's virtual bus, which shows both sharing one Python.
"""

from __future__ import annotations

import contextlib
import sys
import threading

import numpy as np
import pytest

from rigs.motors.damiao_rig import Pendulums, swing
from rigs.motors.realtime_arm import serve
from robot_sysid.damiao.adapters import BusAddress, open_bus
from robot_sysid.damiao.bus import GuardedLink, SystemClock, inspect_bus
from robot_sysid.damiao.execution import run
from robot_sysid.damiao.joints import MOTORS, damiao_joints
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import (
    BusTiming,
    MitCommand,
    Scaling,
    decode_feedback,
    encode_mit,
)
from robot_sysid.damiao.safety.holding import file_holding
from robot_sysid.damiao.settings import Plan, PlaySettings, RecordingOptions
from robot_sysid.damiao.simulated import SimulatedArm, simulated_motor
from robot_sysid.damiao.trajectory import (
    export_damiao_trajectory,
    read_damiao_trajectory,
)

JOINTS = 7
SECONDS = 8.0
RATES = (250.0, 500.0)
SWITCH_INTERVAL = 2e-4


class SameThreadLink:
    """A link whose arm answers at once, in the caller's thread."""

    error_frames = 0

    def __init__(self, arm: SimulatedArm, clock: SystemClock) -> None:
        self._arm = arm
        self._clock = clock
        self._start = clock.now()
        self._replies = []

    def send(self, frame):
        """Let the arm handle a frame; its replies wait."""
        self._replies += self._arm.handle(frame, self._clock.now() - self._start)

    def receive(self, until):
        """Return the next reply, or None after the time is over."""
        if self._replies:
            return self._replies.pop(0)._replace(time=self._clock.now())
        self._clock.sleep_until(until)
        return None

    def close(self):
        """Do nothing: there is nothing to release."""


def arm_and_plan(folder, rate: float) -> tuple[SimulatedArm, Plan]:
    """Return a simulated arm of seven motors and a trajectory for it."""
    joints = damiao_joints(["DM4340"] * JOINTS, JOINTS)
    path = folder / "damiao_trajectory.csv"
    motion = swing(JOINTS, SECONDS, rate=1000.0)
    with path.open("w") as file:
        export_damiao_trajectory([motion], joints, file)
    # Measure lateness instead of stopping for it.
    settings = PlaySettings(
        rate=rate,
        max_lateness=10.0,
        max_missed=10_000,
        max_lost=10_000,
        max_doubted=10_000,
        max_tracking_error=3.0,
    )
    recording = RecordingOptions(folder / "measured.csv", overwrite=True)
    plan = Plan(
        read_damiao_trajectory(path), settings, BusTiming(fd=True), recording=recording
    )
    motors = [simulated_motor(j, watchdog=3.0) for j in joints]
    return SimulatedArm(Pendulums(JOINTS), motors), plan


def _ignore(message: object) -> None:
    """Print nothing."""


def play(link: GuardedLink, plan: Plan):
    """Inspect the motors and play a plan on them."""
    inspection = inspect_bus(link)
    holding = file_holding(plan.trajectory)
    return run(link, plan, inspection, StopRequest(), _ignore, holding)


def tell(benchmark, report, rate: float) -> None:
    """Keep the figures with the benchmark and print them."""
    figures = {
        "lateness_p50_us": round(1e6 * report.lateness_p50),
        "lateness_p99_us": round(1e6 * report.lateness_p99),
        "skipped_cycles": report.skipped,
        "cycles": report.cycles,
        "missed_replies": int(np.sum(report.missed)),
    }
    benchmark.extra_info.update(figures)
    print(f"\n{rate:g} Hz: {figures}")


@contextlib.contextmanager
def served_in_background(arm, link, clock):
    """Serve the arm in a thread while the block runs, then close its link."""
    leave = threading.Event()
    # Python hands over between busy threads every 5 ms by default: longer than a control cycle.
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    thread = threading.Thread(
        target=serve, args=(arm, link, clock, lambda: not leave.is_set()), daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        leave.set()
        thread.join()
        sys.setswitchinterval(interval)
        link.close()


@pytest.mark.parametrize("rate", RATES)
def test_the_player_alone(benchmark, tmp_path, rate):
    arm, plan = arm_and_plan(tmp_path, rate)
    clock = SystemClock()
    link = GuardedLink(SameThreadLink(arm, clock), clock)
    report = benchmark.pedantic(play, (link, plan), rounds=1)
    tell(benchmark, report, rate)


@pytest.mark.parametrize("rate", RATES)
def test_over_the_virtual_bus(benchmark, tmp_path, rate):
    arm, plan = arm_and_plan(tmp_path, rate)
    clock = SystemClock()
    address = BusAddress("virtual", f"bench{rate}")
    host, motors = (open_bus(address, BusTiming(), clock) for _ in range(2))
    try:
        with served_in_background(arm, motors, clock):
            link = GuardedLink(host, clock)
            report = benchmark.pedantic(play, (link, plan), rounds=1)
    finally:
        host.close()
    tell(benchmark, report, rate)


def test_encoding_and_decoding_one_cycle_of_all_joints(benchmark):
    scaling = Scaling([MOTORS["DM4340"].limits] * JOINTS)
    zero = np.zeros(JOINTS)
    command = MitCommand(zero + 0.1, zero + 0.2, zero + 20.0, zero + 1.0, zero + 0.3)
    replies = np.random.default_rng(0).integers(0, 256, (JOINTS, 8), dtype=np.uint8)

    def cycle():
        """Encode one command and decode its replies."""
        encode_mit(command, scaling)
        return decode_feedback(replies, scaling)

    assert benchmark(cycle).position.shape == (JOINTS,)
