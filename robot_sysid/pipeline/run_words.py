"""The words of a run's command line that its next step repeats."""

from __future__ import annotations

from pathlib import Path

from robot_sysid.config import Config, IdentifyConfig, PayloadConfig
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.model import ModelOptions
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import given_arguments
from robot_sysid.results.next_steps import step_after
from robot_sysid.results.quantities import BEYOND, MOMENT
from robot_sysid.results.record import Result
from robot_sysid.results.table import KNOWN

# Keys of the options that hold for every log of the same arm.
_READING = ("columns", "units", "torque_scale", "torque_constants", "topic")


def step_after_run(config: Config, result: Result) -> NextStep | None:
    """Return what to do after an identification that may be used, or None for nothing more."""
    model = str(config.model.path)
    arm = given_arguments(config.model)
    folder = config.output.output_dir
    if not result.is_measured:
        return step_after("self-test passed", model=model, options=arm, folder=folder)
    if not isinstance(config, PayloadConfig):
        parts = [result.quantity(name, BEYOND) for name in (MOMENT, "mass")]
        ratios = [part.value / part.error for part in parts if part and part.error]
        if (
            not isinstance(config, IdentifyConfig)
            or max(ratios, default=0.0) < INTERVAL
        ):
            if result.body.errors[0] < KNOWN * result.body.mass:
                return None
            return step_after("mass not known", model=model, options=arm, folder=folder)
        # Weighing it by difference, to 1 to 5 %, gains little.
        if ratios[-1] > 20.0:
            return None
        return step_after(
            "part bolted on",
            model=model,
            log=list(map(str, config.log.measurements)),
            options=arm + given_arguments(config.log, _READING),
            folder=folder,
        )
    payload = config.payload
    empty = [str(log) for log in payload.empty if isinstance(log, Path)]
    if payload.known_mass is None or payload.save_torque_scale is None or not empty:
        return None
    # The scales that the run began with are in those that it writes.
    reading = [key for key in _READING if key != "torque_scale"]
    return step_after(
        "torque scales known",
        model=model,
        log=empty,
        options=arm + given_arguments(config.log, reading),
        scales=str(payload.save_torque_scale),
    )


def add_weighing_commands(
    error: InputError, arm: ModelOptions, options: LogOptions, log: Path
) -> None:
    """Add the command that weighs torque scales to an error whose options are for ``payload``.

    Args:
        error: what stopped the reading of a log; one with options for other commands is left.
        arm: the model of the run, and which arm in it.
        options: how the log was read.
        log: the log, of the arm without a weight.
    """
    if error.command != "payload":
        return
    # The remedy's own options, such as the torque scales, replace those of the run.
    remedy_words = {word for option in error.options for word in option}
    reading = [
        key for key in _READING if f"--{key.replace('_', '-')}" not in remedy_words
    ]
    words = given_arguments(arm) + given_arguments(options, reading)
    # The recording with the weight has the form of the log, and lies beside it.
    weight = str(log.with_name(f"weight{log.suffix}"))
    commands = []
    for remedy in error.options:
        step = step_after(
            "torque scales unknown",
            model=str(arm.path),
            log=str(log),
            weight=weight,
            options=[*words, *remedy],
        )
        commands.append(step.command[1:])
    error.command_lines = commands
