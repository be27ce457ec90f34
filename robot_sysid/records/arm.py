"""The arm as its model describes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.records.arrays import Array, check_arrays
from robot_sysid.records.limits import Limits
from robot_sysid.records.messages import MeshesLeftOut


@dataclass(frozen=True)
class InertialParameters:
    """The ten inertial parameters of one rigid body: theta (10,) [m, hx, hy, hz, Ixx, Ixy, Ixz,
    Iyy, Iyz, Izz] in the body frame, inertia about the body ORIGIN; kg, kg m, kg m^2.
    """

    theta: Array

    def __post_init__(self) -> None:
        check_arrays(self, theta=(10,))

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.theta[0])

    @property
    def first_moment(self) -> Array:
        """First moment of mass h = m c (3,) [kg m]."""
        return self.theta[1:4]

    @property
    def com(self) -> Array:
        """Centre of mass (3,) in the body frame [m]."""
        return spatial.com_from_theta(self.theta)[1]

    @property
    def inertia_com(self) -> Array:
        """Rotational inertia about the centre of mass (3, 3), axes of the body frame [kg m^2]."""
        return spatial.com_from_theta(self.theta)[2]

    @property
    def principal_moments(self) -> Array:
        """Principal moments about the centre of mass (3,), ascending [kg m^2]."""
        return np.asarray(np.linalg.eigvalsh(self.inertia_com), dtype=np.float64)

    @property
    def scale(self) -> Array:
        """Typical size of each parameter (10,) of such a body [kg, kg m, kg m^2]."""
        length = spatial.characteristic_length(self.theta)
        return spatial.parameter_scale(max(self.mass, 1e-9), length)

    @property
    def is_consistent(self) -> bool:
        """Whether a rigid body with these parameters can exist."""
        return spatial.is_consistent(self.theta)


@dataclass(frozen=True)
class SubtreeBody:
    """One body of a link: the one that the link's joint moves, or one below it.

    Attributes:
        body_id: its MuJoCo id.
        name: of the body ("#7" for a nameless body with id 7).
        theta: (10,) inertial parameters in the frame of the link's FIRST body, with the inertia
            about the origin of that frame.
        welded: whether no joint lies between the body and the first one.
    """

    body_id: int
    name: str
    theta: Array
    welded: bool

    def __post_init__(self) -> None:
        check_arrays(self, theta=(10,))


KINDS = ("mass", "centre of mass", "inertia")
"""What a model states of a link, or has a placeholder for."""


@dataclass(frozen=True)
class ArmLink:
    """What one chain joint moves: a body with all that hangs on it up to the next chain joint.

    Attributes:
        body_id: MuJoCo id of the body.
        body_name: its name ("#7" for a nameless body with id 7).
        screw: (6,) twist [omega, v] of the body per unit of joint speed, in the body's frame.
        rotation, translation: (3, 3), (3,) the body's frame in that of the link before it (the
            world for the first) at the reference configuration [m].
        theta: (10,) inertial parameters in the body's frame, as the model has them; zero where a
            later chain joint moves the same body.
        reference: (10,) the same, with a body of the link's geometry for each placeholder.
        size: of the link [m], which the error of its centre of mass is a share of.
        placeholders: those of ``KINDS`` that the model does not state.
        odd: those of them of which it states a number that no link of its size has.
        bodies: what it is made of, the body ``body_id`` first; none where a later chain joint moves
            that body.
    """

    body_id: int
    body_name: str
    screw: Array
    rotation: Array
    translation: Array
    theta: Array
    reference: Array = None  # type: ignore[assignment]
    size: float = 0.0
    placeholders: tuple[str, ...] = ()
    odd: tuple[str, ...] = ()
    bodies: tuple[SubtreeBody, ...] = ()

    def __post_init__(self) -> None:
        if self.reference is None:
            object.__setattr__(self, "reference", self.theta)
        check_arrays(self, screw=(6,), rotation=(3, 3), translation=(3,))
        check_arrays(self, theta=(10,), reference=(10,))

    @property
    def has_mass(self) -> bool:
        """Whether the link has any mass or inertia, without which it makes no torque."""
        return bool(np.any(self.theta))

    @cached_property
    def bracket(self) -> Array:
        """ad(S) (6, 6) of the screw S."""
        omega, v = map(spatial.skew, self.screw.reshape(2, 3))
        return spatial.lower_triangular(omega, v)

    @cached_property
    def step_factors(self) -> Array:
        """Factors (6, 6, 3) of 1, sin d and 1 - cos d in Ad(T^-1), which takes twists from the
        frame of the link before it to its own, turned by d about its joint.
        """
        turn = self.rotation.T
        shift = -turn @ spatial.skew(self.translation)
        at_home = spatial.lower_triangular(turn, shift)
        first = self.bracket @ at_home
        return np.stack((at_home, -first, self.bracket @ first), axis=-1)


@dataclass(frozen=True)
class Flange:
    """A frame fixed to the terminal body, in which a payload is stated.

    Attributes:
        name: of the site or body, or the numbers it was given by.
        rotation, translation: (3, 3), (3,) its axes and origin in the terminal body's frame [m].
        terminal: name of the terminal body.
        note: how it was chosen, where nobody named it.
    """

    name: str
    rotation: Array
    translation: Array
    terminal: str = "terminal body"
    note: str | None = None

    def __post_init__(self) -> None:
        check_arrays(self, rotation=(3, 3), translation=(3,))

    def to_flange(self, theta: Array) -> Array:
        """Return theta (10,) in this frame from theta in the terminal body's frame."""
        back = self.rotation.T
        return spatial.transform_theta(theta, back, -back @ self.translation)

    def from_flange(self, theta: Array) -> Array:
        """Return theta (10,) in the terminal body's frame from theta in this frame."""
        return spatial.transform_theta(theta, self.rotation, self.translation)


