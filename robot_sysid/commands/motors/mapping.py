"""``robot-sysid motors map`` and ``motors play --verify``: each joint's motor and direction.

For a map the arm is limp. A person moves one joint after the other in the model's positive
direction; the motor that turned drives it. Then the arm is put into a pose that the model has.

Verification moves the joints whose direction gravity does not show a little, one by one, and asks a
person which way each turned. The answers are kept in the joint map, and not asked for again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robot_sysid.commands.motors.next_steps import play_step
from robot_sysid.commands.motors.session import Session, ask, confirm
from robot_sysid.damiao import protocol
from robot_sysid.damiao.bus import GuardedLink, RegisterClient, inspect_bus
from robot_sysid.damiao.joints import BY_HAND, BY_MOTION, DamiaoJoint, write_joint_map
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.preflight import require_no_stop
from robot_sysid.damiao.references import TRANSFER_RATE, transfer_rows
from robot_sysid.damiao.settings import Plan, RecordingOptions
from robot_sysid.errors import HardwareAbort, InputError
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.messages import NextStep, count_text
from robot_sysid.records.option_fields import OptionRecord, option, record_from

Positions = Mapping[protocol.Address, float]
"""Position of each motor [rad], by its address."""
_LEAST_TURN = 0.15
"""Turn from which on a motor counts as moved by hand [rad]: half of the 20 degrees asked for."""
_CLEAR_RATIO = 3.0
"""Least ratio of the largest turn of a motor to the second largest, which a limp arm may drag
along, for the first to count as the one that was moved (a judgement)."""
_ATTEMPTS = 3
"""Number of times that a person is asked to move the same joint."""
_ENTER = "; then press Enter: "
"""End of a request to a person."""
_PROBE_TURN = 0.3
"""Turn of a joint by which its effect on the tip is judged [rad]."""
_VISIBLE_SHIFT = 0.02
"""Movement of the tip from which on a person sees it [m]."""
_DIRECTIONS = ("-x", "+x"), ("-y", "+y"), ("-z (down)", "+z (up)")
"""Names of the negative and the positive direction of each axis of the world."""
_NUDGE = 0.1
"""Movement of a joint for verification [rad]: enough to be seen, little enough the wrong way."""
_PACE = (0.2, 2.0)
"""Largest speed of the movement for verification [rad/s], and least time for it each way [s].

A movement of ``_NUDGE`` takes this least time, because it never reaches the largest speed.
"""
# Consequence of a check that forbids the movement for verification.
_NO_ROOM = (
    "not moved (where there is no room for 0.1 rad either way, "
    "bring the arm elsewhere by hand)"
)


@dataclass(frozen=True)
class MapOptions(OptionRecord):
    """File that ``motors map`` writes."""

    output: Path = option(Path("joint_map.csv"), "where to write the map", "FILE")


@dataclass(frozen=True)
class DirectionChoices(OptionRecord):
    """Whether ``motors play`` verifies the joints' directions instead of playing."""

    verify: bool = option(
        False,
        "instead of the trajectory, move each joint that gravity hardly loads by 0.1 rad, ask "
        "which way it went, and keep that in the joint map",
    )


def movement_texts(
    robot: RobotModel, q: Array | None = None, signs: Array | float = 1.0
) -> list[str]:
    """Return for each of n joints a sentence on what a person sees when that joint alone turns.

    The sentence has the main direction in which the tip of the arm moves, or, where the tip hardly
    moves, the direction from which the joint is seen to turn counter-clockwise.

    Args:
        robot: model of the arm.
        q: positions (n,) before the movement [rad or m]; None for the model's reference.
        signs: direction in which the joints turn, one (n,) per joint or one for all: 1 for the
            model's positive one, -1 for the opposite one.
    """
    # Imported here so that setting up and monitoring do not wait for MuJoCo.
    from robot_sysid.simulation.plant import ArmStepper

    positions = robot.reference if q is None else q
    arm = ArmStepper(robot, positions)
    turns = _PROBE_TURN * (np.zeros(robot.n_joints) + signs)
    texts = []
    # Row j of the diagonal matrix turns joint j alone.
    for joint, turn in enumerate(np.diag(turns)):
        vector = ArmStepper(robot, positions + turn).tip() - arm.tip()
        text = "the end of the arm moves towards"
        if not np.max(np.abs(vector)) > _VISIBLE_SHIFT:
            vector = np.sign(turns[joint]) * arm.axis(joint)
            text = "it turns counter-clockwise seen from"
        axis = int(np.argmax(np.abs(vector)))
        texts.append(f"{text} {_DIRECTIONS[axis][int(vector[axis] > 0.0)]}")
    return texts


