"""Which body of the model gets which part of the identified terminal link.

What was identified is the composite: the terminal body and all below it. The file keeps every body
of it, so the terminal body gets the composite minus the bodies the file already describes. Where
that difference is no possible body, it gets the whole rigidly attached group instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Array, SubtreeBody

NOTHING = 1e-6
"""Mass, relative to the composite, below which a difference is only rounding."""
SLACK = 1e-10
"""How far, relative to its size, a body may be from possible before it is refused."""
MARGIN = 1e-11
"""How far inside the possible a body is written: MuJoCo refuses what rounding puts outside."""


@dataclass(frozen=True)
class WriteBack:
    """What to write into the model.

    Attributes:
        theta: (10,) inertial parameters of the terminal body alone, in its own frame.
        folded: the bodies whose inertia went into the terminal body and which weigh nothing now.
        note: one sentence on that, or None.
    """

    theta: Array
    folded: tuple[SubtreeBody, ...] = ()
    note: str | None = None


def plan_write_back(composite: Array, bodies: Sequence[SubtreeBody]) -> WriteBack:
    """Share an identified composite among the bodies of the terminal link.

    Args:
        composite: (10,) identified parameters of the terminal body and all below it, in the
            terminal body's frame.
        bodies: those bodies as the model describes them, the terminal body first.

    Raises:
        ExportError: neither the terminal body nor the rigid group can take the rest.
    """
    terminal, others = bodies[0], bodies[1:]
    alone = possible_body(composite - _sum(others), float(composite[0]))
    if alone is not None:
        return WriteBack(alone)
    folded = tuple(body for body in others if body.welded and np.any(body.theta))
    hanging = [body for body in others if not body.welded]
    group = possible_body(composite - _sum(hanging), float(composite[0])) if folded else None
    if group is None:
        raise ExportError(_refusal(composite, terminal, others))
    names = ", ".join(f"'{body.name}'" for body in folded)
    note = (
        f"body '{terminal.name}' now holds the inertia of all that is rigidly attached to it; "
        f"{names} weigh nothing in the written model"
    )
    return WriteBack(group, folded, note)


def possible_body(theta: Array, scale: float) -> Array | None:
    """Return theta, moved inside the possible where rounding left it on the edge, or None.

    Args:
        theta: (10,) a difference of two bodies.
        scale: mass of the larger of them [kg]; what is tiny beside it is nothing.
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    size = float(np.trace(inertia)) / 2.0
    if not np.all(np.isfinite(theta)) or mass <= NOTHING * scale or size <= 0.0:
        return None
    # Second moments about the centre of mass: a body is possible when they are not negative.
    smallest = 1.0 - float(np.linalg.eigvalsh(inertia)[-1]) / size
    if smallest < -SLACK:
        return None
    missing = max(0.0, MARGIN - smallest) * size
    # Adding s to each second moment adds 2 s to each moment of inertia.
    return spatial.theta_from_com(mass, com, inertia + 2.0 * missing * np.eye(3))


def _sum(bodies: Sequence[SubtreeBody]) -> Array:
    return np.sum([body.theta for body in bodies], axis=0) if bodies else np.zeros(10)


def _refusal(composite: Array, terminal: SubtreeBody, others: Sequence[SubtreeBody]) -> str:
    if not others:
        return (
            f"the identified parameters of body '{terminal.name}' are not a possible rigid body, "
            "so no model was written; use --consistency enforce or a longer --duration"
        )
    names = ", ".join(f"'{body.name}'" for body in others)
    return (
        f"the identified link ({composite[0]:.4g} kg) minus the bodies below '{terminal.name}' "
        f"({names}: {_sum(others)[0]:.4g} kg) is not a possible rigid body, so no model was "
        "written; correct the inertia of those bodies in the model file"
    )