@dataclass(frozen=True)
class JointFriction:
    """Friction of n chain joints, tau_f = coulomb sign(qd) + viscous qd + that of shared motors.

    Attributes:
        coulomb: (n,) dry friction of each joint [N m; N for a slide].
        viscous: (n,) friction per speed of each joint [N m s/rad; N s/m for a slide].
        shared: (m, n) dry friction of m motors that turn several joints: entry [k, j] is the torque
            at joint j while motor k turns forward [N m or N], proportional to the motor's speed per
            speed of joint j. (The viscous friction of these motors belongs to MuJoCo's inverse
            dynamics.)
    """

    coulomb: Array
    viscous: Array
    shared: Array

    def __post_init__(self) -> None:
        n = np.size(self.coulomb)
        check_arrays(self, coulomb=(None,), viscous=(n,), shared=(None, n))

    def torque(self, qd: Array) -> Array:
        """Return the friction torque (N, n) [N m or N] at velocities qd (N, n) [rad/s or m/s]."""
        return self.dry(qd) + self.viscous * qd

    def dry(self, qd: Array, direction: Callable[[Array], Array] = np.sign) -> Array:
        """Return the dry friction torque (N, n), which depends on directions of motion alone.

        Args:
            qd: (N, n) velocities [rad/s or m/s].
            direction: returns the direction, -1 to 1, of each element of an array of velocities:
                their sign, or a smooth function in place of it.
        """
        # Speeds (N, m) of the shared motors, each as seen at the joint that it moves most.
        largest = np.max(np.abs(self.shared), axis=1, keepdims=True)
        motor_speed = qd @ (self.shared / largest).T
        return self.coulomb * direction(qd) + direction(motor_speed) @ self.shared

    @property
    def largest_dry(self) -> Array:
        """Largest dry friction (n,) of each joint, whichever way shared motors turn [N m or N]."""
        return self.coulomb + np.sum(np.abs(self.shared), axis=0)


@dataclass(frozen=True)
class StatedBodies:
    """Bodies as a model file states them, where an estimate has others in their place.

    Attributes:
        numbers: name of each field of the compiled model that has bodies to its values.
        links: the arm's links with them, base to terminal.
    """

    numbers: Mapping[str, Any]
    links: tuple[ArmLink, ...]


