"""Errors of predicted torques on rows that were not fitted: held-out blocks, logs, other logs.

In-sample errors fall with every parameter. So each block of time is predicted from the others.

Shapes: B blocks, J joints with equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from robot_sysid.estimate.fit import Fit
from robot_sysid.records import Array, Validation
from robot_sysid.records.levels import INTERVAL, SURE
from robot_sysid.signals.process import FilteredRecording

LOWER = 0.9
"""Share of reference squared errors below which others are clearly lower, a tenth less: a smaller
gain is worth no other model, however clear it is."""


def validation(fitted: Fit) -> Validation:
    """Return the held-out error of the recordings that were fitted."""
    return _of_blocks(fitted, fitted.held_out)


def validation_as_used(fitted: Fit) -> Validation:
    """Return the held-out error of a file as it is used: without the offsets, which none holds."""
    return _of_blocks(fitted, fitted.held_out_as_used)


def _of_blocks(fitted: Fit, squares: Array) -> Validation:
    """Return squared errors (B, J) of blocks that were predicted from the others as a record."""
    expected = np.sum(fitted.expected_held_out, axis=0)
    source = "the logs, each tenth predicted from the others"
    return _record(fitted, squares, expected, fitted.sums.blocks, source)


def held_out_logs(fitted: Fit) -> Iterator[Validation]:
    """Yield the error of each log predicted from the others; none where there is a single log.

    A log whose error does not test the fit is left out, as one with joints that the other logs do
    not identify.
    """
    names = list(dict.fromkeys(fitted.sums.logs))
    if len(names) < 2:
        return
    for name in names:
        blocks = [k for k, log in enumerate(fitted.sums.logs) if log == name]
        test = error_in(
            fitted,
            *fitted.without(blocks),
            blocks,
            f"{name}, predicted from the other logs",
        )
        if test.is_informative:
            yield test


def prediction_error(
    fitted: Fit, recordings: Sequence[FilteredRecording], source: str
) -> Validation:
    """Return the error with which a fit predicts the torques of other recordings.

    Raises:
        InputError: the recordings hold no usable samples.
    """
    other = fitted.of(fitted.arm.sums(recordings, fitted.next_point()))
    blocks = other.sums.blocks
    return error_in(other, other.values, fitted.covariance, blocks, source)


def error_in(
    fitted: Fit, values: Array, covariance: Array, blocks: Sequence[int], source: str
) -> Validation:
    """Return the error of an estimate (k,) with its covariance (k, k) in blocks of a fit's sums."""
    residuals = fitted.equations.squared_residuals
    squares = np.array([residuals(values, [block]) for block in blocks])
    expected = fitted.expected_squares(covariance, blocks)
    return _record(fitted, squares, expected, blocks, source)


def _record(
    fitted: Fit, squares: Array, expected: Array, blocks: Sequence[int], source: str
) -> Validation:
    """Return squared errors in some blocks as a record, which says whether they test a fit.

    They do if they are within ``SURE`` times the noise, or exceed the variance of the prediction.
    Large errors that this variance explains only mean that the fitted rows do not identify the
    torque.

    Args:
        squares: (B, J) squared errors [N^2 m^2].
        expected: (J,) squared errors to expect if the model is right [N^2 m^2].
        blocks: (B,) that were predicted.
        source: of the blocks, in words.
    """
    sums = fitted.sums
    torques = np.sum(sums.squared_torque[list(blocks)], axis=0)
    counts = np.sum(sums.counts[list(blocks)], axis=0)
    errors = np.sum(squares, axis=0)
    noise = counts * fitted.noise**2
    used = noise > 0.0
    is_informative = False
    if np.any(used):
        of_noise, of_all = (
            np.sqrt(np.mean(errors[used] / size[used])) for size in (noise, expected)
        )
        is_informative = bool(of_noise <= SURE or of_all > SURE)
    return Validation(
        joint_names=sums.joints,
        blocks=squares,
        counts=counts,
        source=source,
        squared_torque=torques,
        is_informative=is_informative,
    )


def is_clearly_lower(errors: Array, reference: Array) -> bool:
    """Tell whether squared errors are clearly lower than those of a reference, over all blocks.

    The sum over blocks, and the geometric mean of the ratios of the blocks' errors, have to be
    lower by more than a tenth (``LOWER``); the mean logarithm of these ratios has to be negative by
    more than ``INTERVAL`` standard errors. Fewer than two blocks show nothing.

    Args:
        errors: (B,) squared held-out errors, in any unit.
        reference: (B,) in the unit of ``errors``.
    """
    if len(errors) < 2:
        return False
    ratio = np.log(errors + 1e-300) - np.log(reference + 1e-300)
    mean = np.mean(ratio)
    standard_error = np.std(ratio, ddof=1) / np.sqrt(len(ratio))
    return bool(
        np.sum(errors) < LOWER * np.sum(reference)
        and mean < np.log(LOWER)
        and mean + INTERVAL * standard_error < 0.0
    )
