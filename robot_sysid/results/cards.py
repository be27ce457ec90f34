"""Cards: a payload in the form of each controller, as text to copy, and an arm in that of each
simulator, as Python to import.

Each form is a Jinja template of ``card_templates``, confirmed by its maker's own documentation or
source. Numbers of a payload end at the second digit of their standard error, which the plain form
states; those of an arm are those of the written model, to ``EXACT_DIGITS``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from xml.sax.saxutils import quoteattr

import numpy as np

from robot_sysid import spatial
from robot_sysid.dynamics.straight_friction import (
    load_shares,
    loaded_friction,
    straight_friction,
)
from robot_sysid.errors import ExportError
from robot_sysid.mjcf.inertial import sum_theta
from robot_sysid.model.bodies import body_theta
from robot_sysid.model.chain import shared_motors
from robot_sysid.records import Array, InertialParameters, RobotModel, Traces
from robot_sysid.records.controllers import ALL, AUTO, CHOICES, SIMULATORS, makers_of
from robot_sysid.records.levels import INTERVAL, SURE
from robot_sysid.records.messages import printable, with_error
from robot_sysid.records.quantities import (
    DATA,
    FILE,
    BodyEstimate,
    Quantity,
    load_errors,
    principal_moments,
)
from robot_sysid.results.record import Payload
from robot_sysid.simulation.playback import chain_actuators

# Folder with a template for the plain form, for each of ``controllers.CHOICES`` but two, and for
# each of ``controllers.SIMULATORS``.
TEMPLATES = Path(__file__).with_name("card_templates")
DIGITS = 9
"""Largest number of significant digits of a number that people type into a controller."""
EXACT_DIGITS = 12
"""Number of significant digits of a number that a simulator reads: the margin of a possible body
is 1e-11 of its size."""
# Share of the largest number of a group below which a number is rounding error: about 1e4 times the
# relative rounding error of a double.
_ROUNDING = 1e-12
COMMENT_WIDTH = 100
"""Largest number of characters of a comment's line, as in the templates."""
CONTROLLER_ROUNDING = 1e-6
"""Share of the sum of principal moments that a controller does not keep."""
UNKNOWN_DIGITS = 1
"""Number of significant digits of a number that the data does not determine: a stand-in."""
MOMENTS = ("Ixx_about_com", "Iyy_about_com", "Izz_about_com")
"""Names of the rows of a link's moments of inertia about its centre of mass."""
UNCHANGED = "as in the model before"
"""Comment of a body whose numbers an identification left alone."""
NOT_SHOWN = "the logs do not show its inertia"
"""Comment of a body whose inertia is the model's, or only keeps the body possible."""
IN_FILE = {"gain": "stiffness", "torque_limit": "effort_limit"}
"""Name of a servo's number to the name under which a card has that of the written model."""
POSITIVE = ("gain", "torque_limit", "damping", "armature")
"""Numbers without which there is no servo."""
SERVO_NUMBERS = (
    *POSITIVE,
    "limited_damping",
    "frictionloss",
    "stribeck",
    "load_share",
    "load_stribeck",
    "dead_zone",
    "loop_lag",
)
"""Numbers of a joint behind a servo in a card."""
FRICTION_SHARE = 0.8
"""Share of the identified friction that is written for an arm's driver: one that compensates more
than there is, as after a joint has warmed up, makes it run away."""
STEEPNESS = 100.0
"""How steep the step of dry friction at rest is, where a driver wants a number [s/rad]: it rises
within 0.01 rad/s, as in motions for Damiao motors. No log of a moving arm tells it."""
NOT_KNOWN = "Inertia not known: a ball of aluminium of that mass stands in its place."
"""Note of a card whose inertia the data does not determine."""


class LogResult(Protocol):
    """What a card reads of the result of logs."""

    @property
    def quantities(self) -> Iterable[Quantity]:
        """Its rows."""

    @property
    def traces(self) -> Callable[..., Traces] | None:
        """Torques over time; None where none was measured."""


@dataclass(frozen=True)
class ServoNumbers:
    """Joints behind servos, as a card states them.

    Attributes:
        numbers: joint name to name and value of ``SERVO_NUMBERS``; of joints that did not move
            those of the written model, as far as it has them.
        ranges: joint name to name and (low, high) of those of them that are known.
        delay: time by which commands act late, and its (low, high) [s].
        slip_speed: over which the Stribeck part of friction fades [rad/s].
    """

    numbers: dict[str, dict[str, float | None]]
    ranges: dict[str, dict[str, tuple[float | None, float | None]]]
    delay: tuple[float | None, tuple[float | None, float | None]]
    slip_speed: float


