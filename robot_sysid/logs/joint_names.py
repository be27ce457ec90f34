"""Matching of a recording's joint names with a model's, by the whole set of names.

A name is cut into words and numbers: ``panda_joint1`` is panda, joint, 1. What all of the model's
names share at their beginning and end is left out, so that ``joint1`` to ``joint7`` are told apart
by 1 to 7. The recording's names match where these are found once each between words that are the
same in all of the names: panda, joint in front and nothing behind. Fingers and other joints of the
recording are left over, and the order of the names does not matter.

Two sets of names that fit, such as those of a left and a right arm, and a set that has further
numbers, as an arm with more joints has, are refused.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from robot_sysid.errors import InputError

Words = tuple[str, ...]
"""Words and numbers of a name, in lower case; numbers without leading zeros."""
Frame = tuple[Words, Words]
"""Words in front of and behind the part by which a joint is told apart."""


class JointSetsError(InputError):
    """Several sets of a log's joints could be the model's arm.

    Attributes:
        sets: for each of them the log's names of the arm's joints, base to terminal.
    """

    def __init__(self, message: str, sets: Sequence[Sequence[str]]) -> None:
        super().__init__(message)
        self.sets = tuple(map(tuple, sets))


@dataclass(frozen=True)
class JointMatch:
    """A recording's joints and the joints of the model's arm that they are.

    Attributes:
        model_names: the recording's name of each joint of the arm to the model's name, from base
            to terminal.
        unused: names of the recording's other joints.
        is_counted: whether the names count from another number than the model's.
    """

    model_names: Mapping[str, str]
    unused: tuple[str, ...]
    is_counted: bool = False

    def describe(self) -> str:
        """Return one sentence that says which joints were matched; "" where all names are equal."""
        names = list(self.model_names)
        joints = list(self.model_names.values())
        if names == joints:
            return ""
        counted = ", by counting" if self.is_counted else ""
        verb = "are" if len(names) > 1 else "is"
        text = f"log joints: {join_names(names)} {verb} {join_names(joints)}{counted}"
        if self.unused:
            text += f"; not used: {', '.join(self.unused)}"
        return text


def join_names(names: Sequence[str]) -> str:
    """Return names with commas, or shortly those that count: ``panda_joint1..7``."""
    parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", name) for name in names]
    first = parts[0] if parts else None
    if first is None or len(names) < 3:
        return ", ".join(names)
    start = int(first[2])
    counted = [f"{first[1]}{start + k}{first[3]}" for k in range(len(names))]
    if counted != list(names):
        return ", ".join(names)
    return f"{first[1]}{start}..{start + len(names) - 1}{first[3]}"


def match_joint_names(
    names: Sequence[str],
    joint_names: Sequence[str],
    other_joints: Sequence[str] | None = (),
) -> JointMatch | None:
    """Return which of a recording's joints are those of a model's arm; None where no set fits.

    Args:
        names: of the recording's joints, also repeated.
        joint_names: (n,) of the arm, base to terminal.
        other_joints: the model's joints that are not the arm's; None not to ask whether the
            recording's arm has further joints.

    Raises:
        JointSetsError: several sets of names fit.
        InputError: two names fit one joint, or the set is that of an arm with more or fewer joints,
            or counts from another number.
    """
    names = list(dict.fromkeys(names))
    if not names or not joint_names:
        return None
    arm = _NameSet.of(joint_names)
    frames = arm.frames_in(names)
    complete = {}
    for frame, by_joint in frames.items():
        if len(by_joint) == len(joint_names):
            complete[frame] = by_joint
    if not complete:
        return _match_counted(names, arm, frames)
    frame = _choose_frame(complete, arm)
    chosen = list(joint_names)
    # Equal names come before those that differ in signs only, such as arm-1 and arm_1.
    if not {*joint_names} <= {*names}:
        chosen = _single_names(complete[frame], joint_names)
    if other_joints is not None:
        _refuse_further_joints(names, chosen, frame, arm, other_joints)
    unused = tuple(name for name in names if name not in chosen)
    return JointMatch(dict(zip(chosen, joint_names)), unused)


def find_joint_match(
    names: Sequence[str], joint_names: Sequence[str]
) -> JointMatch | None:
    """Return ``match_joint_names``, and None also where it refuses the names."""
    try:
        return match_joint_names(names, joint_names, other_joints=None)
    except InputError:
        return None


@dataclass(frozen=True)
class _NameSet:
    """The names of a model's arm.

    Attributes:
        names: (n,) as the model has them.
        frame: words that all of them begin and end with.
        cores: (n,) the words between these, by which each joint is told apart.
    """

    names: tuple[str, ...]
    frame: Frame
    cores: tuple[Words, ...]

    @classmethod
    def of(cls, names: Sequence[str]) -> _NameSet:
        """Return the names with the words that they share taken off."""
        words = list(map(_words, names))
        front = tuple(os.path.commonprefix(words))
        reversed_rests = [name_words[len(front) :][::-1] for name_words in words]
        back = tuple(os.path.commonprefix(reversed_rests))[::-1]
        cores = tuple(_core_of(name_words, (front, back)) for name_words in words)
        if len(names) == 1 or not all(cores):
            # Of one name, or where one is all that the others share, whole names count.
            return cls(tuple(names), ((), ()), tuple(words))
        return cls(tuple(names), (front, back), cores)

    @property
    def numbers(self) -> list[int]:
        """The numbers that tell the joints apart; [] where words do."""
        if not all(len(core) == 1 and core[0].isdigit() for core in self.cores):
            return []
        return [int(core[0]) for core in self.cores]

    def frames_in(self, names: Sequence[str]) -> dict[Frame, dict[int, list[str]]]:
        """Return the words around each core in names: frame to joint index to names."""
        frames: dict[Frame, dict[int, list[str]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for name in names:
            for joint, core in enumerate(self.cores):
                for frame in _frames(_words(name), core):
                    frames[frame][joint].append(name)
        return {frame: dict(by_joint) for frame, by_joint in frames.items()}


def _words(name: str) -> Words:
    """Return the words and numbers of a name; camelCase is two words."""
    separate = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    pieces = re.findall(r"[^\W\d_]+|\d+", separate.lower())
    return tuple(str(int(piece)) if piece.isdigit() else piece for piece in pieces)


def _frames(words: Words, core: Words) -> Iterator[Frame]:
    """Yield the words in front of and behind each place of a core in a name's words."""
    for start in range(len(words) - len(core) + 1):
        if words[start : start + len(core)] == core:
            yield words[:start], words[start + len(core) :]


