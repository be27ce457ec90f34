"""The polished model file: numbers of its fit, moved towards open-loop rollouts.

Inverse dynamics comes first, rollouts last. MuJoCo plays windows of the logs with the compiled
file: from the measured state, under the measured torque without the offsets of its sensors. From
the fit x0 of the file, whose covariance C is the prior, Gauss-Newton steps lead to the least

    sum ((q(x) - q) / sigma)^2 + (x - x0)' C^-1 (x - x0)

with possible bodies and within bounds. The derivatives by the directions of C are differences of
rollouts at the fit of all logs. What is judged is predicted from the other blocks: each block is
left out of the fit that is the start, and of the windows.

Shapes: n joints, W windows, m instants of each that are compared, k numbers, B blocks.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import ROTOR
from robot_sysid.estimate.fit import Fit, equations_of
from robot_sysid.estimate.held_out import is_clearly_lower, validation
from robot_sysid.estimate.options import FILE_ROTORS
from robot_sysid.estimate.restricted_fit import errors_on, gravity_in
from robot_sysid.estimate.rows import block_numbers
from robot_sysid.estimate.trust import judge_file
from robot_sysid.model.bodies import body_theta, write_body
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, RobotModel
from robot_sysid.records.file_access import atomic_files
from robot_sysid.records.messages import Level, percent
from robot_sysid.results.record import Identification, ModelErrors, ModelTarget
from robot_sysid.results.written_model import write_model
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.simulation.playback import Rollouts, TorqueWindow, interpolate

WINDOW = 0.3
"""Length of a window [s], in which an open loop does not run away."""
MAX_WINDOWS = 200
"""Most windows that are played, spread evenly over the logs."""
INSTANTS = 6
"""Number of instants of a window at which positions are compared, the last one at its end."""


def written_arm(result: Identification, mesh_dir: Path | None) -> RobotModel:
    """Return the arm in the model file that a result leads to, as its user will load it.

    Raises:
        ExportError: the model cannot hold the numbers.
    """
    assert result.checkpoints is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / result.model_name
        with atomic_files() as files:
            target = ModelTarget(files, path, result.checkpoints, mesh_dir)
            write_model(result, target, None, result.model_kind)
        return load_robot_model(path, joint=result.robot.terminal_joint)


@dataclass(frozen=True)
class OpenLoop:
    """Windows of the logs, played by a model file.

    Attributes:
        rollouts: of the compiled file.
        windows: starts and torques of the W windows, as measured.
        measured: (W, m, n) positions [rad or m].
        blocks: (W,) block of each window.
        steps: (m,) numbers of the steps after which positions are compared.
    """

    rollouts: Rollouts
    windows: tuple[TorqueWindow, ...]
    measured: Array
    blocks: NDArray[np.int64]
    steps: NDArray[np.int64]

    @classmethod
    def of(cls, file: Fit, written: RobotModel) -> OpenLoop:
        """Return windows of a file's logs, of short ones each from the middle of the one before.

        A window lies within a block. Where no row can be used, such as in a contact, there is none.
        """
        rollouts = Rollouts(written)
        timestep = rollouts.model.opt.timestep
        ends = np.linspace(0.0, WINDOW / timestep, INSTANTS + 1)
        steps = np.round(ends[1:]).astype(int)
        edges = timestep * np.arange(steps[-1])
        cut = []
        numbers, _ = block_numbers(file.recordings)
        motion = sum(np.ptp(recording.motion.time) for recording in file.recordings)
        distance = max(0.5 * WINDOW, motion / MAX_WINDOWS)
        for recording, blocks in zip(file.recordings, numbers):
            time = recording.time
            rows = recording.motion.time
            is_used = np.any(recording.used, axis=1)
            for start in np.arange(rows[0], rows[-1] - WINDOW, distance):
                first = np.searchsorted(rows, start, "right") - 1
                last = np.searchsorted(rows, start + WINDOW) + 1
                if np.ptp(blocks[first:last]) or not np.all(is_used[first:last]):
                    continue
                # Velocities of a rollout are half a step before its positions.
                qd = interpolate(start - 0.5 * timestep, time, recording.qd)
                window = TorqueWindow(
                    interpolate(start, time, recording.q),
                    qd,
                    interpolate(start + edges, time, recording.tau),
                )
                at = start + timestep * steps
                measured = interpolate(at, time, recording.q)
                cut.append((window, measured, blocks[first]))
        windows, positions, of_block = zip(*cut) if cut else ((), (), ())
        return cls(rollouts, windows, np.array(positions), np.array(of_block), steps)

    def errors(self, file: Fit) -> Array:
        """Return played minus measured positions (W, m, n), pi where a rollout has diverged.

        Args:
            file: the numbers of the model file.
        """
        robot = self.rollouts.robot
        model = self.rollouts.model
        for name, row, value in self._elements(file):
            getattr(model, name)[row] = value
        for link, theta in zip(robot.links, file.thetas):
            if np.any(theta != link.theta):
                own = body_theta(robot.mj_model, link.body_id)
                write_body(model, link.body_id, own + theta - link.theta)
        gravity = gravity_in(file)
        if gravity is not None:
            model.opt.gravity = gravity
        self.rollouts.set_constants()
        offset = np.array([file.by_name[key] for key in file.arm.terms["offset"].names])
        windows = [replace(window, tau=window.tau - offset) for window in self.windows]
        played = self.rollouts.under_torques(windows)[:, self.steps]
        return np.nan_to_num(played - self.measured, nan=np.pi)

    def _elements(self, file: Fit) -> Iterator[tuple[str, int, float]]:
        """Yield field, row and value of each number of joints and motors in the compiled file."""
        robot = self.rollouts.robot
        dofs = dict(zip(robot.joint_names, robot.dof_index.tolist()))
        # Motors that the model does not have are tendons behind its own.
        new = itertools.count(file.arm.robot.mj_model.ntendon)
        tendons = {}
        for motor in file.arm.motors:
            tendon = motor.tendon
            tendons[motor.name] = next(new) if tendon is None else tendon
        for term in file.arm.terms.values():
            for each in term.parameters:
                kind, rows = ("dof", dofs) if each.of in dofs else ("tendon", tendons)
                name = f"{kind}_{each.attribute}"
                # Tendons have no rotors in older releases.
                if each.attribute and hasattr(self.rollouts.model, name):
                    yield name, rows[each.of], max(file.by_name[each.key], 0.0)


def with_rotors(estimate: Fit, file: Fit) -> tuple[Fit, Array]:
    """Return the file's fit with its rotors among the k estimated numbers, and their prior.

    The prior is the covariance (k, k) of the file's fit, and of each rotor its error in the fit of
    all terms, from which it was taken.
    """
    from scipy.linalg import block_diag

    rotors = file.arm.terms[ROTOR.name]
    terms = [*file.equations.terms]
    # One that the fit of all terms does not show, or holds at its bound, stays.
    is_shown = np.isfinite([*map(estimate.error_of, rotors.names)])
    is_shown &= ~np.isin(rotors.names, estimate.at_bound)
    if np.any(is_shown) and FILE_ROTORS not in file.question.options.kept:
        terms.append(rotors.only(np.flatnonzero(is_shown).tolist()))
    equations = equations_of(file.arm, file.sums, terms, file.by_name)
    values = np.array([file.by_name[name] for name in equations.names])
    added = equations.names[len(file.names) :]
    errors = [*map(estimate.error_of, added)]
    covariance = block_diag(file.covariance, np.diag(np.square(errors)))
    is_free = np.append(file.is_free, np.ones(len(added), dtype=bool))
    start = replace(
        file, equations=equations, values=values, is_free=is_free, bodies=None
    )
    return start, covariance


@dataclass(frozen=True)
class Polish:
    """Gauss-Newton steps of a file's numbers towards the rollouts of its windows.

    Attributes:
        problem: the windows.
        whitening: (k, k) takes numbers to those of unit prior variance.
        slopes: (W, m, n, k) derivatives of positions by the numbers.
    """

    problem: OpenLoop
    whitening: Array
    slopes: Array

    @classmethod
    def of(cls, problem: OpenLoop, start: Fit, covariance: Array) -> Polish:
        """Return what leads from a fit, by the directions of its prior covariance (k, k)."""
        deviation = np.sqrt(np.diag(covariance)) + 1e-300
        shares, axes = np.linalg.eigh(covariance / np.outer(deviation, deviation))
        # Directions that are known by far better than single numbers stay where they are.
        roots = np.sqrt(np.maximum(shares, 1e-9))
        directions = deviation[:, None] * axes * roots
        whitening = (axes / roots).T / deviation
        errors = problem.errors(start)
        # Of differences, in standard deviations: friction at turns makes rollouts rough.
        step = 0.3
        slopes = []
        for direction in directions.T:
            moved = replace(start, values=start.values + step * direction)
            slopes.append((problem.errors(moved) - errors) / step)
        return cls(problem, whitening, np.stack(slopes, axis=-1) @ whitening)

    def steps_from(self, start: Fit, prior: Array, used: NDArray[np.bool_]) -> Fit:
        """Return the fit to which the steps lead.

        Args:
            start: where they begin.
            prior: (k,) mean of the prior.
            used: (W,) which windows count.
        """
        fit = replace(start, values=prior)
        # Positions of a window say no more than one of them, and half of it is another window's.
        correlation = 2.0 * INSTANTS
        held = np.column_stack((self.whitening, self.whitening @ prior))
        for _ in range(3):
            errors = self.problem.errors(fit)[used]
            scale = np.sqrt(correlation * np.mean(errors**2, axis=(0, 1))) + 1e-9
            slopes = self.slopes[used] / scale[:, None]
            slopes = slopes.reshape(-1, len(prior))
            shown = slopes @ fit.values - np.ravel(errors / scale)
            rows = np.vstack((held, np.column_stack((slopes, shown))))
            fit = replace(fit, is_free=start.is_free).constrained(rows.T @ rows, True)
        return fit


def polish(
    estimate: Fit,
    file: Fit,
    written: RobotModel,
    tests: Sequence[tuple[Sequence[FilteredRecording], str]] = (),
) -> tuple[Fit, str]:
    """Return the fit of the polished file, and a sentence on it; the file's fit if it is no better.

    It is better if positions at the ends of held-out windows are clearly nearer to the measured
    ones, those of no joint clearly farther, and torques are predicted no worse, with squares that
    are not a tenth larger: those of held-out blocks, and those of each other log. Errors of the
    numbers stay those of the file's fit.

    Args:
        estimate: the fit of all terms.
        file: the fit of the model file.
        written: the arm in that file.
        tests: other logs, low-passed, and their names.
    """
    if len(file.arm.joints) < written.n_joints or not np.all(
        [recording.has_torque for recording in file.recordings]
    ):
        return file, "not polished: a rollout needs the torques of all joints"
    problem = OpenLoop.of(file, written)
    if len(np.unique(problem.blocks)) < 2:
        reason = f"no two tenths of the logs hold {WINDOW:g} s in which the arm moves"
        return file, f"not polished: {reason}; record longer"
    start, covariance = with_rotors(estimate, file)
    steps = Polish.of(problem, start, covariance)
    is_any = np.ones(len(problem.blocks), dtype=bool)
    fit = steps.steps_from(start, start.values, is_any)

    rotors = start.values[len(file.values) :]
    torques = []
    squares = []
    for block, alone in enumerate(file.alone):
        prior = np.append(alone, rotors)
        in_block = problem.blocks == block
        other = steps.steps_from(fit, prior, ~in_block)
        torques.append(other.equations.squared_residuals(other.values, [block]))
        pair = (replace(other, values=prior), other)
        ends = [problem.errors(each)[in_block, -1] for each in pair]
        if np.any(in_block):
            squares.append(np.sum(np.square(ends), axis=1))
    before, after = np.swapaxes(squares, 0, 1)
    polished = _file_with(file, fit, np.array(torques))

    pairs = [ModelErrors(validation(file), validation(polished))]
    for log in tests:
        pairs.append(
            ModelErrors(*(errors_on(each, *log).after for each in (file, polished)))
        )
    count = before.shape[1] * len(problem.blocks)
    sizes = [1e3 * np.sqrt(np.sum(each) / count) for each in (before, after)]
    shares = [percent(each.relative_error or 0.0) for each in vars(pairs[0]).values()]
    sentence = (
        f"at the end of held-out windows of {WINDOW:g} s, which are played with the measured "
        f"torque, the position error is {sizes[1]:.3g} in place of {sizes[0]:.3g} "
        f"{'mrad or mm' if np.any(written.is_slide) else 'mrad'}, the torque error on held-out "
        f"data {shares[1]} in place of {shares[0]}"
    )
    is_better = is_clearly_lower(np.sum(after, axis=1), np.sum(before, axis=1))
    is_farther = any(map(is_clearly_lower, before.T, after.T))
    # Without a test of significance: the numbers of the torques are there already.
    is_worse = any(
        judge_file(each).level is Level.REFUSES
        or np.sum(each.before.blocks) < 0.9 * np.sum(each.after.blocks)
        for each in pairs
    )
    if is_better and not is_farther and not is_worse:
        return polished, f"polished: {sentence}"
    return (
        file,
        f"not polished, the written numbers stay those of the torques: {sentence}",
    )


def _file_with(file: Fit, fit: Fit, held_out: Array) -> Fit:
    """Return a file's fit with other numbers, its errors kept.

    Args:
        file: the fit of the model file.
        fit: with the numbers, rotors among them.
        held_out: (B, J) squared torque errors of each block, predicted from the others.
    """
    terms = file.equations.terms
    equations = equations_of(file.arm, file.sums, terms, fit.by_name)
    size = len(file.names)
    polished = replace(
        file, equations=equations, values=fit.values[:size], is_free=fit.is_free[:size]
    )
    # What follows from blocks of torque alone is not computed from other numbers.
    kept = {name: getattr(file, name) for name in ("_apart", "covariance")}
    polished.__dict__.update(kept, held_out=held_out)
    return polished


def with_errors_of(result: Identification, before: Identification) -> Identification:
    """Return a polished result in which no error is smaller than before it was polished."""
    errors = {(row.name, row.of, row.source): row.error for row in before.quantities}
    quantities = []
    for row in result.quantities:
        old = errors.get((row.name, row.of, row.source), row.error)
        if old is not None and row.error is not None:
            row = replace(row, error=float(np.fmax(old, row.error)))
        quantities.append(row)
    return replace(result, quantities=tuple(quantities))
