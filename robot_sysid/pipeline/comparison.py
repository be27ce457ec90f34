"""Whether an arm is what it was, or what its model says: by logs of two sides, or of one.

Two runs, or a log since an earlier one, are fitted at once: errors that both sides share, such as
those of the other links and of torque scales, are there once. Without an earlier side the model
takes its place. Rows, verdict and remedies are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any

from robot_sysid.config import IdentifyConfig, PayloadConfig, with_scale_prior
from robot_sysid.errors import InputError, SysidError
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.questions import Question
from robot_sysid.estimate.terms import ArmTerms
from robot_sysid.faults import Finding
from robot_sysid.faults.gate import judge, require_acceptable, usable_fit
from robot_sysid.faults.misfits import misfit
from robot_sysid.logs import FittedLogOptions
from robot_sysid.logs.reader import open_logs, refuse_repeated_logs
from robot_sysid.pipeline.changes import (
    ALL_JOINTS,
    DIFFERS,
    NOT_JUDGED,
    OTHER_FRICTION,
    UNKNOWN,
    Change,
    Kind,
    change_question,
    changes,
    differences,
    model_question,
)
from robot_sysid.pipeline.stages import load_arm
from robot_sysid.records import Recording, RobotModel
from robot_sysid.records.fault_names import FaultName, Needs, StandsFor
from robot_sysid.records.file_access import RUN_NAME, read_toml
from robot_sysid.records.messages import (
    Detail,
    Level,
    Progress,
    count_text,
    number_text,
    with_error,
)
from robot_sysid.records.parameters import INERTIAL
from robot_sysid.report.runs import Run, load_run
from robot_sysid.wording import option_name

# Friction that holds a joint at a turn and lets go looks like a contact: it is said as what it is.
_MOMENTARY = FaultName.CONTACT
_LOOK = "look after these joints, and at the log by itself: robot-sysid log LOG MODEL"
# Faults that both sides share, which is no change, or that are compared.
_SHARED = (FaultName.TORQUE_SCALE, FaultName.ZERO)
# What is compared, in words.
_WORDS = {
    Kind.LOAD: "load",
    Kind.FRICTION: "friction",
    Kind.ZERO: "zero",
    Kind.SCALE: "torque scale",
    Kind.OFFSET: "torque offset",
    Kind.DELAY: "delay",
    Kind.TILT: "tilt",
    Kind.WEIGHT: "weight",
}
# What is compared, to the sensor whose reading it is.
_READINGS = {
    Kind.ZERO: "the position",
    Kind.SCALE: "the torque",
    Kind.OFFSET: "whatever the motion, the torque",
}
# What has changed, to what to do.
_REMEDIES = {
    Kind.LOAD: "take off what came on, put back what came off, or weigh it (payload) and use the "
    "model with it",
    Kind.ZERO: "set the joint's zero anew",
    Kind.SCALE: "calibrate the joint's torque, and look after its gear ratio and motor",
    Kind.OFFSET: "set the torque sensor's zero anew, and look for a cable, a spring or a hose",
    Kind.WEIGHT: "check that the model is of this arm, with all that is fixed to its links",
    Kind.TILT: "level the base, or turn it in the model",
    Kind.DELAY: "record torques and positions at the same instant",
    Kind.FRICTION: "record again when the gears are as warm as before; if it stays, look after "
    "brake, grease and belt, and identify the arm again",
}


@dataclass(frozen=True)
class Check:
    """Whether an arm is what it was, or what its model says.

    Attributes:
        logs: names of the logs that were checked.
        since: names of the earlier logs; () where the logs were compared with the model.
        has_changed: whether anything differs, beyond errors and what is usual: of two sides from
            day to day, of an arm and its model as models are.
        changes: the numbers that were compared.
        verdict: what differs and what to do; or from which size on a change would have been named,
            and what the logs do not show.
        notes: what is said of the arm and not judged, such as its friction.
    """

    logs: tuple[str, ...]
    since: tuple[str, ...]
    has_changed: bool
    changes: tuple[Change, ...]
    verdict: tuple[str, ...]
    notes: tuple[str, ...] = ()


def check_log(
    config: IdentifyConfig,
    since: Sequence[Any],
    progress: Progress,
    same_day: bool = False,
) -> Check:
    """Return whether an arm is what it was, by a log of any motion and an earlier one.

    Args:
        config: names the model and the log, and says how that is read.
        since: the earlier log, as ``open_logs`` takes it, or the folder of a run on earlier logs,
            with whose options these are read; () compares the log with the model.
        progress: receives stages.
        same_day: whether both logs are of one day, with the gears as warm.

    Raises:
        InputError: a log cannot be used or is none of this arm, or both show nothing.
        SysidError: there is a doubt that is not accepted.
    """
    robot = load_arm(config, progress)
    if not since:
        return compare_with_model(
            robot, _read(robot, config, progress), config, progress
        )
    folders = [path for path in since if isinstance(path, Path)]
    is_run = [(path / RUN_NAME).is_file() for path in folders] == [True]
    weighed = False
    try:
        # Options of the command are those of the log alone: an earlier log has its own.
        earlier = replace(config, log=FittedLogOptions(measurements=tuple(since)))
        if is_run:
            run = load_run(folders[0])
            weighed = bool(run.content["payload"])
            earlier = _config_of_empty(run) if weighed else _configs_of([run])[0]
        first = _read(robot, earlier, progress)
        if not is_run:
            found = _found_alone(robot, first, earlier)
            require_acceptable(first, found, (*config.log.accept, *_SHARED))
    except SysidError as error:
        raise _of_earlier(error, config.model.path, since) from None
    second = _read(robot, config, progress)
    names, earlier_names = (tuple(log.name for log in side) for side in (second, first))
    # Both sides with one name would be one log.
    first = [replace(log, name=f"{log.name} ({option_name('since')})") for log in first]
    try:
        sides = (first, second)
        rows = compare_logs(robot, sides, (earlier, config), progress, same_day)
    except SysidError:
        # What is wrong with the log alone says more.
        found = _found_alone(robot, second, config)
        require_acceptable(second, found, config.log.accept)
        raise
    changed = {row.kind for row in rows if row.reason == DIFFERS}
    if changed:
        # A log that is wrong differs, too. A zero that has moved is what was asked.
        found = _found_alone(robot, second, config)
        if changed == {Kind.ZERO}:
            found = [each for each in found if each.about is not FaultName.ZERO]
        require_acceptable(second, found, (*config.log.accept, *_SHARED))
    if all(row.reason == UNKNOWN for row in rows):
        raise InputError(
            f"{second[0].name} shows nothing that could have changed: its joints hardly move, or "
            "those of the earlier log; record a motion of all joints"
        )
    notes: tuple[str, ...] = ()
    if weighed:
        notes = (
            f"{folders[0]} is of a weighing: the log is compared with those without the payload "
            f"({', '.join(earlier_names)}), so that a payload which is on now comes on as a load",
        )
    has_changed = bool(changed)
    return Check(
        names, earlier_names, has_changed, tuple(rows), verdict_on(rows), notes
    )


def compare_with_model(
    robot: RobotModel,
    logs: Sequence[Recording],
    config: IdentifyConfig,
    progress: Progress,
) -> Check:
    """Return whether an arm is what its model says, by logs of any motion.

    What the checks of logs find that no row stands for, such as a load that was dropped, is said in
    their words. Where nothing explains the torques, no number is named.

    Raises:
        InputError: the logs show too little, or are refused.
    """
    progress.stage(Detail("Comparing with the model..."))
    estimation = with_scale_prior(config.estimation, config.log, robot.joint_names)
    estimation = replace(estimation, torques="chain", no_friction=False)
    judged = judge(robot, logs, model_question(estimation), progress)
    names = tuple(log.name for log in logs)
    if judged.fit is None:
        require_acceptable(judged.logs, judged.findings)
        raise AssertionError("a log without a fit is refused")
    found = [
        each
        for each in judged.findings
        if each.level is not Level.SAYS
        and each.about not in (_MOMENTARY, *config.log.accept)
    ]
    differing = differences(judged.fit)
    rows, explains = differing.rows, differing.explains
    is_differing = any(row.reason == DIFFERS for row in rows)
    notes = friction_sentences(rows)
    if not (explains and is_differing):
        notes = (*_said(judged.findings), *notes)
    notes = (*_momentary(judged.fit), *notes)
    if explains and not is_differing:
        # Links that are off as a whole, but not what they weigh at any joint, are no difference.
        found = [each for each in found if each.about is not FaultName.MODEL]
    # Numbers that explain all say more than what was found one after the other.
    if explains and (is_differing or not found):
        is_perhaps = is_differing and not differing.is_certain
        if is_perhaps:
            said = "; ".join(sentences(rows, True))
            notes = (f"perhaps, but not certain: {said}", *notes)
        verdict = verdict_on(rows, True, is_perhaps)
        return Check(names, (), differing.is_certain, rows, verdict, notes)
    # A number that does not explain is no answer.
    rows = tuple(
        replace(row, reason=UNKNOWN) if row.reason == DIFFERS else row for row in rows
    )
    if not found:
        found = [misfit(judged.fit, judged.fit, judged.fit.unexplained_share)]
    remedies = dict.fromkeys(each.remedy for each in found if each.remedy)
    verdict = (
        f"Differs from the model: {'; '.join(each.text for each in found)}",
        f"What to do: {'; '.join(remedies) or _LOOK}",
    )
    return Check(names, (), True, rows, verdict, notes)


def _momentary(fitted: Fit) -> tuple[str, ...]:
    """Return when torque was left over for a moment, which did not count; of many, how many."""
    stretches = [each for log in fitted.recordings for each in log.touched]
    if not stretches:
        return ()
    strongest = max(stretches, key=lambda stretch: stretch.stop - stretch.start)
    names = ", ".join(compress(fitted.arm.joints, strongest.joints))
    text = (
        f"from {strongest.start:.2f} s to {strongest.stop:.2f} s the torque of {names} is neither "
        "that of the links nor steady friction"
    )
    others = len(stretches) - 1
    return (f"{text}, and at {count_text(others, 'other time')}" if others else text,)


def _said(found: Iterable[Finding]) -> tuple[str, ...]:
    """Return what was found and is no doubt, of the arm and not of the log."""
    return tuple(
        each.text
        for each in found
        if each.level is Level.SAYS
        and each.about.needs >= Needs.COLUMNS
        and each.about is not _MOMENTARY
        and not each.about.stands_for & StandsFor.MOMENT
    )


def friction_sentences(rows: Sequence[Change]) -> tuple[str, ...]:
    """Return the friction of joints of which the model says clearly another: it is not judged."""
    parts = []
    for row in rows:
        is_friction = row.kind is Kind.FRICTION_IN_MOTION
        if is_friction and row.reason == NOT_JUDGED and row.model:
            share = (
                f"{1.0 - OTHER_FRICTION:g} of"
                if row.value < 0.0
                else f"{1.0 + OTHER_FRICTION:g} times"
            )
            way = "less than" if row.value < 0.0 else "more than"
            parts.append(f"{row.of} has {way} {share} its {row.model:.2g} {row.unit}")
    if not parts:
        return ()
    return (
        f"the model's friction is not this arm's, in this motion: {', '.join(parts)}",
    )


def compare_runs(runs: Sequence[Run], progress: Progress) -> list[Change]:
    """Return what may have changed from a first run to a second.

    Args:
        runs: two runs.
        progress: receives stages.

    Raises:
        InputError: there is no common fit of the two runs; the message says why.
        SysidError: there is a doubt that the runs have not accepted.
    """
    if len({run.content["model"]["sha256"] for run in runs}) > 1:
        raise InputError("the runs are of different model files")
    configs = _configs_of(runs)
    for key in ("mass_scale", "total_mass", "gravity"):
        if len({getattr(config.model, key) for config in configs}) > 1:
            raise InputError(f"the runs differ in {option_name(key)}")
    robot = load_arm(configs[0], Progress())
    if robot.sha256 != runs[0].content["model"]["sha256"]:
        raise InputError(f"{robot.path} has changed since the runs")
    sides = [_read(robot, config, progress) for config in configs]
    return compare_logs(robot, sides, configs, progress)


def _configs_of(runs: Sequence[Run]) -> list[IdentifyConfig]:
    """Return the options of runs on logs, and the paths of these."""
    if any(not run.content["logs"] or run.content["payload"] for run in runs):
        raise InputError("only identifications from logs have a common fit")
    configs = []
    for run in runs:
        config = IdentifyConfig.of(**read_toml(run.folder / RUN_NAME))
        # The options' own paths are relative to where the run was started.
        logs = tuple(map(Path, run.content["logs"]))
        configs.append(replace(config, log=replace(config.log, measurements=logs)))
    return configs


def _config_of_empty(run: Run) -> IdentifyConfig:
    """Return the options of a weighing for its logs without the payload, with their paths."""
    weighing = PayloadConfig.of(**read_toml(run.folder / RUN_NAME))
    logs = run.content["logs"][: len(weighing.payload.empty)]
    paths = tuple(map(Path, logs))
    return IdentifyConfig(
        model=weighing.model,
        log=FittedLogOptions(**vars(weighing.log), measurements=paths),
        estimation=weighing.estimation,
    )


def _read(
    robot: RobotModel, config: IdentifyConfig, progress: Progress
) -> list[Recording]:
    """Return the logs of one side."""
    return open_logs(robot, config.log.measurements, config.log, progress, "log")


def _found_alone(
    robot: RobotModel, logs: Sequence[Recording], config: IdentifyConfig
) -> list[Finding]:
    """Return what is wrong with the logs of one side, whatever the other side is."""
    estimation = with_scale_prior(config.estimation, config.log, robot.joint_names)
    judged = judge(robot, logs, Question(estimation), Progress())
    return _without_factors(judged.findings)


def _without_factors(found: Iterable[Finding]) -> list[Finding]:
    """Return findings but for a factor on all torques or masses: no change is one."""
    return [each for each in found if not each.is_common_factor]


def _of_earlier(error: SysidError, model: Path, since: Sequence[Any]) -> SysidError:
    """Return the error of an earlier log with what to do about it."""
    takes = f"{option_name('since')} takes an earlier log, or the folder of a run on it"
    text = f"{takes}: {error}"
    paths = [str(path) for path in since if isinstance(path, Path)]
    command_lines = []
    if paths and error.options:
        text += "; identify the arm from it with its options, and give the folder of that run"
        for option in error.options:
            command_lines.append(["identify", str(model), *paths, *option])
    return error.with_message(text, command_lines)


def compare_logs(
    robot: RobotModel,
    sides: Sequence[Sequence[Recording]],
    configs: Sequence[IdentifyConfig],
    progress: Progress,
    same_day: bool = False,
) -> list[Change]:
    """Return what may have changed from the logs of one side to those of the other.

    Args:
        robot: the arm.
        sides: logs of the first state of the arm, and of the second.
        configs: options of each side; those of the first side's fit count.
        progress: receives stages.
        same_day: whether both sides are of one day, with the gears as warm.
    """
    logs = [*sides[0], *sides[1]]
    refuse_repeated_logs(logs)
    progress.stage("Fitting both at once...")
    first = configs[0]
    estimation = with_scale_prior(first.estimation, first.log, robot.joint_names)
    estimation = replace(estimation, torques="chain", no_friction=False)
    question = change_question(ArmTerms(robot, loaded=True), estimation, same_day)
    is_loaded = [False] * len(sides[0]) + [True] * len(sides[1])
    orders = [1.0 if loaded else -1.0 for loaded in is_loaded]
    judged = judge(robot, logs, question, progress, is_loaded, orders)
    accepted: set[str] = {*_SHARED}
    for config in configs:
        accepted |= {*config.log.accept}
    judged = replace(judged, findings=tuple(_without_factors(judged.findings)))
    fitted, _ = usable_fit(judged, accepted, progress)
    return changes(fitted)


def sentences(rows: Sequence[Change], of_model: bool = False) -> list[str]:
    """Return what differs, a sentence each; or from which sizes on a difference would be named.

    ``of_model`` is whether the rows are differences from the model, and not from an earlier side.
    """
    sentence = _sentence_of_model if of_model else _sentence
    # The first of what has changed of a body: a mass that came on has first moments, too.
    found: dict[tuple[str, Kind], str] = {}
    for row in rows:
        if row.reason == DIFFERS:
            found.setdefault((row.of, row.kind), sentence(row))
    if found:
        return list(found.values())
    least: dict[tuple[str, str], list[float]] = {}
    unknown: dict[str, list[str]] = {}
    for row in rows:
        # First moments of a load are not told apart from it, nor is friction in motion judged.
        is_said = _is_mass(row) if row.kind is Kind.LOAD else row.kind in _WORDS
        if not is_said or row.of == ALL_JOINTS:
            continue
        if row.reason == UNKNOWN:
            unknown.setdefault(_WORDS[row.kind], []).append(row.of)
        else:
            sizes_of = least.setdefault((_WORDS[row.kind], row.unit), [])
            sizes_of.append(row.least_either_way)
    sizes = []
    for (words, unit), values in least.items():
        ends = (min(values), max(values))
        span = dict.fromkeys(number_text(size, size) for size in ends)
        sizes.append(f"{' to '.join(span)} {unit} of {words}")
    unseen = f"less than this would not show: {', '.join(sizes)}"
    lines = [f"no difference beyond the errors; {unseen}"]
    if unknown:
        parts = [
            f"{words} of {', '.join(of)}" if any(of) else words
            for words, of in unknown.items()
        ]
        lines.append(f"not shown by these logs: {'; '.join(parts)}")
    return lines


def verdict_on(
    rows: Sequence[Change], of_model: bool = False, is_perhaps: bool = False
) -> tuple[str, ...]:
    """Return what has changed and what to do; or that nothing has, as far as the logs show.

    Args:
        rows: the numbers that were compared.
        of_model: whether they are differences from the model, and not from an earlier side.
        is_perhaps: whether these may be links that are as wrong as usual.
    """
    lines = sentences(rows, of_model)
    changed = [row.kind for row in rows if row.reason == DIFFERS]
    if not changed:
        same = "As the model says" if of_model else "Unchanged"
        return (f"{same}: {lines[0]}", *lines[1:])
    remedies = dict.fromkeys(_REMEDIES[kind] for kind in changed)
    differs = "Differs from the model" if of_model else "Changed"
    differs = "Perhaps differs from the model" if is_perhaps else differs
    return f"{differs}: {'; '.join(lines)}", f"What to do: {'; '.join(remedies)}"


def _is_mass(row: Change) -> bool:
    """Return whether a row is the mass of a load, and not one of its first moments."""
    return row.kind is Kind.LOAD and row.name == INERTIAL[0].name


def _sentence_of_model(row: Change) -> str:
    """Return what differs from the model, in words."""
    size = with_error(abs(row.value), row.error, row.unit)
    is_more = row.value > 0.0
    way = "more" if is_more else "less"
    if _is_mass(row):
        return f"{row.of} weighs {size} {way} than in the model"
    if row.kind is Kind.SCALE:
        owner = "all joints" if row.of == ALL_JOINTS else row.of
        return f"the torque of {owner} reads {size} {way} than the model: torque constant or masses"
    if row.kind is Kind.WEIGHT:
        return f"{row.of} carries {size} {way} than the model's links weigh"
    if row.kind is Kind.TILT:
        return f"the tilt of {row.of} is {size} {way} than the model's"
    if row.kind is Kind.DELAY:
        return f"the torque is {size} {'later' if is_more else 'earlier'} than the position"
    if row.kind in _READINGS:
        return _sentence(row)
    differing = with_error(row.value, row.error, row.unit)
    return f"mass times centre of mass of {row.of} along {row.name[1:]} differs by {differing}"


def _sentence(row: Change) -> str:
    """Return what has changed, in words."""
    size = with_error(abs(row.value), row.error, row.unit)
    is_more = row.value > 0.0
    if row.kind is Kind.FRICTION:
        return f"the friction of {row.of} is {size} {'higher' if is_more else 'lower'}"
    if _is_mass(row):
        return f"{size} came {'on' if is_more else 'off'} at {row.of}"
    if row.kind in _READINGS:
        way = "more" if is_more else "less"
        return f"{_READINGS[row.kind]} of {row.of} reads {size} {way}"
    moved = with_error(row.value, row.error, row.unit)
    return (
        f"mass times centre of mass of {row.of} along {row.name[1:]} changed by {moved}"
    )
