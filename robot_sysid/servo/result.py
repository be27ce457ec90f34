"""What comes of an arm without torque sensors: the record, and the sentences printed about it.

n is the number of joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.dynamics.friction import COULOMB, ROTOR, VISCOUS
from robot_sysid.mjcf.updated_model import ElementChange
from robot_sysid.records import Array, DataOrigin, RobotModel
from robot_sysid.records.messages import Detail, aligned_lines, number_text
from robot_sysid.records.quantities import FILE, MODEL, Quantity
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.results.written_model import versions
from robot_sysid.servo.advice import Advice, advice_lines, advice_of
from robot_sysid.servo.derived import Derived, absolute_numbers, derived_numbers
from robot_sysid.servo.fit import LARGEST_ERROR, ServoFit
from robot_sysid.servo.loop import rms
from robot_sysid.servo.play import LINK_ERROR
from robot_sysid.servo.unknowns import SLIP_SPEED
from robot_sysid.simulation.playback import chain_actuators, early_by, servos_in_model

SERVO_SCHEMA = "robot-sysid servo 6"
"""Name and version of the format of servo.json."""
WITHOUT_TORQUE = (
    "No torque was measured: all of this follows from commanded and measured positions, and "
    "absolute sizes from the masses of the model, which fix their scale (the errors include links "
    f"that are off by {100.0 * LINK_ERROR:.0f} %)"
)
WITH_TORQUE = (
    "Absolute sizes follow from the masses of the model and from recorded torques, all else from "
    "commanded and measured positions (the errors include links that are off by "
    f"{100.0 * LINK_ERROR:.0f} % and torques that are off by "
    f"{100.0 * usual_errors.TORQUE_FROM_CURRENT:.0f} %)"
)
IN_FILE = {
    "gain": "N·m/rad",
    **{term.attribute: term.units[0] for term in (VISCOUS, COULOMB, ROTOR)},
}
"""Numbers of a joint in a model file, in the order of ``ServoParameters``, and their units."""
LIMIT = "torque_limit"
"""Name of the largest torque of a servo."""
LIMITED = "limited_damping"
"""Name of the share of damping that a servo commands within it."""
FAST = (
    "the servo swings faster than the samples resolve, so that many numbers move alike: the file "
    "moves like the arm in motions like these, and no number of the servo is known; record at a "
    "higher rate"
)
"""What limits a servo that is too fast for the samples."""
STILL = "the joint does not move in what is fitted of these logs: it keeps the model's numbers"
"""Reason of a joint's numbers that nothing shows."""
WORSE = "a model with what was found predicts positions worse than the model's numbers, which stay"
"""Reason of numbers that held-out windows, or fitted ones, speak against."""
NOT_ALONE = (
    "these logs do not show its absolute size, only ratios of the joint's numbers"
)
"""Reason of a number that goes with the joint's others."""
TAKEN = "taken to be that of all servos"
"""Reason of a number that is not searched."""
NOT_SHOWN = "these logs do not show it"
"""Reason of a number that is no more than what is usual."""


