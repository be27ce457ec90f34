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
LOADED_NAME = "loaded.csv"
"""Name under which the recording with a payload is expected."""
PAYLOAD_RECORDINGS = (EMPTY_NAME, LOADED_NAME, "loaded_again.csv", "empty_again.csv")
"""Names of the recordings of a motion for a payload, in the order ``PAYLOAD_ORDER``."""
_WEIGHT_NAME = "weight.csv"
"""Name under which the recording with a weight of known mass is expected."""
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
        model: model file of the run.
        arm: options that choose the arm in the model.
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
        speeds: options with speed limits that the model to plan with does not state.
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
    speeds: tuple[str, ...] = ()


def use_lines(path: Path) -> tuple[str, ...]:
    """Return the line that names the model file to use, and a line of Python that loads it."""
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
    for path in files:
        if path.name == CARD_NAME and result.payload is not None:
            frame = result.payload.flange.name
            lines.append(f"Copy into the controller, in the frame of {frame}: {path}")
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
        return _plan_step(
            "Next, plan a motion for the arm, to record it", run, run.model
        )
    if result.payload is not None:
        return _step_after_payload(result, result.payload, run)
    models = models_in(files)
    model = str(models[0]) if models else run.model
    speeds = result.robot.limits.velocity
    # An MJCF that was written for a URDF's arm states no speed limits.
    if result.model_kind != result.robot.kind and min(speeds) < DEFAULT_MAX_VELOCITY:
        listed = ",".join(map("{:.4g}".format, speeds))
        run = replace(run, speeds=("--max-velocity", listed))
    if run.plan_purpose == WEIGHT:
        sentence = "Next, plan a motion with this model, whose weight fits the arm"
        return _plan_step(sentence, run, model)
    return _step_after_link(result, run, model)


def _step_after_link(result: Result, run: RunWords, model: str) -> NextStep | None:
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
    if run.plan_purpose is None and (is_unknown or is_asked):
        sentence = f"Next, {purpose}, plan a wider and faster motion of all joints"
        return _plan_step(sentence, run, model, "arm" if run.links else "link")
    if is_unknown or (is_uncertain and cause == "links"):
        sentence = f"Next, {purpose}, weigh what is bolted on by difference"
        return _plan_step(sentence, run, model, "payload")
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
        return _calibration_step(run)
    if cause in _MOTION and run.plan_purpose is None:
        sentence = "Next, to know the mass better, plan a wider and faster motion"
        return _plan_step(sentence, run, run.model, "payload")
    if cause in _MEASURES:
        return NextStep(f"Next, to know the mass better, {_MEASURES[cause]}")
    return None


def _calibration_step(run: RunWords) -> NextStep:
    """Return the step that determines torque scales with a weight of known mass."""
    recording = run.folder / _WEIGHT_NAME
    folder = run.folder / "torque_scale"
    sentence = (
        "Next, to know the torque scales, bolt a weight of 1 kg on instead (of another one, state "
        f"its mass), record the same motion as {recording}, and compare"
    )
    command = ["robot-sysid", "payload", run.model, *run.arm, *run.log]
    command += ["--empty", *run.empty, "--loaded", str(recording), "--known-mass", "1"]
    command += ["--save-torque-scale", str(folder / _SCALE_NAME)]
    return NextStep(sentence, (*command, "--output-dir", str(folder)))


def weighing_words(run: RunWords, log: Path, scales: Sequence[str]) -> list[str]:
    """Return the words, behind the program's name, of the command that weighs torque scales.

    Args:
        run: the run that read the log.
        log: recording of the arm without the weight; that with it has its form and folder.
        scales: option and value of the scales to begin with.
    """
    recording = log.with_name(f"weight{log.suffix}")
    folder = Path("torque_scale")
    command = ["payload", run.model, *run.arm, *run.log, "--empty", str(log)]
    command += ["--loaded", str(recording), "--known-mass", "1", *scales]
    command += ["--save-torque-scale", str(folder / _SCALE_NAME)]
    return [*command, "--output-dir", str(folder)]


