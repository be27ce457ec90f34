"""A torque is a sum of terms: each a cause with its parameters, columns and prior.

With bodies theta, torque scales s_j, friction F_j phi that drifts by d_j from the first recording
(t = -1) to the last (t = 1), encoder zeros z and a delay, the torque read at joint j is

    tau_j = (1 + s_j) [inverse dynamics at q - z, gravity tilted]_j(t - delay) + (1 + d_j t) F_j phi
            + rotor_j qdd_j + motors that turn several joints + what springs and tendons make.

Each term is the derivative of this by its parameters at a ``Point``: bodies, friction, rotors and
motors are linear; scales, zeros, tilt, delay, drift and the loss of a gear that grows with its load
are linearised around the last estimate.

A torque scale multiplies the last estimate of the last link and, without a payload, the model's
values of the others: with all links' estimates in their place, scales would come out too large by
as much as links are off.

Shapes: a chunk of m rows, n joints of the chain, J joints with equations; a body has ten inertial
parameters (``PARAMETER_NAMES``).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import (
    BEND,
    OFFSET,
    POLYNOMIAL,
    TERMS,
    Coupling,
    stated_tops,
    top_speeds,
)
from robot_sysid.dynamics.inverse_dynamics import (
    ARRAY_SIZE,
    BeyondRigidBodies,
    acting_gravity,
    gravity_vector,
    link_names,
    other_links,
    tilt_axes,
)
from robot_sysid.errors import InputError
from robot_sysid.estimate.links import reference_links
from robot_sysid.estimate.rows import JointSums, Rows, Sums, block_numbers, row_chunks
from robot_sysid.records import Array, RobotModel, parameters
from robot_sysid.records.parameters import INERTIAL, Parameter, keys_of, of_body
from robot_sysid.signals.process import FilteredRecording, Mask
from robot_sysid.spatial import N_INERTIAL

# Causes, as they are called in results.
LINKS = "the other links' parameters"
LAST_LINK = "last link"
PAYLOAD = "payload"
FRICTION = "friction"
FURTHER_FRICTION = "friction model"
SCALES = "the torque scales"
ZEROS = "joint offsets"
TILT = "gravity"
DELAY = "delay"
DRIFT = "drift of friction"
SCALE_DRIFT = "drift of torque scale"
ZERO_DRIFT = "drift of zero"
OFFSET_DRIFT = "drift of torque offset"
MOTORS = "couplings"
PAYLOAD_NAMES = keys_of(of_body("payload"))
"""Names of the ten inertial parameters of the payload."""
USUAL_FRICTION = tuple(
    name
    for name, term in TERMS.items()
    if term.prior or (term.attribute and term not in POLYNOMIAL) or term is OFFSET
)
"""Friction terms that have columns whatever the friction model is: those that any file holds,
offsets of sensors, and those that a prior allows for."""


@dataclass(frozen=True)
class Prior:
    """What is known of k parameters before the data: N(mean, factor factor').

    Attributes:
        mean: (k,) [SI].
        factor: (k, k).
    """

    mean: Array
    factor: Array

    @cached_property
    def rows(self) -> Array:
        """The prior as equations [A b] (k, k + 1) of unit variance."""
        inverse = np.linalg.inv(self.factor)
        return np.column_stack((inverse, inverse @ self.mean))

    @property
    def variances(self) -> Array:
        """Variance (k,) of each parameter."""
        return np.sum(self.factor**2, axis=1)


def independent(
    deviations: Sequence[float] | Array, mean: Array | float = 0.0
) -> Prior:
    """Return the prior of k parameters with independent errors [SI], around zero by default."""
    # A number that is known exactly has an error all the same.
    size = np.maximum(deviations, 1e-9)
    return Prior(np.zeros(len(size)) + mean, np.diag(size))


@dataclass(frozen=True)
class Point:
    """The estimate around which terms are linearised.

    Attributes:
        thetas: (n, 10) links that scales, zeros, tilt and delay multiply.
        links: (n, 10) links whose torque loads the gears: all as they were estimated last.
        payload: (10,) what the last link carries in loaded recordings.
        gravity: (3,) in the world frame [m/s^2].
        friction: name of a parameter to its value, of those of friction at least; a missing one is
            zero.
    """

    thetas: Array
    links: Array
    payload: Array
    gravity: Array
    friction: Mapping[str, float] = field(default_factory=dict)

    def carried_links(self, is_loaded: bool) -> Array:
        """Return the links (n, 10), the last one with the payload if ``is_loaded``."""
        if not is_loaded:
            return self.thetas
        thetas = self.thetas.copy()
        thetas[-1] += self.payload
        return thetas


Columns = Callable[[Rows, Point], Array]
"""Function that returns the columns (m, J, k) of a term's k parameters: torque per unit of each."""


@dataclass(frozen=True)
class Term:
    """One cause of torque.

    Attributes:
        cause: in words, as results have it.
        parameters: its k parameters.
        columns: their columns around a point.
        prior: what is known of them; None where nothing is.
        is_bounded: whether the bounds of its parameters hold.
        bodies: whether each ten parameters have to be a possible body.
        reference: (k,) values that parameters keep which nothing shows; the model's, or (1,) zero.
        least: (k,) bodies beside which each of the term's bodies has to be possible, such as
            fingers on joints of their own, which keep their inertia; (1,) zero for none.
    """

    cause: str
    parameters: tuple[Parameter, ...]
    columns: Columns
    prior: Prior | None = None
    is_bounded: bool = True
    bodies: bool = False
    reference: Array = field(default_factory=partial(np.zeros, 1))
    least: Array = field(default_factory=partial(np.zeros, 1))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the parameters."""
        return keys_of(self.parameters)

    @property
    def key(self) -> str:
        """Its key among the terms of an arm: its cause, or the name of a friction term or motor."""
        first = self.parameters[0]
        keys = {MOTORS: first.of, FRICTION: first.name, FURTHER_FRICTION: first.name}
        return keys.get(self.cause, self.cause or first.name)

    def only(self, at: Sequence[int]) -> Term:
        """Return a term of joints or motors, which has no prior, with some of its parameters."""
        return replace(
            self,
            parameters=tuple(self.parameters[k] for k in at),
            columns=partial(self._columns_at, at),
            reference=self.reference[at],
        )

    def _columns_at(self, at: Sequence[int], rows: Rows, point: Point) -> Array:
        """Return some of the columns, as a function that can be pickled with a result."""
        return self.columns(rows, point)[:, :, at]


class ArmTerms:
    """All terms of an arm's torque, without priors, and what the model says of their parameters.

    Args:
        robot: the arm with its model.
        torques: "chain" for the equations of all joints, "terminal" for the last one's only.
        motors: motors that turn several joints.
        friction: names of friction terms that have columns beside those of ``USUAL_FRICTION``.
        loaded: whether some recordings carry a payload.
        fastest: (n,) highest speed of each joint in the recordings [rad/s or m/s]; None for none.
        offered: motors that an arm may have beside, whose columns stand beside the others.

    Attributes:
        tops: (n,) speeds at which the joints' friction is flat [rad/s or m/s]; a model that bends
            is known up to its own.
        stated_tops: (n,) those of the model's own friction that bends; 0 of others.
        joints: names of the J joints with equations.
        indices: (J,) their numbers among the joints of the chain.
        links: number of each link with parameters, base to terminal, to the names of these.
        terms: cause, or name of a friction term or motor, to the term.
        model: name of a parameter to the model's value; a missing one is zero.
    """

    def __init__(
        self,
        robot: RobotModel,
        torques: str = "chain",
        motors: Sequence[Coupling] = (),
        friction: Sequence[str] = (),
        loaded: bool = False,
        fastest: Array | None = None,
        offered: Sequence[Coupling] = (),
    ) -> None:
        self.robot = robot
        self.motors = tuple(motors)
        self._offered = tuple(offered)
        n = robot.n_joints
        # Columns of what the model does not state would cost time.
        rigid = without_polynomials(robot, self.motors)
        polynomial = [] if rigid is robot else [term.name for term in POLYNOMIAL]
        self.friction = tuple(dict.fromkeys((*USUAL_FRICTION, *polynomial, *friction)))
        self.stated_tops = stated_tops(robot)
        fastest = np.zeros(n) if fastest is None else fastest
        self.tops = np.maximum(
            top_speeds(fastest, stated_speeds(robot)), self.stated_tops
        )
        self.indices = np.arange(0 if torques == "chain" else n - 1, n)
        self.joints = tuple(robot.joint_names[j] for j in self.indices)
        self.others = other_links(robot) if torques == "chain" else ()
        self.links = {link: link_names(robot, link) for link in self.others}
        self.links[n - 1] = keys_of(INERTIAL)
        self.has_gravity = bool(np.any(gravity_vector(robot)))
        self._beyond = BeyondRigidBodies(rigid)
        self.terms = {term.key: term for term in self._terms(loaded)}
        self.model: dict[str, float] = {}
        for link, names in self.links.items():
            self.model.update(zip(names, robot.links[link].theta.tolist()))
        for term in self.terms.values():
            if term.parameters[0].attribute:
                self.model.update(zip(term.names, term.reference.tolist()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of all terms."""
        return tuple(name for term in self.terms.values() for name in term.names)

    @property
    def model_bends(self) -> bool:
        """Whether friction of the given model bends with speed."""
        tops = [*self.stated_tops, *(motor.stated_top for motor in self.motors)]
        return bool(np.any(tops))

    @property
    def owners(self) -> tuple[str, ...]:
        """Names of what has friction and rotors: joints, and motors that turn several."""
        return *self.robot.joint_names, *(motor.name for motor in self.motors)

    def top_of(self, owner: str) -> float:
        """Return the speed at which the friction of a joint or motor is flat [rad/s or m/s]."""
        for motor in self.motors:
            if motor.name == owner:
                return motor.top
        return float(self.tops[self.robot.joint_names.index(owner)])

    def _of_joints(
        self, entry: Parameter, indices: Iterable[int] | None = None
    ) -> tuple[Parameter, ...]:
        """Return a parameter of joints of the chain, by default of those with equations."""
        robot = self.robot
        chosen = self.indices if indices is None else indices
        return tuple(entry.at(robot.joint_names[j], robot.is_slide[j]) for j in chosen)

    def start(self) -> Point:
        """Return the point at the model's own values."""
        thetas = self.robot.thetas
        gravity = gravity_vector(self.robot)
        return Point(thetas, thetas, np.zeros(N_INERTIAL), gravity)

    def _terms(self, loaded: bool) -> Iterator[Term]:
        """Yield all terms, those of bodies first."""
        robot = self.robot
        last = robot.links[-1].reference
        body = partial(Term, bodies=True)
        ends = [robot.n_joints - 1]
        yield body(LAST_LINK, INERTIAL, partial(self._links, ends), reference=last)
        if self.others:
            links = [of_body(robot.links[k].body_name) for k in self.others]
            yield body(
                LINKS,
                tuple(itertools.chain(*links)),
                partial(self._links, list(self.others)),
                reference=reference_links(robot, self.others),
            )
        if loaded:
            yield body(PAYLOAD, of_body("payload"), self._payload, reference=last)
        for name in self.friction:
            own = self._of_joints(TERMS[name])
            columns = partial(self._friction, name)
            reference = TERMS[name].stated_value(robot)[self.indices]
            if TERMS[name] in (BEND, *POLYNOMIAL):
                all_motors = (*self.motors, *self._offered)
                own += tuple(TERMS[name].at(motor.name) for motor in all_motors)
                columns = partial(self._with_motors, name)
                model = robot.mj_model
                stated = [each.stated_value(TERMS[name], model) for each in all_motors]
                reference = np.append(reference, stated)
            yield Term(FRICTION, own, columns, reference=reference)
        yield from map(self.motor, (*self.motors, *self._offered))
        scales = self._of_joints(parameters.SCALE)
        yield Term(SCALES, scales, self._scales)
        zeros = self._of_joints(parameters.ZERO, range(robot.n_joints))
        yield Term(ZEROS, zeros, self._zeros)
        if loaded:
            yield Term(DRIFT, self._of_joints(parameters.DRIFT), self._drift)
            offsets = self._of_joints(OFFSET)
            drifting: tuple[tuple[str, tuple[Parameter, ...], Columns], ...] = (
                (SCALE_DRIFT, scales, self._scales),
                (ZERO_DRIFT, zeros, self._zeros),
                (OFFSET_DRIFT, offsets, partial(self._friction, OFFSET.name)),
            )
            for cause, of_joints, constant in drifting:
                drifts = parameters.drift_of(of_joints)
                yield Term(cause, drifts, partial(self._drift_columns, constant))
        if self.has_gravity:
            yield Term(TILT, parameters.TILTS, self._tilt)
        yield Term(DELAY, (parameters.DELAY,), self._delay)

    def friction_of(self, name: str) -> Term:
        """Return a friction term of joints, and of the motors that the arm has."""
        term = self.terms[name]
        at = [k for k, each in enumerate(term.parameters) if each.of in self.owners]
        return term.only(at)

    def motor(self, motor: Coupling) -> Term:
        """Return the term of a motor that turns several joints."""
        columns = partial(self._motor, motor)
        return Term(MOTORS, motor.parameters, columns, reference=motor.model)

    def of(self, terms: Iterable[Term]) -> ArmTerms:
        """Return the arm with other terms."""
        other = copy(self)
        other.terms = {term.key: term for term in terms}
        return other

    def beside(self, terms: Iterable[Term]) -> ArmTerms:
        """Return the terms of the arm with further ones, whose columns stand beside theirs."""
        return self.of([*self.terms.values(), *terms])

    def sums(
        self,
        recordings: Sequence[FilteredRecording],
        point: Point,
        in_blocks: bool = True,
    ) -> Sums:
        """Return the sums of all rows, linearised around a point.

        Only jackknife, held-out validation and what changes over a log need them ``in_blocks``.
        """
        numbers, logs = block_numbers(recordings, in_blocks)
        return self.add_up(zip(recordings, numbers), logs, point)

    def add_up(
        self,
        recordings: Iterable[tuple[FilteredRecording, NDArray[np.int64]]],
        logs: Sequence[str],
        point: Point,
        with_triangles: bool = False,
        array_size: int = ARRAY_SIZE,
    ) -> Sums:
        """Return the sums of all rows; columns that are nothing but rounding are zero.

        Args:
            recordings: one at least, each with the block (K,) of its rows; read one at a time.
            logs: (B,) the log that a block belongs to.
            point: around which terms are linearised.
            with_triangles: whether to keep triangles beside the products, of rows that are all
                used.
            array_size: of the equations of a chunk [numbers], which bounds memory and changes no
                result.

        Raises:
            InputError: no row can be used.
        """
        names = self.names
        joints = self.joints
        size = len(names) + 1
        joint_sums = [JointSums(len(logs), size) for _ in joints]
        triangles = np.zeros((len(joints), size, size)) if with_triangles else None
        for recording, blocks in recordings:
            for chunk in row_chunks(recording, size * len(joints), array_size):
                rows, is_used = self.equations(chunk, point)
                for joint, sums in enumerate(joint_sums):
                    block = np.where(is_used[:, joint], blocks[chunk.span], -1)
                    sums.add(rows[:, joint], block)
                if triangles is not None:
                    stacked = np.concatenate(
                        (triangles, np.swapaxes(rows, 0, 1)), axis=1
                    )
                    triangles = np.asarray(np.linalg.qr(stacked, mode="r"))
        counts = np.stack([sums.counts for sums in joint_sums], axis=1)
        if not np.any(counts):
            raise InputError(
                f"none of the joints {', '.join(joints)} moves faster than its velocity deadband "
                "for long enough; move faster, and turn round less often"
            )
        for sums in joint_sums:
            sums.finish()
        return Sums(
            names,
            joints,
            tuple(sums.columns for sums in joint_sums),
            tuple(sums.products for sums in joint_sums),
            counts,
            tuple(logs),
            triangles,
        )

    def equations(self, rows: Rows, point: Point) -> tuple[Array, Mask]:
        """Return (rows [A b] (m, J, p + 1), whether each is used (m, J)) of a chunk.

        In memory the m samples of one entry lie side by side, as those of links do.
        """
        columns = [term.columns(rows, point) for term in self.terms.values()]
        tau = self.measured_torque(rows)
        columns.append((tau - self.known(rows))[:, :, None])
        every = [np.transpose(each, (1, 2, 0)) for each in columns]
        return np.concatenate(every, axis=1).transpose(2, 0, 1), np.isfinite(tau)

    def measured_torque(self, rows: Rows) -> Array:
        """Return the measured torque (m, J) of a chunk of rows [N m]; NaN where not used."""
        tau = rows.recording.torque[rows.span]
        return np.where(rows.recording.is_used[rows.span], tau, np.nan)[:, self.indices]

    def torque(self, rows: Rows, point: Point, values: Mapping[str, float]) -> Array:
        """Return the torque (m, J) of named parameters, the known torque added [N m]."""
        torque = self.known(rows)
        for term in self.terms.values():
            coefficients = np.array([values.get(name, 0.0) for name in term.names])
            if np.any(coefficients):
                torque = torque + term.columns(rows, point) @ coefficients
        return torque

    def known(self, rows: Rows) -> Array:
        """Return the torque (m, J) of springs, tendons and actuators, which no term has [N m]."""
        motion = rows.motion
        torque = self._beyond.torque(motion.q, motion.qd, motion.qdd)
        torque = (torque - self.robot.armature * motion.qdd)[:, self.indices]
        for motor in self.motors:
            if motor.tendon is not None:
                # That of its term, of which MuJoCo has all but the dry friction.
                torque = torque - self._motor(motor, rows)[..., 1:] @ motor.model[1:]
        return torque

    def _links(self, links: Sequence[int], rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 10 links) of links by their numbers in the chain."""
        moves = rows.moves(self.robot, point.gravity)
        return moves.columns(links)[:, self.indices]

    def _payload(self, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 10) of the payload, zero where it is not on the arm."""
        if not rows.is_loaded:
            return np.zeros((len(rows.motion.q), len(self.joints), N_INERTIAL))
        return self._links([self.robot.n_joints - 1], rows, point)

    def _per_joint(self, columns: Array) -> Array:
        """Return columns (m, J) of one parameter per joint as columns (m, J, J)."""
        joints = range(len(self.joints))
        every = np.zeros((len(joints), len(joints), len(columns)))
        every[joints, joints] = columns.T
        return every.transpose(2, 0, 1)

    def friction_column(self, name: str, rows: Rows, point: Point) -> Array:
        """Return the column (m, J) of a friction term at each joint.

        Directions of motion are low-passed like the torque; so are dry columns as a whole.
        """
        term = TERMS[name]
        if name == "load":
            sign = self.friction_column("coulomb", rows, point)
            load = self.links_torque(rows, replace(point, thetas=point.links))
            return term.torque(sign, sign, sign, load)
        if term.is_dry:
            return rows.low_passed(name, term.column)[:, self.indices]
        return term.column(rows.motion, self.tops)[:, self.indices]

    def _friction(self, name: str, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, J) of a friction term."""
        return self._per_joint(self.friction_column(name, rows, point))

    def _with_motors(self, name: str, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, J + motors) of a term that motors of several joints have, too.

        It depends on speed alone.
        """
        columns = [self._friction(name, rows, point)]
        for motor in (*self.motors, *self._offered):
            speed = rows.motion.qd @ motor.ratios
            torque = TERMS[name].of_state(speed, speed, speed, speed, motor.top)
            columns.append((torque[:, None] * motor.ratios[self.indices])[:, :, None])
        return np.concatenate(columns, axis=2)

    def _motor(self, motor: Coupling, rows: Rows, _: Point | None = None) -> Array:
        """Return the columns (m, J, 3) of a motor that turns several joints.

        One that turns at s = sum_j r_j qd_j puts its torque on each of these joints r_j times,
        because power is the same on both sides.
        """
        motion = rows.motion
        dry = rows.low_passed(motor.name, lambda m: np.sign(m.qd @ motor.ratios))
        own = np.stack(
            (dry, motion.qd @ motor.ratios, motion.qdd @ motor.ratios), axis=-1
        )
        return own[:, None, :] * motor.ratios[self.indices][:, None]

    def links_torque(self, rows: Rows, point: Point) -> Array:
        """Return the torque (m, J) of the point's links [N m]."""
        thetas = point.carried_links(rows.is_loaded)
        torque = rows.links_torque(self.robot, point.gravity, thetas)
        return torque[:, self.indices]

    def _scales(self, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, J) of torque scales."""
        return self._per_joint(self.links_torque(rows, point))

    def _zeros(self, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, n) of encoders that read too much [N m/rad]."""
        moves = rows.moves(self.robot, point.gravity)
        slopes = moves.slopes(point.carried_links(rows.is_loaded), rows.motion.qd)
        return -slopes[:, self.indices]

    def _drift_columns(self, columns: Columns, rows: Rows, point: Point) -> Array:
        """Return columns (m, J, k) of a drift from recording to recording."""
        return rows.recording.order * columns(rows, point)

    def _tilt(self, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, 2) of gravity turned about two horizontal axes [N m/rad]."""
        thetas = point.carried_links(rows.is_loaded)
        turned = np.cross(tilt_axes(point.gravity), point.gravity)
        moves = rows.moves(self.robot, point.gravity)
        torque = moves.torque_at_rest(thetas, acting_gravity(self.robot, turned))
        return torque[:, self.indices]

    def _delay(self, rows: Rows, point: Point) -> Array:
        """Return the column (m, J, 1) of a torque that lags, -d tau / dt [N m/s]."""
        # A derivative needs the rows beside those of the chunk. Of dry friction, a reversal that is
        # a little early or late looks like a delay.
        of_log = Rows(rows.recording, slice(None))
        torque = self.links_torque(of_log, point)
        torque = torque + self._friction_torque(("viscous", "armature"), of_log, point)
        late = -np.gradient(torque, of_log.motion.time, axis=0)
        return late[rows.span][:, :, None]

    def _drift(self, rows: Rows, point: Point) -> Array:
        """Return the columns (m, J, J) of friction's drift from recording to recording."""
        drifting = [name for name in self.friction if TERMS[name].is_friction]
        friction = self._friction_torque(drifting, rows, point)
        return self._per_joint(rows.recording.order * friction)

    def _friction_torque(self, terms: Sequence[str], rows: Rows, point: Point) -> Array:
        """Return the torque (m, J) of the point's friction by some terms [N m]."""
        friction = np.zeros((len(rows.motion.q), len(self.joints)))
        for name in terms:
            keys = map(TERMS[name].key_of, self.joints)
            sizes = np.array([point.friction.get(key, 0.0) for key in keys])
            if np.any(sizes):
                friction += self.friction_column(name, rows, point) * sizes
        return friction


def stated_speeds(robot: RobotModel) -> Array:
    """Return the speed limits (n,) that a model file states; infinite where it states none."""
    if robot.stated_speeds is None:
        return np.full(robot.n_joints, np.inf)
    return robot.stated_speeds


def without_polynomials(robot: RobotModel, motors: Sequence[Coupling]) -> RobotModel:
    """Return an arm without nonlinear damping of its joints and motors: terms have it."""
    model = robot.mj_model
    stated = [
        (
            *term.stated_value(robot),
            *(motor.stated_value(term, model) for motor in motors),
        )
        for term in POLYNOMIAL
    ]
    if not np.any(stated):
        return robot
    model = copy(model)
    model.dof_dampingpoly[robot.dof_index] = 0.0
    for motor in motors:
        if motor.tendon is not None:
            model.tendon_dampingpoly[motor.tendon] = 0.0
    return replace(robot, mj_model=model)
