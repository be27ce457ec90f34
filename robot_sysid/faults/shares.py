"""One view of a log: what each joint's torque has of the model's links, by weight and by inertia.

The last link is free, whatever hangs on it, and each joint has friction of its own; all other links
are the model's, times two shares of every joint. So it says what class a torque is of before masses
may move: a measured torque has about all of the links' weight, in whatever unit, an external one
has none. Links that are off by as much as those of real arms change shares by as much.

Throughout, J is the number of joints with equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.estimate.fit import Fit, Problem
from robot_sysid.estimate.links import reference_links
from robot_sysid.estimate.terms import Term
from robot_sysid.faults.columns import OTHER_WEIGHT
from robot_sysid.faults.judge import in_sums_alone
from robot_sysid.faults.plausibility import (
    LAST_LINKS,
    LEAST_WEIGHED,
    PLAIN_FRICTION,
    terms_of,
)
from robot_sysid.records import Array
from robot_sysid.records.levels import INTERVAL
from robot_sysid.records.parameters import Parameter

LOST = 1.0 / 3.0
"""Share of the links' weight below which a joint has lost it. Arms whose links are off as usual,
one of them by twice as much, have more."""
NO_INERTIA = 0.15
"""Share of the links' inertia below which a torque has none. Time stamps that are half as far apart
as they were leave a quarter of it, links that are off as usual a fifth less."""
OTHERWISE = 0.25
"""Torque of the share of weight that is left, over the joint's torque, below which something else
makes the torque: in another unit, weight makes as much of it as in newton metres."""
LINKS_OFF = 0.2
"""Share by which the links that a joint carries may be off the model's."""
MOST_LEFT = 0.15
"""Share of all torque that may be left unexplained: columns that are exchanged or turned have no
weight of the links either, and leave most. External torque leaves little, its friction's shape."""


@dataclass(frozen=True)
class Shares:
    """What the torque has of the weight and inertia of all links but the last.

    Attributes:
        weight: (J,) share of the model's weight torque.
        inertia: (J,) share of the torque of its inertia.
        weight_covariance, inertia_covariance: (J, J) theirs; infinite where a joint shows none.
        torque: (J,) root mean square torque of the model's weight [N m].
        measured: (J,) that of the log [N m].
        is_weighed: (J,) at which joints the weight says something.
        left: what is left unexplained, as a share of all torque.
    """

    weight: Array
    inertia: Array
    weight_covariance: Array
    inertia_covariance: Array
    torque: Array
    measured: Array
    is_weighed: NDArray[np.bool_]
    left: float

    @property
    def has_no_weight(self) -> bool:
        """Whether the links' weight has gone from all joints that it says something of.

        At one joint alone the last link, of which nothing is known, takes up that of all others.
        """
        own = self.is_weighed
        most = np.abs(self.weight) + np.sqrt(np.diag(self.weight_covariance))
        is_small = np.abs(self.weight) * self.torque < OTHERWISE * self.measured
        is_lost = (most < LOST) & is_small
        share, error = common_share(self.weight, self.weight_covariance)
        is_clear = abs(share) + INTERVAL * error < LOST and self.left < MOST_LEFT
        return bool(np.sum(own) > 1 and np.all(is_lost[own]) and is_clear)

    @property
    def is_weight_alone(self) -> bool:
        """Whether the links' weight is there, and their inertia has gone.

        Where a last link takes it up that is free, there is less than none.
        """
        own = self.is_weighed
        is_there = np.any(own) and np.all(self.weight[own] > LOST)
        _, error = self.common_inertia
        is_gone = self.most_inertia < NO_INERTIA and INTERVAL * error < LOST
        return bool(is_there and is_gone)

    @property
    def most_inertia(self) -> float:
        """The largest share of the links' inertia that the torque may have."""
        share, error = self.common_inertia
        return share + INTERVAL * error

    @cached_property
    def common_inertia(self) -> tuple[float, float]:
        """(Share of the links' inertia that all joints have in common, its error)."""
        return common_share(self.inertia, self.inertia_covariance)


def common_share(shares: Array, covariance: Array) -> tuple[float, float]:
    """Return what joints' shares (J,) have in common by generalized least squares, and its error.

    A last link of another mass changes the shares of all joints: one of many times the weight at a
    wrist says that the shoulder has some. Links that are off weigh the joints alike, but are no
    error of torque that has none of them.
    """
    known = np.isfinite(np.diag(covariance))
    count = int(np.sum(known))
    if not count:
        return 0.0, np.inf
    own = covariance[np.ix_(known, known)]
    weights = np.linalg.solve(own + LINKS_OFF**2 * np.eye(count), np.ones(count))
    weights /= np.sum(weights)
    return float(weights @ shares[known]), float(np.sqrt(weights @ own @ weights))


def shares_of(fitted: Fit) -> Shares:
    """Return what the torque of a log has of the links before the last one.

    Args:
        fitted: the fit of the log, with the columns of ``readings``.
    """
    arm = fitted.arm
    joints = arm.joints
    free = terms_of(arm, LAST_LINKS)
    friction = terms_of(arm, PLAIN_FRICTION)
    kept = [name for term in (*free, *friction) for name in term.names]
    names = [f"{kind} of {joint}" for kind in ("weight", "inertia") for joint in joints]
    sums = fitted.sums
    count = len(joints)
    # The columns of the view, of each joint's rows: those of what is free, as they are; then, for
    # each joint, the weight of all other links of the model in its own rows, and their torque less
    # that weight.
    mix = np.zeros((count, len(sums.names), len(kept) + 2 * count))
    mix[:, sums.at(kept), np.arange(len(kept))] = 1.0
    others = [name for link in arm.others for name in arm.links[link]]
    values = reference_links(arm.robot, arm.others)
    for joint in range(count):
        weight = len(kept) + joint
        mix[joint, sums.at([OTHER_WEIGHT]), weight] = 1.0
        mix[joint, sums.at(others), weight + count] = values
        mix[joint, sums.at([OTHER_WEIGHT]), weight + count] = -1.0
    mixed = sums.mixed((*kept, *names), mix)
    shares = Term(
        "", tuple(map(Parameter, names)), in_sums_alone, reference=np.ones(len(names))
    )
    problem = Problem(arm, (), fitted.point, mixed, fitted.question)
    view = problem.fit(
        [*free, *friction, shares], correlation=fitted.correlation, possible=False
    )
    found = np.zeros(len(names))
    covariance = np.diag(np.full(len(names), np.inf))
    shown = [k for k, name in enumerate(names) if name in view.names]
    at = view.at([names[k] for k in shown])
    found[shown] = view.free[at]
    covariance[np.ix_(shown, shown)] = view.inverse[np.ix_(at, at)]
    torque = np.sqrt(mixed.squares[:, len(kept) : -count] / mixed.row_counts[:, None])
    torque = np.diag(torque)
    is_slide = arm.robot.is_slide[arm.indices]
    is_compared = ~is_slide | np.all(is_slide)
    return Shares(
        found[:count],
        found[count:],
        covariance[:count, :count],
        covariance[count:, count:],
        torque,
        sums.rms_torque,
        is_compared & (torque > LEAST_WEIGHED * np.max(torque[is_compared])),
        view.residual_share,
    )
