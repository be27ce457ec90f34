"""Which motor drives which joint, and whether their ids can share one bus."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robot_sysid.damiao.protocol.frames import Address
from robot_sysid.damiao.protocol.motors import MotorSpec, motor_spec, motor_specs
from robot_sysid.errors import InputError

MASTER_ID_OFFSET = 0x10


@dataclass(frozen=True)
class DamiaoJoint:
    """Which motor drives a joint, and how it is mounted; see ``joint_space``.

    Attributes:
        motor_type: its type.
        can_id: the id it listens to.
        master_id: the id it answers on.
        name: the joint's name in the model, or "".
        bus: number of the bus it is on, from 0.
        channel: name of that bus where there are several, or "".
        direction: +1, or -1 where the motor turns the other way than the joint.
        offset: motor position where the joint is at zero [rad].
        torque_ratio: joint torque per torque that the motor believes in.
    """

    motor_type: str
    can_id: int
    master_id: int
    name: str = ""
    bus: int = 0
    channel: str = ""
    direction: int = 1
    offset: float = 0.0
    torque_ratio: float = 1.0

    @property
    def address(self) -> Address:
        """Where its motor is."""
        return Address(self.bus, self.can_id)

    @property
    def label(self) -> str:
        """How messages call it."""
        place = f" on {self.channel}" if self.channel else ""
        return f"motor {self.can_id}{place}" + (f" (joint {self.name})" if self.name else "")

    @property
    def spec(self) -> MotorSpec:
        """The type's data."""
        return motor_spec(self.motor_type)


def damiao_joints(
    motor_types: Sequence[str],
    n_joints: int,
    can_ids: Sequence[int] | None = None,
    master_ids: Sequence[int] | None = None,
    names: Sequence[str] = (),
) -> tuple[DamiaoJoint, ...]:
    """Return one checked DamiaoJoint per joint.

    Args:
        motor_types: one type name per joint, base to terminal.
        n_joints: number of joints of the chain.
        can_ids: 1 to 15 each; none counts from 1.
        master_ids: reply ids; none means CAN id + 0x10.
        names: of the joints in the model; none leaves them without. Blanks become underscores.

    Raises:
        InputError: wrong number of types or ids, unknown type, or ids that would not work
            together on one bus.
    """
    specs = motor_specs(motor_types, n_joints)
    ids = list(range(1, n_joints + 1)) if not can_ids else list(can_ids)
    replies = [i + MASTER_ID_OFFSET for i in ids] if not master_ids else list(master_ids)
    for option, values in (("--can-id", ids), ("--master-id", replies)):
        if len(values) != n_joints:
            raise InputError(
                f"{option} was given {len(values)} times but the chain has {n_joints} joints: "
                "give it once per joint or not at all"
            )
    problem = next(id_problems(ids, replies), None)
    if problem:
        raise InputError(problem)
    called = ["_".join(name.split()) for name in names] or [""] * n_joints
    return tuple(DamiaoJoint(s.name, i, m, n) for s, i, m, n in zip(specs, ids, replies, called))


def id_problems(can_ids: Sequence[int], master_ids: Sequence[int]) -> Iterator[str]:
    """Yield a sentence for each way in which these ids cannot share one bus.

    A motor compares the low eight bits of every frame's id, replies of other motors included, and
    a reply carries only the low four bits of the sender's id.
    """
    for i in can_ids:
        if not 1 <= i <= 15:
            yield f"CAN id {i} is outside 1 to 15, where replies can be told apart"
    for name, values in (("CAN", can_ids), ("master", master_ids)):
        for i in sorted({i for i in values if list(values).count(i) > 1}):
            yield f"{name} id {i:#04x} is used by more than one motor; each needs its own"
    for i, master in zip(can_ids, master_ids):
        if not 0 <= master <= 0x7FE:
            yield f"master id {master:#x} of the motor with CAN id {i} is outside 0 to 0x7fe"
        for other in can_ids:
            if other != i and master & 0xFF == other:
                yield (
                    f"replies of the motor with CAN id {i} (master id {master:#x}) would be taken "
                    f"as commands by the motor with CAN id {other}; use {i + MASTER_ID_OFFSET:#x}"
                )