def map_joints(session: Session) -> int:
    """Write the joint map that a person shows by moving the limp arm; return the exit code 0.

    InputError where the map's file exists already; other errors are those of ``map_by_hand``.
    """
    options = record_from(MapOptions, session.values)
    robot = session.robot
    if options.output.exists():
        raise InputError(f"{options.output} exists; choose another --output")
    with session.open_guarded(protocol.refuse_motion) as link:
        rows = map_by_hand(link, robot)
    write_joint_map(options.output, rows)
    step = NextStep(
        "Next, check the motors with it",
        session.command("check", joint_map=options.output),
    )
    session.conclude(f"Done: written to {options.output}", step)
    return 0


def map_by_hand(link: GuardedLink, robot: RobotModel) -> list[DamiaoJoint]:
    """Return the joint map that a person shows by moving one joint after the other.

    It has one row per joint of the robot, base to terminal, without motor types.

    Args:
        link: link of the motors' buses.
        robot: model of the arm.

    Raises:
        InputError: there are fewer motors than joints, or standard input has ended.
        HardwareAbort: a motor is enabled or does not answer, or in three attempts no single motor
            turned clearly.
    """
    client = RegisterClient(link)
    motors = inspect_bus(link).motors
    if len(motors) < robot.n_joints:
        raise InputError(
            f"motors that answer: {len(motors)}, but the model's chain has "
            f"{count_text(robot.n_joints, 'joint')}"
        )
    for motor in motors.values():
        if motor.feedback is None or motor.feedback.status[0] == protocol.ENABLED:
            raise HardwareAbort(
                f"{motor.name} is enabled or does not tell; the arm has to be limp"
            )

    def read_positions() -> Positions:
        """Return the present position of each motor [rad]; HardwareAbort where one is silent."""
        positions = {}
        for address, motor in motors.items():
            state = client.state_of(motor)
            if state is None:
                raise HardwareAbort(
                    "a motor does not answer any more; nothing was written"
                )
            positions[address] = float(state.position[0])
        return positions

    directions: dict[protocol.Address, int] = {}
    for name, movement in zip(robot.joint_names, movement_texts(robot)):
        remaining = set(motors) - set(directions)
        address, direction = _find_motor(name, movement, remaining, read_positions)
        directions[address] = direction
    pose = zip(robot.joint_names, robot.reference)
    pose_text = ", ".join(f"{name} {q:.3f}" for name, q in pose)
    ask(
        f"put the arm into the model's own pose ({pose_text} rad or m) and hold it there{_ENTER}"
    )
    positions = read_positions()
    rows = []
    # ``directions`` has the motors' addresses in the order of the joints.
    for name, q, address in zip(robot.joint_names, robot.reference, directions):
        motor = motors[address]
        direction = directions[address]
        offset = round(positions[address] - direction * float(q), 4)
        rows.append(
            DamiaoJoint(
                motor_type="",
                can_id=address.can_id,
                master_id=motor.master_id,
                name=name,
                bus=0,
                channel=motor.channel,
                direction=direction,
                offset=offset,
                verified=BY_HAND,
            )
        )
    return rows


