"""What comes of an arm without torque sensors: the record, and the sentences printed about it.

n is the number of joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import COULOMB, ROTOR, VISCOUS
from robot_sysid.mjcf.updated_model import ElementChange
from robot_sysid.records import Array, DataOrigin, RobotModel, file_access
from robot_sysid.records.quantities import DATA, MODEL, Quantity
from robot_sysid.results.table import cells, label, table_lines
from robot_sysid.results.written_model import versions
from robot_sysid.servo.equations import LINK_ERROR
from robot_sysid.servo.fit import ServoFit
from robot_sysid.servo.loop import rms
from robot_sysid.servo.windows import WINDOW
from robot_sysid.simulation.playback import chain_actuators, early_by, servos_in_model

SERVO_SCHEMA = "robot-sysid servo 5"
"""Name and version of the format of servo.json."""
WITHOUT_TORQUE = (
    "No torque was measured: all of this follows from commanded and measured positions, and from "
    "the masses of the model, which fix its scale (the errors include links that are "
    f"off by {100.0 * LINK_ERROR:.0f} %)"
)
UNITS = {
    "gain": "N·m/rad",
    **{term.attribute: term.units[0] for term in (VISCOUS, COULOMB, ROTOR)},
}
"""The identified numbers of a joint, in the order of ``ServoParameters``, and their units."""
STILL = (
    "the joint moves too little or too slowly in these logs, or its servo is nearly always at its "
    "torque limit: it keeps the model's numbers"
)
"""Reason of a joint's numbers that nothing shows."""
LIMITED = (
    "its servo is at its torque limit in most of its motion: it keeps the model's numbers; move it "
    "more gently"
)
"""Reason of a joint's numbers of which too few samples beside the limit are left."""
MOSTLY = 0.5
"""Share of limited samples from which the limit is the reason that nothing is known."""
LEAST_LIMITED = 0.005
"""Share of samples at a limit from which it is worth a sentence."""
UNTIMED = (
    "the servos are at their torque limits for so long that it is not known, and the one that is "
    "printed may be tens of milliseconds off; move the arm more gently"
)
"""Reason of a delay that is not known."""
WORSE = (
    "what was found predicts positions worse than the model's numbers, which all stay"
)
"""Reason of numbers that held-out windows, or fitted ones, speak against."""
NOT_ALONE = (
    "these logs do not show its absolute size, only ratios of the joint's numbers"
)
"""Reason of a number that goes with the joint's others."""


