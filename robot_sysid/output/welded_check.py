"""Is a written model the one without its new body, with that body and nothing else added?"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from robot_sysid.errors import ExportError
from robot_sysid.mjcf.changes import WeldedBody
from robot_sysid.model.chain import body_label
from robot_sysid.output.verification import DERIVED, PATHS, compiled_fields, require_theta

PLACE = 1e-12
"""Largest deviation of the new body's place [m] and axes."""
# Names and their places, and tables that list each body or number the pairs of them.
_BOOKKEEPING = {
    *("nbody", "nB", "nnames", "nnames_map", "names", "names_map", "signature"),
    *("tree_bodynum", "exclude_signature", "pair_signature"),
}
_OF_NAMES = ("name_", "B_")


def require_one_more_body(without: Any, written: Any, body: WeldedBody) -> None:
    """Raise ExportError unless a model has one welded body more, and is the same beside it.

    Args:
        without: the model without the new body.
        written: the model with it.
        body: what was to be added.
    """
    new = mujoco.mj_name2id(written, int(mujoco.mjtObj.mjOBJ_BODY), body.name)
    if new < 0 or written.nbody != without.nbody + 1:
        raise ExportError(f"the written model has no body '{body.name}' of its own")
    theirs = dict(compiled_fields(written))
    for name, value in compiled_fields(without):
        skipped = name in DERIVED | PATHS | _BOOKKEEPING or name.startswith(_OF_NAMES)
        if not skipped and not _is_same(value, theirs.get(name), new, without.nbody):
            raise ExportError(
                f"the new body '{body.name}' changes {name} of the model; no model was written"
            )
    _require_place(written, new, body)
    require_theta(written, new, body.theta, body.theta)


def _is_same(ours: Any, theirs: Any, new: int, bodies: int) -> bool:
    """Tell whether a field is the same beside the row of body ``new`` and the numbers after it."""
    if not isinstance(ours, np.ndarray) or not isinstance(theirs, np.ndarray):
        return bool(ours == theirs)
    if ours.shape != theirs.shape and ours.shape[:1] == (bodies,):
        theirs = np.delete(theirs, new, axis=0)
    if ours.shape != theirs.shape:
        return False
    if ours.dtype.kind == "f":
        return bool(np.array_equal(ours, theirs, equal_nan=True))
    return bool(np.all((theirs == ours) | ((theirs == ours + 1) & (ours >= new))))


def _require_place(written: Any, new: int, body: WeldedBody) -> None:
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, written.body_quat[new])
    off = np.max(np.abs(axes.reshape(3, 3) - body.rotation))
    off = max(off, np.max(np.abs(written.body_pos[new] - body.translation)))
    parent = body_label(written, int(written.body_parentid[new]))
    if parent != body.carrier or written.body_jntnum[new] or not off <= PLACE:
        raise ExportError(
            f"in the written model, body '{body.name}' is not fixed to '{body.carrier}' where it "
            "should be; no model was written"
        )
