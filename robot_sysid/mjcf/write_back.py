"""Which body of the model gets which part of the identified terminal link.

What was identified is the composite: the terminal body and all below it. The file keeps every body
of it, so the terminal body gets the composite minus the bodies the file already describes. Where
that difference is no possible body, it gets the whole rigidly attached group instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Array, SubtreeBody

NOTHING = 1e-6
"""Mass, relative to the composite, below which a difference is only rounding."""
SLACK = 1e-10
"""How far, relative to its size, a body may be from possible before it is refused."""
MARGIN = 1e-11
"""How far inside the possible a body is written: MuJoCo refuses what rounding puts outside."""
_MOMENTS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


@dataclass(frozen=True)
class Tolerance:
    """What may be done to moments of inertia that a model file cannot hold as identified.

    Attributes:
        least_moment: smallest principal moment the file's compiler leaves alone [kg m^2].
        most_inflated: by how much all three moments may be inflated, because they are not known any
            better [kg m^2].
    """

    least_moment: float = 0.0
    most_inflated: float = 0.0


EXACT = Tolerance()


@dataclass(frozen=True)
class WriteBack:
    """What to write into the model.

    Attributes:
        theta: (10,) inertial parameters of the terminal body alone, in its own frame.
        lumped: the bodies whose inertia went into the terminal body and which weigh nothing now.
        note: one sentence on that, or None.
        inflated: by how much all moments of inertia are larger than identified [kg m^2].
    """

    theta: Array
    lumped: tuple[SubtreeBody, ...] = ()
    note: str | None = None
    inflated: float = 0.0

    def written(self, composite: Array) -> Array:
        """Return what an identified composite (10,) is in the written model."""
        return composite + self.inflated * _MOMENTS


def plan_write_back(
    composite: Array, bodies: Sequence[SubtreeBody], tolerance: Tolerance = EXACT
) -> WriteBack:
    """Share an identified composite among the bodies of the terminal link.

    Args:
        composite: (10,) identified parameters of the terminal body and all below it, in the
            terminal body's frame.
        bodies: those bodies as the model describes them, the terminal body first.
        tolerance: what may be done to moments that the file cannot hold.

    Raises:
        ExportError: neither the terminal body nor the rigid group can take the rest.
    """
    terminal, others = bodies[0], bodies[1:]
    mass, rest = float(composite[0]), _sum(others)
    alone = possible_body(composite - rest, mass, tolerance)
    if alone is not None:
        inflated = float(alone[4] - (composite - rest)[4])
        return WriteBack(alone, (), _inflated_note(alone, inflated), inflated)
    lumped = tuple(body for body in others if body.welded and np.any(body.theta))
    hanging = [body for body in others if not body.welded]
    rest = _sum(hanging)
    group = possible_body(composite - rest, mass, tolerance) if lumped else None
    if group is None:
        raise ExportError(_refusal(composite, terminal, others))
    names = ", ".join(f"'{body.name}'" for body in lumped)
    note = (
        f"body '{terminal.name}' now holds the inertia of all that is rigidly attached to it; "
        f"{names} weigh nothing in the written model"
    )
    inflated = float(group[4] - (composite - rest)[4])
    both = [part for part in (note, _inflated_note(group, inflated)) if part]
    return WriteBack(group, lumped, "; ".join(both), inflated)


def possible_body(theta: Array, scale: float, tolerance: Tolerance = EXACT) -> Array | None:
    """Return theta, moved inside the possible where rounding left it on the edge, or None.

    Args:
        theta: (10,) a difference of two bodies.
        scale: mass of the larger of them [kg]; what is tiny beside it is nothing.
        tolerance: what may be done to its moments.
    """
    mass, com, inertia = spatial.com_from_theta(theta)
    size = float(np.trace(inertia)) / 2.0
    if not np.all(np.isfinite(theta)) or mass <= NOTHING * scale or size <= 0.0:
        return None
    # Second moments about the centre of mass: a body is possible when they are not negative.
    moments = np.linalg.eigvalsh(inertia)
    smallest = 1.0 - float(moments[-1]) / size
    # Adding s to each second moment adds 2 s to each moment of inertia.
    inflated = 2.0 * max(0.0, MARGIN - smallest) * size
    if tolerance.most_inflated >= tolerance.least_moment - float(moments[0]):
        inflated = max(inflated, tolerance.least_moment - float(moments[0]))
    if inflated > max(2.0 * (SLACK + MARGIN) * size, tolerance.most_inflated):
        return None
    return spatial.theta_from_com(mass, com, inertia + inflated * np.eye(3))


def _inflated_note(theta: Array, inflated: float) -> str | None:
    """Return a sentence where moments of inertia were inflated by more than rounding."""
    moments = np.linalg.eigvalsh(spatial.com_from_theta(theta)[2])
    if inflated <= SLACK * float(np.sum(moments)):
        return None
    return (
        f"the model file cannot hold moments of inertia as small as identified (its compiler "
        f"settings, or what other bodies hold already), so all three are written {inflated:.2g} "
        "kg m^2 larger; that is less than their standard errors"
    )


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
