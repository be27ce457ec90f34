"""A limp arm that a person moves by hand, while its motors tell where they are."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import TypeVar

import numpy as np

from robot_sysid.commands.motors.stops import Extremes
from robot_sysid.damiao.bus import GuardedLink, RegisterClient, inspect_bus
from robot_sysid.damiao.joints import DamiaoJoint
from robot_sysid.damiao.protocol import ENABLED
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records.messages import count_text

Positions = Mapping[int, float]
"""Position of each motor [rad], by its CAN id."""
Answer = TypeVar("Answer")
FOLLOWER = "follow motors"
"""Name of the thread that follows the motors while a person is waited for."""
# Time between two looks at a joint that is pushed [s]: a person holds it for longer.
_LOOK = 0.02


class LimpArm:
    """Motors of a bus, all of them disabled, of an arm with n joints.

    Args:
        link: link of the motors' bus, on which nothing that moves a motor may be sent.
        n_joints: number of joints n, which need a motor each.

    Attributes:
        motors: the motors that answer, by their CAN ids.

    Raises:
        InputError: there are fewer motors than joints.
        HardwareAbort: a motor is enabled or does not tell.
    """

    def __init__(self, link: GuardedLink, n_joints: int) -> None:
        self._client = RegisterClient(link)
        self.motors = inspect_bus(link).motors
        if len(self.motors) < n_joints:
            raise InputError(
                f"motors that answer: {len(self.motors)}, but the model's chain has "
                f"{count_text(n_joints, 'joint')}"
            )
        for motor in self.motors.values():
            if motor.feedback is None or motor.feedback.status[0] == ENABLED:
                raise HardwareAbort(
                    f"{motor.name} is enabled or does not tell; the arm has to be limp"
                )

    def require(self, joints: Iterable[DamiaoJoint]) -> None:
        """Raise HardwareAbort where the motor of one of some joints does not answer as they say."""
        for joint in joints:
            motor = self.motors.get(joint.can_id)
            if motor is None or motor.master_id != joint.master_id:
                raise HardwareAbort(
                    f"{joint.label} does not answer on {joint.master_id:#x}; check power and ids; "
                    "nothing was written"
                )

    def positions(self) -> Positions:
        """Return the present position of each motor [rad].

        HardwareAbort where a motor does not answer, or another program has enabled it.
        """
        positions = {}
        for can_id, motor in self.motors.items():
            state = self._client.state_of(motor)
            if state is None:
                raise HardwareAbort(
                    f"{motor.name} does not answer any more; nothing was written"
                )
            if state.status[0] == ENABLED:
                raise HardwareAbort(
                    f"another program has enabled {motor.name}; nothing was written"
                )
            positions[can_id] = state.position[0]
        return positions

    def follow_while(self, extremes: Extremes, waiting: Callable[[], Answer]) -> Answer:
        """Return what ``waiting`` returns, and follow the motors as long as it takes.

        The motors are asked by another thread, because nothing else can be done while a person is
        waited for. Errors are those of ``positions``, and of ``waiting``.

        Args:
            extremes: of the motors, in the order of ``motors``.
            waiting: waits for a person; it must not use the bus.
        """
        over = threading.Event()
        failures: list[BaseException] = []

        def follow() -> None:
            """Follow the motors until a person has answered, or one of them does not."""
            try:
                while not over.is_set():
                    extremes.follow(np.array([*self.positions().values()]))
                    over.wait(_LOOK)
            except Exception as error:
                failures.append(error)

        thread = threading.Thread(target=follow, name=FOLLOWER, daemon=True)
        thread.start()
        try:
            answer = waiting()
        finally:
            over.set()
            thread.join()
        for failure in failures:
            raise failure
        return answer
