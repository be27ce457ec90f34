"""Messages of joint states in the order in which they were sampled, and whole arms out of them.

A message that comes late takes its place. Where no message holds all joints of an arm, those of one
stamp are put together; where stamps differ, each joint keeps its own.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, groupby

Key = tuple[str, str]
"""Joint and quantity."""
Sample = Mapping[Key, float]
Stamped = tuple[tuple[int, int], Sample]
"""When a message was sampled and when it was recorded [ns], and what it says."""
_WAITING = 100
"""So many messages may overtake a late one: half a second of a log at 200 Hz."""
_LATE_IN_A_ROW = 3
"""More messages in a row from before the newest are a clock that was set back, or another
recording: they stay where they are, and the log is refused for them."""
_STALE = 50_000_000
"""A joint's sample is put into a row up to so long after it was taken [ns]; half of what is
refused as another clock (``logs.checks``)."""


@dataclass(frozen=True)
class Arm:
    """How an arm's joints come in messages.

    Attributes:
        parts: joints that share a message, the rarest last; nothing where all come in one.
        own_time: whether the parts are sampled at times of their own.
        clock: which of a message's two stamps counts.
        start: stamp from which time counts [ns].
    """

    parts: tuple[frozenset[str], ...]
    own_time: bool
    clock: int
    start: int

    @classmethod
    def of(cls, first: Sequence[Stamped], joints: Sequence[str]) -> Arm:
        """Return it of a recording's first messages."""
        # Where no header has a time stamp, the time of recording stands in.
        clock = 0 if any(stamps[0] for stamps, _ in first) else 1
        stamps: dict[frozenset[str], list[int]] = {}
        for each, sample in first:
            part = frozenset(joint for joint in joints if (joint, "position") in sample)
            stamps.setdefault(part, []).append(each[clock])
        stamps.pop(frozenset(), None)
        is_split = len(stamps) > 1 and sorted(j for part in stamps for j in part) == sorted(joints)
        parts = tuple(sorted(stamps, key=lambda p: -len(stamps[p]))) if is_split else ()
        common = set.intersection(*(set(stamps[part]) for part in parts)) if parts else set()
        own_time = is_split and 2 * len(common) < len(stamps[parts[-1]])
        return cls(parts, own_time, clock, min(each[clock] for each, _ in first))

    @property
    def time_keys(self) -> tuple[Key, ...]:
        """The joints' own time stamps that ``samples`` adds."""
        joints = sorted(joint for part in self.parts for joint in part)
        return tuple((joint, "time") for joint in joints if self.own_time)

    @property
    def said(self) -> str:
        """How its joints come, in words; "" for all in one message."""
        how = "each at its own time" if self.own_time else "put together by their stamps"
        return f", joints of {len(self.parts)} kinds of message {how}" if self.parts else ""

    def samples(self, messages: Iterator[Stamped]) -> Iterator[tuple[float, Sample]]:
        """Yield time from the start [s] and sample of an arm's messages, in order."""
        ordered = in_order(messages) if self.clock == 0 else messages
        stamped: Iterator[tuple[int, Sample]]
        stamped = ((stamps[self.clock], sample) for stamps, sample in ordered)
        if self.parts:
            stamped = self._latest(stamped) if self.own_time else _of_one_stamp(stamped)
        for stamp, sample in stamped:
            yield 1e-9 * (stamp - self.start), sample

    def _latest(self, stamped: Iterator[tuple[int, Sample]]) -> Iterator[tuple[int, Sample]]:
        """Yield the newest of all joints at each message of the rarest part."""
        newest: dict[frozenset[str], tuple[int, Sample]] = {}
        for stamp, sample in stamped:
            part = next((p for p in self.parts if all((j, "position") in sample for j in p)), None)
            if part is None:
                continue
            newest[part] = stamp, sample
            fresh = all(stamp - newest.get(each, (0, {}))[0] <= _STALE for each in self.parts)
            if part == self.parts[-1] and fresh:
                row = {key: value for _, each in newest.values() for key, value in each.items()}
                for each, (taken, _) in newest.items():
                    row.update({(joint, "time"): 1e-9 * (taken - self.start) for joint in each})
                yield stamp, row


def in_order(messages: Iterator[Stamped]) -> Iterator[Stamped]:
    """Yield messages by the stamps of their headers, those of an equal one as recorded."""
    waiting: list[tuple[int, int, Stamped]] = []
    newest: dict[frozenset[str], int] = {}
    late: Counter[frozenset[str]] = Counter()
    for number, each in enumerate(messages):
        (stamp, _), sample = each
        publisher = frozenset(joint for joint, _ in sample)
        is_late = stamp < newest.get(publisher, stamp)
        late[publisher] = (late[publisher] + 1) * is_late
        newest[publisher] = max(stamp, newest.get(publisher, stamp))
        if late[publisher] > _LATE_IN_A_ROW:
            messages = chain([each], messages)
            break
        heapq.heappush(waiting, (stamp, number, each))
        if len(waiting) > _WAITING:
            yield heapq.heappop(waiting)[2]
    yield from (old for _, _, old in sorted(waiting))
    yield from messages


def _of_one_stamp(stamped: Iterator[tuple[int, Sample]]) -> Iterator[tuple[int, Sample]]:
    for stamp, group in groupby(stamped, key=lambda each: each[0]):
        yield stamp, {key: value for _, sample in group for key, value in sample.items()}
