"""The frozen records that pass between stages; each checks itself once. SI units and radians.

Legend of shapes: N samples, n chain joints (base to terminal), p parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robot_sysid import spatial
from robot_sysid.errors import InputError

Array = NDArray[np.float64]


def checked_array(value: Any, shape: tuple[int | None, ...], name: str) -> Array:
    """Return a read-only float view of ``value``, or raise InputError naming what is wrong.

    Args:
        value: anything numpy can turn into a float array.
        shape: expected length per axis; None accepts any length.
        name: how the array is called in the message.
    """
    array = np.asarray(value, dtype=np.float64).view()
    fits = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape)
    )
    if not fits:
        raise InputError(f"{name} has shape {array.shape}, expected {shape} (None = any length)")
    if not np.all(np.isfinite(array)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name} is not finite at index {where}")
    array.flags.writeable = False
    return array


@dataclass(frozen=True)
class InertialParameters:
    """The ten inertial parameters of one rigid body.

    Attributes:
        theta: (10,) [m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] in the body frame, inertia about
            the body ORIGIN; kg, kg m, kg m^2.
    """

    theta: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", checked_array(self.theta, (10,), "theta"))

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.theta[0])

    @property
    def first_moment(self) -> Array:
        """First moment of mass h = m c (3,) [kg m]."""
        return self.theta[1:4]

    @property
    def inertia_origin(self) -> Array:
        """Rotational inertia about the body origin (3, 3) [kg m^2]."""
        return spatial.symmetric_from_six(self.theta[4:])

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
        return np.linalg.eigvalsh(self.inertia_com)

    @property
    def is_consistent(self) -> bool:
        """Whether a rigid body with these parameters can exist."""
        return spatial.is_consistent(self.theta)


@dataclass(frozen=True)
class SubtreeBody:
    """One body of the terminal link, the terminal body itself or one below it.

    Attributes:
        body_id: MuJoCo body id.
        name: body name ("#7" for a nameless body with id 7).
        theta: (10,) its inertial parameters in the TERMINAL body's frame, inertia about that
            frame's origin; kg, kg m, kg m^2.
        welded: whether no joint lies between it and the terminal body.
    """

    body_id: int
    name: str
    theta: Array
    welded: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", checked_array(self.theta, (10,), f"theta of {self.name}"))


@dataclass(frozen=True)
class JointLimits:
    """What each chain joint may do; infinite where there is no limit.

    Attributes:
        lower, upper: (n,) position limits [rad or m].
        velocity: (n,) speed limits [rad/s or m/s].
        torque: (n,) torque limits, symmetric [N m or N].
    """

    lower: Array
    upper: Array
    velocity: Array
    torque: Array

    def __post_init__(self) -> None:
        sizes = {np.shape(v) for v in (self.lower, self.upper, self.velocity, self.torque)}
        if len(sizes) != 1 or np.any(np.isnan(self.lower)) or np.any(np.isnan(self.upper)):
            raise InputError(f"joint limits must be numbers of one length, got shapes {sizes}")
        if np.any(self.lower >= self.upper) or np.any(self.velocity <= 0.0):
            raise InputError("joint limits are empty: need lower < upper and velocity > 0")


@dataclass(frozen=True)
class JointFriction:
    """Friction coefficients of the chain joints: tau_f = coulomb sign(qd) + viscous qd.

    Attributes:
        coulomb: (n,) [N m or N].
        viscous: (n,) [N m s/rad or N s/m].
    """

    coulomb: Array
    viscous: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "coulomb", checked_array(self.coulomb, (None,), "coulomb"))
        size = len(self.coulomb)
        object.__setattr__(self, "viscous", checked_array(self.viscous, (size,), "viscous"))

    def torque(self, qd: Array) -> Array:
        """Return the friction torque (N, n) at velocities qd (N, n)."""
        return self.coulomb * np.sign(qd) + self.viscous * qd


@dataclass(frozen=True)
class RobotModel:
    """One arm as the identification sees it.

    Attributes:
        path: the model file.
        mj_model: the compiled MuJoCo model, exactly as the file describes it.
        joint_names: the n chain joints, base to terminal ("#3" for a nameless joint with id 3).
        body_name: the terminal body ("#7" for a nameless body with id 7).
        body_id: its MuJoCo body id.
        qpos_index, dof_index: (n,) addresses of the chain joints in qpos and qvel.
        reference_qpos: (nq,) configuration at which joints outside the chain are held.
        is_slide: (n,) whether a chain joint is a slide.
        limits: what the chain joints may do.
        prior: composite terminal link (terminal body and all below it at the reference
            configuration), in the terminal body's frame.
        friction: the model's friction of the chain joints.
        sha256: hash of the files that make the model.
        notes: what the reader of the file had to assume, one sentence each.
    """

    path: Path
    mj_model: Any
    joint_names: tuple[str, ...]
    body_name: str
    body_id: int
    qpos_index: NDArray[np.int64]
    dof_index: NDArray[np.int64]
    reference_qpos: Array
    is_slide: NDArray[np.bool_]
    limits: JointLimits
    prior: InertialParameters
    friction: JointFriction
    sha256: str = ""
    notes: tuple[str, ...] = ()

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return len(self.joint_names)

    @property
    def terminal_joint(self) -> str:
        """Name of the last chain joint."""
        return self.joint_names[-1]

    @property
    def reference(self) -> Array:
        """Chain joint positions (n,) at the reference configuration."""
        return self.reference_qpos[self.qpos_index]


@dataclass(frozen=True)
class Motion:
    """Chain joint motion on a time grid.

    Attributes:
        time: (N,) [s].
        q, qd, qdd: (N, n) positions, velocities, accelerations [rad, rad/s, rad/s^2].
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", checked_array(self.time, (None,), "time"))
        shape = (len(self.time), np.shape(self.q)[1] if np.ndim(self.q) == 2 else None)
        for name in ("q", "qd", "qdd"):
            object.__setattr__(self, name, checked_array(getattr(self, name), shape, name))


