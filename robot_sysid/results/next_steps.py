"""What to do after an identification or a plan: which file to use, and the next command.

A path of commands ends: a step is suggested only where it improves a number that was asked for, and
none where the result is good enough.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robot_sysid.motion import PAYLOAD_ORDER, WEIGHT
from robot_sysid.records import Source
from robot_sysid.records.file_access import CARD_NAME, DAMIAO_NAME, RUN_NAME, models_in
from robot_sysid.records.messages import NextStep
from robot_sysid.records.option_fields import DEFAULT_MAX_VELOCITY
from robot_sysid.results.record import Payload, Result
from robot_sysid.results.verdict import UNKNOWN, largest_cause, verdict_line

LARGE = 0.02
"""Relative standard error of a mass above which the next step is to reduce it: friction and
sensors allow about that at best."""
LOG_NAME = "log.csv"
"""Name under which the recording of a planned motion is expected."""
EMPTY_NAME = "empty.csv"
"""Name under which the recording without a payload is expected."""
PAYLOAD_RECORDINGS = (EMPTY_NAME, "loaded.csv", "loaded_again.csv", "empty_again.csv")
"""Names of the recordings of a motion for a payload, in the order ``PAYLOAD_ORDER``."""
WEIGHT_STEM = "weight"
"""Name, without its ending, under which the recording with a known mass is expected."""
_SCALE_NAME = "torque_scale.json"
"""Name of the file of torque scales that weighing a known mass writes."""
_SCALES = ("torque scale", "common torque scale")
_MOTION = ("noise", "delay", "filtering")
"""Causes of a mass's error that a wider, faster motion reduces."""
_MEASURES = {
    "other links": "record the empty arm as long and as widely as the loaded one",
    "joint offsets": "calibrate the joints' zero positions",
    "gravity": "level the base, and state with --gravity-uncertainty how well",
    "friction model": "warm the arm up before recording",
}
"""Cause of a mass's error to what reduces it, where no command does."""


@dataclass(frozen=True)
class RunWords:
    """What the next step repeats of a run: words of its command line, and its folder.

    Attributes:
        model: model file of the run, or the one to go on with.
        arm: options that choose the arm in the model, and state what the model does not.
        log: options on how logs are read.
        folder: folder of the results.
        links: whether every link was asked for.
        origin: model and logs that an identification wrote ``model`` from; () where none did.
        empty: of a payload, the recordings without it.
        scales: file of torque scales that the run wrote, or what it was given for them; None for
            neither.
        plan: settings file of the planned motion that was recorded; None where no motion was
            planned, or its settings are not known.
        plan_purpose: what that motion was planned for, as in ``--for``; None where the recorded
            motion was not planned.
        is_out_of_reach: whether no motion of the arm determines the terminal link's mass.
        is_static: whether the motions of a payload's recordings rest at poses.
    """

    model: str
    arm: tuple[str, ...] = ()
    log: tuple[str, ...] = ()
    folder: Path = Path()
    links: bool = False
    origin: tuple[str, ...] = ()
    empty: tuple[str, ...] = ()
    scales: str | None = None
    plan: Path | None = None
    plan_purpose: str | None = None
    is_out_of_reach: bool = False
    is_static: bool = False


def use_lines(path: Path) -> tuple[str, str]:
    """Return the line that names the model file to use, and a line of Python that loads it.

    ``path`` is that of the written file.
    """
    text = json.dumps(str(path), ensure_ascii=False)
    return f"Use this file: {path}", f"  mujoco.MjModel.from_xml_path({text})"


def last_lines(
    result: Result, files: Sequence[Path], step: NextStep | None, failure: str | None
) -> tuple[str, ...]:
    """Return the last lines of the console: the verdict, which files to use, and the next step.

    Args:
        result: of the identification.
        files: the written files, among them the model and a payload's card.
        step: the next step, or None.
        failure: why a result that is usable in itself must not be used, or None.
    """
    lines = [verdict_line(result, failure)]
    if failure is not None:
        return tuple(lines)
    # A self-test writes back what its model says already.
    if result.data.source is not Source.ITSELF:
        for path in models_in(files)[:1]:
            lines += use_lines(path)
    if result.payload is not None:
        start = (
            f"Copy into the controller, in the frame of {result.payload.flange.name}"
        )
        lines += [f"{start}: {path}" for path in files if path.name == CARD_NAME]
    lines += () if step is None else step.lines()
    return tuple(lines)


