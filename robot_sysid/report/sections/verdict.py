"""What the run says, in words, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.mjcf.inertial import rmse_words
from robot_sysid.records.atomic_files import MODEL_NAMES
from robot_sysid.records.figures import percent, with_error
from robot_sysid.report.drawing import Section
from robot_sysid.report.runs import Run

_LESS = {
    "noise": "record longer, or move faster and wider (`robot-sysid plan` designs such a motion)",
    "links": "move the other joints too, so that the other links show (`robot-sysid identify "
    "--links` says how well they do), or weigh a payload by difference (`robot-sysid payload`), "
    "which needs no knowledge of them",
    "other links": "record the empty arm as long and as widely as the loaded one",
    "torque scale": "calibrate the torques with a known weight (`robot-sysid payload "
    "--known-mass KG --save-torque-scale FILE`)",
    "common torque scale": "calibrate the torques with a known weight (`robot-sysid payload "
    "--known-mass KG`)",
    "joint offsets": "calibrate the joints' zero positions",
    "gravity": "level the base, and say how well (`--gravity-uncertainty`)",
    "filtering": "record at a higher rate, or give a higher `--cutoff`",
    "friction model": "warm the arm up before recording, and let the data choose the friction "
    "model (`--friction-model auto`, as usual)",
}
"""Cause of error to what makes it smaller."""
_LARGE = 0.02
"""Error of the mass, as a part of it, above which something is to be done about it: what
friction and sensors leave of it at best."""
_PART = 0.3
"""Share of the whole error from which a cause is worth a remedy: without it 5 % less is left."""


def verdict(run: Run) -> Section:
    """Return what was found, whether it may be used, and why not."""
    content, good = run.content, run.trustworthy
    use = "may be used" if good else "must not be used"
    return Section(
        "verdict",
        "Verdict",
        sentences=(f"This result {use}: {content['status_text']}.", *_masses(run), *_origin(run)),
        points=(*content["reasons"], *content["limitations"]),
        missing=run.missing,
        verdict="bad" if not good else "good" if run.all_known else "part",
        details=(("What the run had to say", content["notes"]),),
    )


def _masses(run: Run) -> Iterator[str]:
    for body in run.bodies if run.is_payload else run.bodies[:1]:
        mass, error = float(body.after[0]), float(body.errors[0])
        relative = f" ({percent(error / mass)})" if np.isfinite(error) and mass > 0.0 else ""
        if run.is_itself:
            relative = " (the model's own value, which had to come back)"
        stated = body.stated(body.errors)[0]
        yield f"Mass of {body.title}: {with_error(mass, stated, 'kg')}{relative}."
    if run.content["file"] is not None:
        errors = run.content["file"]["torque_error"].values()
        before, after = (None if each is None else percent(each) for each in errors)
        if before is not None:
            after = after or "not known, no model was written"
            yield f"Torque error of the model on held-out data: {before} -> {after}."


def _origin(run: Run) -> Iterator[str]:
    content, payload = run.content, run.content["payload"]
    kind = "the terminal link, with the other links around it"
    if payload is not None:
        kind = "a payload, from recordings without and with it"
    yield (
        f"Identified: {kind}, joint {content['joint_name']}. Model: {content['model']['path']}. "
        f"Data: {content['source']}, {content['duration']:.3g} s."
    )
    if content["rmse"] is not None:
        yield f"Root mean square of the torque that is left over: {content['rmse']:.3g} N·m."


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
        status = str(run.content["status_text"])
        yield "Do not load these numbers into a model or a controller."
        yield f"{status[:1].upper()}{status[1:]}."
        yield "`robot-sysid log LOG MODEL` says what is wrong with a log."
    yield from _smaller_errors(run)
    if run.trustworthy:
        yield from _uses(run)
    if not run.is_payload and len(run.content["validation"]) < 2:
        yield (
            "Test the result on a log that was not fitted, with another motion: "
            "`robot-sysid identify --validation-measurements LOG`."
        )


def _uses(run: Run) -> Iterator[str]:
    ours, payload = rmse_words(run.content["rmse"]), run.content["payload"]
    for path in (run.folder / name for name in MODEL_NAMES.values()):
        if path.is_file():
            # A model that this run read from its own folder stays there where it writes none.
            own = ours in path.read_text("utf-8", errors="replace")
            older = f"Do not load {path.name}: it is from another run, and this one wrote none."
            yield f"Load {path.name} in place of the model." if own else older
    if payload is not None and payload["cards"]:
        yield "Copy the payload into the controller from the card above; mind the frame it names."
    if any(run.bodies[0].kept):
        said = "Some values are the model's own, because these torques do not show them"
        said = said if run.all_known else "The inertia of the payload is not known"
        chain = "all torques (`robot-sysid identify --torques chain`) and "
        chain = chain if run.content["torques"] == "terminal" else ""
        yield f"{said}: use {chain}a designed motion (`robot-sysid plan`) to see more."


def _smaller_errors(run: Run) -> Iterator[str]:
    body = run.bodies[0]
    mass, error = float(body.after[0]), float(body.errors[0])
    if not np.isfinite(error) or error <= _LARGE * abs(mass):
        return
    parts = {cause: float(np.nan_to_num(values[0])) for cause, values in body.budget.items()}
    for cause in sorted(parts, key=lambda c: -parts[c])[:2]:
        if cause in _LESS and parts[cause] > _PART * error:
            share = percent(parts[cause] / abs(mass)) if mass else ""
            yield f"To know the mass better: {_LESS[cause]} ({cause} is {share} of it)."
