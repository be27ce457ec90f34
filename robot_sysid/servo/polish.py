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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import OFFSET, ROTOR
from robot_sysid.estimate.fit import Fit, equations_of
from robot_sysid.estimate.held_out import is_clearly_lower
from robot_sysid.estimate.options import FILE_ROTORS
from robot_sysid.estimate.quantities import quantity
from robot_sysid.estimate.restricted_fit import errors_of, errors_on, gravity_in
from robot_sysid.estimate.rows import block_numbers
from robot_sysid.model.bodies import body_theta, write_body
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Array, Errors, ModelErrors, RobotModel
from robot_sysid.records.file_access import atomic_files
from robot_sysid.records.messages import percent
from robot_sysid.results.reasons import file_fault
from robot_sysid.results.record import Identification, ModelTarget
from robot_sysid.results.written_model import write_model
from robot_sysid.signals.process import FilteredRecording
from robot_sysid.simulation.playback import Rollouts, interpolate

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
    with tempfile.TemporaryDirectory() as folder, atomic_files() as files:
        path = Path(folder) / result.model_name
        target = ModelTarget(files, path, result.checkpoints, mesh_dir)
        write_model(result, target, None, result.model_kind)
        draft = files.draft_of(path)
        return load_robot_model(draft, joint=result.robot.terminal_joint)


class OpenLoop:
    """Windows of a file's logs, played by that file, of short ones each from the middle of another.

    A window lies within a block. Where no row can be used, such as in a contact, there is none.

    Args:
        file: the fit of the model file.
        written: the arm in that file.

    Attributes:
        rollouts: of the compiled file.
        steps: (m,) numbers of the steps after which positions are compared.
        starts: (W, 2, n) positions, and velocities half a step before [rad, rad/s].
        tau: (W, S, n) measured torque of each step [N m].
        measured: (W, m, n) positions [rad or m].
        blocks: (W,) block of each window.
    """

    def __init__(self, file: Fit, written: RobotModel) -> None:
        self.rollouts = Rollouts(written)
        timestep = self.rollouts.model.opt.timestep
        ends = np.linspace(0.0, WINDOW / timestep, INSTANTS + 1)
        self.steps = np.round(ends[1:]).astype(int)
        edges = timestep * np.arange(self.steps[-1] + 1)
        motion = sum(np.ptp(recording.motion.time) for recording in file.recordings)
        distance = max(0.5 * WINDOW, motion / MAX_WINDOWS)
        numbers, _ = block_numbers(file.recordings)
        cut = []
        for recording, row_blocks in zip(file.recordings, numbers):
            time = recording.time
            rows = recording.motion.time
            # NaN, which equals no block, where no row can be used.
            blocks = np.where(np.any(recording.used, axis=1), row_blocks, np.nan)
            for start in np.arange(rows[0], rows[-1] - WINDOW, distance):
                first = np.searchsorted(rows, start, "right") - 1
                last = np.searchsorted(rows, start + WINDOW)
                if np.all(blocks[first : last + 1] == blocks[first]):
                    q = interpolate(start + edges, time, recording.q)
                    qd = interpolate(start - 0.5 * timestep, time, recording.qd)
                    tau = interpolate(start + edges[:-1], time, recording.tau)
                    cut.append(((q[0], qd), tau, q[self.steps], blocks[first]))
        columns = map(np.array, zip(*cut) if cut else [()] * 4)
        self.starts, self.tau, self.measured, self.blocks = columns

    def errors(self, file: Fit) -> Array:
        """Return played minus measured positions (W, m, n), pi where a rollout has diverged.

        Args:
            file: the numbers of the model file.
        """
        robot = self.rollouts.robot
        model = self.rollouts.model
        # Kind and number of each joint and motor in the compiled file.
        owners = {j: ("dof", dof) for j, dof in zip(robot.joint_names, robot.dof_index)}
        # Motors that the model does not have are tendons behind its own.
        new = itertools.count(file.arm.robot.mj_model.ntendon)
        for motor in file.arm.motors:
            tendon = next(new) if motor.tendon is None else motor.tendon
            owners[motor.name] = "tendon", tendon
        for term in file.arm.terms.values():
            for each in term.parameters:
                kind, row = owners.get(each.of, ("", 0))
                # Tendons have no rotors in older releases.
                numbers = getattr(model, f"{kind}_{each.attribute}", None)
                # Damping that bends is the compiled file's own.
                if numbers is not None and each.entry is None:
                    numbers[row] = max(file.by_name[each.key], 0.0)
        for link, theta in zip(robot.links, file.thetas):
            if np.any(theta != link.theta):
                own = body_theta(robot.mj_model, link.body_id)
                write_body(model, link.body_id, own + theta - link.theta)
        gravity = gravity_in(file)
        if gravity is not None:
            model.opt.gravity = gravity
        self.rollouts.set_constants()
        offset = file.full[file.sums.at(file.arm.terms[OFFSET.name].names)]
        played = self.rollouts.under_torques(self.starts, self.tau - offset)
        return np.nan_to_num(played[:, self.steps] - self.measured, nan=np.pi)


