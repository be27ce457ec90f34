"""What a written model has that the user's file has not, and which body gets which part of a link.

The terminal body gets what was identified of the link minus the bodies below it that the file
describes. Where that is no possible body, it gets the whole rigidly attached group instead, and
where bodies on joints of their own leave too little even for that, those are made lighter.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Array, SubtreeBody

NOTHING = 1e-6
SLACK = 1e-10
MARGIN = 1e-11
"""Mass, relative to the link's, below which a difference is only rounding; how far, relative to its
size, a body may be from possible before it is refused; how far inside the possible it is written,
some 4e4 roundings, because MuJoCo refuses what these put outside."""
_MOMENTS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


@dataclass(frozen=True)
class WriteBack:
    """What to write into the model.

    Attributes:
        theta: (10,) inertial parameters of the terminal body alone, in its own frame.
        lumped: the bodies whose inertia went into the terminal body and which weigh nothing now.
        inflated: by how much all moments of inertia are larger than identified [kg m^2].
        scaled, scale: the bodies on joints of their own of which only that part is left.
    """

    theta: Array
    lumped: tuple[SubtreeBody, ...] = ()
    note: str | None = None
    inflated: float = 0.0
    scaled: tuple[SubtreeBody, ...] = ()
    scale: float = 1.0

    def written(self, composite: Array) -> Array:
        """Return what an identified composite (10,) is in the written model."""
        return composite + self.inflated * _MOMENTS


def plan_write_back(
    composite: Array,
    bodies: Sequence[SubtreeBody],
    least_moment: float = 0.0,
    most_inflated: float = 0.0,
) -> WriteBack:
    """Share an identified composite among the bodies of the terminal link, or raise ExportError
    where it is no possible body itself, or nothing of the bodies on joints has room in it.

    Args:
        composite: (10,) of the terminal body and all below it, in the terminal body's frame.
        bodies: those bodies as the model describes them, the terminal body first.
        least_moment: smallest principal moment the file's compiler leaves alone [kg m^2].
        most_inflated: by how much all three moments may be inflated, because they are not known any
            better [kg m^2].
    """
    top = bodies[0]
    mass = float(composite[0])
    tolerance = (least_moment, most_inflated)
    lumped: tuple[SubtreeBody, ...] = ()
    scaled = lumped
    scale = 1.0
    beside = _sum(bodies[1:])
    if possible_body(composite - beside, mass, *tolerance) is None:
        below = [body for body in bodies[1:] if np.any(body.theta)]
        lumped = tuple(body for body in below if body.welded)
        hanging = tuple(body for body in below if not body.welded)
        beside = _sum(hanging)
        if possible_body(composite - beside, mass, *tolerance) is None:
            scale = _largest_scale(composite, beside)
            scaled = hanging
    rest = composite - scale * beside
    own = possible_body(rest, mass, *tolerance)
    if own is None or scale < NOTHING:
        fault = f"the identified parameters of body '{top.name}' are not a possible rigid body"
        raise ExportError(f"{fault}, so no model was written; use a longer motion")
    plan = WriteBack(own, lumped, None, float(own[4] - rest[4]), scaled, scale)
    return replace(plan, note="; ".join(_notes(top, plan)) or None)


def _sum(bodies: Sequence[SubtreeBody]) -> Array:
    return np.sum([np.zeros(10), *(body.theta for body in bodies)], axis=0)


def _largest_scale(composite: Array, hanging: Array) -> float:
    """Return the largest part, below 1, of bodies that leaves a possible rest; 0 for none."""
    # Possible bodies are a convex set: what leaves one is an interval that begins at nothing.
    low = 0.0
    high = 1.0
    for _ in range(60):  # down to the last digit
        middle = (low + high) / 2.0
        leaves_a_body = (
            possible_body(composite - middle * hanging, float(composite[0])) is not None
        )
        low, high = (middle, high) if leaves_a_body else (low, middle)
    return low


def _notes(above: SubtreeBody, plan: WriteBack) -> Iterator[str]:
    both = plan.lumped, plan.scaled
    emptied, lighter = (", ".join(f"'{b.name}'" for b in bodies) for bodies in both)
    if plan.lumped:
        yield (
            f"body '{above.name}' now holds the inertia of all that is rigidly attached to it; "
            f"{emptied} weigh nothing in the written model"
        )
    if plan.scaled:
        yield (
            f"{lighter} on joints of their own below body '{above.name}' left no possible body "
            "of what was identified of all of them, so their mass and inertia are "
            f"{plan.scale:.4g} of the model's in the written model"
        )
    moments = np.linalg.eigvalsh(spatial.com_from_theta(plan.theta)[2])
    if plan.inflated > SLACK * float(np.sum(moments)):  # by more than rounding
        yield (
            "the model file cannot hold moments of inertia as small as identified (its compiler "
            "settings, or what other bodies hold already), so all three are written "
            f"{plan.inflated:.2g} kg m^2 larger; that is less than their standard errors"
        )


def possible_body(
    theta: Array, scale: float, least_moment: float = 0.0, most_inflated: float = 0.0
) -> Array | None:
    """Return theta (10,), a difference of two bodies, moved inside the possible where rounding left
    it on the edge, or None. Beside ``scale``, the mass of the larger one [kg], what is tiny is
    nothing; the others as in ``plan_write_back``.
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
    if most_inflated >= least_moment - float(moments[0]):
        inflated = max(inflated, least_moment - float(moments[0]))
    if inflated > max(2.0 * (SLACK + MARGIN) * size, most_inflated):
        return None
    return spatial.theta_from_com(mass, com, inertia + inflated * np.eye(3))


