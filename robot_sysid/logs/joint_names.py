"""Matching of a recording's joint names with a model's, by the whole set of names.

A name is cut into words and numbers: ``panda_joint1`` is panda, joint, 1. What all of the model's
names share at their beginning and end is left out, so that ``joint1`` to ``joint7`` are told apart
by 1 to 7. The recording's names match where these are found once each between words that are the
same in all of the names: panda, joint in front and nothing behind. Fingers and other joints of the
recording are left over, and the order of the names does not matter.

Two sets of names that fit, such as those of a left and a right arm, and one of the other side than
the model's are refused.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations

from robot_sysid.errors import InputError

NamePieces = tuple[str, ...]
"""Words and numbers of a name, in lower case; numbers without leading zeros."""
Frame = tuple[NamePieces, NamePieces]
"""Pieces in front of and behind the core, the part by which a joint is told apart."""
NamesByCore = dict[NamePieces, list[str]]
"""Core to the names that have it in one frame."""
# Words of names by which two arms of a robot are told apart.
_OPPOSITE_SIDES = (("left", "right"), ("right", "left"), ("l", "r"), ("r", "l"))


@dataclass(frozen=True)
class JointMatch:
    """A recording's joints and the joints of the model's arm that they are.

    Attributes:
        model_names: the recording's name of each joint of the arm to the model's name, from base
            to terminal.
        unused: names of the recording's other joints.
    """

    model_names: Mapping[str, str]
    unused: tuple[str, ...]

    def describe(self) -> str:
        """Return one sentence that says which joints were matched; "" where all names are equal."""
        names = list(self.model_names)
        joints = list(self.model_names.values())
        if names == joints:
            return ""
        verb = "are" if len(names) > 1 else "is"
        text = f"log joints: {join_names(names)} {verb} {join_names(joints)}"
        if self.unused:
            text += f"; not used: {', '.join(self.unused)}"
        return text


def join_names(names: Sequence[str]) -> str:
    """Return names with commas, or only the first and the last of more than four."""
    if len(names) > 4:
        names = names[0], "...", names[-1]
    return ", ".join(names)


NO_MATCH = JointMatch({}, ())
"""The match where no set of a recording's names fits the model's."""


def match_joint_names(names: Sequence[str], joint_names: Sequence[str]) -> JointMatch:
    """Return which of a recording's joints are those of a model's arm, ``NO_MATCH`` for none.

    Args:
        names: of the recording's joints, also repeated.
        joint_names: (n,) of the arm, base to terminal.

    Raises:
        InputError: several sets of names fit, two names fit one joint, or the set is that of the
            other arm of two.
    """
    names = list(dict.fromkeys(names))
    arm_frame, cores = _frame_and_cores(joint_names)
    frames = _frames_in(names, cores).items()
    complete = {f: by_core for f, by_core in frames if len(by_core) == len(cores)}
    if not complete:
        return NO_MATCH
    frame = _choose_frame(complete, arm_frame, joint_names)
    arm_joints = list(joint_names)
    # Equal names come before those that differ in signs only, such as arm-1 and arm_1.
    if not {*joint_names} <= {*names}:
        by_core = complete[frame]
        for core, joint_name in zip(cores, joint_names):
            if len(by_core[core]) > 1:
                listed = " and ".join(by_core[core])
                raise InputError(
                    f"the log's {listed} could both be the joint {joint_name}"
                )
        arm_joints = [by_core[core][0] for core in cores]
    if are_opposite_sides({*chain(*frame)}, {*chain(*arm_frame)}):
        raise InputError(
            f"the log's joints {join_names(arm_joints)} are those of another arm than the model's "
            f"{join_names(joint_names)}: give the model of the arm that was recorded"
        )
    unused = tuple(name for name in names if name not in arm_joints)
    return JointMatch(dict(zip(arm_joints, joint_names)), unused)


def name_numbers(joint_names: Sequence[str]) -> list[int]:
    """Return the numbers that tell joints apart, such as 1 to 7; [] where words do."""
    _, cores = _frame_and_cores(joint_names)
    if not all(len(core) == 1 and core[0].isdecimal() for core in cores):
        return []
    return [int(core[0]) for core in cores]


def _frame_and_cores(names: Sequence[str]) -> tuple[Frame, Sequence[NamePieces]]:
    """Return what all names of an arm begin and end with, and the pieces of each between these."""
    cores = list(map(split_name, names))
    front = tuple(os.path.commonprefix(cores))
    reversed_ends = [pieces[len(front) :][::-1] for pieces in cores]
    back = tuple(os.path.commonprefix(reversed_ends))[::-1]
    short_cores = [tuple(end[len(back) :])[::-1] for end in reversed_ends]
    if len(names) == 1 or not all(short_cores):
        # Of one name, or where one is all that the others share, whole names count.
        return ((), ()), cores
    return (front, back), short_cores


def _frames_in(
    names: Sequence[str], cores: Sequence[NamePieces]
) -> dict[Frame, NamesByCore]:
    """Return the frame of each core in names."""
    frames: dict[Frame, NamesByCore] = defaultdict(lambda: defaultdict(list))
    for name in names:
        pieces = split_name(name)
        for start, end in combinations(range(len(pieces) + 1), 2):
            core = pieces[start:end]
            if core in cores:
                frames[pieces[:start], pieces[end:]][core].append(name)
    return frames


def split_camel_case(text: str) -> str:
    """Return a text with a blank in front of each capital behind a small letter."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)


def split_name(name: str) -> NamePieces:
    """Return the words and numbers of a name; camelCase is two words."""
    pieces = re.findall(r"[^\W\d_]+|\d+", split_camel_case(name).lower())
    return tuple(str(int(piece)) if piece.isdecimal() else piece for piece in pieces)


def _choose_frame(
    complete: Mapping[Frame, NamesByCore], arm_frame: Frame, joint_names: Sequence[str]
) -> Frame:
    """Return the model's own frame, or the one with most words of the model's frame.

    InputError where several frames fit alike.
    """
    if arm_frame in complete:
        return arm_frame
    arm_pieces = {*chain(*arm_frame)}
    shared = {frame: len(arm_pieces & {*chain(*frame)}) for frame in complete}
    fitting = [frame for frame in complete if shared[frame] == max(shared.values())]
    if len(fitting) == 1:
        return fitting[0]
    _, cores = _frame_and_cores(joint_names)
    sets = [[names[c][0] for c in cores] for names in complete.values()]
    raise InputError(
        f"the log holds {len(sets)} sets of joints that could be the model's "
        f"{join_names(joint_names)}: {' and '.join(map(join_names, sets))}"
    )


def are_opposite_sides(pieces: set[str], other_pieces: set[str]) -> bool:
    """Return whether the pieces of two names say that they are those of two arms of a robot."""
    own = pieces - other_pieces
    others = other_pieces - pieces
    return any(side in own and other in others for side, other in _OPPOSITE_SIDES)