@dataclass(frozen=True)
class ServoIdentification:
    """The result for an arm identified from commands and positions alone.

    Attributes:
        robot: the arm as in the model file.
        fit: the numbers that are written; joints that do not move or that are predicted worse by
            what was found keep all of the model's.
        is_new: (n,) whether the numbers of a joint are not the model's.
        data: the logs.
        before, after: (n,) root mean square position errors of the models before and after, played
            on held-out windows [rad or m].
        goal: error of the commands of some time before, where that fits best [rad or m].
        notes: sentences for the user.
    """

    robot: RobotModel
    fit: ServoFit
    is_new: NDArray[np.bool_]
    data: DataOrigin
    before: Array
    after: Array
    goal: float
    notes: tuple[str, ...]

    @property
    def quantities(self) -> Iterator[Quantity]:
        """Yield the delay of the commands, dead zones, then each of ``UNITS`` of all joints.

        A gain of a joint without a position actuator has a NaN model.
        """
        fit = self.fit
        in_steps = fit.delay + early_by(self.robot)
        source, reason = (MODEL, UNTIMED) if np.isinf(fit.delay_error) else (DATA, "")
        delays = {"command_delay": fit.delay, "simulated_delay": in_steps}
        for name, delay in delays.items():
            error = fit.delay_error
            yield Quantity(name, "arm", "s", None, delay, error, source, reason)
        for k in np.flatnonzero(fit.dead_zones).tolist():
            found = fit.dead_zones[k], fit.dead_zone_errors[k]
            yield Quantity("dead_zone", self.robot.joint_names[k], "rad", 0.0, *found)
        before = servos_in_model(self.robot).numbers
        is_limited = ~fit.is_known & (fit.limited_share > MOSTLY)
        cases = [is_limited, ~fit.is_known, ~self.is_new, ~fit.is_shown]
        reasons = np.select(cases, [LIMITED, STILL, WORSE, NOT_ALONE], "")
        arrays = before, fit.numbers, fit.errors, reasons
        for (name, unit), *rows in zip(UNITS.items(), *arrays):
            for of, model, value, error, reason in zip(self.robot.joint_names, *rows):
                source = MODEL if reason else DATA
                yield Quantity(name, of, unit, model, value, error, source, reason)

    @property
    def is_better(self) -> bool:
        """Whether the new model plays held-out windows better than all that there is without it."""
        return rms(self.after) < min(rms(self.before), self.goal)

    def changes(self) -> Iterator[ElementChange]:
        """Yield the changes of the model file's joints and of their position actuators.

        Of the damping of joint and servo together, the servo gets its share in the model as its kv,
        the joint the remainder. An actuator's numbers are those at the motor: a gear g makes them
        g^2 times as large at the joint.
        """
        actuators = chain_actuators(self.robot)
        for k in np.flatnonzero(self.is_new):
            numbers = dict(zip(UNITS, self.fit.numbers[:, k]))
            stiffness = numbers.pop("gain")
            kv = actuators.damping_share[k] * numbers["damping"]
            numbers["damping"] -= kv
            yield ElementChange("joint", self.robot.joint_names[k], numbers)
            if np.isfinite(actuators.stiffness[k]):
                squared_gear = actuators.gear[k] ** 2
                gains = {"kp": stiffness / squared_gear}
                if kv:
                    gains["kv"] = kv / squared_gear
                yield ElementChange("actuator", int(actuators.index[k]), gains)

    def json_content(self) -> dict[str, Any]:
        """Return the content of servo.json, which ``json_text`` turns into text."""
        return {
            "schema": SERVO_SCHEMA,
            "torque": WITHOUT_TORQUE,
            "quantities": [*self.quantities],
            "joint_names": self.robot.joint_names,
            "rollout": {"before": self.before, "after": self.after, "goal": self.goal},
            "source": self.data.description,
            "duration": self.data.duration,
            "model": {"path": str(self.robot.path), "sha256": self.robot.sha256},
            "versions": versions(),
            "notes": self.notes,
        }


def servo_lines(result: ServoIdentification) -> Iterator[str]:
    """Yield the printed lines of a result: the table of its numbers, and errors of rollouts."""
    yield "Servos, friction and rotor inertia (prior: the logs do not show a number alone):"
    yield f"  {WITHOUT_TORQUE}."
    rows = file_access.strict_json([*result.quantities])
    yield from table_lines(cells(row, f"{row['of']} {label(row)}") for row in rows)
    yield (
        f"Played on held-out windows of {WINDOW:g} s: root mean square position error "
        f"{rms(result.before):.3g} rad of the model before, {rms(result.after):.3g} of the new "
        f'one, {result.goal:.3g} of "position = command of some time before"'
    )


def servo_notes(result: ServoIdentification) -> Iterator[str]:
    """Yield sentences on the weak points of a result."""
    for row in result.quantities:
        titles = {"gain": f"gain of {row.of}", "command_delay": "delay of the commands"}
        if row.name in titles and row.reason:
            yield f"{titles[row.name]}: {row.reason}"
    fit = result.fit
    for k in np.flatnonzero(
        fit.is_known & (fit.limited_share > LEAST_LIMITED)
    ).tolist():
        yield (
            f"the servo of {result.robot.joint_names[k]} reaches its torque limit: these "
            f"{100.0 * fit.limited_share[k]:.0f} % of its motion are left out; gentler motion "
            "shows more"
        )
    if np.any(fit.dead_zones):
        yield (
            "the written model has no dead zone, as MuJoCo has none: in a simulation, give the "
            "servos q + e - clip(e, -dead_zone, dead_zone) with e = command - q"
        )
    has_servo = np.isfinite(chain_actuators(result.robot).stiffness)
    without = np.array(result.robot.joint_names)[result.is_new & ~has_servo]
    if len(without):
        yield (
            f"the model has no position actuator on {', '.join(without)}: the gain is printed, but "
            "not written"
        )
