"""Equations of recordings without and with a payload: one arm, the payload in the loaded ones.

Rows [Y F 0] hold for an empty recording and [Y F Y_p] for a loaded one; Y_p is the terminal link's
Y once more, because the payload moves with it. With torque scales s_j and friction that drifts by
d_j from the first recording (t = -1) to the last (t = 1) the torque of joint j is

    tau_j = (1 + s_j) (Y_j theta + Y_pj p) + (1 + d_j t) F_j phi.

It is linearised around what is known so far, and so are encoder zeros, the tilt of the base and a
lag of the torque behind the position, which are small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robot_sysid.dynamics.equations import N_INERTIAL, Equations, friction_per_joint, other_links
from robot_sysid.dynamics.friction import FrictionModel
from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.dynamics.nuisances import NuisanceColumns, scale_names, zero_names
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.identify.judgement.filtering import filtering_pull
from robot_sysid.identify.nuisances import known_links
from robot_sysid.identify.payload.data.rows import FilteredRows, RowSource
from robot_sysid.identify.samples import DecimatedSamples
from robot_sysid.records import DELAY_NAME, Array, RobotModel

PAYLOAD_NAMES = tuple(f"{name}(payload)" for name in PARAMETER_NAMES)
_DRIFTING = ("coulomb", "viscous", "sqrt", "stribeck", "load")


@dataclass(frozen=True)
class Recording:
    """One recording, ready to be fitted.

    Attributes:
        name: what it is called in messages.
        is_loaded: whether the payload was on the arm.
        source: of its rows.
        place: its place in the order of recording, -1 the first and 1 the last; 0 where the order
            is not known.
    """

    name: str
    is_loaded: bool
    source: RowSource
    place: float = 0.0


class PayloadEquations:
    """The equations of all recordings, around what is known so far.

    Args:
        robot: the arm.
        friction: friction terms of every joint.
        drifts: whether a drift of friction over the recordings is sought.
    """

    def __init__(self, robot: RobotModel, friction: FrictionModel, drifts: bool) -> None:
        self._robot, self.friction = robot, friction
        self.joint_names = robot.joint_names
        self._links = other_links(robot)
        self._arm = self._arm_equations(None)
        self._drifts = drifts
        joints = robot.joint_names
        self.drift_names = tuple(f"drift[{joint}]" for joint in joints) if drifts else ()
        self.scale_names, self.zero_names = scale_names(robot), zero_names(robot)
        self.load_names = tuple(name for name in self._arm.names if name.startswith("load["))
        own = (*PAYLOAD_NAMES, *self.drift_names)
        nuisances = (*self.scale_names, *self.zero_names, *TILT_NAMES, DELAY_NAME)
        self.names = (*self._arm.names, *own, *nuisances)

    @property
    def prior(self) -> Array:
        """The model's own values of all parameters (p,); zero where it says nothing."""
        return np.append(self._arm.prior, np.zeros(len(self.names) - len(self._arm.names)))

    def places(self, names: Sequence[str]) -> list[int]:
        """Return where some parameters stand."""
        return [self.names.index(name) for name in names]

    def thetas(self, values: Array, is_loaded: bool) -> Array:
        """Return the links (n, 10) of some values (p,), the terminal one with or without load."""
        found = known_links(self._robot, self.names, values)
        if is_loaded:
            found[-1] += values[self.places(PAYLOAD_NAMES)]
        return found

    def samples(self, recording: Recording, values: Array) -> DecimatedSamples:
        """Return the equations of one recording around values (p,)."""
        loaded = self._loaded(recording, values)
        arm = recording.source.samples(self._arm_equations(loaded))
        common = self._common_columns(recording, values)
        rows, right = [], []
        for joint, (block, tau) in enumerate(zip(arm.rows, arm.tau)):
            linear = _Linearised(block, tau, loaded[arm.columns[joint]], len(self.friction.terms))
            known = arm.measured[joint] - tau
            scale, drift = self._factors(joint, values, recording.place)
            linear.expand(scale, known)
            linear.drift(drift, self._drifting())
            rows.append(self._full_rows(joint, linear, recording, common[:, joint]))
            right.append(linear.tau)
        names = self.names[len(arm.names) :]
        extended = replace(arm, tau=tuple(right), blocks=tuple((b,) for b, _ in rows))
        return extended.with_columns(names, [extra for _, extra in rows])

    def filtering_pull(
        self, recording: Recording, samples: DecimatedSamples, values: Array
    ) -> Array:
        """Return (joints, p), see ``judgement.filtering``; zero of an arm that rests."""
        source, loaded = recording.source, self._loaded(recording, values)
        if not isinstance(source, FilteredRows):
            return np.zeros((len(samples.joints), len(self.names)))
        return filtering_pull(samples, self._arm_equations(loaded), source.signals, loaded)

    def _loaded(self, recording: Recording, values: Array) -> Array:
        """Return the arm's own values, the payload part of the terminal link where there is one."""
        loaded = values[: len(self._arm.names)].copy()
        if recording.is_loaded:
            loaded[:N_INERTIAL] += values[self.places(PAYLOAD_NAMES)]
        return loaded

    def _full_rows(
        self, joint: int, linear: _Linearised, recording: Recording, common: Array
    ) -> tuple[Array, Array]:
        """Return (the arm's rows, all others) of one joint."""
        payload = linear.rows[:, :N_INERTIAL] * float(recording.is_loaded)
        own = np.eye(self._robot.n_joints)[joint]
        scale = linear.torque[:, None] * own
        drift = recording.place * linear.friction[:, None] * own
        parts = (payload, *((drift,) if self._drifts else ()), scale, common)
        return linear.rows, np.hstack(parts)

    def _factors(self, joint: int, values: Array, place: float) -> tuple[float, float]:
        """Return (s_j, d_j t) of some values."""
        name = self._robot.joint_names[joint]
        scale = float(values[self.names.index(f"scale[{name}]")])
        drift = float(values[self.names.index(f"drift[{name}]")]) if self._drifts else 0.0
        return scale, drift * place

    def _drifting(self) -> list[int]:
        """Return which of a joint's columns are friction that may drift."""
        terms = self.friction.terms
        return [N_INERTIAL + k for k, term in enumerate(terms) if term in _DRIFTING]

    def _common_columns(self, recording: Recording, values: Array) -> Array:
        """Return (K, n, n + 3) columns of encoder zeros, tilt and lag.

        They are slow, so that they need not pass the low-pass.
        """
        motion, late = recording.source.motion, recording.source.lag
        columns = NuisanceColumns(self._robot, self.thetas(values, recording.is_loaded))
        return np.concatenate((columns.zero(motion), columns.tilt(motion), late[..., None]), -1)

    def _arm_equations(self, values: Array | None) -> Equations:
        per_joint = friction_per_joint(self._robot, "chain", self.friction)
        return Equations(self._robot, "chain", per_joint, (), self._links, values)


