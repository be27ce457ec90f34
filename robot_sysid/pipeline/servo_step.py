"""What to do after servos were identified from a log of an arm without torque sensors."""

from __future__ import annotations

from dataclasses import replace

from robot_sysid.config import IdentifyConfig
from robot_sysid.logs import FittedLogOptions
from robot_sysid.pipeline.next_steps import step_after
from robot_sysid.records.messages import NextStep, percent
from robot_sysid.records.option_fields import command_arguments, options_of_all
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting
from robot_sysid.servo.result import ServoIdentification
from robot_sysid.servo.weighing import best_weighing

SETTINGS = options_of_all(FittedLogOptions, only=("servo_setting",))
"""The option that says what servos were recorded with."""


def step_after_servos(
    config: IdentifyConfig, result: ServoIdentification
) -> NextStep | None:
    """Return the recording with a weight that fixes the sizes of servos; None where none does.

    A weight that a log has already is not asked for again.
    """
    logs = config.log.measurements
    settings = _settings_of(config, len(logs))
    if any(setting.load_mass for setting in (result.setting, *settings)):
        return None
    weighing = best_weighing(result.robot, result.fit)
    if weighing is None:
        return None
    x, y, z = weighing.position
    empty = [replace(setting, load_mass=0.0) for setting in settings]
    weighed = replace(settings[0], load_mass=weighing.mass, load_position=(x, y, z))
    values = {"servo_setting": (*empty, weighed)}
    typed = command_arguments(values, SETTINGS)
    return step_after(
        "servo sizes unknown",
        {**vars(config.model), **vars(config.log)},
        *typed,
        log=logs,
        folder=config.output.output_dir,
        mass=f"{weighing.mass:g}",
        place=f"{x:g} {y:g} {z:g}",
        body=result.robot.links[-1].body_name,
        joints=", ".join(weighing.joints),
        now=percent(weighing.now),
        after=percent(weighing.after),
    )


def _settings_of(config: IdentifyConfig, count: int) -> list[ServoSetting]:
    """Return what the user says of each of the logs that are fitted."""
    typed = config.log.servo_setting
    return [*typed[:count]] if len(typed) > 1 else [*(typed or (UNKNOWN,))] * count
