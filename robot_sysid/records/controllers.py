"""Who takes a card: makers of arms, recognised by the names in a model, and simulators."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from robot_sysid.wording import option_name, with_option_names

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
TORQUES: Mapping[str, str] = {
    "franka": "tau_J, and not tau_J_d or tau_ext_hat_filtered",
    "ur": "actual_current with {torque_constants}, and not actual_current_as_torque",
    "kuka": "measured_torque, and not external_torque",
}
"""Key of a maker to what its controllers call the torque that has gravity in it, and what they call
those that have none. Of Universal Robots the maintainer of the maker's driver says so."""
CHOICES = (AUTO, ALL, *MAKERS, "urdf", "mujoco")
"""Choices of the cards of a payload."""
SIMULATORS: Mapping[str, str] = {
    "isaaclab": "Isaac Lab",
    "mjlab": "mjlab",
    "newton": "Newton",
    "genesis": "Genesis",
    "drake": "Drake",
    "pinocchio": "Pinocchio",
    "bam": "BAM",
}
"""Key of a library that simulates or computes arms to its name: each has a card of an arm, the
template of that key in ``results/card_templates``."""
DRIVERS: Mapping[str, tuple[str, str]] = {
    "i2rt": ("i2rt (YAM)", "i2rt_card.yml"),
    "openarm": ("openarm_teleop", "openarm_card.yaml"),
    "axol": ("the Axol SDK", "axol_card.py"),
}
"""Key of an arm's own software to its name and the name of the file with what it reads of an
identified arm: each has a template of that key in ``results/card_templates``."""


def makers_of(robot: RobotModel) -> tuple[str, ...]:
    """Return the keys of the makers whose controller may drive an arm, as its names say.

    The names of its joints decide where they fit any maker, else those of its bodies, of the model,
    of the file and of the file's folder. Empty where none fits, several where several do.
    """
    names = [link.body_name for link in robot.links]
    names += [robot.path.stem, robot.path.absolute().parent.name]
    if robot.mj_model is not None:
        # The model's own name is the first of all names.
        names.append(robot.mj_model.names.split(b"\0")[0].decode(errors="replace"))
    for parts in (robot.joint_names, names):
        text = "_".join(re.findall(r"[a-z0-9]+", " ".join(parts).lower()))
        # A pattern fits one word, or several in a row.
        keys = tuple(
            k for k in MAKERS if re.search(rf"(?:^|_)(?:{MAKERS[k]})(?:_|$)", text)
        )
        if keys:
            return keys
    return ()


def torque_to_record(robot: RobotModel) -> str:
    """Return which torque of an arm to record, as its controller calls what has gravity in it."""
    keys = [key for key in makers_of(robot) if key in TORQUES]
    if not keys:
        constants = option_name("torque_constants")
        return (
            f"record the measured joint torque, or motor current with {constants}, from which no "
            "gravity was taken off"
        )
    columns = "; or ".join(with_option_names(TORQUES[key]) for key in keys)
    return f"record the joint torque from which no gravity was taken off: {columns}"
