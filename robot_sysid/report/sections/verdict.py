"""What the run says, in words, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.mjcf.inertial import rmse_words
from robot_sysid.records.figures import percent, with_error
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.report.drawing import Section
from robot_sysid.report.runs import Run, listed, mapping, mappings, number
from robot_sysid.results.record import LINK, PAYLOAD

_KINDS = {
    LINK: "the terminal link, with the other links around it",
    PAYLOAD: "a payload, from recordings without and with it",
}
_LESS = {
    "noise": "record longer, or move faster and wider (`robot-sysid plan` designs such a motion)",
    "links": "move the other joints too, so that the other links show (`robot-sysid identify "
    "--links` says how well they do), or weigh a payload by difference (`robot-sysid payload`), "
    "which needs no knowledge of them",
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
    content, good = run.content, run.trustworthy
    words = f"This result {'may be used' if good else 'must not be used'}"
    status = f"{words}: {content.get('status_text', 'no status is given')}."
    return Section(
        "verdict",
        "Verdict",
        sentences=(status, *_masses(run), *_predicted(run), *_came_from(run)),
        points=(*listed(content, "reasons"), *listed(content, "limitations")),
        missing=run.missing,
        verdict="good" if good else "bad",
        details=(("What the run had to say", listed(content, "notes")),),
    )


def _masses(run: Run) -> Iterator[str]:
    bodies = run.bodies()
    for body in bodies if run.question == PAYLOAD else bodies[:1]:
        mass, error = float(body.after[0]), float(body.errors[0])
        known = number(run.content.get("known_to")) if body is bodies[0] else error / mass
        relative = f" ({percent(known)})" if np.isfinite(known) else ""
        if run.is_itself:
            relative = " (the model's own value, which had to come back)"
        yield f"Mass of {body.title}: {with_error(mass, error, 'kg')}{relative}."


def _predicted(run: Run) -> Iterator[str]:
    errors = mapping(mapping(run.content, "file"), "torque_error")
    before, after = (number(errors.get(when)) for when in ("before", "after"))
    if np.isfinite(before):
        written = percent(after) if np.isfinite(after) else "not known, no model was written"
        yield f"Torque error of the model on held-out data: {percent(before)} -> {written}."


def _came_from(run: Run) -> Iterator[str]:
    content = run.content
    model = mapping(content, "model").get("path", "an unknown model")
    joint, duration = content.get("joint_name"), number(content.get("duration"))
    place = f", joint {joint}" if joint else ""
    length = f", {duration:.3g} s" if np.isfinite(duration) else ""
    source = content.get("source") or "recordings"
    logs = [n for kind in mapping(mapping(content, "payload"), "recordings").values() for n in kind]
    given = f" {', '.join(map(str, logs))}" if logs else ""
    kind = _KINDS[run.question]
    yield f"Identified: {kind}{place}. Model: {model}. Data: {source}{given}{length}."
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
    if run.question == LINK and len(mappings(run.content, "validation")) < 2:
        yield (
            "Test the result on a log that was not fitted, with another motion: "
            "`--validation-measurements LOG`."
        )


def _uses(run: Run) -> Iterator[str]:
    tests = (run.content, *mappings(run.content, "validation")[:1])
    ours = [rmse_words(number(test.get("rmse"))) for test in tests]
    for path in (run.folder / name for name in MODEL_NAMES.values()):
        if path.is_file():
            text = path.read_text("utf-8", errors="replace")
            older = f"Do not load {path.name}: it is from another run, and this one wrote none."
            own = any(words in text for words in ours)
            yield f"Load {path.name} in place of the model." if own else older
    if mapping(mapping(run.content, "payload"), "cards"):
        yield "Copy the payload into the controller from the card below; mind the frame it names."
    if any(run.bodies()[0].kept):
        yield (
            "Some values are the model's own, because these torques do not show them: use "
            "`--torques chain` and a designed motion (`robot-sysid plan`) to see more."
        )


def _smaller_errors(run: Run) -> Iterator[str]:
    body = run.bodies()[0]
    mass, error = float(body.after[0]), float(body.errors[0])
    if not np.isfinite(error) or error <= _LARGE * abs(mass):
        return
    parts = {cause: float(np.nan_to_num(values[0])) for cause, values in body.budget.items()}
    for cause in sorted(parts, key=lambda c: -parts[c])[:2]:
        if cause in _LESS and parts[cause] > 0.3 * error:
            share = percent(parts[cause] / abs(mass)) if mass else ""
            yield f"To know the mass better: {_LESS[cause]} ({cause} is {share} of it)."