def card_text(
    payload: Payload, numbers: Mapping[str, Any], robot: RobotModel, choice: str = AUTO
) -> str:
    """Return the text of payload_card.txt: the payload with its errors, then the chosen cards.

    Args:
        payload: the payload.
        numbers: its ``number_groups``.
        robot: the arm, whose names tell the controller.
        choice: of ``controllers.CHOICES``; ``AUTO`` for the arm's own controller.
    """
    own = makers_of(robot)
    chosen = list(own) if choice == AUTO else [choice]
    if choice == ALL:
        others = [key for key in CHOICES if key not in (*own, AUTO, ALL)]
        chosen = [*own, *others]
    flange = payload.flange
    exact = np.zeros(4)
    quaternion = spatial.quaternion(flange.rotation)
    texts = []
    for name in ("plain", *chosen):
        text = _template(name).render(
            numbers,
            model=robot.path.name,
            recordings=payload.recordings,
            flange=flange,
            flange_origin=round_to_errors(flange.translation, exact),
            flange_quaternion=round_to_errors(quaternion, exact),
            errors=load_errors(payload).tolist(),
            inertia_lines=textwrap.wrap(
                inertia_source(payload), COMMENT_WIDTH - len("# ")
            ),
            choices=[key for key in CHOICES if key != AUTO] if choice == AUTO else [],
        )
        texts.append(text)
    return "\n".join(texts)


def arm_card(
    software: str,
    robot: RobotModel,
    written: RobotModel,
    model_name: str,
    curved: str = "",
    result: LogResult | None = None,
    base: str = "",
    scale: Array | None = None,
) -> str:
    """Return the numbers of a written model as text that a simulator or an arm's software reads.

    Args:
        software: of ``controllers.SIMULATORS`` or ``controllers.DRIVERS``.
        robot: the arm as in the original model.
        written: the same arm as in the written model.
        model_name: name of the file of the written model.
        curved: name of the file whose friction bends with speed; "" where there is none.
        result: of the logs, which says how fast joints were, what friction grows with load, what
            each inertia comes from and what servos do; None where there is none that knows it.
        base: name of the first link of a URDF, which some readers leave free in the air; "" else.
        scale: (n,) how many times too large the torque of each joint reads in the logs, as in
            what its driver commands; None for 1.
    """
    rows = tuple(result.quantities) if result else ()
    not_shown = _links_without_inertia(rows)
    original = {body.name: body.theta for link in robot.links for body in link.bodies}
    bodies = {}
    merged = {}
    sources = {}
    links = {}
    for joint, link in zip(written.joint_names, written.links):
        # What hangs on joints of its own, such as fingers, is not identified.
        parts = [
            body
            for body in link.bodies
            if body.welded and np.any((body.theta, original[body.name]))
        ]
        for body in parts:
            theta = body_theta(written.mj_model, body.body_id)
            bodies[body.name] = _exact_numbers(theta)
            if np.allclose(body.theta, original[body.name], 1e-9, 1e-12):
                sources[body.name] = UNCHANGED
            elif link.body_name in not_shown:
                sources[body.name] = NOT_SHOWN
        if len(parts) > 1:
            others = [body.name for body in parts[1:]]
            merged[parts[0].name] = others, _exact_numbers(sum_theta(parts))
        if parts:
            links[joint] = _exact_numbers(sum_theta(parts))
    traces = result.traces(every_sample=False) if result and result.traces else None
    friction = straight_friction(written, traces)
    actuators = chain_actuators(written)
    # Of servos that were identified, a simulator has one damping: that of servo and joint.
    own_damping = _has_servos(rows) * actuators.damping_share * actuators.damping
    columns = {
        "armature": written.armature,
        "damping": friction.viscous + own_damping,
        "frictionloss": friction.dry,
        "effort_limit": written.limits.torque,
    }
    joints = {}
    for index, name in enumerate(written.joint_names):
        joints[name] = {key: _exact(column[index]) for key, column in columns.items()}
    servos = _servo_numbers(rows, joints)
    loaded = {}
    shares = load_shares(rows)
    for name, of_joint in loaded_friction(written, friction, traces, shares).items():
        loaded[name] = {
            "friction_base": _exact(of_joint.base),
            "friction_viscous": _exact(of_joint.viscous),
            "load_friction_motor": _exact(of_joint.load),
        }
    scales = np.ones(written.n_joints) if scale is None else scale
    return _template(software).render(
        simulator=SIMULATORS.get(software),
        links=links,
        scales=dict(zip(written.joint_names, map(_exact, scales.tolist()))),
        driver_friction=_driver_friction(joints, scales),
        friction_share=FRICTION_SHARE,
        steepness=STEEPNESS,
        model=robot.path.name,
        file=model_name,
        base=base,
        curved=curved,
        bodies=bodies,
        sources=sources,
        merged=merged,
        joints=joints,
        loaded=loaded,
        servos=servos,
        dc_motors=_dc_motors(written, joints, servos, own_damping) if servos else (),
        replaced=friction.replaced,
        gravity=tuple(map(_exact, written.mj_model.opt.gravity)),
        has_shared_motors=bool(shared_motors(written.mj_model, written.dof_index)),
        has_nameless=any(name.startswith("#") for name in (*bodies, *joints)),
    )


