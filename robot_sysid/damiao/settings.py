"""The plan of a run on motors: trajectory, gains, speeds, limits, permissions and recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Optional

import numpy as np

from robot_sysid.damiao.bus import Inspection
from robot_sysid.damiao.joints import DamiaoJoint, MotorSpec, Mounting, largest_friction
from robot_sysid.damiao.protocol import KD_MAX, KD_STEP, KP_MAX, BusTiming, default_rate
from robot_sysid.damiao.trajectory import DamiaoTrajectory
from robot_sysid.errors import InputError
from robot_sysid.records import Array, Limits
from robot_sysid.records.file_access import hold, refuse_overwriting
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.option_fields import (
    Check,
    OptionRecord,
    check_speed_factor,
    joint_values,
    option,
    options_of_all,
)
from robot_sysid.records.usual_errors import WEIGHT
from robot_sysid.wording import option_name

# Arguments of options whose default depends on the type of each motor.
_BY_TYPE: dict[str, Any] = {"takes_many": True, "default_text": "by motor type"}


def _range_check(least: float, most: float, unit: str) -> Check:
    """Return the check of a gain that frames can carry from ``least`` to ``most``."""
    problem = f"must be from {least:.2g} to {most:g} {unit}"
    return lambda gain: None if least <= gain <= most else problem


TRACKING = 0.2
"""How far a joint may leave its path, or float, unless the user says another angle [rad]."""
LARGEST_SAG = 0.6
"""The largest angle that a joint may leave its path by because its stiffness is low [rad]: with
more, the motion is another one than the one that was checked."""
MOST_OF_PEAK = 0.75
"""Share of a motor's peak torque that still carries a joint which has sunk: the rest stops it."""
OVERSHOOT = 2.0
"""How far an arm that takes up its load swings, over how far it then sags."""
LEAST_FADING = 1e-9
"""Stiffness that stands for none where it is divided by [N m/rad]."""
LEAST_STIFFNESS = 1.0
"""Stiffness below which an arm counts as limp [N m/rad]."""

STIFFNESS_PER_TORQUE = 20.0
"""Default stiffness over a motor's rated torque [1/rad]. Makers of arms with these motors use a
stiffness of 240 N m/rad and a damping of 5 N m s/rad for motors with a rated torque of 9 N m, 10
and 1.5 for 3 N m; the defaults are between these."""
DAMPING_PER_STIFFNESS = 0.025
"""Default damping over stiffness [s]: within the range of the same arms."""
LEAST_DAMPING_SHARE = 0.4
"""Least share of the default damping that a light joint keeps, as models often lack rotor
inertia."""
LEAST_DAMPING = 0.05
"""Least default damping of any joint [N m s/rad]: motors with stiffness alone oscillate."""
PEAK_ACCELERATION = 3.08
"""Peak acceleration of a transfer, times its duration over its peak speed, rounded up: (10 /
sqrt(3)) / (15 / 8) of the polynomial of ``references.transfer_reference``."""
SPEED_MARGIN = 1.1
"""Speed limit of commands over the largest speed in the trajectory: its rows are rounded."""


