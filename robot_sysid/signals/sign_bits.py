"""Signed numbers of a driver that were logged as unsigned ones.

Registers of servos and drives hold sign and magnitude, with the sign in a bit of any place (bit 10
of a Feetech's load, bit 15 of its speed), or two's complement. A log that has the bare register has
0 to 346 for one direction, and 1024 to 1370 for the other. Numbers tell: where the sign changes,
the register jumps by the weight of its bit, and the number that it stands for does not.
"""

from __future__ import annotations

import numpy as np

from robot_sysid.records import Array

LEAST_BIT = 5
"""Lowest bit that is looked at for a sign: fewer values are no measurement."""
MOST_BIT = 31
WIDTHS = (8, 16, 32)
"""Bits of numbers in two's complement, as all processors have them."""
LEAST_CHANGES = 4
"""Changes of sign that show how it is written."""
LARGEST_CHANGE = 8.0
"""Step of a number at a change of its sign, over the usual large one of all its steps, from which
on it is no change of sign."""
USUAL_STEPS = 95.0
"""Percentile of steps that is a usual large one: fast motion makes the others."""
WHOLE = 1e-6
"""Deviation from a whole number that rounding makes in a factor of a unit."""


def decode_signs(values: Array) -> tuple[Array, str] | None:
    """Return signed numbers (N, n) for registers, and how they were written; else None.

    ``values``: (N, n) one column per joint, NaN where a cell is empty. All columns of a quantity
    are written alike, as one driver writes them.
    """
    known = values[np.isfinite(values).all(axis=1)]
    whole = np.round(known)
    if len(known) < LEAST_CHANGES or np.any(np.abs(known - whole) > WHOLE):
        return None
    if np.min(whole) < 0.0 or not 2.0**LEAST_BIT <= np.max(whole) < 2.0 ** (
        MOST_BIT + 1
    ):
        return None
    bit = int(np.log2(np.max(whole)))
    weight = 2.0**bit
    ways = {f"sign and magnitude, with the sign in bit {bit}": (weight, -1.0)}
    if bit + 1 in WIDTHS:
        ways[f"two's complement of {bit + 1} bits"] = (2.0 * weight, 1.0)
    is_negative = whole >= weight
    is_change = np.diff(is_negative, axis=0)
    if np.count_nonzero(is_change) < LEAST_CHANGES:
        return None
    for way, (offset, sign) in ways.items():
        steps = np.abs(
            np.diff(np.where(is_negative, sign * (whole - offset), whole), axis=0)
        )
        # A joint that is read in steps may repeat its value most of the time.
        moving = steps[~is_change & (steps > 0.0)]
        if not len(moving):
            continue
        usual = np.percentile(moving, USUAL_STEPS)
        least = min(LARGEST_CHANGE * usual, 0.5 * weight)
        if np.percentile(steps[is_change], USUAL_STEPS) <= least:
            rounded = np.round(values)
            signed = sign * (rounded - offset) + 0.0
            return np.where(rounded >= weight, signed, values), way
    return None
