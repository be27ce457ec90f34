"""Damiao motors from Python: ``rs.motors.play``; the commands ask for their runs by its record.

Nothing is printed, and nobody is asked whether the arm may move.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_sysid.api.keywords import MOTOR_RECORDS, in_python
from robot_sysid.config import ModelOptions
from robot_sysid.damiao import execution
from robot_sysid.damiao.bus import (
    BusAddress,
    GuardedLink,
    Link,
    SimulatedClock,
    SystemClock,
    Told,
    open_bus,
)
from robot_sysid.damiao.holding import HoldingCheck
from robot_sysid.damiao.inspection import Inspection, inspect_bus
from robot_sysid.damiao.player import PlayReport
from robot_sysid.damiao.preflight import (
    Check,
    Permissions,
    Plan,
    bus_checks,
    direction_checks,
    limit_checks,
    plan_checks,
    require_no_stop,
)
from robot_sysid.damiao.protocol.frames import BusTiming, Frame, refuse_harmful
from robot_sysid.damiao.protocol.joints import DamiaoJoint, JointSpace, mapped, read_joint_map
from robot_sysid.damiao.protocol.lerobot import read_lerobot_map
from robot_sysid.damiao.protocol.motors import matching_types
from robot_sysid.damiao.recorder import RecordingOptions
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.damiao.simulated import (
    DEFAULT_WATCHDOG,
    SimulatedArm,
    SimulatedLink,
    simulated_motor,
)
from robot_sysid.damiao.supervision import StopRequest
from robot_sysid.damiao.trajectory import (
    NO_LIMITS,
    DamiaoTrajectory,
    read_damiao_trajectory,
    together,
)
from robot_sysid.errors import HardwareAbort, InputError, SysidError
from robot_sysid.motion.options import LimitOptions
from robot_sysid.records import Array
from robot_sysid.records.atomic_files import DAMIAO_NAME, temporary_folder
from robot_sysid.records.options import (
    OptionRecord,
    given_options,
    keys_of,
    option,
    record_from,
    refuse_unknown,
)

if TYPE_CHECKING:
    from robot_sysid.api.models import Model
    from robot_sysid.api.results import PlanResult

Say = Callable[[str], None]
MODEL_LIMITS = "workspace", "keep_out", "clearance"
LIMITS = ("max_velocity", "max_acceleration", "max_torque", *MODEL_LIMITS)
"""Which of a motion's limits hold for all that a run moves."""


@dataclass(frozen=True)
class SecondArm(OptionRecord):
    """Another arm of the same model that moves at the same time."""

    also: Path | None = option(
        None, "trajectory of the model's other arm, played at the same time", "FILE"
    )
    also_joint: str | None = option(None, "terminal joint of that arm", "NAME")

    def of_model(self, model: object) -> Path | None:
        """Return the trajectory of that arm; InputError where nothing says which arm it is."""
        if self.also is None and self.also_joint is not None:
            raise InputError("--also-joint is about a second arm; add --also")
        if self.also and not (self.also_joint and model):
            raise InputError("--also needs --also-joint, --joint and --model: which arms they are")
        return self.also