@dataclass(frozen=True)
class PlaySettings(OptionRecord):
    """Gains, speeds, limits and permissions of a run; ``for_motors`` completes gains and rate.

    The text of each option describes it, with its unit. ``kp`` and ``kd`` are empty (for defaults
    by motor type), or have one value for all joints or one per joint.

    Attributes:
        tracking: how far each joint may leave its path [rad]; ``for_motors`` fills it in.
        approach_speed: joint speed on the way to the first point, and when lowered [rad/s].
        start_tolerance: how far a joint may be from the first point [rad].
        max_speed_error: how much a joint may be faster or slower than commanded [rad/s].
        max_temperature: of power stage and winding [degC].
        max_missed: number of unanswered commands in a row that stop the run. With the pause after
            the first one they take six cycles, no more than half of the shortest watchdog that is
            allowed; and where two of a hundred frames are lost by chance, as by poor adapters, five
            in a row are lost once in 300 million commands.
        max_lost: number of unanswered commands among about a hundred that stop the run: by chance
            never so many are lost of those five; with more, an adapter that answers too late again
            and again would play to the end.
        max_doubted: number of answers in a row that cannot be true, which stop the run: single
            damaged frames pass.
        max_lateness: largest delay of a control cycle [s]: far more than most pauses of a busy
            computer, far less than a watchdog's time.
        ramp_time: time in which the gains are raised [s]; short, because the arm sinks meanwhile
            under a load that the feed-forward torque does not include.
        approach_time: least duration of the transfer to the first point [s].
        rest_time: time for which the arm is held still before and after moving [s].
        deceleration: deceleration of a controlled stop [rad/s^2].
    """

    kp: tuple[float, ...] = option(
        (),
        "stiffness, one for all or one per joint",
        "KP [N·m/rad]",
        check=_range_check(0.0, KP_MAX, "N·m/rad"),
        **_BY_TYPE,
    )
    kd: tuple[float, ...] = option(
        (),
        "damping, one for all or one per joint",
        "KD [N·m·s/rad]",
        # With less a frame carries no damping at all, and the motor would ring.
        check=_range_check(KD_STEP, KD_MAX, "N·m·s/rad"),
        **_BY_TYPE,
    )
    rate: Optional[float] = option(
        None,
        "control cycles per second",
        "HZ [Hz] > 0",
        default_text="250; 500 with {fd}; less where the bus is full",
    )
    speed: float = option(
        1.0, "1 as exported, 0.3 slower", "FACTOR", check=check_speed_factor
    )
    max_tracking_error: Optional[float] = option(
        None,
        "how far a joint may leave its path, or float",
        "ANGLE [rad] > 0",
        default_text="0.2; more where a soft arm sags by what models are usually off",
    )
    park: Optional[str] = option(
        None,
        "with rest, lower it until no joint carries a load",
        "WHERE",
        choices=("rest",),
        default_text="disabled where it ends",
    )
    accept_register_limits: bool = option(
        False,
        "use the motors' own PMAX, VMAX, TMAX where they differ from the motor type's",
    )
    accept_directions: bool = option(
        False,
        "play although nobody has verified which way the joints turn that gravity hardly loads",
    )
    tracking: tuple[float, ...] = ()
    approach_speed: float = 0.2
    start_tolerance: float = 0.5
    max_speed_error: float = 1.0
    max_temperature: float = 80.0
    max_missed: int = 5
    max_lost: float = 15.0
    max_doubted: int = 3
    max_lateness: float = 0.02
    ramp_time: float = 0.3
    approach_time: float = 1.0
    rest_time: float = 0.5
    deceleration: float = 10.0

    def for_motors(
        self,
        specs: Sequence[MotorSpec],
        timing: BusTiming,
        mobility: Array | None = None,
        sag: Array | float = 0.0,
        load: Array | float = 0.0,
        slope: Array | None = None,
    ) -> PlaySettings:
        """Return these settings with a cycle rate, and gains and a tracking limit for each motor.

        With the default stiffness, an error of a twentieth of a radian makes rated torque: an arm
        whose model is wrong by a third of the rated torque sags by a degree. Where the arm's
        inertia is known, a light joint is damped less, so that its velocity does not settle within
        a cycle: the torque step that is to be measured would have vanished by then.

        A joint may leave its path by ``TRACKING``, or by what its weight is usually off over its
        stiffness: an arm with little stiffness sags by that, and nothing is wrong with it. The
        weight that an arm that sinks takes up counts against the stiffness, so that without its
        slope nobody knows how far that is; and a joint may sink no farther than its motor holds it.

        Args:
            specs: types of the n motors.
            timing: frame format and bit rates of the bus, which determine the default rate.
            mobility: the arm's inverse mass matrix (n, n) [1/(kg m^2)]; None without a model.
            sag: torque (n,) by which what carries the arm is usually off, friction included [N m].
            load: largest torque (n,) that carries the arm in the motion [N m].
            slope: by how much a joint's weight grows (n,) as it sinks [N m/rad]; None where it is
                not known.

        Raises:
            InputError: a setting has neither one value nor one per motor.
        """
        rate = self.rate or default_rate(len(specs), timing)
        stiffness = usual_stiffness(specs)
        damping = DAMPING_PER_STIFFNESS * stiffness
        least_damping = np.maximum(LEAST_DAMPING_SHARE * damping, LEAST_DAMPING)
        if mobility is not None:
            # With more damping, a joint's velocity would settle in less than a cycle.
            damping = np.minimum(damping, rate / np.diag(mobility))
        damping = np.clip(damping, least_damping, KD_MAX)
        n = len(specs)
        # An empty setting stands for the default.
        kp = joint_values(self.kp or tuple(stiffness), n, option_name("kp"))
        kd = joint_values(self.kd or tuple(damping), n, option_name("kd"))
        tracking = np.full(n, self.max_tracking_error or TRACKING)
        if self.max_tracking_error is None and slope is not None:
            left = np.maximum(kp - slope, LEAST_STIFFNESS)
            # With less stiffness than that it topples, and no sag is usual.
            sagged = np.where(kp > slope, OVERSHOOT * sag / left, 0.0)
            spare = MOST_OF_PEAK * np.array([spec.peak_torque for spec in specs])
            held = (spare - load - sag) / np.maximum(slope, LEAST_STIFFNESS)
            usual = np.minimum(sagged, np.minimum(held, LARGEST_SAG))
            tracking = np.maximum(tracking, usual)
        return replace(
            self,
            rate=rate,
            kp=tuple(kp),
            kd=tuple(kd),
            tracking=tuple(tracking.tolist()),
        )

    @property
    def period(self) -> float:
        """Length of a control cycle [s]; ``rate`` must not be None."""
        assert self.rate is not None
        return 1.0 / self.rate