def with_rotors(estimate: Fit, file: Fit) -> tuple[Fit, Array]:
    """Return the file's fit with its rotors among the k estimated numbers, and their prior.

    The prior is the covariance (k, k) of the file's fit, and of each rotor its error in the fit of
    all terms, from which it was taken.
    """
    from scipy.linalg import block_diag

    rotors = file.arm.terms[ROTOR.name]
    errors = np.array([quantity(estimate, name)[1] for name in rotors.names])
    # One that the fit of all terms does not show, or holds at its bound, stays.
    is_free = np.isfinite(errors) & (FILE_ROTORS not in file.question.options.kept)
    terms = (*file.equations.terms, rotors.only(np.flatnonzero(is_free).tolist()))
    equations = equations_of(file.arm, file.sums, terms, file.by_name)
    start = replace(
        file,
        equations=equations,
        values=file.full[equations.index],
        is_free=~np.isin(equations.names, file.at_bound),
        bodies=None,
    )
    return start, block_diag(file.covariance, np.diag(errors[is_free] ** 2))


class Polish:
    """Gauss-Newton steps of a file's numbers towards the rollouts of its windows.

    Args:
        problem: the windows.
        start: the numbers at which derivatives are taken.
        covariance: of their prior (k, k).

    Attributes:
        problem: as given.
        whitening: (k, k) takes numbers to those of unit prior variance.
        slopes: (W, m, n, k) derivatives of positions by the numbers.
    """

    def __init__(self, problem: OpenLoop, start: Fit, covariance: Array) -> None:
        self.problem = problem
        deviation = np.sqrt(np.diag(covariance)) + 1e-300
        shares, axes = np.linalg.eigh(covariance / np.outer(deviation, deviation))
        # Directions that are known by far better than single numbers stay where they are.
        roots = np.sqrt(np.maximum(shares, 1e-9))
        self.whitening = (axes / roots).T / deviation
        errors = problem.errors(start)
        # Of differences, in standard deviations: friction at turns makes rollouts rough.
        step = 0.3
        slopes = []
        for direction in (deviation[:, None] * axes * roots).T:
            moved = replace(start, values=start.values + step * direction)
            slopes.append((problem.errors(moved) - errors) / step)
        self.slopes = np.stack(slopes, axis=-1) @ self.whitening

    def steps_from(self, start: Fit, used: NDArray[np.bool_]) -> Fit:
        """Return the fit to which the steps lead.

        Args:
            start: where they begin: the mean of the prior.
            used: (W,) which windows count.
        """
        fit = start
        # Positions of a window say no more than one of them, and half of it is another window's.
        correlation = 2.0 * INSTANTS
        prior = np.column_stack((self.whitening, self.whitening @ start.values))
        for _ in range(3):
            errors = self.problem.errors(fit)[used]
            scale = np.sqrt(correlation * np.mean(errors**2, axis=(0, 1))) + 1e-9
            slopes = self.slopes[used] / scale[:, None]
            slopes = slopes.reshape(-1, len(self.whitening))
            shown = slopes @ fit.values - np.ravel(errors / scale)
            rows = np.vstack((prior, np.column_stack((slopes, shown))))
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
    problem = OpenLoop(file, written)
    blocks = problem.blocks
    if len(np.unique(blocks)) < 2:
        reason = f"no two tenths of the logs hold {WINDOW:g} s in which the arm moves"
        return file, f"not polished: {reason}; record longer"
    start, covariance = with_rotors(estimate, file)
    steps = Polish(problem, start, covariance)
    polished = steps.steps_from(start, blocks >= 0)

    rotors = start.values[len(file.values) :]
    is_offset = np.isin(start.names, file.arm.terms[OFFSET.name].names)
    torques = []
    torques_as_used = []
    squares = []
    for block, alone in enumerate(file.alone):
        begin = replace(polished, values=np.append(alone, rotors))
        is_held_out = blocks == block
        end = steps.steps_from(begin, ~is_held_out)
        torques.append(end.equations.squared_residuals(end.values, [block]))
        without = np.where(is_offset, 0.0, end.values)
        torques_as_used.append(end.equations.squared_residuals(without, [block]))
        last = [problem.errors(fit)[is_held_out, -1] for fit in (begin, end)]
        if np.any(is_held_out):
            squares.append(np.sum(np.square(last), axis=1))
    before, after = np.swapaxes(squares, 0, 1)
    # What else follows from blocks of torque is that of the file's fit.
    of_file = {"_apart": file._apart, "covariance": covariance}
    of_torques = {
        "held_out": np.array(torques),
        "held_out_as_used": np.array(torques_as_used),
    }
    polished.__dict__.update(of_file, **of_torques)

    fits = file, polished
    errors = [errors_of(fit) for fit in fits]
    for log in tests:
        errors += [errors_on(fit, *log) for fit in fits]
    pairs = [
        ModelErrors(old.after, new.after, Errors(old.after_as_used, new.after_as_used))
        for old, new in zip(errors[::2], errors[1::2])
    ]
    count = before.shape[1] * len(blocks)
    sizes = [1e3 * np.sqrt(np.sum(each) / count) for each in (before, after)]
    torque_errors = pairs[0].before, pairs[0].after
    shares = [percent(each.relative_error or 0.0) for each in torque_errors]
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
        file_fault(pair) or np.sum(pair.before.blocks) < 0.9 * np.sum(pair.after.blocks)
        for pair in pairs
    )
    if is_better and not is_farther and not is_worse:
        return polished, f"polished: {sentence}"
    stays = "not polished, the written numbers stay those of the torques"
    return file, f"{stays}: {sentence}"


def with_errors_of(result: Identification, before: Identification) -> Identification:
    """Return a polished result in which no error is smaller than before it was polished."""
    errors = {(row.name, row.of, row.source): row.error for row in before.quantities}
    quantities = []
    for row in result.quantities:
        if row.error is not None:
            old = errors.get((row.name, row.of, row.source)) or 0.0
            row = replace(row, error=float(np.fmax(old, row.error)))
        quantities.append(row)
    return replace(result, quantities=tuple(quantities))
