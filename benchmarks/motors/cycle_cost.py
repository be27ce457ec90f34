"""Processor time of a control cycle of seven motors, beside that of a bare loop on the same bus.

Run from the checkout, nothing else running:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.motors.cycle_cost
    ... --write              # the table of docs/evidence.md
    ... --seconds 20         # longer runs

The bus is python-can's virtual one, and both its ends are in this process and thread. At the far
end are motors that make exactly what they are told and answer at once. The bare loop sends seven
frames and takes seven answers and as many echoes; ``play`` does all that it does on an arm, with a
recording. Time is simulated, so that nothing waits and no other program makes a run late. All
processor time counts, that of the far end included: what ``play`` itself takes is the difference.
``simulate`` is the same run on an arm and motors that are simulated in its usual steps. Runs of all
kinds take turns, and the least of each counts.
"""

from __future__ import annotations

import argparse
import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rigs.files.page_tables import PageTable
from rigs.motors.fault_bench import SetUp
from robot_sysid.damiao.adapters import BusAddress, BusLink, can_message, open_bus
from robot_sysid.damiao.bus import (
    GuardedLink,
    SimulatedClock,
    inspect_bus,
    undisturbed_processor,
)
from robot_sysid.damiao.execution import run
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.protocol import (
    ENABLE,
    ENABLED,
    BusTiming,
    CanFrame,
    is_special,
    special_frame,
)
from robot_sysid.damiao.safety.holding import file_holding, gravity_holding
from robot_sysid.damiao.settings import Plan, RecordingOptions
from robot_sysid.damiao.simulated import (
    SimulatedArm,
    SimulatedLink,
    SimulatedMotor,
    simulated_motor,
)
from robot_sysid.records import RobotModel
from robot_sysid.simulation.plant import ArmStepper

PAGE = Path(__file__).resolve().parents[2] / "docs" / "evidence.md"
TABLE = PageTable(PAGE, "cost", "python -m benchmarks.motors.cycle_cost --write")
FAST = 500.0
SLOW = 250.0
"""Rates of what is played and of what is simulated [Hz]: the usual ones with CAN-FD and without."""
TURNS = 3
"""Number of times that each kind of run takes its turn."""
WATCHDOG = 3.0
"""Watchdog of the motors [s]; nothing here depends on it."""
TEMPERATURES = bytes([31, 29])
"""Last two bytes of an answer [degC]."""
DATA = bytes([0x80, 0, 0x80, 0, 0, 0, 0x08, 0])
"""A command of the bare loop: all zero."""


class IdealMotors:
    """Motors at the far end of a bus, which do what they are told within a cycle.

    Args:
        motors: their registers and states; they are enabled and disabled as real ones are.
        end: the far end of the bus.
    """

    def __init__(self, motors: Sequence[SimulatedMotor], end: BusLink) -> None:
        self._motors = {motor.can_id: motor for motor in motors}
        self._bus = end.bus
        # Bytes of each motor's position, velocity and torque, by its CAN id.
        self._states = {motor.can_id: motor.feedback()[1:6] for motor in motors}

    def answer(self) -> None:
        """Answer all frames that have come."""
        while (message := self._bus.recv(0.0)) is not None:
            # What this end has sent comes back as an echo.
            if message.is_rx:
                frame = CanFrame(message.arbitration_id, bytes(message.data))
                for reply in self._replies(frame):
                    self._bus.send(can_message(reply))

    def _replies(self, frame: CanFrame) -> Iterator[CanFrame]:
        """Yield the answers to a frame; a command is answered by what the one before it said."""
        motor = self._motors.get(frame.id)
        if motor is None or is_special(frame.data) or not motor.drives:
            answers = (motor.handle(frame, 0.0) for motor in self._motors.values())
            yield from filter(None, answers)
            return
        head = bytes([ENABLED << 4 | frame.id])
        state = self._states[frame.id]
        # Position, velocity and torque have 16, 12 and 12 bits both in commands and in answers.
        data = frame.data
        speed = data[2] << 4 | data[3] >> 4
        torque = (data[6] & 0xF) << 8 | data[7]
        self._states[frame.id] = data[:2] + (speed << 12 | torque).to_bytes(3, "big")
        yield CanFrame(motor.joint.master_id, head + state + TEMPERATURES)


@dataclass
class Wire:
    """This end of the bus; the far end answers what was sent before this one is read."""

    near: BusLink
    motors: IdealMotors
    clock: SimulatedClock
    error_frames = 0
    _is_answered = True

    def send(self, frame: CanFrame) -> None:
        """Send a frame."""
        self.near.send(frame)
        self._is_answered = False

    def receive(self, until: float) -> CanFrame | None:
        """Return the next frame, or None at ``until`` [s]."""
        if not self._is_answered:
            self.motors.answer()
            self._is_answered = True
        now = self.clock.now()
        frame = self.near.receive(now)
        if frame is None:
            self.clock.sleep_until(until)
            return None
        return frame._replace(time=now)