def _choose_frame(
    complete: Mapping[Frame, Mapping[int, Sequence[str]]], arm: _NameSet
) -> Frame:
    """Return the only frame, the model's own one, or the only one with words of the model's names.

    JointSetsError where several frames fit alike.
    """
    if arm.frame in complete:
        return arm.frame
    if len(complete) == 1:
        return next(iter(complete))
    model_words = {word for name in arm.names for word in _words(name)}
    words_of = {frame: {*frame[0], *frame[1]} for frame in complete}
    shared_words = set.intersection(*words_of.values())
    fitting = []
    for frame, words in words_of.items():
        own_words = words - shared_words
        if own_words and own_words <= model_words:
            fitting.append(frame)
    if len(fitting) == 1:
        return fitting[0]
    sets = []
    for by_joint in complete.values():
        sets.append([by_joint[k][0] for k in range(len(arm.names))])
    raise JointSetsError(
        f"the log holds {len(sets)} sets of joints that could be the model's "
        f"{join_names(arm.names)}: {' and '.join(map(join_names, sets))}",
        sets,
    )


def _single_names(
    by_joint: Mapping[int, Sequence[str]], joint_names: Sequence[str]
) -> list[str]:
    """Return the log's name of each joint; InputError where two names could be one joint."""
    chosen: list[str] = []
    for joint, joint_name in enumerate(joint_names):
        candidates = by_joint[joint]
        if len(candidates) > 1:
            listed = " and ".join(candidates)
            raise InputError(f"the log's {listed} could both be the joint {joint_name}")
        chosen += candidates
    return chosen


def _refuse_further_joints(
    names: Sequence[str],
    chosen: Sequence[str],
    frame: Frame,
    arm: _NameSet,
    other_joints: Sequence[str],
) -> None:
    """Raise InputError where names beside the chosen ones go on counting: another arm's.

    Args:
        names: all of the recording's.
        chosen: (n,) those of the arm.
        frame: words around the numbers of the chosen names.
        arm: the model's names.
        other_joints: the model's joints that are not the arm's; the log may have them.
    """
    if not arm.numbers:
        return
    model_numbers = {*arm.numbers, *_numbered_names(other_joints, arm.frame)}
    numbered = _numbered_names(names, frame)
    further = [numbered[number] for number in numbered if number not in model_numbers]
    if further:
        raise _count_error([*chosen, *further], arm)


def _match_counted(
    names: Sequence[str], arm: _NameSet, frames: Iterable[Frame]
) -> JointMatch | None:
    """Return the match of names that count from 1 with a model that counts from 0, or the reverse.

    ``frames``: words around at least one of the model's numbers. None where nothing counts so.

    Raises:
        InputError: the names have a word of the model's names, so that their numbers contradict
            the model's; or there are fewer names than joints.
    """
    n_joints = len(arm.names)
    if arm.numbers not in (list(range(n_joints)), list(range(1, n_joints + 1))):
        return None
    for frame in frames:
        numbered = _numbered_names(names, frame)
        first = min(numbered)
        chosen = [numbered[number] for number in sorted(numbered)]
        is_counted = sorted(numbered) == list(range(first, first + len(numbered)))
        if not is_counted or first > 1 or 2 * len(chosen) <= n_joints:
            continue
        if len(chosen) != n_joints:
            raise _count_error(chosen, arm)
        if {*frame[0], *frame[1]} & {*arm.frame[0], *arm.frame[1]}:
            raise InputError(
                f"the log's joints {join_names(chosen)} count from {first}, the model's "
                f"{join_names(arm.names)} from {arm.numbers[0]}"
            )
        unused = tuple(name for name in names if name not in chosen)
        return JointMatch(dict(zip(chosen, arm.names)), unused, is_counted=True)
    return None


def _numbered_names(names: Sequence[str], frame: Frame) -> dict[int, str]:
    """Return the names that consist of a number between the words of a frame, by their number."""
    numbered = {}
    for name in names:
        core = _core_of(_words(name), frame)
        if len(core) == 1 and core[0].isdigit():
            numbered[int(core[0])] = name
    return numbered


def _core_of(words: Words, frame: Frame) -> Words:
    """Return the words between those of a frame; () where these are not around them."""
    front, back = frame
    end = len(words) - len(back)
    if words[: len(front)] != front or words[end:] != back:
        return ()
    return words[len(front) : end]


def _count_error(names: Sequence[str], arm: _NameSet) -> InputError:
    """Return the error for a set of names that belongs to an arm with more or fewer joints."""
    return InputError(
        f"the log's joints {join_names(names)} are {len(names)}, the model's "
        f"{join_names(arm.names)} are {len(arm.names)}: give the model of the arm that was recorded"
    )
