"""The linearised equations of all recordings: the only place where columns are made.

With the bodies that hang on the arm in a recording (the links, and the payload where it is on),
torque scales s_j, friction that drifts by d_j from the first recording (t = -1) to the last (t = 1)
and a delay, the measured torque of joint j is

    tau_j = (1 + s_j) [inverse dynamics at q - z, gravity tilted]_j + (1 + d_j t) F_j phi
            + rotor_j qdd_j + couplings.

It is linear in bodies, friction, rotors and couplings, and linearised around the last estimate in
everything else: scales, drift, encoder zeros z, two angles of gravity, the delay, the loss of
a gear that grows with its load, and speeds that friction is nonlinear in.

Without a payload s_j multiplies the last estimate of the last link, and the model's values of the
others. With all links' estimates in their place, scales would be too large by as much as links are
off: by 5 % for an iiwa whose links are 5 % off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.equations import (
    Equations,
    friction_per_joint,
    link_names,
    names_of,
    other_links,
    split_name,
)
from robot_sysid.dynamics.friction import (
    FADING_SPEEDS,
    NONLINEAR_TERMS,
    TERMS,
    Coupling,
    FrictionModel,
)
from robot_sysid.dynamics.inverse_dynamics import (
    TILT_NAMES,
    LinkDynamics,
    gravity_vector,
    tilt_angles,
    tilt_axes,
    tilt_columns,
    turn_gravity,
    with_gravity,
    zero_columns,
)
from robot_sysid.dynamics.spatial import N_INERTIAL, PARAMETER_NAMES
from robot_sysid.estimation.dataset import (
    AssembledRows,
    Dataset,
    DecimatedSamples,
    store_rows,
)
from robot_sysid.model.bodies import usual_bodies
from robot_sysid.records import DELAY_NAME, Array, Motion, RobotModel

PAYLOAD_NAMES = tuple(f"{name}(payload)" for name in PARAMETER_NAMES)
"""Names of the ten inertial parameters of the payload."""
LINEAR = tuple(term for term in TERMS if term not in ("load", *NONLINEAR_TERMS))
"""Friction terms whose columns depend on the motion only, not on the estimate."""
# Friction terms that drift from the first recording to the last, F_j phi above.
_BY_SPEED = ("coulomb", "viscous", "sqrt", "load")
_DRIFTING = (*_BY_SPEED, *NONLINEAR_TERMS, *FADING_SPEEDS)
# Joint terms whose torque is smooth, so that its time derivative identifies a delay.
_SMOOTH = ("viscous", "armature")
# Number of rows whose link-dependent columns are computed in one call: fewer calls, more memory.
_TOGETHER = 4000
# Relative change of gravity up to which the change of rows is added without the low-pass.
_SMALL_TURN = 0.1
# Type of a cache: (key, ``exact_load`` to columns of load by recording, columns of zeros and tilt).
_LinkColumns = tuple[Any, dict[bool, list[Array]], list[Array]]


@dataclass(frozen=True)
class Point:
    """The estimate around which the equations are linearised.

    Attributes:
        values: (p,) of all parameters [SI]; those of delay, tilt and friction speeds are increments
            on the fields below.
        gravity: (3,) in the world frame of the model [m/s^2].
        delay: lag of the torque behind the position [s].
        speed: nonlinear friction term to its speed (n,) at each joint [rad/s].
        exact_load: whether columns of load-dependent friction are low-passed like the torque. Where
            only a prior allows for this friction, the unfiltered load is accurate enough.
        in_file: whether only the parameters of a model file, and gravity's tilt, have columns.
    """

    values: Array
    gravity: Array
    delay: float = 0.0
    speed: Mapping[str, Array] | None = None
    exact_load: bool = False
    in_file: bool = False


class Columns:
    """Names of all p parameters, and the linearised rows of recordings in these parameters.

    Columns that do not depend on the point are cached, and so are those that depend on links only.
    Recordings have K rows each (instants of equations), the chain n joints; q parameters, the first
    of the p, have columns that do not depend on the point.

    Args:
        robot: model of the arm.
        datasets: the recordings.
        torques: "chain" for every joint that carries the link, "terminal" for the last one only.
        couplings: motors that turn with several joints, or candidates for such motors.

    Attributes:
        names: (p,) of all parameters.
        index: name of a parameter to its index in ``names``.
        model_values: (p,) the model's values, zero for nuisances.
        joints: names of the joints that have equations, base to terminal.
        joint_indices: indices of these joints among the joints of the chain.
        tilts: names of the two angles of gravity's direction; () without gravity.
    """

    def __init__(
        self,
        robot: RobotModel,
        datasets: Sequence[Dataset],
        torques: str = "chain",
        couplings: Sequence[Coupling] = (),
    ) -> None:
        self.robot = robot
        self.datasets = tuple(datasets)
        self.torques = torques
        self.couplings = tuple(couplings)
        self._base: tuple[Array, float, list[DecimatedSamples]] | None = None
        self._arm: tuple[Array, RobotModel] | None = None
        self._link_columns: _LinkColumns = ((), {}, [])
        arm = self._equations(robot)
        self._arm_names = arm.names
        self.joint_indices = arm.joint_indices
        self.joints = arm.joints
        # Parameters whose columns depend on the point.
        point_terms = ["load"]
        for term in NONLINEAR_TERMS:
            point_terms += [term, f"{term}_speed"]
        self._scales = names_of("scale", self.joints)
        self._drifts = names_of("drift", self.joints)
        self._zeros = names_of("zero", robot.joint_names)
        self.tilts = TILT_NAMES if np.any(gravity_vector(robot)) else ()
        point_names = list[str]()
        for joint in self.joints:
            point_names += [f"{term}[{joint}]" for term in point_terms]
        point_names += (*self._scales, *self._drifts, *self._zeros, *self.tilts)
        point_names += (DELAY_NAME, *PAYLOAD_NAMES)
        self.names = (*arm.names, *point_names)
        self.model_values = np.append(arm.prior, np.zeros(len(point_names)))
        self.index = dict(zip(self.names, range(len(self.names))))
        # Names of parameters that act in no recording: their columns would enlarge every triangle.
        no_drift = () if any(dataset.order for dataset in datasets) else self._drifts
        self._loaded = any(dataset.is_loaded for dataset in datasets)
        empty = () if self._loaded else PAYLOAD_NAMES
        self._nowhere = {*no_drift, *empty}
        self._classify_columns(arm.names)

    def _classify_columns(self, names: Sequence[str]) -> None:
        """Set masks (q,) over the q named parameters, whose columns do not depend on the point.

        One mask each selects parameters of bodies, friction that drifts, parameters whose torque is
        smooth, and links that the model states.
        """
        # Parameters of bodies have no owner in brackets.
        terms, owners = np.array(list(map(split_name, names))).T
        self._of_bodies = owners == ""
        self._drifting = np.isin(terms, _DRIFTING) & np.isin(owners, self.joints)
        self._smooth = self._of_bodies | np.isin(terms, _SMOOTH)
        # Links that the model states, in whose values a torque scale is linearised.
        self._is_stated = np.zeros(len(names), dtype=bool)
        if self.torques == "chain" and not self._loaded:
            for link in other_links(self.robot):
                model = self.robot.links[link]
                if self.usual_bodies[model.body_name] is model.theta:
                    self._is_stated[self.indices(link_names(self.robot, link))] = True

    def with_couplings(self, couplings: tuple[Coupling, ...]) -> Columns:
        """Return columns with only these ``couplings``; cached rows move there from this object."""
        columns = Columns(self.robot, self.datasets, self.torques, couplings)
        columns._link_columns = self._link_columns
        base = self._base
        self._base = None
        if base is not None:
            gravity, delay, rows = base
            names = columns._arm_names
            # A recording's rows are released once they are copied: they take most of the memory.
            fewer = (rows.pop(0).only(names) for _ in self.datasets)
            columns._base = gravity, delay, store_rows(fewer)
        return columns

    def start(self) -> Point:
        """Return the point at the model's own values, with default speeds of friction."""
        speed = {}
        for term, nonlinear in NONLINEAR_TERMS.items():
            speed[term] = np.full(self.robot.n_joints, nonlinear.default_speed)
        return Point(self.model_values, gravity_vector(self.robot), speed=speed)

    def indices(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return the indices (m,) of m named parameters among all p."""
        return np.array([self.index[name] for name in names], dtype=np.int64)

    def bodies(self) -> dict[str, NDArray[np.int64]]:
        """Return the indices (10,) of each body by its name: links, base to terminal, "payload"."""
        indices = {}
        if self.torques == "chain":
            for link in other_links(self.robot):
                name = self.robot.links[link].body_name
                indices[name] = self.indices(link_names(self.robot, link))
        indices[self.robot.body_name] = self.indices(PARAMETER_NAMES)
        indices["payload"] = self.indices(PAYLOAD_NAMES)
        return indices

    @cached_property
    def usual_bodies(self) -> dict[str, Array]:
        """Body name to a plausible body (10,): the model's, or a ball where it is a placeholder."""
        return usual_bodies(self.robot)

    def thetas(self, values: Array, is_loaded: bool = False) -> Array:
        """Return the inertial parameters (n, 10) of the links, taken from parameter values (p,).

        The terminal link includes the payload if ``is_loaded``. With ``torques="terminal"``, all
        other links have the model's values.
        """
        thetas = self.robot.thetas
        if self.torques == "chain":
            for link in other_links(self.robot):
                thetas[link] = values[self.indices(link_names(self.robot, link))]
        thetas[-1] = values[:N_INERTIAL]
        if is_loaded:
            thetas[-1] = thetas[-1] + values[self.indices(PAYLOAD_NAMES)]
        return thetas

    def move_point(
        self, point: Point, values: Array, increments: Sequence[str]
    ) -> Point:
        """Return the next linearisation point, at an estimate made around ``point``.

        The named increments of delay, tilt and friction speeds are added to the point's fields and
        become zero in its values.

        Args:
            values: (p,) the estimate.
        """
        indices = self.indices(increments)
        new = values.copy()
        new[indices] = 0.0
        # (p,) change of each parameter that is an increment, zero for all others.
        steps = values - new
        speed = dict(point.speed or {})
        for term, nonlinear in NONLINEAR_TERMS.items():
            speeds = speed[term].copy()
            # The slope at a speed says little of half or twice that speed.
            bounds = np.clip(np.outer([0.5, 2.0], speeds), *nonlinear.bounds)
            speed_names = names_of(f"{term}_speed", self.joints)
            speeds[list(self.joint_indices)] += steps[self.indices(speed_names)]
            speed[term] = np.clip(speeds, *bounds)
        return replace(
            point,
            values=new,
            gravity=self._tilt_gravity(point, steps[self.indices(self.tilts)]),
            delay=point.delay + float(steps[self.index[DELAY_NAME]]),
            speed=speed,
        )

    def _tilt_gravity(self, point: Point, angles: Array) -> Array:
        """Return a point's gravity (3,), tilted by angles (2,) [rad] about horizontal axes.

        Without gravity, ``angles`` is empty.
        """
        if not np.any(angles):
            return point.gravity
        axes = tilt_axes(gravity_vector(self.robot), point.gravity)
        return turn_gravity(point.gravity, angles, axes)

    def total_tilt(self, point: Point, values: Array) -> Array:
        """Return the tilt angles (2,) [rad] between the model's gravity and that of an estimate.

        Args:
            values: (p,) the estimate around ``point``.
        """
        steps = values[self.indices(TILT_NAMES)]
        return tilt_angles(gravity_vector(self.robot), self._tilt_gravity(point, steps))

    def samples(self, point: Point) -> tuple[DecimatedSamples, ...]:
        """Return the rows of each recording around a point; fill the caches of this object."""
        arm = self._arm_at(point.gravity)
        delayed = [dataset.remove_delay(point.delay) for dataset in self.datasets]
        bases = self._base_rows(point, delayed)
        if point.in_file:
            tilts = self._link_dependent(point, delayed, partial(self._tilt, arm))
            return tuple(map(self._rows_for_file, delayed, bases, tilts))
        loads, zeros_and_tilts = self._smooth_columns(arm, point, delayed)
        linearise = partial(self._linearise, point)
        return tuple(map(linearise, bases, delayed, loads, zeros_and_tilts))

    def _base_rows(
        self, point: Point, delayed: Sequence[Dataset]
    ) -> Iterator[DecimatedSamples]:
        """Yield each recording's columns that depend on no value of the point but its gravity.

        They are cached, and made anew for another delay or a large tilt. They are linear in
        gravity: for a small tilt their change is added, which is as slow as the positions and needs
        no low-pass. The error is within 1e-4 of the change.

        Args:
            delayed: the recordings, with the point's delay removed.
        """
        gravity = point.gravity
        is_cached = False
        if self._base is not None:
            cached_gravity, cached_delay, _ = self._base
            turn = np.linalg.norm(gravity - cached_gravity)
            is_small = turn <= _SMALL_TURN * np.linalg.norm(gravity)
            is_cached = cached_delay == point.delay and bool(is_small)
        if self._base is None or not is_cached:
            equations = self._equations(self._arm_at(gravity))
            rows = store_rows(dataset.samples(equations) for dataset in delayed)
            self._base = gravity, point.delay, rows
        cached_gravity, _, recordings = self._base
        if np.array_equal(cached_gravity, gravity):
            yield from recordings
            return
        # Made anew, not stored: MuJoCo's data cannot be pickled.
        equations = self._equations(self.robot)
        for samples, dataset in zip(recordings, delayed):
            change = equations.rows_of_gravity(
                dataset.motion.q, gravity - cached_gravity
            )
            yield replace(samples, rows=tuple(map(np.add, samples.rows, change)))

    def _arm_at(self, gravity: Array) -> RobotModel:
        """Return the arm under gravity (3,) [m/s^2]; the last one is cached."""
        if self._arm is None or not np.array_equal(self._arm[0], gravity):
            self._arm = gravity, with_gravity(self.robot, gravity)
        return self._arm[1]

    def _equations(self, arm: RobotModel) -> Equations:
        """Return the equations of an arm's joint torques in the columns that are always linear.

        These are links, linear friction and couplings: their columns stay the same whatever the
        estimate is.
        """
        friction = friction_per_joint(arm, self.torques, FrictionModel(LINEAR))
        links = other_links(arm) if self.torques == "chain" else ()
        return Equations(arm, self.torques, friction, self.couplings, links)

    def arm_torque(self, point: Point, is_loaded: bool) -> tuple[Equations, Array]:
        """Return (equations, values (q,) of their q parameters at a point).

        The equations have all columns that do not depend on the point but for its gravity. With
        ``is_loaded``, the values of the terminal link contain the payload. Columns of bodies
        (``Equations.bodies``) contain no sign of a speed and may be computed at fewer instants.
        """
        equations = self._equations(self._arm_at(point.gravity))
        return equations, self._arm_values(point, is_loaded)

    def _arm_values(self, point: Point, is_loaded: bool) -> Array:
        """Return a point's first values (q,), with the payload in the terminal link if loaded."""
        values = point.values[: len(self._arm_names)].copy()
        if is_loaded:
            values[:N_INERTIAL] += point.values[self.indices(PAYLOAD_NAMES)]
        return values

    def _linearise(
        self,
        point: Point,
        base: DecimatedSamples,
        dataset: Dataset,
        load: Array,
        common: Array,
    ) -> DecimatedSamples:
        """Return one recording's rows with the columns that depend on the point.

        Symbols are those of the module's equation: s_j is ``scale``, d_j ``drift``, and t is
        ``dataset.order``.

        Args:
            base: rows with all other columns, under the point's gravity.
            load: (K, joints) columns of friction that grows with a gear's load.
            common: (K, n, n + 2) columns of n encoder zeros and two tilts in each joint's equation.
        """
        friction_columns = {"load": load, **self._nonlinear(dataset, point)}
        values = self._arm_values(point, dataset.is_loaded)
        blocks = []
        right_sides = []
        columns = []
        for row, joint in enumerate(self.joint_indices):
            indices = base.columns[row]
            block = base.rows[row]
            coefficients = values[indices]
            drifting = self._drifting[indices]
            smooth = self._smooth[indices]

            linear = self._scaled_torque(block, indices, coefficients)
            scale_drift = self.indices((self._scales[row], self._drifts[row]))
            scale, drift = point.values[scale_drift]
            # With a payload, bodies count 1 + s_j fold; without, the column of the scale alone
            # contains its effect, as the module says.
            body_scale = self._loaded * scale
            # measured - tau is the torque that depends on no parameter.
            gear = linear + base.measured[row] - base.tau[row]

            joint_friction = {}
            friction = block[:, drifting] @ coefficients[drifting]
            for term, column in friction_columns.items():
                name = f"{term}[{self.joints[row]}]"
                joint_friction[name] = column[:, row]
                if term == "load" or term in NONLINEAR_TERMS:
                    friction += column[:, row] * point.values[self.index[name]]
            drifted = 1.0 + drift * dataset.order

            smooth_torque = block[:, smooth] @ coefficients[smooth]
            late = dataset.delay_column(base.time, smooth_torque)
            nonlinear = np.stack([*joint_friction.values()], axis=1)
            payload_factor = (1.0 + body_scale) * dataset.is_loaded
            # Names of parameters to (their columns (K, b), or a slice of ``block``; a factor).
            point_columns: dict[tuple[str, ...], tuple[Array | slice, Any]] = {
                tuple(joint_friction): (nonlinear, drifted),
                (self._scales[row],): (gear[:, None], 1.0),
                (self._drifts[row],): (friction[:, None], dataset.order),
                (*self._zeros, *self.tilts): (common[:, joint], 1.0 + body_scale),
                (DELAY_NAME,): (late[:, None], 1.0),
                # A payload has the columns of the terminal link, which come first, or zeros.
                PAYLOAD_NAMES: (slice(N_INERTIAL), payload_factor),
            }
            factor = np.where(drifting, drifted, 1.0)
            factor[self._of_bodies[indices]] = 1.0 + body_scale
            names = [group for group in point_columns if group[0] not in self._nowhere]
            point_blocks = map(point_columns.__getitem__, names)
            blocks.append(((slice(None), factor), *point_blocks))
            columns.append(np.concatenate((indices, *map(self.indices, names))))
            tau = base.tau[row] + body_scale * linear + drift * dataset.order * friction
            right_sides.append(tau)
        return replace(
            base,
            names=self.names,
            columns=tuple(columns),
            tau=tuple(right_sides),
            rows=AssembledRows(base.rows, blocks),
        )

    def _scaled_torque(
        self, block: Array, indices: NDArray[np.int64], coefficients: Array
    ) -> Array:
        """Return the torque (K,) of the links that a torque scale multiplies.

        A link that the model states counts with the model's values, in which the scale is
        linearised.

        Args:
            block: (K, m) rows of a joint.
            indices: (m,) of the columns of ``block`` among all p parameters.
            coefficients: (m,) value of each column's parameter.
        """
        bodies = self._of_bodies[indices]
        is_stated = self._is_stated[indices]
        values = np.where(is_stated, self.model_values[indices], coefficients)
        return block[:, bodies] @ values[bodies]

    def _rows_for_file(
        self, dataset: Dataset, base: DecimatedSamples, tilt: Array
    ) -> DecimatedSamples:
        """Return one recording's rows in the parameters of a model file and in gravity's tilt.

        Args:
            base: rows with the columns that do not depend on the point.
            tilt: (K, n, 2) columns of gravity's direction in each joint's equation.
        """
        payload_names = () if PAYLOAD_NAMES[0] in self._nowhere else PAYLOAD_NAMES
        indices = self.indices((*self.tilts, *payload_names))
        # A payload has the columns of the terminal link, which come first, or zeros.
        payload_block = slice(len(payload_names)), dataset.is_loaded
        blocks = []
        columns = []
        for joint, base_columns in zip(self.joint_indices, base.columns):
            tilt_block = tilt[:, joint], 1.0
            blocks.append(((slice(None), 1.0), tilt_block, payload_block))
            columns.append(np.append(base_columns, indices))
        return replace(
            base,
            names=self.names,
            columns=tuple(columns),
            rows=AssembledRows(base.rows, blocks),
        )

    def _tilt(self, arm: RobotModel, thetas: Array, motion: Motion) -> Array:
        """Return the columns of gravity's direction (K, n, 2); none (K, n, 0) without gravity."""
        if not self.tilts:
            return np.zeros((*motion.q.shape, 0))
        return tilt_columns(arm, thetas, motion.q, gravity_vector(self.robot))

    def _link_dependent(
        self,
        point: Point,
        delayed: Sequence[Dataset],
        make: Callable[[Array, Motion], Array],
    ) -> list[Array]:
        """Return columns (K, ...) of each recording that depend on its links.

        Recordings with the payload share calls of ``make``, and so do those without, as most have
        few rows: one call for about ``_TOGETHER`` rows.

        Args:
            delayed: the recordings, with the point's delay removed.
            make: returns columns (m, ...) from links (n, 10) and a motion (m, n).
        """
        columns = dict[int, Array]()
        motions = [dataset.motion for dataset in delayed]
        counts = np.array([len(motion.time) for motion in motions])
        ends = np.cumsum(counts)
        # (whether loaded, number of the batch) to numbers of recordings.
        batches = dict[tuple[bool, int], list[int]]()
        for index, dataset in enumerate(delayed):
            key = dataset.is_loaded, int(ends[index] // _TOGETHER)
            batches.setdefault(key, []).append(index)
        for (is_loaded, _), batch in batches.items():
            # Time, positions, speeds and accelerations, each of all recordings of the batch.
            series = zip(*[vars(motions[index]).values() for index in batch])
            motion = Motion(*map(np.concatenate, series))
            batch_ends = np.cumsum(counts[batch])
            batch_columns = make(self.thetas(point.values, is_loaded), motion)
            columns.update(zip(batch, np.split(batch_columns, batch_ends[:-1])))
        return list(map(columns.__getitem__, range(len(delayed))))

    def _smooth_columns(
        self, arm: RobotModel, point: Point, delayed: Sequence[Dataset]
    ) -> tuple[list[Array], list[Array]]:
        """Return each recording's columns of load (K, joints), and of zeros and tilt (K, n, n + 2).

        They depend on links, gravity and delay only and are cached: trials of friction share them.
        """
        thetas = self.thetas(point.values), self.thetas(point.values, is_loaded=True)
        links = np.array(thetas).tobytes()
        key = (point.delay, point.gravity.tobytes(), links)
        if self._link_columns[0] != key:
            # These columns are smooth and small and need no low-pass: the motion at the instant
            # of a row is accurate enough.
            def common(theta: Array, motion: Motion) -> Array:
                """Return columns (K, n, n + 2) of zeros and tilt for links (n, 10)."""
                zeros = zero_columns(arm, theta, motion)
                return np.concatenate((zeros, self._tilt(arm, theta, motion)), axis=-1)

            zeros_and_tilts = self._link_dependent(point, delayed, common)
            self._link_columns = (key, {}, zeros_and_tilts)
        _, loads, smooth = self._link_columns
        if point.exact_load not in loads:
            dynamics = LinkDynamics(arm)
            rows = list(self.joint_indices)

            def load(theta: Array, motion: Motion) -> Array:
                """Return columns (K, joints) of load for links (n, 10)."""
                torque = dynamics.motion(motion.q, motion.qd, motion.qdd).torque(theta)
                return (np.sign(motion.qd) * np.abs(torque))[:, rows]

            columns = []
            for dataset in delayed:
                make = partial(load, thetas[dataset.is_loaded])
                columns.append(dataset.filter_columns(make, point.exact_load))
            loads[point.exact_load] = columns
        return loads[point.exact_load], smooth

    def _nonlinear(self, dataset: Dataset, point: Point) -> dict[str, Array]:
        """Return the columns (K, joints) of each nonlinear friction term, by the term's name.

        A term that is not zero at the point also has columns of its derivative by the speed, named
        "<term>_speed".
        """
        rows = list(self.joint_indices)
        speed = point.speed or {}
        names = list(NONLINEAR_TERMS)
        # Term to its coefficients (joints,) at the point, where one of them is not zero.
        sizes = {}
        for term in NONLINEAR_TERMS:
            coefficients = point.values[self.indices(names_of(term, self.joints))]
            if np.any(coefficients):
                sizes[term] = coefficients
                names.append(f"{term}_speed")

        def make(motion: Motion) -> Array:
            """Return all terms' columns (K, joints, terms), then those by their speeds."""
            columns = []
            for term, nonlinear in NONLINEAR_TERMS.items():
                columns.append(nonlinear.column(motion.qd, speed[term])[:, rows])
            for term, size in sizes.items():
                slope = NONLINEAR_TERMS[term].slope(motion.qd, speed[term])
                columns.append(size * slope[:, rows])
            return np.stack(columns, axis=-1)

        columns = np.moveaxis(dataset.filter_columns(make, point.exact_load), -1, 0)
        return dict(zip(names, columns))
