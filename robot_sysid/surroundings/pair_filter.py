"""Keeps MuJoCo from testing pairs of geoms whose distance cannot matter.

MuJoCo tests two geoms if a bit of one's ``contype`` is set in the other's ``conaffinity``. Geoms
that behave alike form a group with a bit of its own; the affinities then say for every two groups
whether they are tested. Bodies of one part of the arm, or of the scene, keep their distances; a
model with a second arm or a full scene has many of those.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MOST_GROUPS = 31
"""Bits there are for groups."""


def drop_pairs(mj_model: Any, part: Any, ignored: Any) -> None:
    """Change a model's collision filter so that only pairs that matter are tested.

    Explicit contact pairs of the model are tested as before. A model with too many groups is left
    as it is.

    Args:
        mj_model: compiled model, changed in place.
        part: (nbody,) bodies with equal numbers do not move against each other.
        ignored: (nbody, nbody) body pairs whose distance does not matter.
    """
    body = mj_model.geom_bodyid
    keys = np.stack((part[body], mj_model.geom_contype, mj_model.geom_conaffinity), axis=1)
    groups, member = np.unique(keys, axis=0, return_inverse=True)
    member = np.ravel(member)
    if len(groups) > MOST_GROUPS:
        return
    tested = _compatible(groups) & (groups[:, :1] != groups[:, 0])
    tested &= _any_pair_matters(len(groups), member, ~ignored[np.ix_(body, body)])
    bit = 1 << np.arange(len(groups))
    _write(mj_model, "contype", bit[member])
    _write(mj_model, "conaffinity", (tested @ bit)[member])


def _write(mj_model: Any, name: str, value: Any) -> None:
    """Give geoms new filter bits, and bodies all bits of their geoms: they are tested first."""
    getattr(mj_model, f"geom_{name}")[:] = value
    of_bodies = getattr(mj_model, f"body_{name}", None)
    if of_bodies is not None:
        of_bodies[:] = 0
        np.bitwise_or.at(of_bodies, mj_model.geom_bodyid, value.astype(of_bodies.dtype))


def _compatible(groups: Any) -> Any:
    """Return (G, G) booleans: which groups the model itself tests against each other."""
    contype, conaffinity = groups[:, 1], groups[:, 2]
    one_way = (contype[:, None] & conaffinity) != 0
    return one_way | one_way.T


def _any_pair_matters(count: int, member: Any, matters: Any) -> Any:
    """Return (G, G) booleans: whether any two geoms of two groups matter."""
    belongs = (np.arange(count)[:, None] == member).astype(float)
    return belongs @ matters.astype(float) @ belongs.T > 0.0