def _driver_friction(
    joints: Mapping[str, Mapping[str, float | None]], scales: Array
) -> dict[str, list[float]]:
    """Return "coulomb" and "viscous" friction per joint, as a driver compensates it.

    It is ``FRICTION_SHARE`` of the identified friction [N m, N m s/rad], in the unit of what the
    driver commands, which reads ``scales`` (n,) times too large.
    """
    columns = {"coulomb": "frictionloss", "viscous": "damping"}
    friction = {}
    for name, key in columns.items():
        identified = np.array([joint[key] or 0.0 for joint in joints.values()])
        friction[name] = round_to_errors(
            FRICTION_SHARE * scales * identified, np.full(len(scales), np.inf), 2
        )
    return friction


def _has_servos(rows: Sequence[Quantity]) -> bool:
    """Return whether rows are of servos that were identified."""
    return any(row.name == "command_delay" for row in rows)


def _servo_numbers(
    rows: Sequence[Quantity], joints: dict[str, dict[str, float | None]]
) -> ServoNumbers | None:
    """Return what rows say of servos; None where they say nothing.

    The numbers of the written model's servos are added to its joints, None for those that it lacks.
    """
    if not _has_servos(rows):
        return None
    found = {(row.name, row.of): row for row in rows if row.source != FILE}
    in_file = {(row.name, row.of): row.value for row in rows if row.source == FILE}
    numbers = {}
    ranges = {}
    for joint, of_joint in joints.items():
        for name, key in IN_FILE.items():
            of_model = found[name, joint].model
            value = in_file.get(
                (name, joint), math.nan if of_model is None else of_model
            )
            of_joint[key] = _exact(value)
        of_file = {**of_joint, **{name: of_joint[key] for name, key in IN_FILE.items()}}
        values: dict[str, float | None] = {}
        known = {}
        for name in SERVO_NUMBERS:
            row = found[name, joint]
            if row.error is None or not math.isfinite(row.error):
                values[name] = of_file.get(name, 0.0)
            else:
                values[name] = _exact(row.value)
                known[name] = _range(row)
        numbers[joint] = values
        ranges[joint] = known
    delay = found["command_delay", "arm"]
    return ServoNumbers(
        numbers=numbers,
        ranges=ranges,
        delay=(_exact(delay.value), _range(delay)),
        slip_speed=found["slip_speed", "arm"].value,
    )


def _range(row: Quantity) -> tuple[float | None, float | None]:
    """Return the interval of a row's number that is not negative, as far as it is possible.

    What is positive is as uncertain to both sides by its factor.
    """
    assert row.error is not None
    high = row.value + INTERVAL * row.error
    low = max(row.value - INTERVAL * row.error, 0.0)
    if row.name in POSITIVE:
        low = row.value**2 / high
    return _exact(low), _exact(high)