@contextlib.contextmanager
def wired(plan: Plan) -> Iterator[Wire]:
    """Yield this end of a bus with motors that stand where a plan begins."""
    motors = [simulated_motor(joint, WATCHDOG) for joint in plan.trajectory.joints]
    for motor, angle in zip(motors, plan.trajectory.q[0].tolist()):
        motor.position = angle
    address = BusAddress("virtual", "cost")
    clock = SimulatedClock()
    near, far = (open_bus(address, BusTiming(), clock) for _ in range(2))
    with contextlib.closing(near), contextlib.closing(far):
        yield Wire(near, IdealMotors(motors, far), clock)


@contextlib.contextmanager
def simulated(plan: Plan, robot: RobotModel) -> Iterator[SimulatedLink]:
    """Yield a simulated bus with motors and an arm that stands where a plan begins."""
    motors = [simulated_motor(joint, WATCHDOG) for joint in plan.trajectory.joints]
    arm = SimulatedArm(ArmStepper(robot, plan.trajectory.q[0]), motors)
    yield SimulatedLink(SimulatedClock(), arm, plan.timing, echo=True)


def cost_of_run(setup: SetUp, opened: AbstractContextManager[Any]) -> float:
    """Return the processor time of a cycle of a played and recorded motion [s].

    ``opened`` yields the bus.
    """
    plan = setup.plan()
    holding = file_holding(plan.trajectory)
    if setup.model_is_given:
        holding = gravity_holding(setup.robot, plan.trajectory.joints)
    used = {}

    def note(phase: str) -> None:
        """Keep the processor time at the beginning of a phase."""
        used[phase.partition(" (")[0]] = time.process_time()

    with tempfile.TemporaryDirectory() as folder, opened as wire:
        recording = RecordingOptions(Path(folder) / "measured.csv")
        plan = replace(plan, recording=recording)
        link = GuardedLink(wire, wire.clock, plan.timing.fd)
        report = run(link, plan, inspect_bus(link), StopRequest(), note, holding)
    return (used["coming to rest"] - used["playing"]) / report.cycles


def cost_of_play(setup: SetUp) -> float:
    """Return the processor time of a cycle of ``play`` [s]."""
    return cost_of_run(setup, wired(setup.plan()))


def cost_of_simulate(setup: SetUp) -> float:
    """Return the processor time of a cycle of ``simulate`` [s]."""
    return cost_of_run(setup, simulated(setup.plan(), setup.robot))


def cost_of_bare_loop(setup: SetUp) -> float:
    """Return the processor time of a cycle of the loop that only sends and receives [s]."""
    joints = setup.plan().trajectory.joints
    messages = [can_message(CanFrame(joint.can_id, DATA)) for joint in joints]
    n_cycles = round(setup.duration * setup.rate)
    with wired(setup.plan()) as wire, undisturbed_processor(live=False):
        bus = wire.near.bus
        for joint in joints:
            wire.send(special_frame(ENABLE, joint.can_id))
        wire.motors.answer()
        while bus.recv(0.0) is not None:
            pass
        begun = time.process_time()
        for _ in range(n_cycles):
            for message in messages:
                bus.send(message)
            wire.motors.answer()
            n_missing = len(messages)
            while n_missing:
                n_missing -= bus.recv(0.0).is_rx
        return (time.process_time() - begun) / n_cycles


def least_costs(kinds: dict[str, Callable[[], float]]) -> dict[str, float]:
    """Return the least processor time of a cycle of each kind of run [s]."""
    turns = [{kind: cost() for kind, cost in kinds.items()} for _ in range(TURNS)]
    return {kind: min(turn[kind] for turn in turns) for kind in kinds}


def main() -> None:
    """Print the table, and write it into the page where that is asked for."""
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--seconds", type=float, default=8.0, help="of each motion")
    options.add_argument("--write", action="store_true", help="write docs/evidence.md")
    arguments = options.parse_args()
    fast = SetUp(belief="truth", rate=FAST, duration=arguments.seconds)
    slow = replace(fast, rate=SLOW)
    costs = least_costs(
        {
            f"{FAST:g} Hz, seven sends and answers with python-can": partial(
                cost_of_bare_loop, fast
            ),
            f"{FAST:g} Hz, `play`": partial(
                cost_of_play, replace(fast, model_is_given=False)
            ),
            f"{FAST:g} Hz, `play --model`": partial(cost_of_play, fast),
            f"{SLOW:g} Hz, `simulate --model`": partial(cost_of_simulate, slow),
        }
    )
    lines = ["| Seven motors at | Processor time of a cycle [µs] |", "| --- | --- |"]
    lines += [f"| {kind} | {1e6 * cost:.0f} |" for kind, cost in costs.items()]
    TABLE.show(lines, arguments.write)


if __name__ == "__main__":
    main()
