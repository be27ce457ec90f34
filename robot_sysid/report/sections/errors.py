"""How well torques are predicted that were fitted, held out, or of another log; and rollouts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Optional

import numpy as np

from robot_sysid.records.figures import percent
from robot_sysid.report.drawing import AFTER, BEFORE, INK, NARROW, SERIES, WIDE, drawn, legend
from robot_sysid.report.elements import Figure, Section, table, text
from robot_sysid.report.runs import ARM, Run, mapping, number
from robot_sysid.report.sections.excitation import shortened

_HATCHES = ("", "///", "...", "xxx", "\\\\\\")
_MOST_SETS = len(_HATCHES)
ErrorSet = tuple[str, Optional[float], Mapping[str, float]]
"""Which data, its error as part of the torque, joint to error [N m]."""


def errors(run: Run) -> Section:
    """Return train, held-out and second-log errors."""
    sets = list(error_sets(run))
    title = "Prediction errors"
    if not sets:
        return Section("errors", title, missing=("the result file holds no errors per joint",))
    words = (
        "on what was fitted, and on what was not. Bars that grow from left to right mean that the "
        "model misses something that other motion shows."
    )
    bars, said = error_bars("errors", sets, words), []
    if len(sets) == 1:
        said.append("Nothing was held out: nobody knows how other motion would be predicted.")
    return Section("errors", title, tuple(said), figures=(bars,))


def error_bars(name: str, sets: Sequence[ErrorSet], words: str) -> Figure:
    """Return the errors per joint of some sets of data, the first of them as bars too."""
    joints = list(dict.fromkeys(joint for _, _, per_joint in sets for joint in per_joint))
    rows = [
        (what, "–" if relative is None else percent(relative), *map(text, _of(per_joint, joints)))
        for what, relative, per_joint in sets
    ]
    numbers = table(("data", "of the torque", *(f"{joint} [N·m or N]" for joint in joints)), rows)
    start = "Root mean square error of the predicted torque of each joint [N·m, N for slides]: "
    if len(sets) > _MOST_SETS:
        words += f" The figure shows the first {_MOST_SETS} of {len(sets)}, the table all."
    size = (WIDE, 3.2) if len(joints) > 2 else (NARROW, 3.2)
    return drawn(name, start + words, numbers, size, lambda c: _bars(c, sets[:_MOST_SETS], joints))


def error_sets(run: Run) -> Iterator[ErrorSet]:
    """Yield (words, error as part of the torque, joint to error) per set of data."""
    content = run.content
    if run.kind == ARM:
        joints = mapping(content, "joints")
        noise = {name: number(entry.get("torque_noise")) for name, entry in joints.items()}
        yield "fitted", None, noise
        yield from _tests([content.get("held_out")])
    elif mapping(content, "rmse_per_joint"):
        fitted = mapping(content, "rmse_per_joint").items()
        yield "fitted", None, {k: number(v) for k, v in fitted}
    found = content.get("validation")
    yield from _tests(found if isinstance(found, list) else [found])


def _tests(found: Sequence[Any]) -> Iterator[ErrorSet]:
    for test in found:
        if isinstance(test, Mapping):
            per_joint = {k: number(v) for k, v in mapping(test, "rmse_per_joint").items()}
            relative = number(test.get("relative_error"))
            whole = relative if np.isfinite(relative) else None
            yield str(test.get("source", "other data")), whole, per_joint


def _of(per_joint: Mapping[str, float], joints: Sequence[str]) -> list[float]:
    return [per_joint.get(joint, np.nan) for joint in joints]


def _bars(canvas: Any, sets: Sequence[Any], joints: Sequence[str]) -> None:
    ax = canvas.subplots()
    width, places = 0.8 / len(sets), np.arange(len(joints), dtype=float)
    for k, (words, _, per_joint) in enumerate(sets):
        heights = np.nan_to_num(np.array(_of(per_joint, joints)))
        style = {"facecolor": SERIES[k][0], "edgecolor": INK, "hatch": _HATCHES[k], "alpha": 0.8}
        at = places + width * (k - 0.5 * (len(sets) - 1))
        ax.bar(at, heights, 0.92 * width, label=shortened(words, 60), **style)
    ax.set_xticks(places, [shortened(name) for name in joints], rotation=20, ha="right")
    ax.set_ylabel("error [N·m]")
    legend(canvas, ax, 1)


def rollout(run: Run) -> Section | None:
    """Return how far the model moves away from the arm when it is played, or None."""
    found = mapping(run.content, "rollout")
    tests = [each for each in found.get("errors") or () if isinstance(each, Mapping)]
    if not found:
        return None
    words = f"Both models were played on {found.get('held_out', 'held-out pieces')}"
    said = [f"{words}; in closed loop with {found.get('closed_loop_is', 'a servo')}."]
    score = number(found.get("score"))
    if np.isfinite(score):
        better = "smaller" if score < 1.0 else "not smaller"
        said.append(f"Errors are {better} than before: {score:.3g} times, all together.")
    notes = tuple(str(note) for note in found.get("notes") or ())
    figures = tuple(_played(test, f"rollout-{k}") for k, test in enumerate(tests))
    return Section("rollout", "Played in the simulator", tuple(said), figures=figures, points=notes)


def _played(test: Mapping[str, Any], name: str) -> Figure:
    joints = mapping(test, "joints")
    pairs = {
        joint: tuple(number(mapping(joints, joint).get(key)) for key in ("before", "after"))
        for joint in joints
    }
    whole = mapping(test, "overall")
    pairs = {"all": (number(whole.get("before")), number(whole.get("after"))), **pairs}
    rows = [(joint, before, after) for joint, (before, after) in pairs.items()]
    caption = (
        f"{test.get('loop', 'loop')}, {text(number(test.get('horizon')))} s: root mean square "
        "position error of the model before and after [rad, m for slides]."
    )

    def draw(canvas: Any) -> None:
        ax = canvas.subplots()
        places = np.arange(len(pairs), dtype=float)
        for k, (what, colour) in enumerate((("before", BEFORE), ("after", AFTER))):
            heights = np.nan_to_num([pair[k] for pair in pairs.values()])
            style = {"facecolor": colour, "edgecolor": INK, "alpha": 0.8, "label": what}
            ax.bar(places + 0.4 * (k - 0.5), heights, 0.37, hatch=_HATCHES[1 - k], **style)
        ax.set_xticks(places, [shortened(joint, 14) for joint in pairs], rotation=35, ha="right")
        ax.set_ylabel("position error [rad]")
        legend(canvas, ax)

    numbers = table(("joint", "before [rad or m]", "after [rad or m]"), rows)
    return drawn(name, caption, numbers, (NARROW, 3.2), draw)