class MotorRun:
    """What a run on motors was asked for, key of an option to value, as records.

    ``tell`` is told of a driver that does not return, see ``bus.DriverWatch``.
    """

    def __init__(self, values: Mapping[str, Any], tell: Told) -> None:
        self.values, self._tell, self.clock = values, tell, SystemClock()
        self.address = record_from(BusAddress, values)
        self.timing = record_from(BusTiming, values)

    def plan(self) -> Plan:
        """Return the trajectory and how to play it."""
        trajectory = together(*self._files) if self._also else self._files[0]
        return self._planned(replace(trajectory, joints=self._mounted(trajectory.joints)))

    @cached_property
    def _files(self) -> tuple[DamiaoTrajectory, ...]:
        paths = filter(None, (self.values["trajectory"], self._also))
        return tuple(map(read_damiao_trajectory, paths))

    @cached_property
    def _also(self) -> Path | None:
        return record_from(SecondArm, self.values).of_model(self.values.get("model"))

    def hold_plan(self, inspection: Inspection) -> Plan:
        """Return how the arm is held for a second where it stands, by torques of its model.

        The motors' types are those that their registers agree with. HardwareAbort where a motor
        does not answer, does not tell its state or is of no known type.
        """
        from robot_sysid.damiao.model_check import gravity_check

        joints, places = [], []
        plain = [DamiaoJoint("", k, 0) for k in range(1, self.robot.n_joints + 1)]
        for joint in self._mounted(plain):
            motor = inspection.motors.get(joint.address)
            types = matching_types(motor.limits) if motor else ()
            if motor is None or not types or motor.feedback is None:
                lacks = "does not tell its state" if types else "is of no known type"
                said = lacks if motor else "does not answer"
                raise HardwareAbort(f"{joint.label} {said}; see robot-sysid motors check")
            master = joint.master_id or motor.master_id
            joints.append(replace(joint, motor_type=types[0], master_id=master))
            places.append(motor.position)
        q = JointSpace.of(joints).joint_position(np.array(places))
        still, torque = np.zeros((2, len(q))), gravity_check(self.robot, tuple(joints)).torque(q)
        rows = np.arange(2), np.array([0.0, 1.0]), still + q, still, still + torque
        return self._planned(DamiaoTrajectory(Path("holding"), tuple(joints), *rows))

    def _planned(self, trajectory: DamiaoTrajectory) -> Plan:
        return Plan(
            trajectory,
            record_from(PlaySettings, self.values),
            self.timing,
            record_from(Permissions, self.values),
            record_from(RecordingOptions, self.values),
            self._inertia(trajectory),
            self._limits(),
        )

    def _limits(self) -> LimitOptions:
        """Return what holds for all that moves; InputError where only a model could tell."""
        asked = {key: self.values[key] for key in LIMITS if key in self.values}
        for key in MODEL_LIMITS if self.robot is None else ():
            if key in asked:
                raise InputError(f"--{key.replace('_', '-')} is about a model; add --model")
        free = {"max_velocity": NO_LIMITS.max_velocity, "clearance": 0.0, "below_base": True}
        return record_from(LimitOptions, {**free, **asked})

    def _inertia(self, trajectory: DamiaoTrajectory) -> Array | None:
        """Return what each joint moves at the first point, where a model is known [kg m^2]."""
        if self.robot is None or self.robot.n_joints != trajectory.n_joints:
            return None
        from robot_sysid.simulation.forward_dynamics import ArmStepper

        return ArmStepper(self.robot, trajectory.q[0]).moved_inertia()

    def _mounted(self, joints: Sequence[DamiaoJoint]) -> tuple[DamiaoJoint, ...]:
        names = self.robot.joint_names if self.robot else ()
        if self.rows:
            return mapped(joints, self.rows, self.channels, names)
        if len(names) != len(joints):
            return tuple(joints)
        return tuple(replace(joint, name=name) for joint, name in zip(joints, names))

    @cached_property
    def rows(self) -> tuple[DamiaoJoint, ...]:
        """The joint map's lines; none without one."""
        path = self.values.get("joint_map")
        if path is not None and Path(path).suffix == ".json":
            return read_lerobot_map(Path(path), self.robot.joint_names if self.robot else ())
        return () if path is None else read_joint_map(path)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the buses: those that were given, or else those of the joint map."""
        mapped_to = dict.fromkeys(row.channel for row in self.rows if row.channel)
        return tuple(self.address.buses or mapped_to)

    def checks(self, plan: Plan) -> list[Check]:
        """Return the checks that need no bus, those of a model of the arm included."""
        own = [*plan_checks(plan), *limit_checks(plan)]
        if self.robot is None:
            for given in given_options(record_from(ModelOptions, self.values)):
                raise InputError(f"{given.flag} is about a model; add --model")
            return own
        # Imported here so that playing on real motors does not wait for MuJoCo.
        from robot_sysid.damiao.model_check import (
            arm_by_arm,
            arms_apart,
            model_checks,
            torque_checks,
        )

        played, settings, pose = plan.trajectory, plan.settings, plan.pose
        # Files have rows of their own; what is made from their joints has none.
        parts = self._files if played.both else arm_by_arm(played, self.robots)
        fits, speed = list[Check](), settings.speed
        for each, robot in zip(parts, self.robots):
            left = None if pose is None else pose[: each.n_joints]
            pose = None if pose is None else pose[each.n_joints :]
            fits += model_checks(each, speed, robot, left, plan.limits)
        if self._also:
            fits += arms_apart(self.robots, played, speed, plan.pose)
        return [*own, *fits, *torque_checks(played, settings, self.robot)]

    def met_checks(self, plan: Plan, inspection: Inspection, real: bool = True) -> list[Check]:
        """Return what motors that were met say, and whether ``real`` ones turn as they should."""
        checks, here = bus_checks(plan, inspection), plan.places(inspection)
        if np.all(np.isfinite(here)):
            checks += limit_checks(plan, here)
            if self.robot is not None:
                from robot_sysid.damiao.model_check import way_checks

                checks += way_checks(plan, self.robots, here)
        return [*checks, *(direction_checks(plan, self.holding(plan)) if real else ())]

    def require_free(self, plan: Plan) -> None:
        """Raise InputError where a recording would replace a file, or be one that the run reads."""
        keys = "trajectory", "model", "also", "joint_map", "park"
        plan.recording.require_free(*filter(None, map(self.values.get, keys)))

    def holding(self, plan: Plan) -> HoldingCheck | None:
        """Return what compares the arm, held still, with the model's gravity; None without one."""
        if self.robot is None:
            return None
        from robot_sysid.damiao.model_check import gravity_check

        return gravity_check(self.robot, plan.trajectory.joints)

    @cached_property
    def robot(self) -> Any:
        """The arm of the model file, or both as one; None without a model."""
        if not self._also:
            return self.robots[0] if self.robots else None
        from robot_sysid.motion.two_arms import as_one

        return as_one(*self.robots)

    @cached_property
    def robots(self) -> tuple[Any, ...]:
        """The arm of the model file, or both; empty without a model."""
        if self.values.get("model") is None:
            return ()
        from robot_sysid.parser import load_robot_model

        chosen, second = record_from(ModelOptions, self.values), record_from(SecondArm, self.values)
        terminals = (chosen.joint, second.also_joint) if self._also else (chosen.joint,)
        rest = float("inf"), chosen.keyframe
        load = partial(load_robot_model, self.values["model"], chosen.mesh_dir)
        return tuple(load(joint, *rest) for joint in terminals)

    def simulated_arm(
        self, plan: Plan, watchdog: float = DEFAULT_WATCHDOG, *timestep: float
    ) -> SimulatedArm:
        """Return the model's arm at the plan's first point, driven by simulated motors."""
        if self.robot is None:
            raise InputError("a simulated arm needs a model; add --model")
        from robot_sysid.simulation.forward_dynamics import ArmStepper

        motors = [simulated_motor(each, watchdog) for each in plan.trajectory.joints]
        return SimulatedArm(ArmStepper(self.robot, plan.scan.first, *timestep), motors)

    @contextlib.contextmanager
    def simulated(self, arm: SimulatedArm) -> Iterator[GuardedLink]:
        """Open a bus with a simulated arm on it, in simulated time."""
        clock = SimulatedClock()
        wire = SimulatedLink(clock, arm, self.timing, echo=True)
        yield GuardedLink(wire, clock, self.timing.fd, self.channels or ("simulated",))

    def open(self, timing: BusTiming | None = None) -> Link:
        """Open the bus, with other bit rates than those asked for if given."""
        return open_bus(self.address, timing or self.timing, self.clock, self._tell)

    @contextlib.contextmanager
    def bus(
        self, refuse: Callable[[Frame], None] = refuse_harmful, timing: BusTiming | None = None
    ) -> Iterator[GuardedLink]:
        """Open the bus for as long as the block runs; what ``refuse`` raises for is not sent."""
        if not self.address.channel:
            raise InputError("this command needs --channel, for instance --channel can0")
        with contextlib.closing(self.open(timing)) as link:
            yield GuardedLink(link, self.clock, self.timing.fd, self.channels, refuse)