def _find_motor(
    name: str,
    movement: str,
    addresses: Collection[protocol.Address],
    read_positions: Callable[[], Positions],
) -> tuple[protocol.Address, int]:
    """Have a person move a joint; return the address of the motor that turned, and its direction.

    The direction is 1 where the motor's position grew, else -1.

    Args:
        name: name of the joint.
        movement: positive movement of the joint in words.
        addresses: addresses of the motors that do not belong to another joint.
        read_positions: returns the present positions of all motors [rad].

    Raises:
        HardwareAbort: in ``_ATTEMPTS`` attempts no single motor turned clearly.
    """
    complaint = ""
    for _ in range(_ATTEMPTS):
        start = read_positions()
        ask(
            f"{complaint}move joint {name} alone, by 20 degrees or more, so that {movement}{_ENTER}"
        )
        end = read_positions()
        turns = {address: end[address] - start[address] for address in addresses}
        first, *others = sorted(addresses, key=lambda address: -abs(turns[address]))
        largest = abs(turns[first])
        if largest > _LEAST_TURN:
            if not others or largest > _CLEAR_RATIO * abs(turns[others[0]]):
                return first, 1 if turns[first] > 0.0 else -1
            complaint = "several motors turned; "
        else:
            complaint = "no motor turned far enough; "
    raise HardwareAbort(
        f"it cannot be told which motor drives {name}; nothing was written"
    )


def verify_directions(session: Session, link: GuardedLink, plan: Plan) -> int:
    """Move each joint whose direction is unknown, ask a person, write the joint map, return 0.

    The map becomes an option of the session. Where every direction is known, nothing is moved and
    nothing is written.

    Args:
        session: run of the command.
        link: link of the open bus.
        plan: plan of the trajectory whose joints are to be verified.

    Raises:
        InputError: there is no model, the map would replace a file, a motor does not answer, or a
            person does not confirm; nothing is written.
        HardwareAbort: a check forbids the movement, or the movement was stopped.
    """
    if session.robot is None:
        raise InputError(
            "--verify needs --model, which says where each joint should go"
        )
    path = Path(session.values.get("joint_map") or "joint_map.csv")
    # LeRobot's own files are read and never written.
    is_updated = session.values.get("joint_map") and path.suffix != ".json"
    if not is_updated:
        path = Path("joint_map.csv")
        if path.exists():
            raise InputError(f"{path} is there already; give it with --joint-map")
    holding = session.holding(plan)
    unverified: Sequence[DamiaoJoint] = ()
    if holding is not None:
        unverified = holding.unverified_joints(plan.trajectory.q[0])
    if not unverified:
        session.conclude(
            "Done: gravity shows which way each joint turns, or somebody has verified it",
            play_step(session, plan),
        )
        return 0
    movements = _nudge_joints(session, link, plan, unverified)
    for joint, movement in zip(unverified, movements):
        if not confirm(
            f"Did {joint.label}, and no other joint, turn so that {movement}, and back?"
        ):
            raise InputError(
                f"{joint.label} is not verified and nothing was written; a motor turns the other "
                "way than its joint, or sits at another one: motors map finds it"
            )
    # Rows of a joint map may lack what the trajectory's joints have; id and name identify them.
    addresses = {joint.address for joint in unverified}
    verified_ids = set()
    for joint in plan.trajectory.joints:
        if joint.address in addresses:
            verified_ids.add((joint.can_id, joint.name))
    rows = []
    for row in session.rows or plan.trajectory.joints:
        is_verified = (row.can_id, row.name) in verified_ids
        rows.append(replace(row, verified=BY_MOTION) if is_verified else row)
    write_joint_map(path, rows)
    session.values = {**session.values, "joint_map": path}
    session.conclude(
        f"Done: kept in {path}, and all motors are disabled", play_step(session, plan)
    )
    return 0


