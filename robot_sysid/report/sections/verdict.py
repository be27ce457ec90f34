"""What the run says, in words, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robot_sysid.mjcf.inertial import rmse_words
from robot_sysid.records.figures import percent, with_error
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.report.elements import Section
from robot_sysid.report.runs import ARM, LINK, PAYLOAD, Run, listed, mapping, number

_KINDS = {
    LINK: "the terminal link",
    PAYLOAD: "a payload, from recordings without and with it",
    ARM: "every link of the arm",
}
_LESS = {
    "noise": "record longer, or move faster and wider (`robot-sysid plan` designs such a motion)",
    "links": "identify the other links too (`robot-sysid arm`), or weigh a payload by difference "
    "(`robot-sysid payload`), which needs no knowledge of them",
    "other links": "record the empty arm as long and as widely as the loaded one",
    "torque scale": "calibrate the torques with a known weight (`robot-sysid payload "
    "--known-mass KG --save-torque-scale FILE`)",
    "common torque scale": "calibrate the torques with a known weight (`--known-mass KG`)",
    "joint offsets": "calibrate the joints' zero positions",
    "gravity": "level the base, or let `--tilt auto` find how it stands",
    "filtering": "record at a higher rate, or give a higher `--cutoff`",
    "friction model": "let `--friction-model auto` choose, and warm the arm up before recording",
}
"""Cause of error to what makes it smaller."""
_LARGE = 0.02
"""Error of the mass, as a part of it, above which something is to be done about it."""


def verdict(run: Run) -> Section:
    """Return what was found, whether it may be used, and why not."""
    content = run.content
    good = run.trustworthy
    words = "may be used" if good else "must not be used"
    return Section(
        "verdict",
        "Verdict",
        sentences=(
            f"This result {words}: {content.get('status_text', 'no status is given')}.",
            *_found(run),
            *_came_from(run),
        ),
        points=(*listed(content, "reasons"), *listed(content, "limitations")),
        missing=run.missing,
        verdict="good" if good else "bad",
        details=(("What the run had to say", listed(content, "notes")),),
    )


def _found(run: Run) -> Iterator[str]:
    if run.kind == ARM:
        yield from _predicted(run)
        return
    for body in run.bodies():
        mass, error = float(body.after[0]), float(body.errors[0])
        relative = f" ({percent(error / mass)})" if np.isfinite(error) and mass > 0.0 else ""
        if run.is_itself:
            relative = " (the model's own value, which had to come back)"
        yield f"Mass of {body.title}: {with_error(mass, error, 'kg')}{relative}."


def _predicted(run: Run) -> Iterator[str]:
    error = number(mapping(run.content, "held_out").get("relative_error"))
    before = number(run.content.get("held_out_error_of_the_model"))
    if np.isfinite(error) and np.isfinite(before):
        yield (
            f"Torques that were not fitted are predicted to {percent(error)} of their size; by the "
            f"model's own links, with friction fitted, to {percent(before)}."
        )


def _came_from(run: Run) -> Iterator[str]:
    content = run.content
    model = mapping(content, "model").get("path", "an unknown model")
    joint = content.get("joint_name")
    place = f", joint {joint}" if joint else ""
    duration = number(content.get("duration"))
    length = f", {duration:.3g} s" if np.isfinite(duration) else ""
    source = content.get("source") or "recordings"
    names = [name for names in mapping(content, "recordings").values() for name in names]
    listing = f" {', '.join(map(str, names))}" if names else ""
    yield f"Identified: {_KINDS[run.kind]}{place}. Model: {model}. Data: {source}{listing}{length}."
    rmse = number(content.get("rmse"))
    if np.isfinite(rmse):
        yield f"Root mean square of the torque that is left over: {rmse:.3g} N·m."


def next_steps(run: Run) -> Section:
    """Return what to do now."""
    return Section("next", "What to do next", points=tuple(_steps(run)))


def _steps(run: Run) -> Iterator[str]:
    if run.is_itself:
        yield (
            "This run simulated the model itself. Record a real log: `robot-sysid plan MODEL` "
            "designs a motion for it, `robot-sysid identify MODEL LOG` identifies from it."
        )
        return
    if not run.trustworthy:
        status = str(run.content.get("status_text", ""))
        yield "Do not load these numbers into a model or a controller."
        yield f"{status[:1].upper()}{status[1:]}."
        yield "`robot-sysid log LOG MODEL` says what is wrong with a log."
    yield from _smaller_errors(run)
    if run.trustworthy:
        yield from _uses(run)
    if run.kind != PAYLOAD and not any(_other_logs(run)):
        yield (
            "Test the result on a log that was not fitted, with another motion: "
            "`--validation-measurements LOG`."
        )


def _uses(run: Run) -> Iterator[str]:
    for name in MODEL_NAMES.values():
        if (run.folder / name).is_file():
            ours = _is_of(run.folder / name, run)
            older = f"Do not load {name}: it is from another run, and this one wrote none."
            yield f"Load {name} in place of the model." if ours else older
    if mapping(run.content, "cards"):
        yield "Copy the payload into the controller from the card below; mind the frame it names."
    kept = [body.title for body in run.bodies() if any(body.kept)]
    if kept:
        yield (
            "Some values are the model's own, because these torques do not show them: use "
            "`--torques chain` and a designed motion (`robot-sysid plan`) to see more."
        )


def _is_of(model: Path, run: Run) -> bool:
    """Tell whether a written model states the residual of a run in its comments."""
    held = mapping(run.content, "held_out") if run.kind == ARM else run.content
    return rmse_words(number(held.get("rmse"))) in model.read_text("utf-8", errors="replace")


def _smaller_errors(run: Run) -> Iterator[str]:
    """Yield what makes the mass's largest causes of error smaller."""
    body = run.bodies()[0]
    mass, error = float(body.after[0]), float(body.errors[0])
    if not np.isfinite(error) or error <= _LARGE * abs(mass):
        return
    parts = {cause: float(values[0]) for cause, values in body.budget.items()}
    known = sorted((c for c in parts if np.isfinite(parts[c])), key=lambda c: -parts[c])
    for cause in known[:2]:
        if cause in _LESS and parts[cause] > 0.3 * error:
            share = percent(parts[cause] / abs(mass)) if mass else ""
            yield f"To know the mass better: {_LESS[cause]} ({cause} is {share} of it)."


def _other_logs(run: Run) -> Iterator[str]:
    for test in run.content.get("validation") or ():
        if isinstance(test, dict) and "not fitted for it" not in str(test.get("source")):
            yield str(test.get("source"))
