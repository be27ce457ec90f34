"""``motors play --verify``: joints whose direction gravity does not show move a little, one by one.

A person sees which way each turned. What was seen is kept in the joint map, so that a set-up is
asked once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.commands.motors.asked import Asked, said_yes
from robot_sysid.commands.motors.setup import positive_ways
from robot_sysid.damiao.bus import GuardedLink, inspect_bus
from robot_sysid.damiao.joints import BY_MOTION, DamiaoJoint, write_joint_map
from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.preflight import require_no_stop
from robot_sysid.damiao.references import TRANSFER_RATE, transfer_rows
from robot_sysid.damiao.settings import Plan, RecordingOptions
from robot_sysid.errors import InputError
from robot_sysid.records import Array
from robot_sysid.records.option_fields import OptionRecord, option


@dataclass(frozen=True)
class DirectionChoices(OptionRecord):
    """How ``motors play`` finds out which way joints turn."""

    verify: bool = option(
        False,
        "instead of the trajectory, move each joint that gravity hardly loads by 0.1 rad, ask "
        "which way it went, and keep that in the joint map",
    )


# How far a joint moves [rad], at most how fast [rad/s] and at least how long each way [s]: enough
# to be seen, little enough for the wrong way.
_NUDGE = 0.1
_PACE = (0.2, 2.0)

_NO_ROOM = (
    "not moved (where there is no room for 0.1 rad either way, "
    "bring the arm elsewhere by hand)"
)


def verify(asked: Asked, link: GuardedLink, plan: Plan) -> int:
    """Let each joint of a plan that nothing shows the direction of move, ask, and keep the answers.

    InputError where no model is known, or where a joint did not go the way that was said; then
    nothing is written. HardwareAbort as for any run.
    """
    if asked.robot is None:
        raise InputError(
            "--verify needs --model, which says where each joint should go"
        )
    path = Path(asked.values.get("joint_map") or "joint_map.csv")
    # LeRobot's own files are read and never written.
    kept = asked.values.get("joint_map") and path.suffix != ".json"
    path = path if kept else Path("joint_map.csv")
    if not kept and path.exists():
        raise InputError(f"{path} is there already; give it with --joint-map")
    holding = asked.holding(plan)
    unseen = [] if holding is None else holding.unverified_joints(plan.trajectory.q[0])
    if not unseen:
        shown = "gravity shows which way each joint turns, or somebody has verified it"
        asked.conclude(f"Done: {shown}", asked.play_words())
        return 0
    ways = _move_a_little(asked, link, plan, unseen)
    for joint, way in zip(unseen, ways):
        if not said_yes(
            f"Did {joint.label}, and no other joint, turn so that {way}, and back?"
        ):
            raise InputError(
                f"{joint.label} is not verified and nothing was written; a motor turns the other "
                "way than its joint, or sits at another one: see robot-sysid motors map"
            )
    seen = {joint.address for joint in unseen}
    rows = asked.rows or plan.trajectory.joints
    met = {
        (joint.can_id, joint.name)
        for joint in plan.trajectory.joints
        if joint.address in seen
    }
    write_joint_map(
        path,
        [
            replace(r, verified=BY_MOTION) if (r.can_id, r.name) in met else r
            for r in rows
        ],
    )
    asked.values = {**asked.values, "joint_map": path}
    asked.conclude(
        f"Done: kept in {path}, and all motors are disabled", asked.play_words()
    )
    return 0


def _move_a_little(
    asked: Asked, link: GuardedLink, plan: Plan, unseen: Sequence[DamiaoJoint]
) -> list[str]:
    """Move joints one after the other; return which way each should have gone, in words."""
    inspection = inspect_bus(link)
    console = asked.console
    here = plan.joint_positions(inspection)
    for j in np.flatnonzero(~np.isfinite(here)).tolist():
        joint = plan.trajectory.joints[j]
        raise InputError(f"{joint.label} does not answer; see robot-sysid motors check")
    numbers = [plan.trajectory.joints.index(joint) for joint in unseen]
    room = asked.robot.limits
    signs = np.where(room.upper - here < here - room.lower, -1.0, 1.0)
    ways = positive_ways(asked.robot, here, signs)
    little, mirrored = (
        _small_motion(asked, plan, here, numbers, s) for s in (signs, -signs)
    )
    for each in (little, mirrored):
        checks = [
            *asked.checks(each),
            *asked.inspection_checks(each, inspection, False),
        ]
        require_no_stop(checks, _NO_ROOM)
    for joint, j in zip(unseen, numbers):
        console.stage(f"{joint.label} is to turn so that {ways[j]}, and back")
    if not said_yes(
        "They move one after the other, by 0.1 rad. Keep clear, and watch."
    ):
        raise InputError("not confirmed; nothing was moved")
    stop = StopRequest()
    waiting = list(unseen)

    def tell(time: float) -> None:
        if waiting and time >= 2.0 * _PACE[1] * (len(unseen) - len(waiting)):
            console.stage(f"now {waiting.pop(0).label}")

    asked.play(link, little, inspect_bus(link), stop, console.stage, tell)
    return [ways[j] for j in numbers]


def _small_motion(
    asked: Asked, plan: Plan, here: Array, numbers: Sequence[int], signs: Array
) -> Plan:
    """Return the motion of some joints, one after the other, from where they stand (n,) [rad]."""
    holding = asked.holding(plan)
    played = plan.trajectory
    assert holding is not None
    pokes = here + np.diag(_NUDGE * signs)[list(numbers)]
    ends = (pair for poke in pokes for pair in ((here, poke), (poke, here)))
    ways = [transfer_rows(played, begin, end, _PACE) for begin, end in ends]
    q, qd = (
        np.vstack([getattr(way, name)[1:] for way in ways]) for name in ("q", "qd")
    )
    tau = np.array([holding.torque(row) for row in q])
    time = (1.0 + np.arange(len(q))) / TRANSFER_RATE
    rows: Any = {"line": np.arange(len(q)), "time": time, "q": q, "qd": qd, "tau": tau}
    # No joint of which nobody knows which way it turns goes to a pose.
    park = plan.settings.park if plan.parking_pose is None else "rest"
    settings = replace(plan.settings, speed=1.0, park=park)
    small = replace(played, has_two_arms=False, **rows)
    return replace(
        plan, trajectory=small, settings=settings, recording=RecordingOptions()
    )
