"""Makers of arms whose controllers take a payload, recognised by the names in an arm's model."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robot_sysid.records import RobotModel

AUTO = "auto"
"""Choice of the cards of the arm's own controller."""
ALL = "all"
"""Choice of every card."""


MAKERS: Mapping[str, str] = {
    "franka": r"franka\w*?|emika|panda\d*|fr3\w*?|fp3",
    "ur": r"ur|ur\d+[a-z]*|universal_?robots?|"
    r"shoulder_pan_\w*elbow_\w*wrist_1_\w*wrist_2_\w*wrist_3",
    "kuka": r"kuka|iiwa\w*?|lbr|lwr\d*|kr_?\d+\w*?",
    "kinova": r"kinova|kortex|gen3",
    "xarm": r"ufactory|xarm\d*|uf850|lite6",
    "abb": r"abb|irb_?\d+|yumi|gofa",
    "mecademic": r"mecademic|meca500",
}
"""Key of a maker in ``CHOICES`` to a regular expression of the names of its arms, in lower case
with "_" between words."""
CHOICES = (AUTO, ALL, *MAKERS, "urdf", "mujoco")
"""Choices of the cards that are written."""


def makers_of(robot: RobotModel) -> tuple[str, ...]:
    """Return the keys of the makers whose controller may drive an arm, as its names say.

    The names of its joints count first, then those of its bodies, of the model, of the file and of
    the file's folder: the first of these that fit any maker decide. Empty where none does, several
    where a name fits several makers.
    """
    for name in _names(robot):
        joined = "_".join(re.findall(r"[a-z0-9]+", name.lower()))
        keys = [key for key, pattern in MAKERS.items() if _has_word(joined, pattern)]
        if keys:
            return tuple(keys)
    return ()


def _has_word(text: str, pattern: str) -> bool:
    """Return whether words joined by "_" have one, or several in a row, that fit a pattern."""
    return re.search(rf"(?:^|_)(?:{pattern})(?:_|$)", text) is not None


def _names(robot: RobotModel) -> Iterator[str]:
    """Yield the names that may tell an arm's maker, the most reliable first."""
    yield " ".join(robot.joint_names)
    yield " ".join(link.body_name for link in robot.links)
    if robot.mj_model is not None:
        # The model's own name is the first of all names.
        yield robot.mj_model.names.split(b"\0")[0].decode(errors="replace")
    yield robot.path.stem
    yield robot.path.absolute().parent.name
