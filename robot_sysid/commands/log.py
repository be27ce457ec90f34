"""``robot-sysid log LOG MODEL``: what is in a log, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robot_sysid.commands import Console
from robot_sysid.commands.arguments import Command, LogArgument
from robot_sysid.errors import InputError
from robot_sysid.logs import LogOptions
from robot_sysid.model import OF_LOG, ModelOptions
from robot_sysid.pipeline.next_steps import SAME_LOG, step_after
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.option_fields import (
    Option,
    given_values,
    options_of_all,
    record_from,
)


def run(values: Mapping[str, Any], console: Console) -> int:
    """Print a log's findings against a model and return the exit code.

    SysidError where a finding is not accepted; it is raised when all is printed.
    """
    from robot_sysid.config import with_scale_prior
    from robot_sysid.estimate.options import EstimationOptions
    from robot_sysid.estimate.questions import Question
    from robot_sysid.faults.gate import judge, not_acceptable, require_acceptable
    from robot_sysid.logs.reader import open_logs
    from robot_sysid.parser import load_robot_model

    paths = record_from(LogArgument, values).log
    log_options = record_from(LogOptions, values)
    model_options = record_from(ModelOptions, values)
    robot = load_robot_model(values["path"], **given_values(model_options))
    log, *others = open_logs(robot, paths, log_options, console)
    if others:
        listed = ", ".join(map(str, [log, *others]))
        raise InputError(f"{listed} are logs of their own: check them one by one")
    count = len(log)
    rate = (count - 1) / log.duration
    console.stage(f"{log.name}: {count} samples in {log.duration:.4g} s, {rate:.4g} Hz")
    console.stage(*map(str, log.notes))  # As plain text: details are printed here.
    options = with_scale_prior(EstimationOptions(), log_options, robot.joint_names)
    findings = judge(robot, [log], Question(options), console).findings
    # What stops an identification is in the error.
    stopping = not_acceptable(findings, log_options.accept)
    said = [each for each in findings if each not in stopping]
    console.stage(*(finding.line() for finding in said))
    console.result(
        {
            "log": log.name,
            "samples": count,
            "duration": log.duration,
            "sample_rate": rate,
            "notes": log.notes,
            "findings": findings,
        }
    )
    require_acceptable([log], findings, log_options.accept)
    start = "Log can be used, with what is said above" if findings else "Log is fine"
    console.stage(f"{start}: nothing that stops an identification was found")
    console.stage(*step_after(SAME_LOG, values, log=paths).lines())
    return 0


_ARGUMENTS = (
    *options_of_all(LogArgument),
    Option("path", "MJCF, URDF or xacro file", metavar="MODEL", parse=Path),
)
COMMANDS = (
    Command(
        "log",
        "log log.csv arm.xml",
        "Say what is in a log of the real arm: its form, its columns and their units, and look for "
        f"what is wrong with it, as every identification does: {', '.join(FaultName)}.",
        {
            "": _ARGUMENTS,
            "model": options_of_all(ModelOptions, only=OF_LOG),
            "log": options_of_all(LogOptions),
        },
        run,
        interrupted="interrupted; nothing was written",
    ),
)
