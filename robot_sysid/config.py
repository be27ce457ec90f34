"""What a run was asked to do: one frozen record, checked once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.least_squares import EstimatorOptions
from robot_sysid.estimation.registry import estimator
from robot_sysid.excitation.options import ExcitationOptions
from robot_sysid.records.options import require_positive
from robot_sysid.signals.process import SignalOptions
from robot_sysid.simulation.sensors import SensorOptions

MOST_SAMPLES = 1e9
"""Samples of a run; more would take days."""
SIMULATIONS = ("inverse", "forward")
EXCITATIONS = ("sines", "optimal")


@dataclass(frozen=True)
class SysidConfig:
    """Options of one identification; defaults are those of the command line.

    Attributes:
        model: MJCF or URDF file.
        mesh_dir: folder of the meshes; None takes what the model says.
        duration: trajectory length [s].
        sample_rate: samples per second [Hz].
        friction: whether to identify friction.
        output_dir: folder of the results.
        export_damiao: whether to write a trajectory for Damiao motors.
        motor_types: Damiao motor type per chain joint.
        can_ids, master_ids: of the motors; empty counts from 1, and adds 0x10 for replies.
        damiao_rate: rows per second of the motor trajectory [Hz]; None takes the sample rate.
        supply: voltage of the motors' supply [V], for comparing speeds with their no-load speed.
        seed: of the random trajectory and the simulated noise; None draws a fresh one.
        joint: terminal joint; None finds it.
        torques: "chain" or "terminal".
        max_velocity: speed limit of hinge joints [rad/s].
        excitation: "sines" for random sinusoids, "optimal" for a designed trajectory.
        design: how a trajectory is designed, and what a plan is checked against.
        trajectory: file of an earlier trajectory to use again.
        save_trajectory: file for the coefficients (JSON); samples go beside it as CSV.
        plan_only: whether to stop after the trajectory is made, checked and written.
        speed: factor that slows the whole trajectory down.
        measurements: a log of the arm; None simulates.
        columns: file that names the log's columns.
        units: units of the log, such as "deg" or "deg,ms".
        plant_model: model file that plays the real arm; None simulates the model itself.
        simulation: "inverse" or "forward", how the plant is simulated.
        sensors: the plant's sensors.
        save_measurements: file for the measurements that were analysed.
        signals: filtering of measured data.
        friction_model: friction terms of measured data; None takes the default, "auto" chooses.
        estimate_delay, estimate_tilt: whether torque may lag position, the base may be tilted.
        method: estimator; None takes "wls" for measured data, else "ols".
        estimator: physical consistency, prior.
        validate: share of a log, at its end, that is not fitted.
        validation_measurements: another log to test the result on.
    """

    model: Path
    mesh_dir: Path | None = None
    duration: float = 15.0
    sample_rate: float = 1000.0
    friction: bool = True
    output_dir: Path = Path("sysid_output")
    export_damiao: bool = False
    motor_types: tuple[str, ...] = ()
    can_ids: tuple[int, ...] = ()
    master_ids: tuple[int, ...] = ()
    damiao_rate: float | None = None
    supply: float | None = None
    seed: int | None = None
    joint: str | None = None
    torques: str = "chain"
    max_velocity: float = 2.0
    excitation: str = "sines"
    design: ExcitationOptions = field(default_factory=ExcitationOptions)
    trajectory: Path | None = None
    save_trajectory: Path | None = None
    plan_only: bool = False
    speed: float = 1.0
    measurements: Path | None = None
    columns: Path | None = None
    units: str | None = None
    plant_model: Path | None = None
    simulation: str = "inverse"
    sensors: SensorOptions = field(default_factory=SensorOptions)
    save_measurements: Path | None = None
    signals: SignalOptions = field(default_factory=SignalOptions)
    friction_model: str | None = None
    estimate_delay: bool = False
    estimate_tilt: bool = False
    method: str | None = None
    estimator: EstimatorOptions = field(default_factory=lambda: EstimatorOptions("auto"))
    validate: float = 0.2
    validation_measurements: Path | None = None

    def __post_init__(self) -> None:
        self._check_trajectory()
        self._check_damiao()
        self._check_excitation()
        self._check_source()
        self._check_estimation()

    @property
    def is_measured(self) -> bool:
        """Whether the data comes from a log or a plant instead of the model itself."""
        return self.measurements is not None or self.plant_model is not None

    @property
    def estimation_method(self) -> str:
        """The estimator's name."""
        return self.method or ("wls" if self.is_measured else "ols")

    def _check_trajectory(self) -> None:
        require_positive(self.duration, "--duration")
        require_positive(self.sample_rate, "--sample-rate")
        require_positive(self.max_velocity, "--max-velocity")
        if self.duration * self.sample_rate < 1.0:
            raise InputError(
                "--duration times --sample-rate gives less than two samples; raise one of them"
            )
        if self.duration * self.sample_rate > MOST_SAMPLES:
            raise InputError(
                f"--duration times --sample-rate gives {self.duration * self.sample_rate:.3g} "
                f"samples, more than the {MOST_SAMPLES:.0e} a run can take; lower one of them"
            )
        if self.seed is not None and self.seed < 0:
            raise InputError(f"--seed must not be negative (got {self.seed})")

    def _check_damiao(self) -> None:
        if self.export_damiao and not self.motor_types:
            raise InputError(
                "--export-damiao requires at least one --motor-type, one per joint of the chain"
            )
        given = {
            "--motor-type": self.motor_types,
            "--can-id": self.can_ids,
            "--master-id": self.master_ids,
            "--damiao-rate": self.damiao_rate,
            "--supply": self.supply,
        }
        for option, value in given.items():
            if value and not self.export_damiao:
                raise InputError(f"{option} is only used together with --export-damiao; add it")
        for option, number in (("--damiao-rate", self.damiao_rate), ("--supply", self.supply)):
            if number is not None:
                require_positive(number, option)
        if self.export_damiao and self.measurements is not None:
            raise InputError("--export-damiao needs a trajectory; it does not go with a log")

    def _check_excitation(self) -> None:
        if self.excitation not in EXCITATIONS:
            raise InputError(f"--excitation {self.excitation!r}: choose one of {EXCITATIONS}")
        if not 0.0 < self.speed <= 1.0:
            raise InputError(f"--speed must be above 0 and at most 1 (got {self.speed:g})")
        wanted = {
            "--excitation optimal": self.excitation == "optimal",
            "--trajectory": self.trajectory is not None,
            "--save-trajectory": self.save_trajectory is not None,
            "--plan-only": self.plan_only,
            "--speed": self.speed != 1.0,
        }
        for option, given in wanted.items():
            if given and self.measurements is not None:
                raise InputError(f"{option} is about a trajectory; a log brings its own motion")
        if self.trajectory is not None and self.excitation == "optimal":
            raise InputError("--trajectory and --excitation optimal exclude each other")

    def _check_source(self) -> None:
        if self.measurements is not None and self.plant_model is not None:
            raise InputError("--measurements and --plant-model exclude each other; choose one")
        if self.simulation not in SIMULATIONS:
            raise InputError(f"--simulation {self.simulation!r}: choose one of {SIMULATIONS}")
        spoiled = not self.sensors.exact or self.simulation != "inverse"
        planned = self.plan_only or self.excitation == "optimal"
        if spoiled and self.plant_model is None and not planned:
            raise InputError(
                "sensor noise and --simulation forward belong to a simulated plant; add "
                "--plant-model (the model file itself will do)"
            )
        for option, value in (("--columns", self.columns), ("--units", self.units)):
            if value is not None and self.measurements is None:
                raise InputError(f"{option} describes a log; add --measurements LOG.csv")

    def _check_estimation(self) -> None:
        estimator(self.estimation_method)
        if self.friction_model not in (None, "auto"):
            friction_model(str(self.friction_model))
        if not 0.0 <= self.validate < 1.0:
            raise InputError(f"--validate must be at least 0 and below 1 (got {self.validate:g})")
        wanted = {
            "--friction-model": self.friction_model is not None,
            "--cutoff": self.signals.cutoff is not None,
            "--velocity-deadband": self.signals.velocity_deadband is not None,
            "--delay auto": self.estimate_delay,
            "--tilt auto": self.estimate_tilt,
            "--validation-measurements": self.validation_measurements is not None,
        }
        for option, given in wanted.items():
            if given and not self.is_measured:
                raise InputError(f"{option} needs --measurements or --plant-model")
        if self.friction_model is not None and not self.friction:
            raise InputError("--friction-model and --no-friction exclude each other")