def usual_stiffness(specs: Sequence[MotorSpec]) -> Array:
    """Return the stiffness (n,) that motors of some types have by default [N m/rad]."""
    rated_torque = np.array([spec.rated_torque for spec in specs])
    return np.minimum(STIFFNESS_PER_TORQUE * rated_torque, KP_MAX)


def slowing_in_a_cycle(period: float, kp: Array | float, kd: Array | float) -> Any:
    """Return the largest ratio of a joint's mean speed to the one at which it is sampled.

    A joint without inertia has the velocity v = v_des + k (p_des - p), k = kp / kd, and is sampled
    when it has slowed down at the end of a cycle T: in steady motion its mean speed is (exp(kT) -
    1) / (kT) times the sampled one; with inertia, between 1 and this.

    Args:
        period: length of a cycle T [s].
        kp: stiffness [N m/rad], above zero.
        kd: damping [N m s/rad], above zero.
    """
    fade = period * np.maximum(kp, LEAST_FADING) / kd
    return np.expm1(fade) / fade


HOLD_SETTINGS = {
    stated.key for stated in options_of_all(PlaySettings) if stated.key != "speed"
}
"""Keys of the options of ``PlaySettings`` that are about an arm which stays where it is."""


@dataclass(frozen=True)
class HoldOptions(OptionRecord):
    """What ``motors hold`` does, and the arm that it simulates."""

    floats: bool = option(
        False,
        "take the stiffness away, and measure how fast the joints drift",
        flag="--float",
    )
    lifetime: float = option(
        5.0, "how long it is held, or floats", "S [s] > 0", flag="--for"
    )
    motor_type: tuple[str, ...] = option(
        (),
        "Damiao motor, one for all or one per joint, base first",
        "TYPE",
        default_text="by the motors' registers",
        repeats=True,
    )
    simulate: bool = option(False, "take a simulated arm, without a bus")
    pose: tuple[float, ...] = option(
        (),
        "where the simulated arm stands, one angle per joint",
        "Q [rad]",
        takes_many=True,
        default_text="the model's own pose",
    )


ARM_OPTIONS = "motor_type", "simulate", "pose"
"""Keys of the options of ``HoldOptions`` that say which arm a command without a file has."""


@dataclass(frozen=True)
class MoveOptions(OptionRecord):
    """Where ``motors move`` moves an arm."""

    to: tuple[str, ...] = option(
        (),
        "keyframe of the model, by its name or its number from 0 on, or one position per joint",
        "POSE",
        takes_many=True,
    )


@dataclass(frozen=True)
class RecordingOptions(OptionRecord):
    """The files into which a run is recorded."""

    record: Optional[Path] = option(None, "write the measurement CSV", "FILE")
    overwrite: bool = option(False, "replace an existing recording")

    def require_free(self, *inputs: Path | None) -> None:
        """Raise InputError where the recording cannot be written, or would replace a file.

        It never replaces one of the run's ``inputs``, and another file with --overwrite alone.
        """
        if self.record is None:
            return
        refuse_overwriting(inputs, [(option_name("record"), self.record)])
        if self.record.exists() and not self.overwrite:
            raise InputError(
                f"{self.record} exists; choose another {option_name('record')} file or give "
                f"{option_name('overwrite')}"
            )
        if not os.access(self.record.parent, os.W_OK):
            raise InputError(
                f"cannot write {self.record}: its folder is missing, or not to be written to"
            )
        with hold(self.record, option_name("record")):
            pass  # No other run is writing it.