@dataclass(frozen=True)
class BodyChange:
    """New inertia for a body, called "#7" where it has no name, and more words for its comment."""

    label: str
    body_id: int
    plan: WriteBack
    addition: str | None = None


@dataclass(frozen=True)
class JointChange:
    """New numbers for a joint; None leaves what the file says.

    Attributes:
        label: the joint's name, or "#3" for the nameless joint with id 3.
        armature: rotor inertia seen at the joint [kg m^2 or kg]; a URDF cannot hold it.
        damping, frictionloss: viscous and Coulomb friction [N m s/rad, N m or N s/m, N].
        polynomial: damping beyond the linear one, of qd abs(qd) and of qd^3; MuJoCo 3.7 and later.
    """

    label: str
    armature: float | None = None
    damping: float | None = None
    frictionloss: float | None = None
    polynomial: tuple[float, float] | None = None
    words: str = ""

    @property
    def numbers(self) -> dict[str, float]:
        """What is to be written, by its name in MJCF."""
        values = {
            name: getattr(self, name)
            for name in ("armature", "damping", "frictionloss")
        }
        return {
            name: float(value) for name, value in values.items() if value is not None
        }


@dataclass(frozen=True)
class TendonChange:
    """A motor that turns several joints, as a fixed tendon over them.

    Attributes:
        tendon: its MuJoCo id, or that which a new one gets; ``is_new`` tells which.
        coefficients: joint to speed of the tendon per speed of that joint.
        numbers: new ones, by their name in MJCF: "armature", "damping", "frictionloss".
    """

    tendon: int
    is_new: bool
    coefficients: Mapping[str, float]
    numbers: Mapping[str, float]
    words: str = ""


@dataclass(frozen=True)
class ActuatorChange:
    """New gains for a position actuator, by its MuJoCo id."""

    actuator: int
    stiffness: float
    damping: float


@dataclass(frozen=True)
class WeldedBody:
    """A body of its own, fixed to one of the file's.

    Its frame in the carrier's, (3, 3) and (3,) [m], and theta (10,) in its own frame.
    """

    name: str
    carrier: str
    rotation: Array
    translation: Array
    theta: Array
    words: str = ""


@dataclass(frozen=True)
class ModelChange:
    """All that is written into a model; the residual [N m] is for the comments, gravity [m/s^2] in
    the world frame, and ``principal`` as in ``inertial.mjcf_inertial``.
    """

    bodies: tuple[BodyChange, ...]
    rmse: float
    joints: tuple[JointChange, ...] = ()
    welded: WeldedBody | None = None
    actuators: tuple[ActuatorChange, ...] = ()
    tendons: tuple[TendonChange, ...] = ()
    gravity: tuple[float, float, float] | None = None
    principal: bool = False
