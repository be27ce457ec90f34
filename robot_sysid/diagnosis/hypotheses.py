"""Mistakes of a recording that can be undone, and whether the log fits better without them.

Signs, exchanged joints, a reversed order and degrees are finite in number: each is undone on the
low-passed samples and the fit repeated. A mistake is named where undoing it makes its joints fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from robot_sysid.diagnosis.evidence import Evidence, Sample
from robot_sysid.diagnosis.finding import Finding, Level
from robot_sysid.diagnosis.model_fit import INDEPENDENT, Fit, ModelFit, plausible
from robot_sysid.records import RobotModel

CLEARLY = 60.0
"""Fall of chi-squared by undoing a mistake that chance and small errors of a model do not bring."""
LIKELY = 15.0
"""The same where the log as it is would need an impossible terminal link."""
WELL = 1.4
"""Cost of a log that fits."""
BETTER = 0.25
"""Part of the cost that is left where a log that does not fit for other reasons fits better."""
# One fit per mistake: fewer instants than elsewhere do.
_EVERY = 2


def hypotheses(sample: Sample, robot: RobotModel) -> Iterator[tuple[str, str, Sample]]:
    """Yield every mistake that is tried: its name, a text, and the log without it."""
    to_radians = np.where(robot.is_slide, 1.0, np.pi / 180.0)
    text = "positions look like degrees; pass --units deg"
    yield "angle-unit", text, sample.with_motion(to_radians)
    text = "positions look like radians that were taken for degrees; drop --units deg"
    yield "angle-unit", text, sample.with_motion(1.0 / to_radians)
    yield from _signs(sample, robot.joint_names)
    yield from _orders(sample, robot.joint_names)


def explanations(evidence: Evidence, fit: ModelFit) -> list[tuple[Fit, Finding]]:
    """Return the mistakes that explain a log, best first, each behind the fit without it."""
    sample = evidence.sample.thinned(_EVERY)
    base = fit.fit(sample)
    possible, convincing = plausible(fit, base), []
    for name, text, undone in hypotheses(sample, evidence.robot):
        after = fit.fit(undone)
        if plausible(fit, after) and explains(base, after, certain=possible):
            convincing.append((after, Finding(name, Level.REFUSE, text)))
    return sorted(convincing, key=lambda each: each[0].cost)


def explains(base: Fit, after: Fit, certain: bool = True) -> bool:
    """Return whether a log fits so much better without a mistake that it was made.

    Args:
        certain: whether the log as it is has a possible terminal link; one that has none takes less
            to be called mistaken.
    """
    fall = (base.cost - after.cost) * len(base.per_joint) * INDEPENDENT
    enough = fall > (CLEARLY if certain else LIKELY)
    return enough and (after.cost < WELL or after.cost < BETTER * base.cost)


def _signs(sample: Sample, names: tuple[str, ...]) -> Iterator[tuple[str, str, Sample]]:
    for joint, name in enumerate(names):
        sign = np.ones(len(names))
        sign[joint] = -1.0
        for what, text, undone in (
            ("torque", f"torque.{name} = -TITLE", sample.with_torque(sign)),
            ("position", f"position.{name} = -TITLE", sample.with_motion(sign)),
            (
                "position and torque",
                f"position.{name} = -TITLE and torque.{name} = -TITLE",
                sample.with_motion(sign).with_torque(sign),
            ),
        ):
            said = f"the {what} of joint {name} has the opposite sign of the model's; flip it in "
            yield "sign", f"{said}the columns file: {text}", undone


def _orders(sample: Sample, names: tuple[str, ...]) -> Iterator[tuple[str, str, Sample]]:
    plain = list(range(len(names)))
    orders = []
    for first, second in combinations(plain, 2):
        order = plain.copy()
        order[first], order[second] = second, first
        orders.append((order, f"joints {names[first]} and {names[second]} are exchanged"))
    if len(names) > 2:
        orders.append((plain[::-1], "the order of the joints is reversed"))
    for order, said in orders:
        for what, motion, torque in (
            ("", order, order),
            (" in the positions", order, plain),
            (" in the torques", plain, order),
        ):
            text = f"{said}{what}; put the columns right with --columns FILE"
            yield "order", text, sample.with_order(motion, torque)
