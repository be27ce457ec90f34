"""A whole run on motors: its options, its plan and checks, and playing it.

The options are records, made once where a command line or a Python call comes in. From there on a
run asks records, not names.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Optional

import numpy as np

from robot_sysid.damiao.adapters import BusAddress, open_bus
from robot_sysid.damiao.bus import (
    GuardedLink,
    Inspection,
    OpenLink,
    SimulatedClock,
    SystemClock,
)
from robot_sysid.damiao.checks import preflight
from robot_sysid.damiao.joints import (
    MASTER_ID_OFFSET,
    DamiaoJoint,
    damiao_joints,
    map_joints,
    matching_types,
    read_joint_map,
)
from robot_sysid.damiao.player import Player, PlayReport, StopRequest
from robot_sysid.damiao.protocol import BusTiming, CanFrame, Scaling, is_harmful
from robot_sysid.damiao.recorder import Aside, MeasurementRecorder
from robot_sysid.damiao.references import Activity, trajectory_reference
from robot_sysid.damiao.safety.holding import (
    HoldingTorque,
    file_holding,
    gravity_holding,
    refuse_guessed_masses,
)
from robot_sysid.damiao.session import MotorSession
from robot_sysid.damiao.settings import (
    HoldOptions,
    Plan,
    PlaySettings,
    RecordingOptions,
    joint_positions,
)
from robot_sysid.damiao.simulated import SimulatedArm, SimulatedLink, simulated_motor
from robot_sysid.damiao.trajectory import DamiaoTrajectory, read_damiao_trajectory
from robot_sysid.damiao.weight_file import weight_path
from robot_sysid.errors import HardwareAbort, InputError, SysidError, error_text
from robot_sysid.model import ModelOptions
from robot_sysid.motion import LimitOptions
from robot_sysid.records.messages import Remark
from robot_sysid.records.option_fields import (
    FileArguments,
    Option,
    OptionRecord,
    given_values,
    joint_values,
    option,
    options_of_all,
    record_from,
)
from robot_sysid.simulation import SimulatedArmOptions
from robot_sysid.wording import option_name, option_setting


@dataclass(frozen=True)
class ArmFiles(FileArguments):
    """The trajectory to play, and the files that say what its arm is."""

    trajectory: Optional[Path] = option(
        None, "damiao_trajectory.csv", "TRAJECTORY", flag="trajectory"
    )
    model: Optional[Path] = option(None, "MJCF or URDF of the arm", "MODEL")
    joint_map: Optional[Path] = option(
        None, "how each joint's motor is mounted (see: motors map)", "FILE"
    )


MODEL_LIMITS = "workspace", "keep_out", "clearance"
"""The limits that can only be compared with a model of the arm."""
LIMITS = ("max_velocity", "max_acceleration", "max_torque", *MODEL_LIMITS)
"""Names of the limits of a motion that hold for all that a run moves."""
NO_LIMITS = LimitOptions(max_velocity=1e6, clearance=0.0, below_base=True)
"""The limits of a run for which the user gives none: 1e6 rad/s stops no motion."""
LIMIT_OPTIONS = options_of_all(LimitOptions, only=LIMITS, **dict.fromkeys(LIMITS))
"""Limits of a run; by default only the model limits the motion."""
RUN_OPTIONS: list[Option] = [
    *options_of_all(
        ArmFiles, BusAddress, BusTiming, ModelOptions, PlaySettings, RecordingOptions
    ),
    *LIMIT_OPTIONS,
]
"""Options of a run."""
SIMULATED_OPTIONS: list[Option] = [
    *options_of_all(SimulatedArmOptions, only=("plant_model",))
]
"""Options of the simulated arm of a run."""


@dataclass(frozen=True)
class RunOptions:
    """What a run on motors was asked for; what was not asked for has its default.

    Attributes:
        files: the trajectory, the model and the joint map.
        model: the arm in the model.
        address: how the bus is reached.
        timing: frame format and bit rates of the bus.
        settings: gains, speeds and permissions.
        limits: the user's limits of all motions; one that is not given forbids nothing.
        recording: files to write.
        standing: how an arm without a trajectory is held, and which one it is.
        plant: the arm that is simulated.
        given: option's key to its value, of those that were given: a command that is printed
            repeats them.
    """

    files: ArmFiles = ArmFiles()
    model: ModelOptions = ModelOptions()
    address: BusAddress = BusAddress()
    timing: BusTiming = BusTiming()
    settings: PlaySettings = PlaySettings()
    limits: LimitOptions = NO_LIMITS
    recording: RecordingOptions = RecordingOptions()
    standing: HoldOptions = HoldOptions()
    plant: SimulatedArmOptions = SimulatedArmOptions()
    given: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> RunOptions:
        """Return the options with values by key; InputError where one cannot be used."""
        given = {key: value for key, value in values.items() if value is not None}
        records: dict[str, Any] = {
            name: record_from(type(default), given, default)
            for name, default in vars(cls()).items()
            if isinstance(default, OptionRecord)
        }
        return cls(**records, given=given)

    def require_model(self) -> None:
        """Raise InputError where an option about a model was given, but no model."""
        if self.files.model is not None:
            return
        limits = options_of_all(LimitOptions, only=MODEL_LIMITS)
        for stated in (*options_of_all(ModelOptions), *limits):
            if stated.key in self.given:
                raise InputError(
                    f"{stated.name} is about a model; add {option_name('model')}"
                )


@dataclass(frozen=True)
class Equipment:
    """What a run works with beside its options, none of which replaces it.

    A program that has a bus of its own hands it to ``MotorRun``, as tests do with a bus in
    simulated time.

    Attributes:
        clock: clock of the bus.
        open_bus: opens the bus at an address, with its timing and that clock; InputError where it
            cannot.
        physics_step: length of a step of a simulated arm [s]; None for the usual one.
    """

    clock: SystemClock = SystemClock()
    open_bus: Callable[[BusAddress, BusTiming, SystemClock], OpenLink] = open_bus
    physics_step: float | None = None


COMPUTER = Equipment()
"""Clock and adapters of this computer."""


# Seed of the simulated arm, so that the same command writes the same recording.
_USUAL_ARM = 0
# How far a joint that is to be held may be from where it was inspected [rad]: the arm stays there.
# With more, an arm that somebody has moved meanwhile would be moved back.
_HELD_TOLERANCE = 0.05
# Timeout of a simulated motor's watchdog [s]: as docs/motors.md recommends for real motors; and in
# control cycles, where those are slow: two more than the least that is allowed.
_SIMULATED_WATCHDOG = 0.1
_WATCHDOG_CYCLES = 12.0
# What an inspection finds where there are no motors.
_NOTHING = Inspection({}, 0, np.nan)


class MotorRun:
    """One run on motors: makes its plan, checks it, opens the bus and plays.

    The robot and its geometry are made once and cached.

    Args:
        options: of the command line, or of a Python call.
        equipment: clock and adapters.

    Attributes:
        options, equipment: as given.
    """

    def __init__(self, options: RunOptions, equipment: Equipment = COMPUTER) -> None:
        self.options = options
        self.equipment = equipment

    def plan(self) -> Plan:
        """Return the plan of the trajectory file with the options' settings.

        With a model it also has the arm's inverse mass matrix at the first point, and the lower and
        the upper limits (n,) of the joints [rad].

        InputError where the file does not fit the model or the joint map, an option needs a model,
        or a recording would replace an input, or another file without --overwrite.
        """
        robot = self.robot
        self.options.require_model()
        path = self.options.files.trajectory
        assert path is not None
        trajectory = read_damiao_trajectory(path)
        if robot is not None and trajectory.n_joints != robot.n_joints:
            raise InputError(
                f"{trajectory.path} has {trajectory.n_joints} joints but the chain of "
                f"{robot.path} has {robot.n_joints}: {', '.join(robot.joint_names)}"
            )
        return self._plan_of(trajectory)

    def standing_plan(self, inspection: Inspection = _NOTHING) -> Plan:
        """Return the plan that holds the model's arm where an inspection finds it.

        Positions that are not known are those of the options, as for a simulated arm; for another
        one a check says what is missing.

        InputError where a motor's type is unknown, the files do not fit the model, or a recording
        would replace a file.
        """
        robot = self.robot
        n = robot.n_joints
        options = self.options.standing
        # A joint has the number of its motor where no joint map says another.
        joints = self._with_joint_map(
            [DamiaoJoint("", i, i + MASTER_ID_OFFSET) for i in range(1, n + 1)]
        )
        types = options.motor_type or [_stored_type(j, inspection) for j in joints]
        types = types * n if len(types) == 1 else types
        joints = self._with_joint_map(damiao_joints(types, n))
        pose = joint_values(options.pose or tuple(robot.reference), n, "--pose")
        positions = joint_positions(joints, inspection)
        pose = np.where(np.isfinite(positions), positions, pose)
        torque = gravity_holding(robot, joints).torque(pose)
        time = np.array([0.0, options.lifetime])
        still = np.zeros((2, n))
        trajectory = DamiaoTrajectory(
            Path("hold"), joints, time, still + pose, still, still + torque
        )
        return self._plan_of(trajectory, start_tolerance=_HELD_TOLERANCE)

    def _plan_of(self, trajectory: DamiaoTrajectory, **settings: Any) -> Plan:
        """Return the plan of a trajectory, with its joints mapped; ``settings`` are no options."""
        robot = self.robot
        mobility = None
        if robot is not None:
            from robot_sysid.damiao.checks.model import with_weight_of
            from robot_sysid.simulation.plant import ArmStepper

            mobility = ArmStepper(robot, trajectory.q[0]).mobility()
            trajectory = with_weight_of(robot, trajectory)
        options = self.options
        files = options.files
        inputs = files.trajectory, files.model, files.joint_map
        options.recording.require_free(*inputs, weight_path(trajectory.path))
        return Plan(
            replace(trajectory, joints=self._with_joint_map(trajectory.joints)),
            settings=replace(options.settings, **settings),
            timing=options.timing,
            recording=options.recording,
            mobility=mobility,
            user_limits=options.limits.limits([False] * trajectory.n_joints),
            model_limits=robot and robot.limits,
        )

    def _with_joint_map(self, joints: Sequence[DamiaoJoint]) -> tuple[DamiaoJoint, ...]:
        """Return joints (base to terminal) with the ids and mounting of the joint map.

        Without a joint map only the model's joint names are added, if there is a model.
        """
        names = self.robot.joint_names if self.robot else ()
        path = self.options.files.joint_map
        if path is not None:
            return map_joints(joints, read_joint_map(path), names)
        names = names or [""] * len(joints)
        return tuple(replace(joint, name=name) for joint, name in zip(joints, names))

    def checks(self, plan: Plan) -> list[Remark]:
        """Return a plan's checks that need no bus."""
        checks = [*preflight.plan_checks(plan)]
        if self.robot is not None:
            from robot_sysid.damiao.checks.model import contact_checks, torque_checks

            checks += contact_checks(plan, self.problem)
            checks += torque_checks(plan, self.robot)
        return checks

    @cached_property
    def problem(self) -> Any:
        """Geometry of the model's arm and the user's obstacles (ExcitationProblem)."""
        # Imported here so that playing on real motors does not wait for MuJoCo.
        from robot_sysid.motion.problem import build_problem

        return build_problem(self.robot, self.options.limits)

    def inspection_checks(
        self, plan: Plan, inspection: Inspection, real: bool = True
    ) -> list[Remark]:
        """Return the checks of a plan against the motors of an inspection.

        ``real`` tells whether the motors are real ones, whose directions are checked too.
        """
        checks = [*preflight.bus_checks(plan, inspection)]
        q = joint_positions(plan.trajectory.joints, inspection)
        if self.robot is not None and np.all(np.isfinite(q)):
            from robot_sysid.damiao.checks.model import transfer_checks

            checks += transfer_checks(self.problem, q, plan.trajectory.q[0])
        if real:
            checks += preflight.direction_checks(plan, self.holding(plan))
        return checks

    def holding(self, plan: Plan) -> HoldingTorque:
        """Return the torques that hold the arm by the model, or else by the file."""
        if self.robot is None:
            return file_holding(plan.trajectory)
        return gravity_holding(self.robot, plan.trajectory.joints)

    @cached_property
    def robot(self) -> Any:
        """The arm of the model file (RobotModel); None without a model."""
        path = self.options.files.model
        if path is None:
            return None
        from robot_sysid.parser import load_robot_model

        options = given_values(self.options.model)
        robot = load_robot_model(path, max_velocity=np.inf, **options)
        refuse_guessed_masses(robot)
        return robot

    @contextlib.contextmanager
    def open_simulated(self, plan: Plan) -> Iterator[GuardedLink]:
        """Yield a link to a simulated arm that stands at the plan's first point.

        It is the arm of --plant-model, exactly, or else one that is as far from the model as arms
        usually are, always the same one for the same model and motors. Its clock only advances when
        waited for. InputError without a model, or where the two do not have the same joints.
        """
        if self.robot is None:
            raise InputError(
                f"a simulated arm needs a model; add {option_name('model')}"
            )
        from robot_sysid.simulation.plant import TIMESTEP, ArmStepper, load_plant
        from robot_sysid.simulation.usual_arm import usual_arm

        plant = self.options.plant.plant_model
        if plant is None:
            joints = plan.trajectory.joints
            rated = np.array([joint.spec.rated_torque for joint in joints])
            rng = np.random.default_rng(_USUAL_ARM)
            robot = usual_arm(self.robot, rated, rng)
        else:
            robot = load_plant(self.robot, plant, self.options.model.mesh_dir)

        watchdog = max(_SIMULATED_WATCHDOG, _WATCHDOG_CYCLES * plan.settings.period)
        motors = [simulated_motor(joint, watchdog) for joint in plan.trajectory.joints]
        step = self.equipment.physics_step or TIMESTEP
        stepper = ArmStepper(robot, plan.trajectory.q[0], step)
        clock = SimulatedClock()
        arm = SimulatedArm(stepper, motors)
        timing = self.options.timing
        wire = SimulatedLink(clock, arm, timing, echo=True)
        yield GuardedLink(wire, clock, timing.fd)

    @contextlib.contextmanager
    def open_guarded(
        self, refuses: Callable[[CanFrame], bool] = is_harmful
    ) -> Iterator[GuardedLink]:
        """Open the bus for a block and yield its link; InputError without --channel.

        Args:
            refuses: tells of each frame to be sent whether it must not be.
        """
        address = self.options.address
        timing = self.options.timing
        if not address.channel:
            raise InputError(
                f"this command needs {option_name('channel')}, for instance "
                f"{option_setting('channel', 'can0')}"
            )
        clock = self.equipment.clock
        link = self.equipment.open_bus(address, timing, clock)
        with contextlib.closing(link):
            yield GuardedLink(link, clock, timing.fd, refuses)


