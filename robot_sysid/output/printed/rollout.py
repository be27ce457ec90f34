"""Rollouts of the old and the new model, for the result block and for JSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from robot_sysid.records.results import RolloutError, RolloutTest


def rollout_lines(test: RolloutTest, verbose: bool = False) -> Iterator[str]:
    """Yield the lines of the result block; ``verbose`` adds every joint."""
    yield (
        f"Played on {test.held_out}: root mean square position error [rad or m], model before -> "
        "new model"
    )
    for error in test.errors:
        ratio = "" if error.ratio is None else f", {error.ratio:.3g} times"
        old, new = error.overall
        yield (
            f"  {error.loop}, {error.horizon:g} s ({error.windows} windows): {old:.3g} -> "
            f"{new:.3g}{ratio}"
        )
        yield from _joint_lines(test, error) if verbose else ()
    yield from (f"  {note}" for note in test.notes)
    worse = _worse(test)
    if worse:
        yield f"  worse than before over the longest horizon: {', '.join(worse)}"


def _joint_lines(test: RolloutTest, error: RolloutError) -> Iterator[str]:
    for name, old, new in zip(test.joint_names, error.before, error.after):
        yield f"    {name}: {old:.3g} -> {new:.3g}"


def _worse(test: RolloutTest) -> list[str]:
    """Return the joints that follow the arm less well than before in the last comparison."""
    if not test.errors:
        return []
    last = test.errors[-1]
    pairs = zip(test.joint_names, last.before, last.after)
    return [f"{name} ({last.loop}, {new / old:.2g} times)" for name, old, new in pairs if new > old]


def rollout_entry(test: RolloutTest | None) -> dict[str, Any] | None:
    """Return the entry of params.json or arm.json; None where nothing was played."""
    if test is None:
        return None
    return {
        "held_out": test.held_out,
        "closed_loop_is": test.servo,
        "is_better": test.is_better,
        "score": test.score,
        "errors": [_entry(test, error) for error in test.errors],
        "notes": list(test.notes),
    }


def _entry(test: RolloutTest, error: RolloutError) -> dict[str, Any]:
    before, after = error.overall
    return {
        "loop": error.loop,
        "horizon": error.horizon,
        "windows": error.windows,
        "diverged": {"before": error.diverged[0], "after": error.diverged[1]},
        "overall": _figures(before, after),
        "joints": {
            name: _figures(float(old), float(new))
            for name, old, new in zip(test.joint_names, error.before, error.after)
        },
    }


def _figures(before: float, after: float) -> dict[str, float | None]:
    ratio = after / before if before > 0.0 else None
    return {"before": before, "after": after, "ratio": ratio}