class MotionPlan(Protocol):
    """A trajectory: anything with a duration that can be evaluated exactly at any time."""

    @property
    def duration(self) -> float:
        """Length [s]."""

    @property
    def n_joints(self) -> int:
        """Number of joints n."""

    def evaluate(self, time: Array) -> Motion:
        """Return the motion at times (N,) [s]; exact derivatives."""


@dataclass(frozen=True)
class Measurement:
    """Joint motion and torque samples, from a simulation or a log; one chunk of them or all.

    Attributes:
        time: (N,) [s], increasing.
        q: (N, n) positions [rad].
        qd: (N, n) velocities [rad/s], or None where only positions were measured.
        tau: (N, n) joint torques [N m].
        qdd: (N, n) accelerations [rad/s^2], or None where the log has none.
        joint_time: (N, n) when each joint was sampled [s], where it has time stamps of its own;
            None where ``time`` holds for all.
    """

    time: Array
    q: Array
    qd: Array | None
    tau: Array
    qdd: Array | None = None
    joint_time: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", checked_array(self.time, (None,), "time"))
        shape = (len(self.time), np.shape(self.q)[1] if np.ndim(self.q) == 2 else None)
        for name in ("q", "qd", "tau", "qdd", "joint_time"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, checked_array(getattr(self, name), shape, name))

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class BodyMotion:
    """What the regressor needs to know about the terminal body, in its own coordinates.

    Attributes:
        velocity: (N, 6) spatial velocity [omega, v] of the body-frame origin.
        acceleration: (N, 6) spatial acceleration [alpha, a - omega x v] minus gravity.
        jacobian: (N, 6, n) body Jacobian, velocity = jacobian qd.
        tau_rest: (N, n) torque of the arm without the terminal link and without friction [N m].
    """

    velocity: Array
    acceleration: Array
    jacobian: Array
    tau_rest: Array


@dataclass(frozen=True)
class JointInformation:
    """Square-root information of one joint's equations: R^T R = [Y tau]^T [Y tau].

    Attributes:
        joint: joint name.
        columns: (k,) which global parameters this joint's equations contain.
        triangle: (k+1, k+1) upper triangle R of the QR factorisation of [Y tau].
        n_samples: number of equations that went in.
    """

    joint: str
    columns: NDArray[np.int64]
    triangle: Array
    n_samples: int

    def __post_init__(self) -> None:
        size = len(self.columns) + 1
        triangle = checked_array(self.triangle, (size, size), f"information of {self.joint}")
        object.__setattr__(self, "triangle", triangle)


