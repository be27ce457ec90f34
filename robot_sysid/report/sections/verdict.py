"""The first screen: whether to use the result, how much better it is, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot_sysid.mjcf.inertial import rmse_words
from robot_sysid.records.data import Source
from robot_sysid.records.file_access import MODEL_NAMES
from robot_sysid.records.messages import percent, with_error
from robot_sysid.report.drawing import Section
from robot_sysid.report.runs import Run
from robot_sysid.report.sections.signals import most_changed


def verdict(run: Run) -> Section:
    """Return the verdict as the console says it, the torque error, and one figure of a torque."""
    content = run.content
    good = run.content["valid"]["trustworthy"]
    of_itself = str(content["source"]).startswith(Source.ITSELF.value)
    return Section(
        "verdict",
        "Verdict",
        sentences=content["verdict"],
        headline=_headline(run),
        points=tuple(_other_models(run)),
        figures=() if of_itself or run.data is None else (most_changed(run),),
        missing=run.missing,
        verdict="bad" if not good else "good" if run.all_known else "part",
        details=(
            ("What was identified", (*_masses(run), *_origin(run))),
            ("What limits it", (*content["reasons"], *content["limitations"])),
            ("What the run had to say", content["notes"]),
        ),
    )


def _headline(run: Run) -> str:
    """Return "torque error 27 % → 0.3 %", of a payload its mass before it; "" where neither is."""
    file = run.content["file"]
    errors = [] if file is None else file["torque_error"].values()
    told = ["not known" if each is None else percent(each) for each in errors]
    better = [f"torque error {' → '.join(told)}"] if told else []
    body = run.bodies[0]
    mass = with_error(float(body.after[0]), body.stated(body.errors)[0], "kg")
    return ", ".join([f"payload {mass}", *better] if run.is_payload else better)


def _masses(run: Run) -> Iterator[str]:
    for body in run.bodies if run.is_payload else run.bodies[:1]:
        mass = float(body.after[0])
        error = float(body.errors[0])
        relative = (
            f" ({percent(error / mass)})" if np.isfinite(error) and mass > 0.0 else ""
        )
        stated = body.stated(body.errors)[0]
        yield f"Mass of {body.title}: {with_error(mass, stated, 'kg')}{relative}."


def _origin(run: Run) -> Iterator[str]:
    content = run.content
    payload = run.content["payload"]
    kind = "the terminal link, with the other links around it"
    if payload is not None:
        kind = "a payload, from recordings without and with it"
    yield (
        f"Identified: {kind}, joint {content['joint_name']}. Model: {content['model']['path']}. "
        f"Data: {content['source']}, {content['duration']:.3g} s."
    )
    if content["rmse"] is not None:
        yield f"Root mean square of the torque that is left over: {content['rmse']:.3g} N·m."


def _other_models(run: Run) -> Iterator[str]:
    """Yield a warning of each model in the folder that another run has written."""
    ours = rmse_words(run.content["rmse"])
    for path in (run.folder / name for name in MODEL_NAMES.values()):
        # A model that this run read from its own folder stays there where it writes none.
        if path.is_file() and ours not in path.read_text("utf-8", errors="replace"):
            yield f"Do not load {path.name}: it is from another run, and this one wrote none."
