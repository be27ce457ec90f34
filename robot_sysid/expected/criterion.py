"""What a motion will tell, as the number that a search minimises, with its gradient.

The number is one of two. Where an arm is identified, it is the error that the written file is
expected to have on any motion (``file_errors``); where the last link or a payload is, the volume of
its confidence ellipsoid (``Volume``).

Joint j delivers equations tau_j = Y_j theta + Z_j x_j, theta the parameters of all links and x_j
the unknowns of this joint alone, friction and torque scale, with the priors of the one fit
(``recording.prior_knowledge``). In units in which each prior has variance one, the inverse
covariance of all unknowns is H = A^T A + P, A the equations over their noise and P a one for each
unknown with a prior. A value with the derivative -tr(W dH) / 2 by H has -A W by A.

Encoder zeros, gravity's direction and a delay are part of the predicted errors (``recording``) but
not of this number: they are a small part of any variance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from robot_sysid.dynamics.friction import TERMS, top_speeds
from robot_sysid.dynamics.inverse_dynamics import LinksMotion
from robot_sysid.expected.file_errors import FileErrors
from robot_sysid.expected.planned_arm import PlannedArm
from robot_sysid.records import Array
from robot_sysid.records.parameters import SCALE

SMOOTHING = 0.03
"""Share of the speed limits below which Coulomb friction's jump is rounded off: it changes no
predicted standard deviation by more than 3 % (``test_the_grid_is_fine_enough_for_the_band``)."""

STEP = 1e-6
"""Step of one-sided differences [rad, and its derivatives; N m]: torques are exact to 1e-13, so
their derivatives to 1e-7."""


@dataclass(frozen=True)
class PriorKnowledge:
    """Priors of an estimate: what is known about an arm before there is a recording.

    Attributes:
        link_factor: (10 L, 10 L) F; the parameters of the L links with mass other than the terminal
            one, from the base to the tool, have the prior covariance F F^T. (10 L, 0) where they
            are taken as known.
        joint_deviations: name of a friction term, or of the torque scale, to its prior standard
            deviation (rows,) at each joint; infinite where nothing is known.
        file: what is known of the file of the whole arm; None where the last link or a payload is
            to be identified, of which nothing is known.
    """

    link_factor: Array
    joint_deviations: Mapping[str, Array]
    file: FileKnowledge | None = None


@dataclass(frozen=True)
class FileKnowledge:
    """What is known of an arm's model file before there is a recording.

    Attributes:
        last_factor: (10, 10) F; the parameters of the terminal link have the prior covariance
            F F^T.
        held: names of those terms of joints that the file's fit has.
        elsewhere: (3, N, n) q, qd and qdd of the motions on which the file is judged.
    """

    last_factor: Array
    held: tuple[str, ...]
    elsewhere: Array


class Objective(Protocol):
    """A number that depends on the information H about all unknowns."""

    def value_and_weight(self, information: Array) -> tuple[float, Array]:
        """Return the number v, and W (P, P) of dv = -tr(W dH) / 2, of an information H (P, P).

        The number is infinite, and W zero, where H is singular.
        """


@dataclass(frozen=True)
class Volume:
    """The volume of the confidence ellipsoid of the first unknowns t, whose covariance is C:

        ln det C[t, t] / 2r,   W = C[:, t] (C[t, t])^-1 C[t, :] / r,   C = H^-1,

    the logarithm of the geometric mean of the standard deviations along its axes: a change of 0.01
    is one of about 1 % (Bayesian D-optimality; Chaloner, Verdinelli, "Bayesian experimental design:
    a review", Statistical Science 10(3), 1995).

    Attributes:
        count: number r of these unknowns.
    """

    count: int

    def value_and_weight(self, information: Array) -> tuple[float, Array]:
        """Return the value and W (P, P); (infinite, zeros) where the equations are singular."""
        singular = np.inf, np.zeros_like(information)
        length = np.sqrt(np.diag(information))
        if not np.all(np.isfinite(length) & (length > 0.0)):
            return singular
        scaled = information / np.outer(length, length)
        try:
            pivots = np.diag(np.linalg.cholesky(scaled))
        except np.linalg.LinAlgError:
            return singular
        # Smaller squared pivots, of a matrix with a unit diagonal, are rounding.
        if np.min(pivots) ** 2 <= 1e-14:
            return singular
        covariance = np.linalg.inv(scaled) / np.outer(length, length)
        count = self.count
        of_target = covariance[:count, :count]
        value = 0.5 * np.linalg.slogdet(of_target)[1] / count
        weight = covariance[:, :count] @ np.linalg.solve(of_target, covariance[:count])
        return value, weight / count


class Criterion:
    """The number that a design minimises: a file's error, or what is left open of a body.

    The latter is over all combinations of parameters that can be told.

    A combination counts if random motion has information about it: no trajectory of these joints
    can show more than unrelated random positions, velocities and accelerations do.

    Args:
        problem: the arm, and its joints whose torque is used.
        knowledge: priors.
        samples: number of samples of the recording that each sample of a motion stands for.
        smoothing: share of the speed limits below which Coulomb friction's jump is rounded off.

    Attributes:
        visible: (10, r) directions in the space of the terminal link's parameters that are
            identifiable by some motion, in units of the typical sizes of the parameters; all, in
            units of their prior, where the file of the whole arm is to be identified.
        hidden: (10, 10 - r) orthonormal directions that no motion identifies, of parameters over
            their typical sizes.
    """

    def __init__(
        self,
        problem: PlannedArm,
        knowledge: PriorKnowledge,
        samples: float = 1.0,
        smoothing: float = SMOOTHING,
    ) -> None:
        self._problem = problem
        self._theta = np.ravel([problem.robot.links[k].theta for k in problem.links])
        self._joints = slice(problem.rows[0], None)
        # A motion goes up to the limits, and a little beyond them friction is flat.
        tops = top_speeds(problem.limits.velocity, problem.limits.velocity)
        self._tops = tops[self._joints, None]
        self._smooth_speed = smoothing * problem.limits.velocity[self._joints]
        # All directions at first, and the noise of one torque [N m]: only shares count.
        scale = np.diag(problem.robot.prior.scale)
        free = replace(knowledge, file=None)
        self._set_unknowns(free, scale, np.ones(len(problem.rows)))
        information = self.information(random_motion(problem))
        cross = information[:10, 10:]
        precision = information[:10, :10] - cross @ np.linalg.solve(
            information[10:, 10:], cross.T
        )
        values, vectors = np.linalg.eigh(precision)
        is_visible = values > 1e-9 * values[-1]
        self.hidden: Array = vectors[:, ~is_visible]
        sigma = problem.sigma / np.sqrt(samples)
        file = knowledge.file
        shown = scale @ vectors[:, is_visible] if file is None else file.last_factor
        self._set_unknowns(knowledge, shown, sigma)
        self._objective: Objective = Volume(shown.shape[1])
        if file is not None:
            self._objective = self._file_errors(file, sigma)

    def _set_unknowns(
        self, knowledge: PriorKnowledge, visible: Array, sigma: Array
    ) -> None:
        """Set the P unknowns: r directions of the last link, the other links', each joint's own.

        Args:
            knowledge: priors.
            visible: (10, r) directions of the terminal link's parameters, of which something is
                known where the whole arm's file is.
            sigma: (rows,) noise of each joint's torque [N m].
        """
        from scipy.linalg import block_diag

        factor = knowledge.link_factor
        self._terms = tuple(knowledge.joint_deviations)
        deviations = np.column_stack([*knowledge.joint_deviations.values()])
        has_prior = np.isfinite(deviations)
        n_visible = visible.shape[1]
        n_others = factor.shape[1]
        self.visible = visible
        self._n_links = n_visible + n_others
        # (P,) prior information about each unknown.
        of_last = np.full(n_visible, float(knowledge.file is not None))
        self._prior = np.concatenate((of_last, np.ones(n_others), has_prior.ravel()))
        # (rows, 10 L + terms, P) columns of a joint's equations per unit of each unknown, over the
        # noise.
        changes = []
        for is_own, units in zip(
            np.eye(len(sigma)), np.where(has_prior, deviations, 1.0)
        ):
            own = np.kron(is_own, np.diag(units))
            changes.append(block_diag(visible, factor, own))
        self._changes = np.stack(changes) / sigma[:, None, None]

    def information(self, motion: Array) -> Array:
        """Return H (P, P), the inverse covariance of all unknowns: the terminal link's along
        ``visible``, the other links', each joint's. ``motion`` is q, qd and qdd (3, N, n).
        """
        return self._information(self._columns(*motion))

    def evaluate(self, motion: Array) -> float:
        """Return the value of a motion q, qd and qdd (3, N, n); infinite if singular."""
        return self._objective.value_and_weight(self.information(motion))[0]

    def with_gradient(self, motion: Array) -> tuple[float, Array]:
        """Return the value of a motion (3, N, n) and its gradient by q, qd and qdd."""
        q, qd, qdd = motion
        links = self._problem.dynamics.motion(q, qd, qdd)
        columns = self._columns_of(links, qd, qdd)
        information = self._information(columns)
        value, weight = self._objective.value_and_weight(information)
        by_column = -self._changes @ weight @ self._changes.transpose(0, 2, 1) @ columns
        n_links = len(self._theta)
        by_links = by_column[:, :n_links]
        own_slopes = self._own_slopes(columns, by_column, qd, qdd)
        # A load is the torque of the links as they are in the model.
        by_links = by_links + self._theta[:, None] * own_slopes[2][:, None]
        weights = np.zeros((self._problem.n_joints, *by_links.shape[1:]))
        weights[self._joints] = by_links
        gradient = links.weighted_gradient(self._problem.links, weights, qd)
        gradient[1:, :, self._joints] += own_slopes[:2].swapaxes(1, 2)
        return value, gradient

    def _own_slopes(
        self, columns: Array, by_column: Array, qd: Array, qdd: Array
    ) -> Array:
        """Return the derivative (3, rows, N) of the value by each joint's speed, acceleration and
        load, as far as its own unknowns have columns of these.

        One-sided differences, away from zero: dry friction jumps where a joint reverses.
        """
        n_links = len(self._theta)
        own = columns[:, n_links:]
        load = self._theta @ columns[:, :n_links]
        states = np.stack((qd.T[self._joints], qdd.T[self._joints], load))
        slopes = np.empty_like(states)
        for index, state in enumerate(states):
            step = np.where(state < 0.0, -STEP, STEP)
            moved = states.copy()
            moved[index] += step
            change = (self._own_columns(*moved) - own) / step[:, None]
            slopes[index] = np.sum(change * by_column[:, n_links:], axis=1)
        return slopes

    def _file_errors(self, file: FileKnowledge, sigma: Array) -> FileErrors:
        """Return the errors of a file on the motions elsewhere, as a function of the information.

        A constant torque at a joint counts as an offset of its sensor, and not as an error.
        """
        columns = self._columns(*file.elsewhere)
        columns = columns - np.mean(columns, axis=2, keepdims=True)
        size = self._changes.shape[2]
        elsewhere = np.zeros((size, size))
        for change, column, noise in zip(self._changes, columns, sigma):
            rows = noise * column.T @ change
            elsewhere += rows.T @ rows
        is_held = [name in file.held for name in self._terms]
        of_joints = np.tile(is_held, len(sigma))
        of_links = np.ones(self._n_links, dtype=bool)
        in_file = np.concatenate((of_links, of_joints))
        return FileErrors.at_once(elsewhere, in_file)

    def _columns(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the columns (rows, 10 L + terms, N) of each joint's equations: those of the links'
        parameters, then those of the joint's own unknowns.
        """
        return self._columns_of(self._problem.dynamics.motion(q, qd, qdd), qd, qdd)

    def _columns_of(self, links: LinksMotion, qd: Array, qdd: Array) -> Array:
        """Return ``_columns`` where the motion of the links is known already."""
        of_links = links.columns(self._problem.links).transpose(1, 2, 0)[self._joints]
        load = self._theta @ of_links
        own = self._own_columns(qd.T[self._joints], qdd.T[self._joints], load)
        return np.concatenate((of_links, own), axis=1)

    def _own_columns(self, qd: Array, qdd: Array, load: Array) -> Array:
        """Return the columns (rows, terms, N) of each joint's own unknowns.

        Args:
            qd, qdd: (rows, N) speeds and accelerations.
            load: (rows, N) torque of the links [N m].
        """
        sign = np.tanh(qd / self._smooth_speed[:, None])
        terms = [
            load
            if name == SCALE.name
            else TERMS[name].of_state(sign, qd, qdd, load, self._tops)
            for name in self._terms
        ]
        return np.stack(terms, axis=1)

    def _information(self, columns: Array) -> Array:
        """Return H (P, P) of columns as those of ``_columns``."""
        information = np.diag(self._prior)
        for change, column in zip(self._changes, columns):
            rows = column.T @ change
            information += rows.T @ rows
        joints = range(self._n_links, len(information))
        # All x_j can then be eliminated too where a joint stands still and its friction columns are
        # zero.
        ridge = 1e-12 * np.trace(information[self._n_links :, self._n_links :])
        information[joints, joints] += ridge
        return information


def random_motion(problem: PlannedArm) -> Array:
    """Return unrelated random positions within the limits, velocities and accelerations (3, N, n),
    which are the same in every call.
    """
    rng = np.random.default_rng(0)
    motion = rng.normal(size=(3, 400, problem.n_joints))
    q = problem.rest + 2.0 * motion[0]
    motion[0] = np.clip(q, problem.limits.lower, problem.limits.upper)
    return motion


def gradient_of(total: Callable[[Array, Array, Array], Array], motion: Array) -> Array:
    """Return the gradient of the sum of a function over the samples of a motion, by one-sided
    differences, exact to a millionth: the derivatives (3, N, n) by q, qd and qdd.

    Args:
        total: returns a number per sample (m, N) of m motions q, qd and qdd, (m N, n) each, one
            after the other; depends on each sample alone.
        motion: (3, N, n) q, qd and qdd.
    """
    # Dry friction jumps where a joint reverses; a step across the jump would be noise.
    states = np.concatenate(motion, axis=1)
    step = np.where(states < 0.0, -STEP, STEP)
    size = states.shape[1]
    # A step of each number in turn, at last none: (number that is moved, sample, number).
    moved = np.repeat(states[None], size + 1, axis=0)
    moved[range(size), :, range(size)] += step.T
    # In parts, which bound the memory for arms with many joints.
    sums = [
        total(*np.split(part.reshape(-1, size), 3, axis=1))
        for part in np.array_split(moved, 1 + size**3 // 30_000)
    ]
    values = np.concatenate(sums)
    return np.stack(np.split((values[:-1] - values[-1]).T / step, 3, axis=1))
