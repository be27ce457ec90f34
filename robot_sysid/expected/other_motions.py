"""The torque error to expect of a written model file on motions that nobody recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.choose import fastest_of, speeds_in
from robot_sysid.estimate.equations.inverse import solve
from robot_sysid.estimate.fit import Fit, settled_values
from robot_sysid.estimate.rows import Sums
from robot_sysid.estimate.terms import LAST_LINK, PAYLOAD
from robot_sysid.expected.errors import ExpectedSquares, largest_expected
from robot_sysid.expected.knowledge import knowledge_of
from robot_sysid.expected.motions import highest_speed, made_up_motions, sums_elsewhere
from robot_sysid.expected.unknown import is_without_rows, still_joints, with_zero_torque
from robot_sysid.expected.unrecorded_arm import is_held
from robot_sysid.records import Array

SLOWEST = 0.2
"""Least speed of motions like a log's [rad/s or m/s]: a joint that hardly moved has none."""
FASTER = 2.0
"""Times the log's speed of a joint from which its friction is taken to be unknown there."""
GAIN = 0.8
"""Share of the expected error that a further motion has to bring it to, to be proposed: files are
as far off as is expected within a factor, so that less may be no gain."""
AS_GOOD = 1.1
"""Times the least error after a further motion up to which one that costs less is as good."""


@dataclass(frozen=True)
class FurtherMotion:
    """A motion that may be recorded next, as ``plan`` makes it.

    Attributes:
        words: of ``plan``, behind the model.
        duration: of its recording [s].
    """

    words: tuple[str, ...]
    duration: float


FURTHER_MOTIONS = (FurtherMotion((), 15.0), FurtherMotion(("--duration", "60"), 60.0))
"""What ``plan`` makes by default, and for longer; those that cost less first. A slow motion is none
of them: beside a log at full speed it makes the error of a file a tenth smaller at most, where
another one at full speed halves it."""


class OtherMotions:
    """Motions all over an arm's range that nobody recorded, and what a fit knows of them.

    Args:
        fitted: the fit of all terms.

    Attributes:
        fitted: as given.
        fast: sums of motions up to the arm's highest speeds.
        slow: sums of motions in which no joint is faster than in the logs.
        speed, log_speed: highest speed of both.
        speed_unit: its unit.
    """

    def __init__(self, fitted: Fit) -> None:
        self.fitted = fitted
        self._robot = fitted.arm.robot
        thetas, links = fitted.point.thetas.copy(), fitted.point.links.copy()
        settled = settled_values(fitted)
        last = [settled[name] for name in fitted.arm.terms[LAST_LINK].names]
        thetas[-1] = links[-1] = last
        self._point = replace(fitted.point, thetas=thetas, links=links)
        # These motions are the same in every run, others than a further log's.
        self._rng = np.random.default_rng(0)
        self._highest = self._robot.limits.velocity
        self._of_log = fastest_of(
            speeds_in(fitted.recordings), np.eye(self._robot.n_joints)
        )
        slowly = np.clip(self._of_log, SLOWEST, self._highest)
        self.fast = self._sums(self._highest)
        self.slow = self._sums(slowly)
        self.speed, self.speed_unit = highest_speed(self._robot, self._highest)
        self.log_speed, _ = highest_speed(self._robot, slowly)
        self._of_logs = knowledge_of(fitted, self.fast)
        self._known = self._of_logs.after()

    def _sums(self, speeds: Array) -> Sums:
        """Return the sums of motions up to some speeds (n,) [rad/s or m/s]."""
        fitted = self.fitted
        motions = [*made_up_motions(self._robot, speeds, self._rng)]
        return sums_elsewhere(fitted.arm, self._point, motions, fitted.question.loaded)

    def errors(self, held: Mapping[str, float], sums: Sums) -> ExpectedSquares:
        """Return the squares of a model's error on ``fast`` or ``slow`` motions.

        ``held`` is the name of each parameter that the model holds to its value.
        """
        return largest_expected(held, self._known, sums)

    @property
    def still(self) -> tuple[str, ...]:
        """Names of the joints that stood still."""
        return still_joints(self.fitted)

    @property
    def faster(self) -> NDArray[np.bool_]:
        """Which joints (n,) move clearly faster in these motions than in the logs."""
        return self._highest > FASTER * np.maximum(self._of_log, SLOWEST)

    @cached_property
    def names_in_file(self) -> list[str]:
        """Names of what a file may hold, of offsets and of a payload that it carries."""
        fitted = self.fitted
        kept = fitted.question.options.kept
        return [
            name
            for term in fitted.arm.terms.values()
            if term.cause == PAYLOAD or is_held(term, kept)
            for name in term.names
        ]

    @cached_property
    def _further(self) -> Sums:
        """The sums of further motions."""
        return self._sums(self._highest)

    def next_motion(
        self, file: Fit, now: float, motions: Sequence[FurtherMotion] = FURTHER_MOTIONS
    ) -> tuple[FurtherMotion, float] | tuple[None, float]:
        """Return the motion whose log lowers the error of a file most, and the error after it.

        Of those that are nearly as good, it is the one that costs least. It is None where no motion
        lowers the error much.

        Args:
            file: the fit of the file.
            now: its expected error.
            motions: from which it is taken; those that cost less first.
        """
        errors = [self._error_after(file, motion.duration) for motion in motions]
        best = min(errors)
        if best > GAIN * now:
            return None, best
        pairs = zip(motions, errors)
        return next(pair for pair in pairs if pair[1] <= AS_GOOD * best)

    def _error_after(self, file: Fit, length: float) -> float:
        """Return the error to expect of a file after a further log, ``length`` [s] long.

        The log makes what is known better known, and the file nearer to it: with the file's normal
        equations N f = b and rows W of the log, f' = (N + W)^-1 (b + W x). What the log will say of
        x is not known, so that x may move by as much as its covariance falls, and f' follows with
        what it holds alone.
        """
        of_logs = self._of_logs
        names = self._further.names
        known = of_logs.after(of_logs.rows(self._further, length, of_logs.weights))
        weights = np.where(is_without_rows(file), of_logs.weights, file.weights)
        rows = of_logs.rows(self._further, length, weights)
        values = np.array([file.by_name.get(name, 0.0) for name in names])
        of_file = file.at([name for name in file.names if name in names])
        at = self._further.at([file.names[k] for k in of_file])
        normal = np.zeros(rows.shape)
        normal[at[:, None], at] = file.normal[of_file[:, None], of_file]
        # What this file does not have, of joints that stood still too, the new one may find.
        in_file = np.isin(names, self.names_in_file)
        _, inverse = solve(with_zero_torque(normal + rows), values, in_file)
        follows = np.where(in_file[:, None], inverse @ rows, 0.0)
        held = values + follows @ (of_logs.values - values)
        follows[np.isin(names, [*map(OFFSET.key_of, self.fast.joints)])] = 0.0
        lacks = np.eye(len(names)) - follows
        told = self._known.covariance - known.covariance
        covariance = known.covariance + lacks @ told @ lacks.T
        return largest_expected(
            dict(zip(names, held.tolist())),
            replace(known, covariance=covariance),
            self.fast,
        ).relative_error