def _dc_motors(
    written: RobotModel,
    joints: Mapping[str, Mapping[str, float | None]],
    servos: ServoNumbers,
    own_damping: Array,
) -> list[str]:
    """Return a line of MJCF for each servo with a torque limit: a motor of 1 V with back-EMF.

    With torque constant k = d / t and resistance R = d / t^2, of damping d and torque limit t, the
    torque k (1 V - k v) / R at speed v is t - d v. The controller asks for gain times position
    error, less d v and the servo's own damping, as far as the voltage suffices.
    """
    delay, _ = servos.delay
    late = ""
    if delay:
        samples = math.ceil(delay / written.mj_model.opt.timestep)
        late = f' delay="{delay:.6g}" nsample="{samples}"'
    lines = []
    for (name, numbers), own in zip(joints.items(), own_damping.tolist()):
        gain, limit, damping = map(
            numbers.get, ("stiffness", "effort_limit", "damping")
        )
        beside = (damping or 0.0) - own
        if gain and limit and beside > 0.0:
            lines.append(
                f"<dcmotor name={quoteattr(name)} joint={quoteattr(name)} "
                f'input="pos" motorconst="{beside / limit:.9g}" '
                f'resistance="{beside / limit**2:.9g}" '
                f'controller="{gain:.9g} 0 {damping:.9g} 0 0 1"{late}/>'
            )
    return lines


def _links_without_inertia(quantities: Sequence[Quantity]) -> set[str]:
    """Return the names of links of which no moment of inertia follows from the data.

    One does where the data says more of it than the model, and it exceeds ``SURE`` errors.
    """
    moments = [row for row in quantities if row.name in MOMENTS]
    shown = set()
    for row in moments:
        if row.source == DATA and row.value > SURE * (row.error or 0.0):
            shown.add(row.of)
    return {row.of for row in moments} - shown


def _exact_numbers(theta: Array) -> dict[str, Any]:
    """Return mass, centre of mass and the inertia about it, xx yy zz xy xz yz, of theta (10,)."""
    body = InertialParameters(theta)
    inertia = spatial.fullinertia_from_symmetric(body.inertia_com)
    # Nothing but rounding.
    inertia[np.abs(inertia) < _ROUNDING * np.max(np.abs(inertia))] = 0.0
    return {
        "mass": _exact(body.mass),
        "com": tuple(map(_exact, body.com)),
        "inertia": tuple(map(_exact, inertia)),
    }


def _exact(value: float) -> float | None:
    """Return a number with ``EXACT_DIGITS``; None where it is infinite, which is no limit."""
    return float(f"{value:.{EXACT_DIGITS}g}") + 0.0 if math.isfinite(value) else None


def _template(name: str) -> Any:
    """Return the Jinja template of ``card_templates`` by its name without suffix."""
    # Imported here: only cards are made of templates.
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
        # Names of frames and files are a stranger's: none begins a line.
        finalize=lambda value: printable(str(value)),
    )
    environment.filters.update(n=join_numbers, pm=_number_with_error, py=repr)
    return environment.get_template(f"{name}.txt")


def number_groups(body: BodyEstimate) -> dict[str, Any]:
    """Return name to number or numbers of a payload, from which every form takes its own.

    The inertia [kg m^2] is about the centre of mass, in axes of the flange. Numbers end at the
    second digit of their error; the inertia gets more where fewer would make an impossible body.

    Raises:
        ExportError: no rigid body has these parameters.
    """
    mass, com, inertia = spatial.com_from_theta(body.theta)
    moments, axes = spatial.principal_axes(inertia)
    # Rounding of an inertia about a distant origin hides a small one about the centre of mass.
    rounding = _ROUNDING * abs(mass) * float(com @ com)
    if np.max(np.abs(moments)) <= rounding:
        inertia = np.zeros((3, 3))
        moments = np.zeros(3)
        axes = np.eye(3)
    if np.ptp(moments) <= rounding + _ROUNDING * np.max(np.abs(moments)):
        # Any axes are principal ones: those of the frame, not those that rounding happens to give.
        moments = np.diag(inertia)
        axes = np.eye(3)
    if mass <= 0.0 or not _is_possible(moments, rounding):
        listed = ", ".join(f"{moment:.4g}" for moment in moments)
        raise ExportError(
            f"a payload of {mass:.4g} kg with principal moments of inertia {listed} kg·m² is not "
            "a possible rigid body, so there is no card for a controller; record longer or faster "
            "motion"
        )
    errors = load_errors(body)
    _, moment_errors = principal_moments(body)
    six = spatial.six_from_symmetric(inertia)
    upper = _round_to_possible(six, errors[4:], _principal_moments_of, rounding)
    rounded = spatial.symmetric_from_six(np.array(upper))
    principal = _round_to_possible(moments, moment_errors, np.sort, rounding)
    angles = np.degrees(spatial.roll_pitch_yaw(axes)[::-1])
    # Fewer decimals would change its length: controllers refuse one that is not 1.
    quaternion = np.round(spatial.quaternion(axes), 6) + 0.0
    return {
        "kg": round_to_errors([mass], errors[:1])[0],
        "com_m": round_to_errors(com, errors[1:4]),
        "com_mm": round_to_errors(1e3 * com, 1e3 * errors[1:4]),
        "inertia_xx_xy_xz_yy_yz_zz": upper,
        "inertia_xx_yy_zz_xy_xz_yz": spatial.fullinertia_from_symmetric(
            rounded
        ).tolist(),
        "inertia_by_columns": rounded.T.ravel().tolist(),
        "principal_moments": principal,
        "axes_yaw_pitch_roll_deg": (np.round(angles, 5) + 0.0).tolist(),
        "axes_quaternion_wxyz": quaternion.tolist(),
    }