def next_step(result: Result, run: RunWords, files: Sequence[Path]) -> NextStep | None:
    """Return what to do after an identification, or None where nothing is left to do.

    Args:
        result: the identification, which may be used.
        run: the run that made it.
        files: the files that it wrote.
    """
    if result.data.source is Source.ITSELF:
        return _plan_step("Next, plan a motion for the arm, to record it", run)
    if result.payload is not None:
        return _step_after_payload(result, result.payload, run)
    models = models_in(files)
    if models:
        run = replace(run, model=str(models[0]))
    speeds = result.robot.limits.velocity
    # An MJCF that was written for a URDF's arm states no speed limits.
    if result.model_kind != result.robot.kind and min(speeds) < DEFAULT_MAX_VELOCITY:
        listed = ",".join(map("{:.4g}".format, speeds))
        run = replace(run, arm=(*run.arm, "--max-velocity", listed))
    if run.plan_purpose == WEIGHT:
        sentence = "Next, plan a motion with this model, whose weight fits the arm"
        return _plan_step(sentence, run)
    return _step_after_link(result, run)


def _step_after_link(result: Result, run: RunWords) -> NextStep | None:
    """Return the step that determines the terminal link's mass better, where that is wanted.

    A model that predicts torques is done. Its mass is a question of its own where every link was
    asked for, or where the log leaves it open.
    """
    share = result.relative_mass_error
    cause = largest_cause(result.body)
    is_unknown = share is None or share >= UNKNOWN
    is_uncertain = share is None or share > LARGE
    is_asked = run.links and is_uncertain and cause in _MOTION
    purpose = "to know the mass better"
    if is_unknown:
        purpose = "to know the mass, which this log does not determine"
    can_improve = run.plan_purpose is None and not run.is_out_of_reach
    if can_improve and (is_unknown or is_asked):
        sentence = f"Next, {purpose}, plan a wider and faster motion of all joints"
        return _plan_step(sentence, run, "arm" if run.links else "link")
    if is_unknown or (is_uncertain and cause == "links"):
        sentence = f"Next, {purpose}, weigh what is bolted on by difference"
        return _plan_step(sentence, run, "payload")
    return None


def _step_after_payload(
    result: Result, payload: Payload, run: RunWords
) -> NextStep | None:
    """Return the step that determines a payload's mass better, where its error is large."""
    if payload.known_mass is not None:
        return _step_after_calibration(run)
    share = result.relative_mass_error
    cause = largest_cause(result.body)
    if share is None or share <= LARGE:
        return None
    if cause in _SCALES and run.scales is None and run.empty:
        recording = run.folder / f"{WEIGHT_STEM}.csv"
        sentence = (
            "Next, to know the torque scales, bolt a weight of 1 kg on instead (of another one, "
            f"state its mass), record the same motion {_recorder_text(run)}as {recording}, and "
            "compare"
        )
        return _step(sentence, *weighing_words(run, recording))
    if cause in _MOTION and run.plan_purpose is None:
        sentence = "Next, to know the mass better, plan a wider and faster motion"
        return _plan_step(sentence, run, "payload")
    if cause in _MEASURES:
        return NextStep(f"Next, to know the mass better, {_MEASURES[cause]}")
    return None


def _recorder_text(run: RunWords) -> str:
    """Return which recorder is to make a recording; "" for any, where no columns are given.

    Logs of another recorder have other columns, and the command that is printed would refuse them.
    """
    has_columns = "--columns" in run.log
    return "with the recorder that the columns file describes " if has_columns else ""


def weighing_words(
    run: RunWords, recording: Path, scales: Sequence[str] = ()
) -> list[str]:
    """Return the words, behind the program's name, of the command that weighs torque scales.

    Args:
        run: the run that read the recordings without the weight, ``run.empty``.
        recording: with a weight of known mass.
        scales: option and value of the scales to begin with.
    """
    folder = run.folder / "torque_scale"
    arguments = ["payload", run.model, *run.arm, *run.log, "--empty", *run.empty]
    arguments += ["--loaded", str(recording), "--known-mass", "1", *scales]
    arguments += ["--static"] if run.is_static else []
    arguments += ["--save-torque-scale", str(folder / _SCALE_NAME)]
    return [*arguments, "--output-dir", str(folder)]


