"""An excitation problem: the arm, its limits and what surrounds it, as the search sees them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot_sysid import spatial
from robot_sysid.design.screws import ScrewChain
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Motion, checked_array

TorqueFunction = Callable[[Motion], Array]


@dataclass(frozen=True)
class Closest:
    """The tightest distance at one configuration.

    Attributes:
        slack: distance minus the distance that must be kept [m]; negative where it is not kept.
        distance: itself [m]; infinite where nothing is near.
        label: between what, for the reader.
    """

    slack: float
    distance: float
    label: str


@dataclass(frozen=True)
class Slack:
    """How much room N configurations have.

    Attributes:
        value: (N,) smallest slack [m], at most the obstacles' horizon.
        gradient: (N, n) with respect to the joint positions.
        budget: (N, P) smallest slack among the pairs of each row of ``Obstacles.rates`` [m];
            infinite where a row has no pair within the horizon.
    """

    value: Array
    gradient: Array
    budget: Array


class Obstacles(Protocol):
    """What the arm must not touch, itself included."""

    @property
    def horizon(self) -> float:
        """Largest slack that is told apart [m]; what is farther away counts as this far."""

    @property
    def rates(self) -> Array:
        """Approach bounds (P, n): pairs of row p approach at rates[p] @ abs(qd) [m/s] at most."""

    def slack(self, q: Array) -> Slack:
        """Return the slack at positions q (N, n)."""

    def closest(self, q: Array) -> Closest:
        """Return the tightest distance at one configuration q (n,)."""


class NoObstacles:
    """Empty space, for an arm whose model has no collision geometry.

    Args:
        joints: number of joints n.
    """

    horizon = 1.0

    def __init__(self, joints: int) -> None:
        self.rates = np.zeros((1, joints))

    def slack(self, q: Array) -> Slack:
        """Return the horizon everywhere."""
        full = np.full(len(q), self.horizon)
        return Slack(full, np.zeros_like(q), full[:, None])

    def closest(self, q: Array) -> Closest:
        """Return that nothing is near."""
        return Closest(self.horizon, np.inf, "")


@dataclass(frozen=True)
class MotionLimits:
    """What the motion must obey; a torque limit is infinite where there is none.

    Attributes:
        lower, upper: (n,) positions, finite, margin already taken off [rad or m].
        velocity: (n,) [rad/s or m/s].
        acceleration: (n,) [rad/s^2 or m/s^2].
        torque: (n,) [N m or N]; infinite too where holding still already exceeds the limit.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    torque: Array

    def __post_init__(self) -> None:
        if not np.all((self.lower < self.upper) & np.isfinite(self.upper - self.lower)):
            raise InputError("position limits must be finite, with lower < upper for every joint")
        for name in ("velocity", "acceleration", "torque"):
            if not np.all(getattr(self, name) > 0.0):
                raise InputError(f"{name} limits must be positive")


@dataclass(frozen=True)
class ExcitationProblem:
    """One arm, ready for the search.

    Attributes:
        joint_names: the n chain joints.
        rest: (n,) where the motion starts and ends [rad].
        limits: what it must obey.
        chain: the arm's screws.
        prior: (10,) the terminal link's parameters in the model; sets the physical scale.
        torque: joint torques (N, n) along a motion, friction included.
        obstacles: what must not be touched.
        rows: chain joints whose torque will be used.
        sigma: (len(rows),) standard deviation of their noise [N m].
        notes: what the reader should know about these limits.
    """

    joint_names: tuple[str, ...]
    rest: Array
    limits: MotionLimits
    chain: ScrewChain
    prior: Array
    torque: TorqueFunction
    obstacles: Obstacles
    rows: tuple[int, ...]
    sigma: Array
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "rest", checked_array(self.rest, (self.n_joints,), "rest"))
        object.__setattr__(self, "prior", checked_array(self.prior, (10,), "prior"))
        sigma = checked_array(self.sigma, (len(self.rows),), "torque noise")
        object.__setattr__(self, "sigma", sigma)

    @property
    def n_joints(self) -> int:
        """Number of chain joints n."""
        return len(self.joint_names)

    @property
    def scale(self) -> Array:
        """Typical magnitudes (10,) of the inertial parameters: m, m L, m L^2."""
        length = spatial.characteristic_length(self.prior)
        return spatial.parameter_scale(float(self.prior[0]), length)