def _stored_type(joint: DamiaoJoint, inspection: Inspection) -> str:
    """Return the type of a joint's motor, by the scaling limits in its registers.

    InputError unless they are those of exactly one type.
    """
    motor = inspection.motors.get(joint.can_id)
    types = matching_types(motor.limits) if motor else ()
    if len(types) == 1:
        return types[0]
    raise InputError(
        f"{joint.label}: no motor answers whose registers tell its type; check power and ids, or "
        f"give {option_name('motor_type')}, one for all joints or one per joint, base first"
    )


def run(
    link: GuardedLink,
    plan: Plan,
    inspection: Inspection,
    stop: StopRequest,
    on_phase: Callable[[str], None],
    holding: HoldingTorque,
    activity: Activity | None = None,
) -> PlayReport:
    """Play a plan on the motors of an inspection, record it, and return the report of the run.

    Signals that end a program stop the run.

    Args:
        link: link of the motors' bus.
        plan: the plan; it is checked again before any motor is enabled.
        inspection: answers of the motors on the link.
        stop: request for a stop, see ``Player``.
        on_phase: called with the name of each phase of the run.
        holding: torques that hold the arm.
        activity: what the arm does; None plays the trajectory.

    Raises:
        HardwareAbort: a check forbids the run, or the run was stopped; the message has the reason,
            and ``report`` is that of the run, if it had begun.
        InputError: a recording exists already or cannot be written.
        SysidError: the run went to its end, but recording or printing failed.
    """
    checks = [*preflight.plan_checks(plan), *preflight.bus_checks(plan, inspection)]
    preflight.require_playable(checks)
    joints = plan.trajectory.joints
    motors = [inspection.motors[joint.can_id] for joint in joints]
    scaling = Scaling(motor.limits for motor in motors)
    session = MotorSession(link, joints, scaling, plan.command_limits)
    if activity is None:
        reference = trajectory_reference(plan.trajectory, plan.settings.speed)
        first = reference(0.0)
        announcement = f"playing ({plan.duration:.1f} s)"
        activity = Activity(announcement, lambda _: reference, plan.duration, first)
    console = Aside(link.clock.live)
    writer = Aside(link.clock.live)
    path = plan.recording.record
    player: Player | None = None
    try:
        recorder = None
        if path is not None:
            registers = [motor.registers for motor in motors]
            recorder = MeasurementRecorder(path, plan, registers, writer)
        with stop.on_signals(), recorder or contextlib.nullcontext(), session:
            player = Player(
                session, plan.settings, stop, recorder, console, on_phase, holding
            )
            report = player.play(activity)
    except HardwareAbort as stopped:
        report_until_then = player and player.report
        raise type(stopped)(str(stopped), report_until_then) from stopped
    finally:
        console.finish()
    for failure in filter(None, (writer.failure, console.failure)):
        raise SysidError(
            "the run is over and all motors are disabled, but recording or printing it failed: "
            f"{error_text(failure)}"
        )
    return report