def _nudge_joints(
    session: Session, link: GuardedLink, plan: Plan, unverified: Sequence[DamiaoJoint]
) -> list[str]:
    """Move joints by ``_NUDGE`` and back, one by one; return what a person should see of each.

    Each joint moves into the direction with more room within the model's range. The opposite
    direction is checked too, because a joint of unknown direction may turn that way.

    Args:
        session: run of the command, which has a model.
        link: link of the open bus.
        plan: plan of the trajectory, whose settings are used.
        unverified: joints of the trajectory that are moved.

    Returns:
        A sentence per joint of ``unverified`` on its movement, as of ``movement_texts``.

    Raises:
        InputError: a motor of the trajectory does not answer, or a person does not confirm.
        HardwareAbort: a check forbids the movement, or the movement was stopped.
    """
    inspection = inspect_bus(link)
    console = session.console
    q = plan.joint_positions(inspection)
    for joint, position in zip(plan.trajectory.joints, q):
        if not np.isfinite(position):
            raise InputError(f"{joint.label} does not answer; motors check says more")
    indices = [plan.trajectory.joints.index(joint) for joint in unverified]
    limits = session.robot.limits
    signs = np.where(limits.upper - q < q - limits.lower, -1.0, 1.0)
    texts = movement_texts(session.robot, q, signs)
    movements = [texts[index] for index in indices]
    nudges = _nudge_plan(session, plan, q, indices, signs)
    opposite_nudges = _nudge_plan(session, plan, q, indices, -signs)
    for nudge_plan in (nudges, opposite_nudges):
        checks = session.checks(nudge_plan)
        # Real motors, but their directions, which are to be found out, cannot be checked.
        checks += session.inspection_checks(nudge_plan, inspection, real=False)
        require_no_stop(checks, _NO_ROOM)
    for joint, movement in zip(unverified, movements):
        console.stage(f"{joint.label} is to turn so that {movement}, and back")
    if not confirm("They move one after the other, by 0.1 rad. Keep clear, and watch."):
        raise InputError("not confirmed; nothing was moved")
    waiting = list(unverified)
    _, one_way_time = _PACE
    there_and_back_time = 2.0 * one_way_time

    def announce_joint(time: float) -> None:
        """Print the next joint's name when it begins to move, at ``time`` in the movement [s]."""
        n_announced = len(unverified) - len(waiting)
        if waiting and time >= there_and_back_time * n_announced:
            console.stage(f"now {waiting.pop(0).label}")

    stop = StopRequest()
    # The arm may have moved while the person was asked.
    inspection = inspect_bus(link)
    session.play(link, nudges, inspection, stop, console.stage, announce_joint)
    return movements


def _nudge_plan(
    session: Session, plan: Plan, q: Array, indices: Sequence[int], signs: Array
) -> Plan:
    """Return a plan that moves joints by ``_NUDGE`` and back, one after the other.

    Its feed-forward torques hold the arm in each pose, and it records nothing. It parks the arm as
    the given plan does, but never in the pose of a file.

    Args:
        session: run that has a model.
        plan: plan of the trajectory, whose settings are used.
        q: positions (n,) where the arm stands [rad or m].
        indices: indices of the joints to move, in this order.
        signs: direction (n,) of each joint's movement: 1 or -1.
    """
    holding = session.holding(plan)
    assert holding is not None
    positions = []
    velocities = []
    for index in indices:
        target = q.copy()
        target[index] += _NUDGE * signs[index]
        for begin, end in ((q, target), (target, q)):
            rows = transfer_rows(plan.trajectory, begin, end, _PACE)
            # The first row is where the arm stands already.
            positions.append(rows.q[1:])
            velocities.append(rows.qd[1:])
    q_rows = np.vstack(positions)
    time = (1.0 + np.arange(len(q_rows), dtype=float)) / TRANSFER_RATE
    trajectory = replace(
        plan.trajectory,
        has_two_arms=False,
        line=np.arange(len(q_rows)),
        time=time,
        q=q_rows,
        qd=np.vstack(velocities),
        tau=np.array([holding.torque(row) for row in q_rows]),
    )
    # A joint of unknown direction must not be moved to a parking pose.
    park = plan.settings.park if plan.parking_pose is None else "rest"
    settings = replace(plan.settings, speed=1.0, park=park)
    return replace(
        plan, trajectory=trajectory, settings=settings, recording=RecordingOptions()
    )
