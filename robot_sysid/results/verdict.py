"""The last lines: the verdict, which files to use, and the next step; also those of a plan.

The verdict says in one line whether to use the result, how much better it is than the model before,
and what limits it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from robot_sysid.dynamics.inverse_dynamics import MUJOCO_VERSION
from robot_sysid.records import ITSELF
from robot_sysid.records.file_access import CARD_NAME, models_in
from robot_sysid.records.messages import NextStep, percent, with_error
from robot_sysid.results.content import Content
from robot_sysid.results.record import PAYLOAD, Verdict
from robot_sysid.results.table import KNOWN, rows_of

# Name of a verdict to the sentence on the result's use, where that is not "Usable".
_USE_TEXTS = {
    Verdict.TORQUES_ONLY.name: "Only for torques of motions like the log's, not for the numbers",
    Verdict.AS_GOOD.name: "Usable, but the model was about as good before",
    Verdict.PARTLY_FROM_MODEL.name: "Usable (not identifiable, model's values kept: {unseen})",
    Verdict.INERTIA_NOT_KNOWN.name: "Usable for mass and centre of mass (the inertia is not known)",
}


def verdict_line(content: Content) -> str:
    """Return one line: whether to use a result, how good it is, and what limits it."""
    if content["failure"] is not None:
        return f"Not usable: {content['failure']}"
    unseen = ", ".join(content["unidentifiable"])
    if content["source"] == ITSELF:
        use = (
            "Self-test passed: the model's own numbers came back from its own simulation, which "
            "says nothing of the real arm"
        )
        return use + (f" (not identifiable: {unseen})" if unseen else "")
    use = _USE_TEXTS.get(content["status"], "Usable").format(unseen=unseen)
    return f"{use}: {'; '.join(_improvements(content))}"


def plan_verdict(failure: str | None, shortfall: str, conditions: Sequence[str]) -> str:
    """Return one line: whether to play a planned motion.

    Args:
        failure: why the motion must not be run; None where it may.
        shortfall: why the motion does not serve its purpose, though it keeps all limits; "" where
            it does.
        conditions: what has to be done before it is played, each with its reason.
    """
    if failure is not None:
        return f"Not usable: {failure}"
    if shortfall:
        return f"Not ready: {shortfall}"
    if conditions:
        return f"Usable once {', and once '.join(conditions)}"
    return "Usable: play it on the arm, slowly at first, and record it"


def plan_conditions(
    contact: str | None, n_unguarded: int, n_links: int, lacks_meshes: bool
) -> list[str]:
    """Return what has to be done before a motion is played, each with its reason.

    Args:
        contact: what the straight way from the model's pose to the start comes too near to, if
            anything.
        n_unguarded: number of moving links without collision geometry.
        n_links: number of moving links.
        lacks_meshes: whether collision meshes of the model were left out.
    """
    conditions = []
    if contact is not None:
        conditions.append(
            "the arm has been brought to the start of this motion another way: the straight way "
            f"from the model's pose at rest is not free, by the clearance of {contact}"
        )
    if n_unguarded:
        remedy = "watch it in a viewer that shows them"
        if lacks_meshes:
            meshes = "--mesh-dir FOLDER, the folder of its meshes (STL or OBJ)"
            remedy = f"plan again with {meshes}, or {remedy}"
        conditions.append(
            f"contacts have been checked: without collision geometry, {n_unguarded} of {n_links} "
            f"moving links may touch anything; {remedy}"
        )
    return conditions


def before_after_text(before: Content, after: Content | None) -> str:
    """Return the relative errors of two models as text, such as "27 % -> 0.3 %".

    An error that is not known is left out, "not known" stands for both.
    """
    errors = [test["relative_error"] for test in (before, after) if test is not None]
    texts = [percent(error) for error in errors if error is not None]
    return " -> ".join(texts) or "not known"


def _improvements(content: Content) -> Iterator[str]:
    """Yield phrases on the torque error before and after, and on the error of the mass."""
    file = content["file"]
    payload = content["payload"]
    if file:
        # A payload is part of both models: the change is that of links and friction.
        load = " with the payload" if payload else ""
        shares = before_after_text(file["before"], file["after"])
        yield f"torque error{load} on held-out data, torque offsets aside, {shares}"
    if payload and payload["known_mass"]:
        yield "torque scales follow from the known mass"
        return
    of = PAYLOAD if payload else content["body_name"]
    row = next((row for row in rows_of(content, of) if row["name"] == "mass"), None)
    if row is None or row["error"] is None or row["value"] <= 0.0:
        yield f"the mass of {of} alone is not identifiable"
        return
    mass = with_error(row["value"], row["error"], "kg")
    text = f"{of} weighs {mass}"
    if row["error"] >= KNOWN * row["value"]:
        text = f"the mass of {of} alone is not known: {mass}"
    yield f"{text}, ± mostly from {row['reason']}" if row["reason"] else text


def use_lines(path: Path, contents: str = "") -> tuple[str, str, str]:
    """Return which model file to use, which MuJoCo loads it, and a line of Python that does.

    Args:
        path: of the written file, which has been compiled by the installed MuJoCo.
        contents: what the file is of, behind a comma; "" for the arm.
    """
    text = json.dumps(str(path), ensure_ascii=False)
    return (
        f"Use this file{contents}: {path}",
        f"  mujoco.MjModel.from_xml_path({text})",
        f"It loads in MuJoCo {MUJOCO_VERSION} (tested); others from 3.0 on load it if they load "
        "your model",
    )


def last_lines(
    content: Content, files: Sequence[Path], step: NextStep | None
) -> list[str]:
    """Return the last lines of the console: the verdict, which files to use, and the next step.

    Args:
        content: of params.json.
        files: the written files, among them the model and a payload's card.
        step: the next step, or None.
    """
    lines = [verdict_line(content)]
    if content["failure"] is not None:
        return lines
    contents = ", the arm with its payload" if content["payload"] else ""
    # A self-test writes back what its model says already.
    if content["source"] != ITSELF:
        for path in models_in(files)[:1]:
            lines += use_lines(path, contents)
    if content["payload"] is not None:
        flange = content["payload"]["flange"]["name"]
        start = f"Copy into the controller, in the frame of {flange}"
        lines += [f"{start}: {path}" for path in files if path.name == CARD_NAME]
    lines += step.lines() if step else ()
    return lines