def lasting(plan: Plan, seconds: float) -> Plan:
    """Return a plan to hold an arm that lasts so long [s]."""
    time = np.array([0.0, seconds])
    return replace(plan, trajectory=replace(plan.trajectory, time=time))


def play(
    trajectory: Path | str | PlanResult,
    *,
    model: Model | None = None,
    joint_map: Path | str | None = None,
    simulate: bool = False,
    say: Say = lambda sentence: None,
    **options: Any,
) -> PlayReport:
    """Play a trajectory on Damiao motors, with all checks of ``robot-sysid motors play``.

    Nobody is asked first. Ctrl-C brings the arm to rest, where this is the main thread.

    Args:
        trajectory: a file for motors, or a plan, made with ``export_damiao=True, motor_type=...``.
        model: MJCF or URDF file of the arm, to compare with; that of the plan where there is one.
        joint_map: how each joint's motor is mounted.
        simulate: play on a simulated arm of the model instead, in simulated time.
        say: called with a sentence for each thing that happens.
        options: those of ``robot-sysid motors play``, such as ``channel="can0"``, ``speed=0.3``,
            ``park="rest"`` or ``record="measured.csv"``.

    Returns:
        How it went: cycles, lateness [s], missed commands and worst tracking [rad] per joint.

    Raises:
        InputError: an option or a file cannot be used.
        HardwareAbort: a check forbids it, or the run was stopped; its message says whether a motor
            may still be enabled.
    """
    with in_python(), _motor_file(trajectory) as (path, own):
        chosen = {**own, **({} if model is None else {"model": _path_of(model)}), **options}
        more = {"trajectory", *keys_of(SecondArm)}
        run = _run(say, more, trajectory=path, joint_map=joint_map, **chosen)
        plan = run.plan()
        require_no_stop(run.checks(plan), "not played")
        run.require_free(plan)
        bus = run.simulated(run.simulated_arm(plan)) if simulate else run.bus()
        with bus as link:
            return _played(run, link, plan, say, real=not simulate)