@dataclass(frozen=True, repr=False)
class RobotModel:
    """One arm as the identification sees it.

    Attributes:
        path: of the model file.
        mj_model: the compiled MuJoCo model, as the file describes it but for ``stated``.
        joint_names: the n chain joints, base to terminal ("#3" for a nameless joint with id 3).
        qpos_index, dof_index: (n,) addresses of the chain joints in qpos and qvel.
        reference_qpos: (nq,) configuration at which joints outside the chain are held.
        is_slide: (n,) whether a chain joint is a slide.
        limits, friction: of the chain joints.
        links: what each chain joint moves, base to terminal.
        sha256: hash of the files that make the model.
        kind: "mjcf" or "urdf".
        mass_scale: by which masses and moments of inertia differ from those of the file.
        mass_error: by which share all of them together may be off, where the user says so.
        gravity: (3,) in place of that of the file [m/s^2]; None for the file's.
        stated_speeds: (n,) speed limits that the file states [rad/s or m/s], infinite where it
            states none; the limits above may be the user's. None for none.
        stated: the bodies that the file states, where the user's factor or a link's geometry makes
            others of them; None where those above are the file's.
        lacks_masses: whether bodies of the links' geometry stand for all of its links.
        notes: what the reader of the file had to assume, one sentence each.
    """

    path: Path
    mj_model: Any
    joint_names: tuple[str, ...]
    qpos_index: NDArray[np.int64]
    dof_index: NDArray[np.int64]
    reference_qpos: Array
    is_slide: NDArray[np.bool_]
    limits: Limits
    friction: JointFriction
    links: tuple[ArmLink, ...]
    sha256: str = ""
    kind: str = "mjcf"
    mass_scale: float = 1.0
    mass_error: float = 0.0
    gravity: Array | None = None
    stated_speeds: Array | None = None
    stated: StatedBodies | None = None
    lacks_masses: bool = False
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        joints = ", ".join(self.joint_names)
        return f"<RobotModel {self.path.name}: {joints} carry {self.body_name}>"

    def without_model(self, load: Callable[[], RobotModel]) -> RobotModel:
        """Return the arm without its compiled model, whose meshes may be larger than all else.

        ``load`` returns the arm with it, and is called where the model is asked for first. It can
        be pickled.
        """
        arm = copy(self)
        fields = vars(arm)
        del fields["mj_model"]
        fields["_load"] = load
        return arm

    def __getattr__(self, name: str) -> Any:
        """Return the compiled model of an arm ``without_model``; called for what is missing."""
        load = vars(self).get("_load")
        if name != "mj_model" or load is None:
            raise AttributeError(f"RobotModel has no attribute {name!r}")
        model = load().mj_model
        object.__setattr__(self, name, model)
        return model

    @property
    def body_name(self) -> str:
        """Name of the terminal body."""
        return self.links[-1].body_name

    @property
    def body_id(self) -> int:
        """MuJoCo id of the terminal body."""
        return self.links[-1].body_id

    @property
    def bodies(self) -> tuple[SubtreeBody, ...]:
        """What the terminal link is made of, the terminal body first."""
        return self.links[-1].bodies

    @property
    def prior(self) -> InertialParameters:
        """The terminal link, the terminal body and all below it, as the model has it."""
        return InertialParameters(self.links[-1].theta)

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return len(self.joint_names)

    @property
    def thetas(self) -> Array:
        """Inertial parameters (n, 10) of its links, each in its own frame; a new array."""
        return np.array([link.theta for link in self.links])

    @property
    def mass(self) -> float:
        """Mass of its links together [kg]."""
        return float(np.sum(self.thetas[:, 0]))

    @property
    def length(self) -> float:
        """Distances from the world to the first link and on to the last one, added up [m]."""
        return self.reach + float(np.linalg.norm(self.links[0].translation))

    @property
    def reach(self) -> float:
        """Distances from its first joint to the next one and on to the last one, added up [m]."""
        return sum(float(np.linalg.norm(link.translation)) for link in self.links[1:])

    @property
    def armature(self) -> Array:
        """Rotor inertia (n,) of its joints, as the model has it [kg m^2, of a slide kg]."""
        return np.array(self.mj_model.dof_armature[self.dof_index])

    @property
    def lacks_meshes(self) -> bool:
        """Whether collision meshes of its file were left out: MuJoCo alone does not load that file,
        nor a URDF that is written from it.
        """
        return any(isinstance(note, MeshesLeftOut) for note in self.notes)

    @property
    def terminal_joint(self) -> str:
        """Name of the last chain joint."""
        return self.joint_names[-1]

    @property
    def slides(self) -> tuple[str, ...]:
        """Names of the chain joints that are slides."""
        return tuple(self.joint_names[j] for j in np.flatnonzero(self.is_slide))

    @property
    def reference(self) -> Array:
        """Chain joint positions (n,) at the reference configuration."""
        return self.reference_qpos[self.qpos_index]