@dataclass(frozen=True)
class Plan:
    """A trajectory of n joints and all settings with which it is played.

    Attributes:
        trajectory: trajectory with at least two rows; fewer raise InputError.
        settings: gains, speeds and limits; open ones are chosen for the motors and the bus.
        timing: frame format and bit rates of the bus.
        recording: files to write.
        mobility: the arm's inverse mass matrix (n, n) at the first point [1/(kg m^2)]; None without
            a model.
        user_limits: the user's; None where there are none.
        model_limits: those of the model's joints; None without one.
        remedy: what to do where the motion leaves a limit, or something touches; "" where it is a
            file's.

    The settings become complete when the plan is made: ``PlaySettings.for_motors`` fills them in.
    The transfer to the first point is made as slow as the limits ask for.
    """

    trajectory: DamiaoTrajectory
    settings: PlaySettings = PlaySettings()
    timing: BusTiming = BusTiming()
    recording: RecordingOptions = RecordingOptions()
    mobility: Array | None = None
    user_limits: Limits | None = None
    model_limits: Limits | None = None
    remedy: str = ""

    def __post_init__(self) -> None:
        """Complete the settings; InputError where the trajectory has fewer than two rows."""
        if len(self.trajectory.time) < 2:
            raise InputError(
                f"{self.trajectory.path} needs at least two rows to be played"
            )
        specs = [joint.spec for joint in self.trajectory.joints]
        settings = self.settings.for_motors(
            specs,
            self.timing,
            self.mobility,
            self.usual_excess,
            np.max(np.abs(self.trajectory.tau), axis=0),
            self.trajectory.weight_slope,
        )
        # The transfer keeps the limits, too.
        stated = filter(None, (self.user_limits, self.model_limits))
        tightest = Limits.of(Limits(), *stated)
        speed = min(settings.approach_speed, float(np.min(tightest.velocity)))
        time = PEAK_ACCELERATION * speed / float(np.min(tightest.acceleration))
        settings = replace(
            settings,
            approach_speed=speed,
            approach_time=max(settings.approach_time, time),
        )
        object.__setattr__(self, "settings", settings)

    @property
    def usual_excess(self) -> Array:
        """Torque (n,) by which what carries the arm is usually off, friction included [N m]."""
        trajectory = self.trajectory
        error = trajectory.weight_error
        if error is None:
            error = WEIGHT * np.abs(trajectory.tau)
        largest = np.max(INTERVAL * error, axis=0)
        return largest + largest_friction(trajectory.joints)

    @property
    def duration(self) -> float:
        """Time that the trajectory takes to play [s]: the file's time over the speed factor."""
        return self.trajectory.duration / self.settings.speed

    @property
    def command_limits(self) -> Limits:
        """Limits of commands for the n joints: the model's positions, or else the trajectory's.

        A joint's speed limit is a tenth above its largest speed in the trajectory as played (by
        velocities and by slopes of positions), or above the approach speed if that is larger.
        """
        q = self.trajectory.q
        ranges = self.model_limits or Limits(np.min(q, axis=0), np.max(q, axis=0))
        speeds = np.abs(np.vstack([self.trajectory.slopes, self.trajectory.qd]))
        peak_speed = self.settings.speed * speeds.max(axis=0)
        speed = np.maximum(peak_speed, self.settings.approach_speed)
        return Limits(ranges.lower, ranges.upper, SPEED_MARGIN * speed)


def joint_positions(joints: Sequence[DamiaoJoint], inspection: Inspection) -> Array:
    """Return the positions (n,) [rad] of joints when the bus was inspected.

    ``inspection`` has each motor's answer by its CAN id; a joint without one has NaN.
    """
    motors = inspection.motors
    ids = [joint.can_id for joint in joints]
    positions = np.array([motors[i].position if i in motors else np.nan for i in ids])
    return Mounting.of(joints).inverse.signals(positions, positions, positions)[0]
