"""Errors of predicted torques on rows that were not fitted: held-out blocks and other logs.

In-sample errors fall with every parameter. So each block of time is predicted from the others
(cross-validation). Blocks are compared by ratios of their errors, because friction may matter far
more in one of them.

Shapes: "blocks" and "joints" count the blocks of cross-validation and the joints with equations; p
parameters (``Columns.names``), of which k are estimated. The equations [A b] of a joint in a block,
A x = b with c parameters x, are kept as the triangle R (m, c+1) with R^T R = [A b]^T [A b]; their
columns belong to the parameters with the indices ``columns`` (c,) among all p.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from robot_sysid.errors import InputError
from robot_sysid.estimation.algebra.consistent_bodies import consistent_least_squares
from robot_sysid.estimation.algebra.least_squares import (
    normal_matrix,
    restrict,
    sample_counts,
    update_triangle,
)
from robot_sysid.estimation.columns import Columns
from robot_sysid.estimation.dataset import Dataset, DecimatedSamples
from robot_sysid.estimation.errors import FitErrors
from robot_sysid.estimation.fit import Evidence, Fit, evidence_of, links_problem
from robot_sysid.estimation.unknowns import Unknowns
from robot_sysid.records import Array, SquareRootInformation, Validation
from robot_sysid.records.data import validation_of

OWN_SOURCE = "the logs, each fifth predicted from the others"
"""Source of a validation on the fitted recordings, in words for the user."""
CLEAR_SHARE = 0.1
"""Least relative decrease of the held-out squared error that counts as clear."""
CLEARLY = 2.0
"""Least mean decrease of the logarithm of the held-out squared error that counts as clear, in
standard errors of the mean over the blocks."""
# Less than every squared error [N^2 m^2]; avoids the logarithm of zero.
_TINY = 1e-30
# Added to the diagonal of scaled normal equations, which stay regular without data on a parameter.
_RIDGE = 1e-12


@dataclass(frozen=True)
class HeldOut:
    """Cross-validation of recordings in blocks, each of which is predicted from the others.

    Sums over the blocks are cached, so that one instance compares many sets of unknowns.

    Attributes:
        data: evidence (triangles of equations) of each block.
        noise: (joints,) effective standard deviation of each joint's torque noise [N m].
        superset: unknowns that contain those of every set to compare, so that sums are made of
            their columns alone, which saves memory; None for all parameters.
        _triangles: cache of ``_other_triangles``, by the unknowns' indices and held values.
    """

    data: Evidence
    noise: Array
    superset: Unknowns | None = None
    _triangles: dict[tuple[bytes, bytes], Sequence[Array]] = field(default_factory=dict)

    @cached_property
    def counts(self) -> Array:
        """Number of rows (blocks, joints) of each joint in each block."""
        return np.array(list(map(sample_counts, self.data.blocks)))

    @cached_property
    def _available(self) -> NDArray[np.bool_]:
        """Which parameters (p,) have columns in the Gram matrices.

        These are parameters with data that are unknown, or held at a value other than zero.
        """
        nonzero = self.data.nonzero
        if self.superset is None:
            return nonzero
        is_unknown = np.isin(np.arange(len(nonzero)), self.superset.estimated)
        return nonzero & (is_unknown | (self.superset.held != 0.0))

    @cached_property
    def _grams(self) -> Array:
        """Gram matrices (blocks, s+2, s+2) of the whitened equations of all blocks but one in turn.

        Columns are the s available parameters, the right-hand sides, and one column of zeros that
        stands for every other parameter: a parameter without a column has the index -1.
        """
        # The last column of a normal matrix (p+1, p+1) belongs to the right-hand sides.
        indices = np.append(np.flatnonzero(self._available), -1)
        grams = np.zeros((len(self.data.blocks), len(indices) + 1, len(indices) + 1))
        for gram, block in zip(grams, self.data.blocks):
            normal = normal_matrix(block, 1.0 / self.noise)
            gram[:-1, :-1] = normal[np.ix_(indices, indices)]
        # Row by row of all blocks: a second array of all matrices would double the memory.
        for row_of_blocks in grams.swapaxes(0, 1):
            row_of_blocks[:] = np.array(_sums_of_others([*row_of_blocks], np.add))
        return grams

    def squared_errors(self, unknowns: Unknowns) -> Array:
        """Return the squared error (blocks, joints) of blocks predicted from the others [N^2 m^2].

        Bodies may be physically inconsistent here.
        """
        return self._squared_residuals(self._values(unknowns))

    def _squared_residuals(self, values: Array) -> Array:
        """Return squared errors (blocks, joints) of each block at its values (blocks, p)."""
        # The evidence takes several sets of values per block, here one.
        return self.data.squared_residuals(values[..., None])[..., 0]

    def _normal_equations(
        self, unknowns: Unknowns
    ) -> Iterator[tuple[Array, Array, Array]]:
        """Yield the normal equations of data and priors without each block in turn.

        Friction terms that the other blocks do not identify stay near zero; all other parameters
        without data have priors. The unknowns have to be part of ``superset``.

        Yields:
            (scaled matrix (k, k), scaled right side (k,), scale (k,)) of each block: the solution
            times the scale is the estimate from the other blocks. The arrays are new.
        """
        available = self._available
        held = unknowns.held.copy()
        assert not np.any(
            self.data.nonzero[unknowns.estimated] & ~available[unknowns.estimated]
        )
        held[unknowns.estimated] = 0.0
        prior_rows = _prior_rows(unknowns)
        prior_gram = prior_rows.T @ prior_rows
        # Parameter to its column in the Gram matrices: an available one's rank among these.
        gram_indices = np.where(available, np.cumsum(available) - 1, -1)
        indices = gram_indices[unknowns.estimated]
        held_indices = np.flatnonzero(held)
        for gram in self._grams:
            # The torque of held parameters is subtracted from the right-hand sides.
            crossed = gram[np.ix_(indices, gram_indices[held_indices])]
            right_side = (
                gram[indices, -2] - crossed @ held[held_indices] + prior_gram[:-1, -1]
            )
            matrix = gram[np.ix_(indices, indices)] + prior_gram[:-1, :-1]
            size = np.sqrt(np.diagonal(matrix))
            scale = 1.0 / np.where(size > 0.0, size, 1.0)
            matrix *= scale[:, None] * scale
            matrix[np.diag_indices_from(matrix)] += _RIDGE
            yield matrix, scale * right_side, scale

    def _values(self, unknowns: Unknowns) -> Array:
        """Return all parameters (blocks, p), estimated without each block in turn.

        Bodies may be physically inconsistent.
        """
        values = []
        for matrix, right_side, scale in self._normal_equations(unknowns):
            values.append(unknowns.full(scale * np.linalg.solve(matrix, right_side)))
        return np.array(values)

    def expected_squared_errors(self, fit: Fit) -> Array:
        """Return expected squared errors (blocks, joints) if the model is right [N^2 m^2].

        It is the noise of the block's own torque plus the variance of the prediction made from the
        other blocks. Where none of them identifies a joint's friction, it is nearly infinite.
        """
        estimated = fit.unknowns.estimated
        expected = self.counts * fit.noise**2
        equations = self._normal_equations(fit.unknowns)
        for index, (matrix, _, scale) in enumerate(equations):
            # R (k, k) with R^T R the covariance C of the estimate: rows A add tr(A C A^T).
            root = np.linalg.inv(np.linalg.cholesky(matrix)) * scale
            for row, joint in enumerate(self.data.blocks[index].joints):
                is_estimated = np.isin(joint.columns, estimated)
                columns = np.searchsorted(estimated, joint.columns[is_estimated])
                rows = joint.triangle[:, :-1][:, is_estimated]
                expected[index, row] += np.sum((rows @ root[:, columns].T) ** 2)
        return expected

    def consistent_squared_errors(self, unknowns: Unknowns) -> Array:
        """Return the squared error (blocks, joints) of blocks predicted from the others [N^2 m^2].

        Bodies are physically consistent in every one of these estimates.
        """
        values = self._values(unknowns)
        problem = links_problem(unknowns)
        prior_rows = _prior_rows(unknowns)
        for index, estimate in enumerate(values):
            if not unknowns.has_consistent_bodies(estimate):
                rows = np.vstack((self._other_triangles(unknowns)[index], prior_rows))
                best = consistent_least_squares(rows[:, :-1], rows[:, -1], problem)
                values[index] = unknowns.full(best)
        return self._squared_residuals(values)

    def _other_triangles(self, unknowns: Unknowns) -> Sequence[Array]:
        """Return per block the triangle (m, k+1) of the whitened equations of all other blocks.

        It is computed once for each set of unknowns and held values.
        """
        key = unknowns.estimated.tobytes(), unknowns.held.tobytes()
        if key not in self._triangles:
            restriction = unknowns.estimated_names, unknowns.held
            empty = np.zeros((0, len(unknowns.estimated) + 1))
            triangles = []
            for block in self.data.blocks:
                equations = restrict(block, *restriction).equations(1.0 / self.noise)
                triangles.append(update_triangle(empty, np.column_stack(equations)))
            self._triangles[key] = _sums_of_others(triangles, update_triangle)
        return self._triangles[key]

    def score(self, unknowns: Unknowns) -> Array:
        """Return the mean squared error (blocks,) of each block predicted from the others.

        The mean is over rows of all joints, in units of each joint's noise variance. Bodies are
        physically consistent.
        """
        squared = self.consistent_squared_errors(unknowns)
        counts = np.maximum(np.sum(self.counts, axis=1), 1.0)
        return np.asarray(np.sum(squared / self.noise**2, axis=-1) / counts)

    def validation(self, squared: Array, source: str = OWN_SOURCE) -> Validation:
        """Return the record of prediction errors of all blocks together.

        Args:
            squared: (blocks, joints) sums of squared errors [N^2 m^2].
            source: which rows were predicted, in words for the user.
        """
        joints = [joint.joint for joint in self.data.blocks[0].joints]
        torque = np.sum(self.data.squared_torque, axis=0)
        counts = np.sum(self.counts, axis=0)
        return validation_of(joints, np.sum(squared, axis=0), torque, counts, source)


def held_out(fit: Fit, superset: Unknowns | None = None) -> HeldOut:
    """Return the cross-validation of a fit's data, with the noise that weights its equations.

    Args:
        fit: the fit whose blocks of data and weights are used.
        superset: see ``HeldOut``; None for all parameters.
    """
    return HeldOut(fit.evidence, 1.0 / fit.weights, superset)


def _sums_of_others(
    summands: Sequence[Array], add: Callable[[Array, Array], Array]
) -> list[Array]:
    """Return for each of two or more summands the sum of all other summands.

    Sums are accumulated from both ends: subtracting a summand from the total would leave rounding
    errors where the others have no data.

    Args:
        add: returns the sum of two summands, which are matrices or triangles.
    """
    sums_before = list(accumulate(summands[:-1], add))
    sums_after = list(accumulate(summands[:0:-1], add))[::-1]
    return [sums_after[0], *map(add, sums_before[:-1], sums_after[1:]), sums_before[-1]]


def _prior_rows(unknowns: Unknowns) -> Array:
    """Return the priors as equations [A b] (m, k+1) of unit variance in the k unknowns."""
    rows = [group.prior_rows(unknowns.estimated_names) for group in unknowns.groups]
    return np.vstack(rows) if rows else np.zeros((0, len(unknowns.estimated) + 1))


def is_clearly_lower(errors: Array, reference: Array) -> bool:
    """Tell whether squared errors are clearly lower than those of a reference, over all blocks.

    The sum over blocks, and the geometric mean of the ratios of the blocks' errors, have to be
    lower by more than ``CLEAR_SHARE``; the mean logarithm of these ratios has to be negative by
    more than ``CLEARLY`` standard errors. Errors that are not finite are higher than all others.

    Args:
        errors: (blocks,) squared held-out errors, in any unit.
        reference: (blocks,) in the unit of ``errors``.
    """
    if not np.all(np.isfinite(errors)) or not np.all(np.isfinite(reference)):
        return bool(np.all(np.isfinite(errors)))
    ratio = np.log((errors + _TINY) / (reference + _TINY))
    mean = float(np.mean(ratio))
    standard_error = float(np.std(ratio, ddof=1)) / np.sqrt(len(ratio))
    threshold = np.log(1.0 - CLEAR_SHARE)
    lower = np.sum(errors) < (1.0 - CLEAR_SHARE) * np.sum(reference)
    return bool(lower and mean < threshold and mean + CLEARLY * standard_error < 0.0)


def held_out_validation(fit: Fit) -> Validation:
    """Return the cross-validated error of the recordings that were fitted.

    ``is_informative`` of the record says whether the error tests the fit.
    """
    judge = held_out(fit, fit.unknowns)
    errors = judge.consistent_squared_errors(fit.unknowns)
    noise = judge.counts * fit.noise**2
    is_informative = is_informative_test(
        errors, noise, lambda: judge.expected_squared_errors(fit)
    )
    return replace(judge.validation(errors), is_informative=is_informative)


def held_out_logs(fit: Fit) -> list[Validation]:
    """Return the error of each log predicted from the others; () where there is a single log.

    Recordings of one name are one log. A log whose error does not test the fit
    (``is_informative_test``) is left out, as one with joints that the other logs do not identify.
    The fit needs its rows (``Fit.samples``).
    """
    logs: dict[str, list[DecimatedSamples]] = {}
    for dataset, samples in zip(fit.columns.datasets, fit.samples):
        logs.setdefault(dataset.name, []).append(samples)
    if len(logs) < 2:
        return []
    data = evidence_of(logs.values(), fit.evidence.torque)
    judge = HeldOut(data, 1.0 / fit.weights, fit.unknowns)
    errors = judge.consistent_squared_errors(fit.unknowns)
    noise = judge.counts * fit.noise**2
    expected = judge.expected_squared_errors(fit)

    def tests_fit(k: int) -> bool:
        """Tell whether the error of log k tests the fit."""
        return is_informative_test(errors[[k]], noise[[k]], lambda: expected[[k]])

    tests = []
    for k, name in enumerate(logs):
        if tests_fit(k):
            source = f"{name}, predicted from the other logs"
            test = validation_of(
                fit.columns.joints,
                errors[k],
                data.squared_torque[k],
                judge.counts[k],
                source,
            )
            tests.append(test)
    return tests


NOISE_EXPLAINS = 3.0
"""Ratio of held-out error to noise up to which noise, and not a wrong model, may be the cause."""


def _error_ratio(squared: Array, expected: Array) -> float:
    """Return the root mean square over joints of the ratio of actual to expected error.

    Blocks are summed. Joints without data are left out.

    Args:
        squared: (blocks, joints) squared errors [N^2 m^2].
        expected: (blocks, joints) expected squared errors, zero for a joint without data [N^2 m^2].
    """
    used = np.any(expected > 0.0, axis=0)
    ratios = squared.sum(axis=0)[used] / expected.sum(axis=0)[used]
    return float(np.sqrt(np.mean(ratios)))


def is_informative_test(
    squared: Array, noise: Array, variance: Callable[[], Array]
) -> bool:
    """Tell whether held-out errors test a fit.

    They do if they are as small as noise, or if they exceed the variance of the prediction. Large
    errors that this variance explains only mean that the fitted rows do not identify the torque.

    Args:
        squared: (blocks, joints) squared errors [N^2 m^2].
        noise: (blocks, joints) squared errors to expect from torque noise alone [N^2 m^2].
        variance: returns the squared errors (blocks, joints) to expect from noise and the errors of
            the fit [N^2 m^2], infinite where the fit does not identify a joint's friction; called
            only where errors are larger than noise.
    """
    if _error_ratio(squared, noise) <= NOISE_EXPLAINS:
        return True
    expected = variance()
    is_known = np.all(np.isfinite(expected), axis=0)
    expected = expected[:, is_known]
    if not np.any(expected):
        return False
    return _error_ratio(squared[:, is_known], expected) > NOISE_EXPLAINS


def validate_datasets(
    fit: Fit, errors: FitErrors, datasets: Sequence[Dataset], source: str
) -> Validation:
    """Return the error with which a fit predicts the torques of other recordings.

    Args:
        fit: the fit that predicts.
        errors: errors of the fit's parameters.
        datasets: the other recordings.
        source: name of these recordings for the user.

    Raises:
        InputError: the recordings hold no usable samples.
    """
    fitted = fit.columns
    columns = Columns(fitted.robot, datasets, fitted.torques, fitted.couplings)
    samples = columns.samples(replace(fit.point, values=fit.values))
    data = evidence_of([samples], fit.evidence.torque)
    counts = sample_counts(data.total)
    squares = np.sum(data.squared_torque, axis=0)
    if not np.any(counts):
        raise InputError(f"no usable torque samples to validate on in {source}")
    residual = data.total.squared_residuals(fit.values)
    joints = fit.columns.joints
    validation = validation_of(joints, residual, squares, counts, source)
    noise = counts[None] * fit.noise**2
    is_informative = is_informative_test(
        residual[None],
        noise,
        lambda: noise + _prediction_variance(fit, errors, data.total),
    )
    return replace(validation, is_informative=is_informative)


def _prediction_variance(
    fit: Fit, errors: FitErrors, data: SquareRootInformation
) -> Array:
    """Return the variance (joints,) of predicted torques due to a fit's errors [N^2 m^2].

    It is summed over the rows of ``data``, and infinite where the fit does not identify a parameter
    of a joint's torque, or had no rows of the joint.

    Args:
        fit: the fit that predicts.
        errors: errors of the fit's parameters.
        data: triangles of the predicted rows, linearised around the fit.
    """
    estimated = fit.unknowns.estimated
    variances = np.full(len(data.joints), np.inf)
    for row, (joint, fitted) in enumerate(zip(data.joints, fit.evidence.total.joints)):
        # Rows (m, k) of the joint in the estimated parameters.
        is_estimated = np.isin(joint.columns, estimated)
        columns = np.searchsorted(estimated, joint.columns[is_estimated])
        rows = np.zeros((len(joint.triangle), len(estimated)))
        rows[:, columns] = joint.triangle[:, :-1][:, is_estimated]
        if fitted.n_samples > 0 and np.all(errors.are_identified(rows)):
            covariance, *_ = errors.of(rows)
            variances[row] = np.trace(covariance)
    return variances