def _step_after_calibration(run: RunWords) -> NextStep | None:
    """Return the step that uses the torque scales which a known mass has determined.

    It repeats the run whose folder the scales lie in. Without such a run, it identifies the arm
    from the recordings without the weight.
    """
    settings = run.folder.parent / RUN_NAME
    if run.scales is None or not (run.empty or settings.is_file()):
        return None
    if not settings.is_file():
        command = ["robot-sysid", "identify", run.model, *run.empty, *run.arm, *run.log]
        sentence = (
            "Next, identify the arm with these torque scales, as in every later run"
        )
        return NextStep(sentence, (*command, "--torque-scale", run.scales))
    command = ["robot-sysid", "payload", "--config", str(settings)]
    sentence = "Next, weigh the payload again with these torque scales"
    return NextStep(sentence, (*command, "--torque-scale", run.scales))


def _plan_step(
    sentence: str, run: RunWords, model: str, purpose: str = "link"
) -> NextStep:
    """Return the step that plans another motion.

    The settings of the motion that was recorded, such as its limits and motors, hold for it, too.

    Args:
        sentence: what the motion is planned for.
        run: the run that the step follows.
        model: the model file to plan with.
        purpose: of the motion, as in ``--for``.
    """
    command = ["robot-sysid", "plan", model, *run.arm, *run.speeds]
    if run.plan is not None:
        command += ["--config", str(run.plan)]
    if run.plan is not None or purpose != "link":
        command += ["--for", purpose]
    folder = run.folder / ("weighing" if purpose == "payload" else "planned")
    return NextStep(sentence, (*command, "--output-dir", str(folder)))


def step_after_plan(
    run: RunWords,
    files: Sequence[Path],
    purpose: str = "link",
    limits: Sequence[str] = (),
    is_static: bool = False,
) -> NextStep:
    """Return what to do with a planned motion: rehearse it on motors, or record and identify.

    Args:
        run: the plan; its folder is where recordings and results of the motion go.
        files: the files that were written.
        purpose: of the motion, as in ``--for``.
        limits: options with limits that motors are to keep.
        is_static: whether the motion rests at poses.
    """
    for path in files:
        if path.name == DAMIAO_NAME:
            command = [
                "robot-sysid",
                "motors",
                "simulate",
                str(path),
                "--model",
                run.model,
            ]
            sentence = "Next, rehearse the motion on simulated motors"
            return NextStep(sentence, (*command, *run.arm, *limits, "--play"))
    log = run.folder / LOG_NAME
    empty = run.folder / EMPTY_NAME
    loaded = run.folder / LOADED_NAME
    sentence = f"Next, play it, record it as {log}, and identify the arm"
    if purpose == "payload":
        later_logs = [str(run.folder / name) for name in PAYLOAD_RECORDINGS[2:]]
        sentence = (
            f"Next, play it without what is bolted on and record it as {empty}, then twice with it "
            f"as {loaded} and {later_logs[0]}, once more without it as {later_logs[1]}, and weigh "
            "the difference"
        )
    recording = loaded if purpose == "payload" else log
    return step_after_recording(run, recording, purpose, is_static, sentence)


def step_after_recording(
    run: RunWords,
    recording: Path,
    purpose: str = "link",
    is_static: bool = False,
    sentence: str = "Next, identify the arm",
) -> NextStep:
    """Return the step that identifies from the recording of a planned motion.

    An identification begins with the model that an earlier one began with, and takes that one's
    logs as well: a written model is no independent prior, as its errors would count as known.

    Args:
        run: what the command repeats; its folder is that of the results.
        recording: the recording; of a payload one of ``PAYLOAD_RECORDINGS``, beside the others.
        purpose: of the motion, as in ``--for``.
        is_static: whether the motion rests at poses.
        sentence: what to do.
    """
    command = ["robot-sysid", "identify", *(run.origin or [run.model]), str(recording)]
    if purpose == "payload":
        command = ["robot-sysid", "payload", run.model]
        names = PAYLOAD_RECORDINGS
        first, second, third, last = (str(recording.with_name(n)) for n in names)
        command += ["--empty", first, last, "--loaded", second, third]
        command += ["--order", PAYLOAD_ORDER]
        command += ["--static"] if is_static else []
    command += ["--links"] if purpose == "arm" else []
    command += [*run.arm, *run.log, "--output-dir", str(run.folder)]
    return NextStep(sentence, tuple(command))