def _step_after_calibration(run: RunWords) -> NextStep | None:
    """Return the step that uses the torque scales which a known mass has determined.

    It repeats the run whose folder the scales lie in. Without such a run, it identifies the arm
    from the recordings without the weight.
    """
    if run.scales is None:
        return None
    scale_words = ("--torque-scale", run.scales)
    settings = run.folder.parent / RUN_NAME
    if settings.is_file():
        sentence = "Next, weigh the payload again with these torque scales"
        return _step(sentence, "payload", "--config", str(settings), *scale_words)
    if not run.empty:
        return None
    sentence = "Next, identify the arm with these torque scales, as in every later run"
    logs = (*run.empty, *run.arm, *run.log)
    return _step(sentence, "identify", run.model, *logs, *scale_words)


def _plan_step(sentence: str, run: RunWords, purpose: str = "link") -> NextStep:
    """Return the step that plans another motion.

    The settings of the motion that was recorded, such as its limits and motors, hold for it, too.

    Args:
        sentence: what the motion is planned for.
        run: the run that the step follows, with the model to plan with.
        purpose: of the motion, as in ``--for``.
    """
    arguments = ["plan", run.model, *run.arm]
    if run.plan is not None:
        arguments += ["--config", str(run.plan)]
    if run.plan is not None or purpose != "link":
        arguments += ["--for", purpose]
    folder = run.folder / ("weighing" if purpose == "payload" else "planned")
    return _step(sentence, *arguments, "--output-dir", str(folder))


def _step(sentence: str, *arguments: str) -> NextStep:
    """Return the step that a command does, of which the words behind the program's name follow."""
    return NextStep(sentence, ("robot-sysid", *arguments))


def step_after_plan(
    run: RunWords,
    files: Sequence[Path],
    purpose: str = "link",
    limits: Sequence[str] = (),
) -> NextStep:
    """Return what to do with a planned motion: rehearse it on motors, or record and identify.

    Args:
        run: the plan; its folder is where recordings and results of the motion go.
        files: the files that were written.
        purpose: of the motion, as in ``--for``.
        limits: options with limits that motors are to keep.
    """
    for path in files:
        if path.name == DAMIAO_NAME:
            sentence = "Next, rehearse the motion on simulated motors"
            arm = ("--model", run.model, *run.arm)
            return _step(
                sentence, "motors", "simulate", str(path), *arm, *limits, "--play"
            )
    recording = run.folder / LOG_NAME
    recorder = _recorder_text(run)
    sentence = (
        f"Next, play it, record it {recorder}as {recording}, and identify the arm"
    )
    if purpose == "payload":
        logs = [run.folder / name for name in PAYLOAD_RECORDINGS]
        recording = logs[0]
        sentence = (
            f"Next, play it without what is bolted on and record it {recorder}as {logs[0]}, then "
            f"twice with it as {logs[1]} and {logs[2]}, once more without it as {logs[3]}, and "
            "weigh the difference"
        )
    return step_after_recording(run, recording, purpose, sentence)


def step_after_recording(
    run: RunWords,
    recording: Path,
    purpose: str = "link",
    sentence: str = "Next, identify the arm",
) -> NextStep:
    """Return the step that identifies from the recording of a planned motion.

    An identification begins with the model that an earlier one began with, and takes that one's
    logs as well: a written model is no independent prior, as its errors would count as known.

    Args:
        run: what the command repeats; its folder is that of the results.
        recording: the recording; of a payload one of ``PAYLOAD_RECORDINGS``, beside the others.
        purpose: of the motion, as in ``--for``.
        sentence: what to do.
    """
    arguments = ["identify", *(run.origin or [run.model]), str(recording)]
    if purpose == "payload":
        names = PAYLOAD_RECORDINGS
        first, second, third, last = (str(recording.with_name(n)) for n in names)
        arguments = ["payload", run.model, "--empty", first, last]
        arguments += ["--loaded", second, third, "--order", PAYLOAD_ORDER]
        arguments += ["--static"] if run.is_static else []
    arguments += ["--links"] if purpose == "arm" else []
    logs = (*run.arm, *run.log)
    return _step(sentence, *arguments, *logs, "--output-dir", str(run.folder))
