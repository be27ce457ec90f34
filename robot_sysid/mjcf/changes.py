"""What a written model has that the user's file has not: the records that say so."""

from __future__ import annotations

from dataclasses import dataclass

from robot_sysid.mjcf.write_back import WriteBack
from robot_sysid.records import Array

JOINT_NUMBERS = ("armature", "damping", "frictionloss")
"""What may be written into a joint, by its name in MJCF."""


FAR = 1000.0
"""Where the spring rests that makes an offset [rad or m]: over a turn it changes by 0.6 %."""


@dataclass(frozen=True)
class BodyChange:
    """New inertia for a body.

    Attributes:
        label: the body's name, or "#7" for the nameless body with id 7.
        body_id: its MuJoCo id.
        plan: what it and the bodies welded to it get.
        addition: words for the comment before it, beside those of the plan.
    """

    label: str
    body_id: int
    plan: WriteBack
    addition: str | None = None

    @property
    def comment(self) -> str | None:
        """What the comment says beside the body's name and the residual."""
        return "; ".join(part for part in (self.addition, self.plan.note) if part) or None


@dataclass(frozen=True)
class JointChange:
    """New numbers for a joint; None leaves what the file says.

    Attributes:
        label: the joint's name, or "#3" for the nameless joint with id 3.
        armature: rotor inertia seen at the joint [kg m^2 or kg]; a URDF cannot hold it.
        damping: viscous friction [N m s/rad or N s/m].
        frictionloss: Coulomb friction [N m or N].
        polynomial: damping beyond the linear one, of qd abs(qd) and of qd^3; MuJoCo 3.7 and later.
        offset: torque that motion takes in both directions [N m or N]; with Coulomb friction
            larger than it, the joint has friction that is unequal in the two directions.
        words: what a comment says of the numbers; empty for their names alone.
    """

    label: str
    armature: float | None = None
    damping: float | None = None
    frictionloss: float | None = None
    polynomial: tuple[float, float] | None = None
    offset: float | None = None
    words: str = ""

    @property
    def numbers(self) -> dict[str, float]:
        """What is to be written, by its name in MJCF."""
        values = {name: getattr(self, name) for name in JOINT_NUMBERS}
        return {name: float(value) for name, value in values.items() if value is not None}

    @property
    def spring(self) -> tuple[float, float] | None:
        """Stiffness, and where it rests [rad or m], of the spring that makes the offset."""
        if self.offset is None:
            return None
        return abs(self.offset) / FAR, -FAR if self.offset > 0.0 else FAR


@dataclass(frozen=True)
class ActuatorChange:
    """New gains for a position actuator.

    Attributes:
        actuator: its MuJoCo id, counted in the order of the file.
        stiffness: its kp.
        damping: its kv.
        delay: by which it acts late [s]; None leaves what the file says.
        samples: commands that it remembers for that, one of each time step.
    """

    actuator: int
    stiffness: float
    damping: float
    delay: float | None = None
    samples: int = 0


@dataclass(frozen=True)
class WeldedBody:
    """A body of its own, fixed to one of the file's.

    Attributes:
        name: of the new body.
        carrier: label of the body it is fixed to.
        rotation, translation: (3, 3), (3,) its frame in the carrier's [m].
        theta: (10,) in its own frame, inertia about its origin.
        words: for the comment before it.
    """

    name: str
    carrier: str
    rotation: Array
    translation: Array
    theta: Array
    words: str = ""


@dataclass(frozen=True)
class ModelChange:
    """All that is written into a model.

    Attributes:
        bodies: new inertias.
        rmse: of the identification [N m], for the comments.
        joints: new numbers of joints.
        welded: a new body, or None.
        actuators: new gains of position actuators.
    """

    bodies: tuple[BodyChange, ...]
    rmse: float
    joints: tuple[JointChange, ...] = ()
    welded: WeldedBody | None = None
    actuators: tuple[ActuatorChange, ...] = ()