def hold(
    model: Model,
    seconds: float,
    *,
    joint_map: Path | str | None = None,
    say: Say = lambda sentence: None,
    **options: Any,
) -> PlayReport:
    """Hold an arm where it stands for some time [s], as ``robot-sysid motors hold`` does.

    For the other arguments, what is returned and what is raised see ``play``.
    """
    if not seconds > 0.0:
        raise InputError(f"seconds must be above 0, got {seconds}")
    with in_python():
        run = _run(say, set(), model=_path_of(model), joint_map=joint_map, **options)
        with run.bus() as link:
            plan = run.hold_plan(inspect_bus(link))
            require_no_stop(run.checks(plan), "not held")
            run.require_free(plan)
            return _played(run, link, lasting(plan, seconds), say, real=False)


def _path_of(model: Model) -> Path:
    from robot_sysid.api.models import path_of

    return path_of(model)


def _run(say: Say, more: set[str], **values: Any) -> MotorRun:
    refuse_unknown(values, keys_of(*MOTOR_RECORDS) | {*LIMITS, "model", "joint_map"} | more)
    return MotorRun(values, lambda words, last: say(words))


def _played(run: MotorRun, link: GuardedLink, plan: Plan, say: Say, real: bool) -> PlayReport:
    stop, inspection = StopRequest(), inspect_bus(link)
    require_no_stop(run.met_checks(plan, inspection, real), "not played")
    with stop.on_signals():
        told = stop, say, lambda time: None, run.holding(plan)
        return execution.run(link, plan, inspection, *told)


@contextlib.contextmanager
def _motor_file(trajectory: Path | str | PlanResult) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield the file of a trajectory, and which arm it is for, where a plan tells."""
    from robot_sysid.api.results import PlanResult
    from robot_sysid.pipeline import motor_writer

    if not isinstance(trajectory, PlanResult):
        yield Path(trajectory), {}
        return
    if trajectory.failure:
        raise SysidError(f"{trajectory.failure}; not played")
    config = trajectory.config
    write = motor_writer(config, trajectory.robot, trajectory.checked.plan)
    if write is None:
        raise InputError("the plan is for no motors; give rs.plan export_damiao and motor_type")
    arm = {each.key: getattr(config.model, each.key) for each in given_options(config.model)}
    with temporary_folder() as folder, open(folder / DAMIAO_NAME, "w", encoding="utf-8") as file:
        write(file)
        file.flush()
        yield folder / DAMIAO_NAME, {"model": config.model.path, **arm}
