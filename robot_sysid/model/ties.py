"""Joints of an arm that its model ties to each other, which no chain of free joints is.

A parallelogram lets one motor turn two joints: the forearm keeps its direction while the upper arm
turns. Models state it as an equality of joints or fixed tendons, as a URDF's ``mimic``, or as rods
whose ends are connected. The arm then has fewer coordinates than joints, a motor bears more than
the links behind its joint, and what is read at a tied joint is whatever the log's writer put there.
So such an arm is refused; ties beside the chain, of a gripper's fingers, say nothing of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from robot_sysid.dynamics.inverse_dynamics import subtree
from robot_sysid.errors import ModelError
from robot_sysid.model.actuators import tendon_coefficients
from robot_sysid.model.chain import is_hinge_or_slide, joint_label

_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_OF_BODIES = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
# Places of the polynomial by which a joint or tendon follows another one, its constant left out.
_FOLLOWS = slice(1, 5)


def refuse_tied_joints(
    mj_model: Any, chain: Sequence[int], mimics: Mapping[str, str]
) -> None:
    """Raise ModelError where joints of a chain (ids) are tied to each other.

    ``mimics``: name of a joint of a URDF to that of the joint it follows.
    """
    names = {joint: joint_label(mj_model, joint) for joint in chain}
    labels = set(names.values())
    of_file = [[one, other] for one, other in mimics.items()]
    found = [pair for pair in of_file if labels.issuperset(pair)]
    for joints in _tied_by_numbers(mj_model):
        tied = [names[joint] for joint in joints if joint in names]
        found += [tied] if len(tied) > 1 else []
    if found:
        raise ModelError(
            f"joints {' and '.join(found[0])} are tied to each other in the model (an equality, "
            "or mimic), as by a parallelogram: they are one coordinate with one motor, and only "
            "joints that move by themselves can be identified. If each of them has a motor of its "
            "own, and a torque of its own in the log, remove the tie from the model"
        )
    crossed = [names[joint] for joint in _joints_in_loop(mj_model, chain)]
    if crossed:
        raise ModelError(
            f"a loop of bodies that the model connects is closed over {', '.join(crossed)}, as by "
            "the rods of a parallelogram: their torque also moves the rods, or comes through them, "
            "and only joints that move by themselves can be identified. If each has a motor of its "
            "own, and the rods weigh little, remove the <connect> or <weld> from the model"
        )


def _tied_by_numbers(mj_model: Any) -> Iterator[set[int]]:
    """Yield the joints (ids) of each equality of joints or fixed tendons that acts."""
    for row in np.flatnonzero(mj_model.eq_active0).tolist():
        kind = int(mj_model.eq_type[row])
        owners = [int(mj_model.eq_obj1id[row]), int(mj_model.eq_obj2id[row])]
        if not np.any(mj_model.eq_data[row, _FOLLOWS]):
            owners[1] = -1  # It holds the first one where it is.
        owners = [owner for owner in owners if owner >= 0]
        if kind == _JOINT:
            yield set(owners)
        elif kind == _TENDON:
            speeds = [tendon_coefficients(mj_model, tendon) for tendon in owners]
            turned = np.flatnonzero(np.any(speeds, axis=0))
            yield set(mj_model.dof_jntid[turned].tolist())


def _joints_in_loop(mj_model: Any, chain: Sequence[int]) -> list[int]:
    """Return the joints of a chain (ids) over which rods close a loop; none where none do.

    Rods are bodies on hinges or slides of their own, beside the chain.
    """
    beyond = [set(subtree(mj_model, mj_model.jnt_bodyid[joint])) for joint in chain]
    for row in np.flatnonzero(mj_model.eq_active0).tolist():
        if int(mj_model.eq_type[row]) not in _OF_BODIES:
            continue
        ends = [int(mj_model.eq_obj1id[row]), int(mj_model.eq_obj2id[row])]
        ends = [_body_of(mj_model, row, end) for end in ends]
        has_rod = any(_is_on_rod(mj_model, body, chain) for body in ends)
        is_beyond = [[body in bodies for body in ends] for bodies in beyond]
        crossed = [j for j, (one, other) in zip(chain, is_beyond) if one != other]
        if crossed and has_rod:
            return crossed
    return []


def _body_of(mj_model: Any, row: int, end: int) -> int:
    """Return the body (id) of an end of an equality, which may be one of its sites."""
    kinds = getattr(mj_model, "eq_objtype", None)
    site = int(mujoco.mjtObj.mjOBJ_SITE)
    is_site = kinds is not None and int(kinds[row]) == site
    return int(mj_model.site_bodyid[end]) if is_site else end


def _is_on_rod(mj_model: Any, body: int, chain: Sequence[int]) -> bool:
    """Return whether a hinge or slide beside a chain (joint ids) carries a body (id)."""
    while body > 0:
        first = int(mj_model.body_jntadr[body])
        for joint in range(first, first + int(mj_model.body_jntnum[body])):
            if joint not in chain and is_hinge_or_slide(mj_model, joint):
                return True
        body = int(mj_model.body_parentid[body])
    return False