@dataclass(frozen=True)
class ServoIdentification:
    """The result for an arm identified from commands and positions alone.

    Attributes:
        robot: the arm as in the model file.
        fit: what was found.
        is_new: (n,) whether the numbers of a joint in the written model are new; those of joints
            that do not move, or that are predicted worse by what was found, are the model's.
        data: the logs.
        before, after: (n,) root mean square position errors of the models before and after, played
            on held-out windows [rad or m].
        fitted: (n,) the same of the model after on windows that were fitted.
        goal: error of the commands of some time before, where that fits best [rad or m].
        window: length of the held-out windows [s].
        setting: of the recording whose gains are stated.
        notes: sentences for the user.
    """

    robot: RobotModel
    fit: ServoFit
    is_new: NDArray[np.bool_]
    data: DataOrigin
    before: Array
    after: Array
    fitted: Array
    goal: float
    window: float
    setting: ServoSetting
    notes: tuple[str, ...]

    @property
    def quantities(self) -> Iterator[Quantity]:
        """Yield the delay of the commands, what needs no scale, absolute sizes, the speed over
        which the Stribeck part fades, then the file's.

        A gain of a joint without a position actuator has a NaN model.
        """
        fit = self.fit
        in_steps = fit.delay + early_by(self.robot)
        delays = {"command_delay": fit.delay, "simulated_delay": in_steps}
        for name, delay in delays.items():
            yield Quantity(name, "arm", "s", None, delay, fit.delay_error)
        joints = self.robot.joint_names
        in_model = self._in_model()
        for name, found in derived_numbers(self.robot, fit).items():
            yield from self._rows(name, found, None, NOT_SHOWN)
        for name, found in absolute_numbers(fit).items():
            yield from self._rows(name, found, in_model.get(name), NOT_ALONE)
        yield Quantity(
            "slip_speed", "arm", "rad/s", None, SLIP_SPEED, None, MODEL, TAKEN
        )
        in_file = dict(zip(IN_FILE, fit.in_file.numbers))
        in_file[LIMIT] = fit.in_file.limits
        # A joint without any damping has no share of it.
        all_damping = np.maximum(in_file["damping"], LEAST_DAMPING)
        in_file[LIMITED] = fit.in_file.servo_damping / all_damping
        for name, unit in (*IN_FILE.items(), (LIMIT, "N·m"), (LIMITED, "")):
            for k, of in enumerate(joints):
                if self.is_new[k]:
                    model = float(in_model[name][k])
                    value = float(in_file[name][k])
                    yield Quantity(name, of, unit, model, value, None, FILE)

    def _in_model(self) -> dict[str, Array]:
        """Return name to numbers (n,) of the joints in the model."""
        servos = servos_in_model(self.robot)
        share = chain_actuators(self.robot).damping_share
        numbers = dict(zip(IN_FILE, servos.numbers))
        return {**numbers, LIMIT: servos.limits, LIMITED: share}

    def _rows(
        self, name: str, found: Derived, model: Array | None, reason: str
    ) -> Iterator[Quantity]:
        """Yield the rows of one number of all joints; what is not shown has the reason."""
        for k, of in enumerate(self.robot.joint_names):
            in_model = None if model is None else float(model[k])
            value = float(found.values[k])
            error = float(found.errors[k])
            if not self.fit.is_known[k]:
                yield Quantity(
                    name, of, found.unit, in_model, value, np.inf, MODEL, STILL
                )
            elif model is not None and error > LARGEST_ERROR * value:
                yield Quantity(
                    name, of, found.unit, in_model, value, error, MODEL, reason
                )
            else:
                yield Quantity(name, of, found.unit, in_model, value, error)

    @property
    def is_better(self) -> bool:
        """Whether the new model plays held-out windows better than all that there is without it."""
        return rms(self.after) < min(rms(self.before), self.goal)

    @property
    def scale_text(self) -> str:
        """What absolute sizes follow from, in words."""
        by_torque = self.fit.by_torque
        is_used = by_torque is not None and bool(np.any(by_torque.is_used))
        return WITH_TORQUE if is_used else WITHOUT_TORQUE

    @property
    def traces(self) -> None:
        """Torques over time, which nothing measured."""

    @cached_property
    def advice(self) -> list[Advice]:
        """Which gains leave less dead band and sag."""
        return advice_of(self.robot, self.fit, self.setting)

    @property
    def expected(self) -> float:
        """Position error to expect on other motions: a short end of a log may be an easy one."""
        return max(rms(self.after), rms(self.fitted))

    def changes(self) -> Iterator[ElementChange]:
        """Yield the changes of the model file's joints and of their position actuators.

        Damping beside the servo's limit of torque is that of the joint, as back-EMF is. An
        actuator's numbers are those at the motor: a gear g makes its gains g^2 times as large at
        the joint, and its torque g times.
        """
        actuators = chain_actuators(self.robot)
        servos = self.fit.in_file
        for k in np.flatnonzero(self.is_new).tolist():
            numbers = dict(zip(IN_FILE, servos.numbers[:, k].tolist()))
            stiffness = numbers.pop("gain")
            numbers["solimpfriction"] = float(servos.firmness[k])
            own_damping = float(servos.servo_damping[k])
            numbers["damping"] -= own_damping
            # A joint's own range would cut what its servo gives.
            if actuators.limit[k] < servos.limits[k]:
                numbers.update(self._ranges_of_joint(k))
            yield ElementChange("joint", self.robot.joint_names[k], numbers)
            if np.isfinite(actuators.stiffness[k]):
                gear = float(actuators.gear[k])
                gains = {"kp": stiffness / gear**2}
                if own_damping or actuators.damping_share[k]:
                    gains["kv"] = own_damping / gear**2
                if np.isfinite(servos.limits[k]):
                    gains["forcerange"] = float(servos.limits[k]) / abs(gear)
                yield ElementChange("actuator", int(actuators.index[k]), gains)

    def _ranges_of_joint(self, k: int) -> dict[str, float]:
        """Return the range of torques of a joint that has one, as its servo's limit is."""
        model = self.robot.mj_model
        joint = model.dof_jntid[self.robot.dof_index[k]]
        if not model.jnt_actfrclimited[joint]:
            return {}
        return {"actuatorfrcrange": float(self.fit.in_file.limits[k])}

    def json_content(self) -> dict[str, Any]:
        """Return the content of servo.json, which ``json_text`` turns into text."""
        return {
            "schema": SERVO_SCHEMA,
            "torque": self.scale_text,
            "setting": str(self.setting),
            "quantities": [*self.quantities],
            "joint_names": self.robot.joint_names,
            "advice": [advice.json_content() for advice in self.advice],
            "rollout": {
                "window": self.window,
                "before": self.before,
                "after": self.after,
                "fitted": self.fitted,
                "goal": self.goal,
            },
            "source": self.data.description,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


COLUMNS = {
    "dead_band": ("dead band, deg", 180.0 / np.pi),
    "sag": ("sag, deg", 180.0 / np.pi),
    "friction_over_gain": ("friction/gain, deg", 180.0 / np.pi),
    "even_speed": ("viscous = dry at, rad/s", 1.0),
    "torque_over_weight": ("torque/weight", 1.0),
    "gain": ("gain, N·m/rad", 1.0),
    LIMIT: ("torque limit, N·m", 1.0),
    "damping": ("damping, N·m·s/rad", 1.0),
    "frictionloss": ("dry friction, N·m", 1.0),
    "armature": ("rotor, kg·m²", 1.0),
    "load_share": ("friction/load", 1.0),
}
"""Name of a number to the heading of its column in the printed tables, and its factor there."""
RATIOS = tuple(COLUMNS)[:5]
"""Numbers that need no scale."""
SIZES = tuple(COLUMNS)[5:]
"""Numbers whose scale is that of the model's masses."""
LEAST_DAMPING = 1e-12
"""Damping that is none [N m s/rad]."""
NOTHING = 1e-9
"""Size below which a number is rounding, as the sag of a joint that carries no weight."""
UNKNOWN = "?"
"""Cell of a number that the logs do not show."""


def servo_lines(result: ServoIdentification) -> Iterator[str]:
    """Yield the printed lines of a result: the table of its sizes, and advice.

    Delays and ratios, and errors of rollouts, are details.
    """
    rows = {(row.name, row.of): row for row in result.quantities if row.source != FILE}
    legend = f"± one standard error; {UNKNOWN}: these logs do not show it"
    yield Detail(f"Servos ({legend}):")
    for name in ("command_delay", "simulated_delay"):
        row = rows[name, "arm"]
        error = row.error or 0.0
        value = number_text(row.value, error) if row.value else "0.0000"
        words = name.replace("_", " ")
        yield Detail(f"  arm {words}  {value}  {number_text(error, error)}  s")
    # Of a joint whose sizes do not show, the ratios are the answer.
    gains = [rows[SIZES[0], joint] for joint in result.robot.joint_names]
    has_size = [_is_shown(row.value, row.error or 0.0) for row in gains]
    heading, *ratios = _matrix(result, rows, RATIOS)
    yield Detail(heading) if all(has_size) else heading
    for is_detail, line in zip(has_size, ratios):
        yield Detail(line) if is_detail else line
    yield Detail(f"  {result.scale_text}:")
    yield from _matrix(result, rows, SIZES)
    yield f"  {legend}"
    yield from advice_lines(result.advice)
    yield Detail(
        f"In windows of {result.window:.2g} s that were not fitted: root mean square position "
        f"error {rms(result.before):.3g} rad of the model before, {rms(result.after):.3g} of the "
        f'new one, {result.goal:.3g} of "position = command of some time before". On other '
        f"motions expect {result.expected:.2g} rad: the larger of this and "
        f"{rms(result.fitted):.3g} on "
        "what was fitted"
    )


def _matrix(
    result: ServoIdentification,
    rows: dict[tuple[str, str], Quantity],
    names: tuple[str, ...],
) -> list[str]:
    """Return lines with a row for each joint and a column for each number, below headings."""
    table = [["", *(COLUMNS[name][0] for name in names)]]
    for joint in result.robot.joint_names:
        cells = []
        for name in names:
            row = rows[name, joint]
            factor = COLUMNS[name][1]
            cells.append(_cell(factor * row.value, factor * (row.error or 0.0)))
        table.append([joint, *cells])
    return [f"  {line}" for line in aligned_lines(table)]


def _cell(value: float, error: float) -> str:
    """Return a number with its error, or that it is not shown."""
    if abs(value) < NOTHING and error < NOTHING:
        return "0"
    if not _is_shown(value, error):
        return UNKNOWN
    return f"{number_text(value, error)} ± {number_text(error, error)}"


def _is_shown(value: float, error: float) -> bool:
    """Return whether logs show a number."""
    return error < LARGEST_ERROR * abs(value)


def servo_notes(result: ServoIdentification) -> Iterator[str]:
    """Yield sentences on the weak points of a result."""
    if result.fit.by_torque is not None:
        yield from result.fit.by_torque.notes
    names = np.array(result.robot.joint_names)
    bodies = {body.body_id for link in result.robot.links for body in link.bodies}
    if np.any(result.robot.mj_model.body_gravcomp[sorted(bodies)]):
        yield (
            "the model compensates gravity (gravcomp), which no servo of a position does: files "
            "were judged without it and keep it, so that they move otherwise; set gravcomp to 0 "
            "in the model, and identify again"
        )
    still = names[~result.fit.is_known]
    if len(still):
        yield f"{', '.join(still)}: {STILL}"
    fast = names[result.fit.is_fast]
    if len(fast):
        yield f"{', '.join(fast)}: {FAST}"
    worse = names[result.fit.is_known & ~result.is_new]
    if len(worse):
        yield f"{', '.join(worse)}: {WORSE}"
    has_servo = np.isfinite(chain_actuators(result.robot).stiffness)
    without = names[result.is_new & ~has_servo]
    if len(without):
        yield (
            f"the model has no position actuator on {', '.join(without)}: the gain is printed, but "
            "not written"
        )
