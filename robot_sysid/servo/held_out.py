"""Which samples of a log of servos are fitted, and which judge what was found.

Held out are blocks within a log, not its end: an end may be of another kind, as that of a motion
that grows faster and faster, or of one in which one joint moves after the other. Commands are those
of the whole log on both sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot_sysid.records import Recording

SHARE = 0.2
"""Share of each piece of a log that is held out."""
BLOCKS = 2
"""Number of blocks: of one joint after the other, each keeps half of its motion at least."""
LEAST_BLOCK = 1.0
"""Length below which there is one block [s]: a model is to play what follows a start."""


def hold_out(piece: Recording) -> tuple[Recording, Recording]:
    """Return a piece of a log with its blocks left out, and with all else left out."""
    n = len(piece)
    count = BLOCKS if SHARE * piece.duration >= BLOCKS * LEAST_BLOCK else 1
    middles = n * (np.arange(count) + 0.5) / count
    half = 0.5 * SHARE * n / count
    number = np.arange(n)
    is_held_out = np.any(np.abs(number - middles[:, None]) < half, axis=0)
    hole = np.zeros(n) if piece.hole is None else piece.hole
    parts = (is_held_out, ~is_held_out)
    fitted, held_out = (
        replace(piece, hole=np.where(part, np.inf, hole)) for part in parts
    )
    return fitted, held_out