@dataclass(frozen=True)
class SquareRootInformation:
    """All that is left of the data after one pass over it.

    Attributes:
        names: (p,) global parameter names: the ten of ``spatial.PARAMETER_NAMES`` first, then
            nuisances such as ``coulomb[joint6]``.
        joints: one entry per joint whose torque is used.
    """

    names: tuple[str, ...]
    joints: tuple[JointInformation, ...]

    @property
    def n_samples(self) -> int:
        """Number of scalar equations."""
        return sum(joint.n_samples for joint in self.joints)

    def stacked(self, weights: Array | None = None) -> tuple[Array, Array]:
        """Return (A (M, p), b (M,)) with ||A x - b||^2 = sum_j w_j^2 ||Y_j x - tau_j||^2.

        Args:
            weights: (joints,) weight of each joint's equations, 1/sigma; None weighs all alike.
        """
        scale = np.ones(len(self.joints)) if weights is None else np.asarray(weights)
        blocks, rights = [], []
        for joint, weight in zip(self.joints, scale):
            block = np.zeros((len(joint.triangle), len(self.names)))
            block[:, joint.columns] = weight * joint.triangle[:, :-1]
            blocks.append(block)
            rights.append(weight * joint.triangle[:, -1])
        return np.vstack(blocks), np.concatenate(rights)

    def squared_residuals(self, values: Array) -> Array:
        """Return sum of squared residuals per joint (joints,) [N^2 m^2] at values (p,)."""
        return np.array(
            [np.sum((j.triangle @ np.append(values[j.columns], -1.0)) ** 2) for j in self.joints]
        )


class Status(Enum):
    """How an identification ended: cause and remedy."""

    OK = "all requested parameters are identified from the data"
    PARTLY_FROM_MODEL = (
        "some parameter combinations do not show in these torques and keep the model's values; "
        "use --torques chain, a longer --duration or another --seed to see more"
    )
    INCONSISTENT = (
        "the estimate is not a possible rigid body (its pseudo-inertia is not positive definite), "
        "because the data is too noisy or excites the link too little; use --torques chain, "
        "a longer --duration, another --seed or --consistency enforce"
    )


@dataclass(frozen=True)
class Identifiability:
    """What the equations can and cannot see.

    Attributes:
        rank: number of identifiable combinations of the ten inertial and the terminal joint's
            friction parameters.
        n_parameters: how many of those parameters were asked for.
        condition_number: of the stacked regressor (of its visible part where columns are blind).
        scaled_condition_number: the same after scaling each column to unit length.
        identified: (p,) per parameter, whether the data alone determines it.
        blind: the invisible combinations in words, for instance "mass".
    """

    rank: int
    n_parameters: int
    condition_number: float
    scaled_condition_number: float
    identified: tuple[bool, ...]
    blind: tuple[str, ...]


@dataclass(frozen=True)
class Estimate:
    """Result of one solver run.

    Attributes:
        names: (p,) parameter names, as in the information.
        values: (p,) estimate.
        identifiability: what the data could see.
        rmse: root mean square torque residual over all equations [N m].
        rmse_per_joint: joint name to root mean square torque residual [N m].
        status: how it ended.
        method: estimator's name.
        covariance: (p, p), where one was computed.
    """

    names: tuple[str, ...]
    values: Array
    identifiability: Identifiability
    rmse: float
    rmse_per_joint: Mapping[str, float]
    status: Status
    method: str = "ols"
    covariance: Array | None = None

    def __post_init__(self) -> None:
        size = len(self.names)
        object.__setattr__(self, "values", checked_array(self.values, (size,), "estimate"))

    @property
    def inertial(self) -> InertialParameters:
        """The ten inertial parameters."""
        return InertialParameters(self.values[:10])

    def value(self, name: str) -> float | None:
        """Return one parameter by name, or None where it was not estimated."""
        return float(self.values[self.names.index(name)]) if name in self.names else None


@dataclass(frozen=True)
class Identification:
    """Everything the exporters and the command line read.

    Attributes:
        model_path, model_sha256: which model file.
        joint_name, body_name: terminal joint and body.
        joint_names: all chain joints.
        prior: the model's own parameters of the terminal link.
        estimate: the result.
        torques: "chain" or "terminal".
        friction: whether friction was estimated.
        seed: of the trajectory; None where the data came from a log.
        duration: of the data [s].
        sample_rate: [Hz].
        versions: package name to version.
        notes: one sentence each: what the user should know.
    """

    model_path: Path
    model_sha256: str
    joint_name: str
    body_name: str
    joint_names: tuple[str, ...]
    prior: InertialParameters
    estimate: Estimate
    torques: str
    friction: bool
    seed: int | None
    duration: float
    sample_rate: float
    versions: Mapping[str, str]
    notes: tuple[str, ...] = field(default=())


class Progress(Protocol):
    """How a long stage tells how far it is; the command line shows it, libraries ignore it."""

    def stage(self, message: str) -> None:
        """Announce a stage."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Pass items through and count them."""

    def note(self, message: str) -> None:
        """Tell the user something that does not stop the run."""

    def detail(self, message: str) -> None:
        """Tell something that is only of interest when a result looks odd."""


class Silent:
    """Progress that says nothing."""

    def stage(self, message: str) -> None:
        """Ignore the announcement."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Pass the items through."""
        return items

    def note(self, message: str) -> None:
        """Ignore the note."""

    def detail(self, message: str) -> None:
        """Ignore the detail."""