class _Linearised:
    """One joint's equations, multiplied by factors that are parameters themselves.

    Args:
        rows: (K, k) of the arm: the terminal link's, friction's, other links'.
        tau: (K,) right-hand side.
        values: (k,) what is known so far of the arm's parameters.
        terms: number of friction terms.
    """

    def __init__(self, rows: Array, tau: Array, values: Array, terms: int) -> None:
        self.rows, self.tau, self._values = rows.copy(), tau.copy(), values
        self._inertial = np.ones(rows.shape[1], dtype=bool)
        self._inertial[N_INERTIAL : N_INERTIAL + terms] = False
        self.torque = self.friction = np.zeros(len(tau))

    def expand(self, scale: float, known: Array) -> None:
        """Linearise (1 + s) (Y theta + known) around s = ``scale``."""
        linear = self.rows[:, self._inertial] @ self._values[self._inertial]
        self.torque = linear + known
        self.rows[:, self._inertial] *= 1.0 + scale
        self.tau += scale * linear

    def drift(self, share: float, columns: list[int]) -> None:
        """Linearise (1 + d t) F phi around d t = ``share`` for some of the columns."""
        self.friction = self.rows[:, columns] @ self._values[columns]
        self.rows[:, columns] *= 1.0 + share
        self.tau += share * self.friction
