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
from collections.abc import Mapping, Sequence
from itertools import chain, combinations

from robot_sysid.errors import InputError

NamePieces = tuple[str, ...]
"""Words and numbers of a name, in lower case; numbers without leading zeros."""
NameContext = tuple[NamePieces, NamePieces]
"""Pieces in front of and behind the core, the part by which a joint is told apart."""
# Words of names by which two arms of a robot are told apart.
_OPPOSITE_SIDES = (("left", "right"), ("right", "left"), ("l", "r"), ("r", "l"))


def join_names(names: Sequence[str]) -> str:
    """Return names with commas, or only the first and the last of more than four."""
    if len(names) > 4:
        names = names[0], "...", names[-1]
    return ", ".join(names)


def match_joint_names(
    names: Sequence[str], joint_names: Sequence[str]
) -> Mapping[str, str]:
    """Return a recording's name of each joint of a model's arm to the model's name, base first.

    It is empty where no set of the recording's names fits the model's.

    Args:
        names: of the recording's joints, also repeated.
        joint_names: (n,) of the arm, base to terminal.

    Raises:
        InputError: several sets of names fit, two names fit one joint, or the set is that of the
            other arm of two.
    """
    if {*joint_names} <= {*names}:
        # Equal names come before those that differ in signs only, such as arm-1 and arm_1.
        return {name: name for name in joint_names}
    arm_context, cores = _context_and_cores(joint_names)
    contexts: dict[NameContext, dict[NamePieces, list[str]]] = {}
    for name in dict.fromkeys(names):
        pieces = split_name(name)
        for start, end in combinations(range(len(pieces) + 1), 2):
            core = pieces[start:end]
            if core in cores:
                by_core = contexts.setdefault((pieces[:start], pieces[end:]), {})
                by_core.setdefault(core, []).append(name)
    complete = {c: found for c, found in contexts.items() if len(found) == len(cores)}
    if not complete:
        return {}
    context = arm_context
    if context not in complete:
        # The one with most words of the model's.
        own = {*chain(*arm_context)}
        shared = {each: len(own & {*chain(*each)}) for each in complete}
        context, *rivals = [c for c in shared if shared[c] == max(shared.values())]
        if rivals:
            sets = [[found[c][0] for c in cores] for found in complete.values()]
            raise InputError(
                f"the log holds {len(sets)} sets of joints that could be the model's "
                f"{join_names(joint_names)}: {' and '.join(map(join_names, sets))}"
            )
    fitting = [complete[context][core] for core in cores]
    for joint_name, candidates in zip(joint_names, fitting):
        if len(candidates) > 1:
            raise InputError(
                f"the log's {' and '.join(candidates)} could both be the joint {joint_name}"
            )
    arm_joints = [candidates[0] for candidates in fitting]
    if are_opposite_sides({*chain(*context)}, {*chain(*arm_context)}):
        raise InputError(
            f"the log's joints {join_names(arm_joints)} are those of another arm than the model's "
            f"{join_names(joint_names)}: give the model of the arm that was recorded"
        )
    return dict(zip(arm_joints, joint_names))


def joint_note(matched: Mapping[str, str], names: Sequence[str]) -> str:
    """Return one sentence that says which joints were matched; "" where all names are equal.

    Args:
        matched: of ``match_joint_names``.
        names: of all joints of the recording, also repeated.
    """
    if all(name == joint for name, joint in matched.items()):
        return ""
    verb = "are" if len(matched) > 1 else "is"
    joints = join_names([*matched.values()])
    text = f"log joints: {join_names([*matched])} {verb} {joints}"
    unused = [name for name in dict.fromkeys(names) if name not in matched]
    return f"{text}; not used: {', '.join(unused)}" if unused else text


def name_numbers(joint_names: Sequence[str]) -> list[int]:
    """Return the numbers that tell joints apart, such as 1 to 7; [] where words do."""
    _, cores = _context_and_cores(joint_names)
    try:
        return [int(number) for (number,) in cores]
    except ValueError:
        return []


def _context_and_cores(
    names: Sequence[str],
) -> tuple[NameContext, Sequence[NamePieces]]:
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


def split_camel_case(text: str) -> str:
    """Return a text with a blank in front of each capital behind a small letter."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)


def split_name(name: str) -> NamePieces:
    """Return the words and numbers of a name; camelCase is two words."""
    pieces = re.findall(r"[^\W\d_]+|\d+", split_camel_case(name).lower())
    return tuple(str(int(piece)) if piece.isdecimal() else piece for piece in pieces)


def are_opposite_sides(pieces: set[str], other_pieces: set[str]) -> bool:
    """Return whether the pieces of two names say that they are those of two arms of a robot."""
    own = pieces - other_pieces
    others = other_pieces - pieces
    return any(side in own and other in others for side, other in _OPPOSITE_SIDES)