def inertia_source(body: BodyEstimate) -> str:
    """Return how the inertia of a payload's cards was made, and how well it is known.

    Every card that states an inertia says so beside it: what is copied into a controller has no ±.
    """
    moments, errors = principal_moments(body)
    if not np.all(np.isfinite(errors)):
        return NOT_KNOWN
    listed = ", ".join(map(with_error, moments.tolist(), errors.tolist()))
    if np.all(moments >= SURE * errors):
        return f"Inertia identified: principal moments {listed} kg m^2."
    return (
        f"Inertia identified in part: principal moments {listed} kg m^2. Those within three ± of "
        "zero are not known."
    )


def _is_possible(moments: Array, rounding: float) -> bool:
    """Return whether a rigid body has these principal moments (3,) [kg m^2], but for rounding."""
    tolerance = CONTROLLER_ROUNDING * np.sum(np.abs(moments)) + rounding
    triangle_excess = 2.0 * np.max(moments) - np.sum(moments)
    return max(-np.min(moments), triangle_excess) <= tolerance


def _principal_moments_of(six: Array) -> Array:
    """Return the principal moments (3,), ascending, of an inertia's six elements [kg m^2]."""
    return np.asarray(np.linalg.eigvalsh(spatial.symmetric_from_six(six)))


def _round_to_possible(
    values: Array, errors: Array, moments_of: Callable[[Array], Array], rounding: float
) -> list[float]:
    """Return numbers of an inertia with as few digits as their errors allow a possible body.

    Args:
        values: (m,) numbers [kg m^2].
        errors: (m,) their standard errors [kg m^2].
        moments_of: returns the principal moments (3,), ascending, of such numbers.
        rounding: rounding error of the values [kg m^2].
    """
    # No moment becomes zero.
    least_moment = 0.5 * moments_of(values)[0]
    rounded = []
    for extra_digits in range(DIGITS + 1):
        rounded = round_to_errors(values, errors, extra_digits)
        moments = moments_of(np.array(rounded))
        if _is_possible(moments, rounding) and moments[0] >= least_moment:
            break
    return rounded


def round_to_errors(
    values: Iterable[float], errors: Iterable[float], extra_digits: int = 0
) -> list[float]:
    """Return m numbers rounded at the second digit of their standard errors, or to ``DIGITS``.

    ``UNKNOWN_DIGITS`` where the error is not known. Zero where they are below ``_ROUNDING`` times
    the largest.

    Args:
        values: (m,) numbers.
        errors: (m,) standard errors, in the numbers' unit; infinite where not known.
        extra_digits: number of further digits.
    """
    numbers = np.array(list(values), dtype=float)
    sizes = np.abs(numbers)
    numbers[sizes < _ROUNDING * np.max(sizes)] = 0.0
    rounded = []
    for value, error in zip(numbers.tolist(), errors):
        digits = DIGITS
        if not math.isfinite(error):
            digits = min(UNKNOWN_DIGITS + extra_digits, DIGITS)
        elif error > 0.0:
            value = round(value, 1 - math.floor(math.log10(error)) + extra_digits)
        rounded.append(float(f"{value:.{digits}g}") + 0.0)
    return rounded


def join_numbers(values: float | Sequence[float], separator: str = ", ") -> str:
    """Return a number, or several with a separator between them, of ``DIGITS`` digits.

    They are without exponent, which not all targets read.
    """
    texts = []
    for value in np.ravel(values).tolist():
        text = np.format_float_positional(value, DIGITS, fractional=False, trim="0")
        texts.append("0.0" if float(text) == 0.0 else text)
    return separator.join(texts)


def _number_with_error(value: float, error: float) -> str:
    """Return a number, and its standard error where that is known."""
    return with_error(value, error) if math.isfinite(error) else join_numbers(value)
