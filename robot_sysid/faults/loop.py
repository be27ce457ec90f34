"""The one loop: what is wrong with a log joins its state, the likeliest first, until nothing gains.

A state is a log as it is read, with the faults of the torque that have joined its fit. ``step``
offers the faults of the table to it (``judge``), and the likeliest one joins. Where nothing more
gains, other readings of the log are tried (``reading_search``, ``scales``): each begins a state of
its own. Of all states, one that explains the log comes first, then one that gains most, for each
thing that is named has to gain ``CLEAR`` nats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

from robot_sysid.estimate.choose import odd_link
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect
from robot_sysid.faults import Finding
from robot_sysid.faults.judge import Score, asked_names, candidates, fit_with
from robot_sysid.faults.plausibility import (
    drives,
    fits,
    is_foreign,
    is_plausible,
    is_sibling,
)
from robot_sysid.faults.reading_search import (
    CLEARLY_LESS,
    Correction,
    Evidence,
    ReadingSearch,
    column_correction,
    exchange_correction,
    sign_correction,
    zero_correction,
)
from robot_sysid.faults.scales import ScaleCorrections
from robot_sysid.records.fault_names import FaultName, StandsFor
from robot_sysid.records.levels import CLEAR, UNEXPLAINED
from robot_sysid.records.messages import Level

S = TypeVar("S")
TIE = 6.0
"""Difference in gain within which two explanations count as equally likely [nats]."""
MOST_ROUNDS = 5
"""Largest number of faults that act together."""
MOST_NAMED = 3
"""Faults that are named: of more that act together, the others are small."""
OTHER_ARM = 0.01
"""Share of all torque that the model of another arm leaves at least, whatever its links."""


@dataclass(frozen=True)
class State:
    """What was found in a log so far.

    Attributes:
        reading: the log as it is read; a correction without findings for the log as it came. Its
            fit has the columns of ``fault_columns``.
        current: the fit with all that have joined it.
        rounds: those that have joined, each with those that tie with it.
        least: what a single fault leaves unexplained, as a share of all torque.
    """

    reading: Correction
    current: Fit
    rounds: tuple[tuple[Score, ...], ...]
    least: float

    @classmethod
    def of(cls, reading: Correction) -> State:
        """Return the state before anything has joined."""
        return cls(reading, reading.fit, (), reading.fit.unexplained_share)

    @property
    def joined(self) -> list[Score]:
        """Explanations that have joined the fit."""
        return [ties[0] for ties in self.rounds]

    @property
    def effects(self) -> list[Effect]:
        """Their effects."""
        return [score.explanation.effect for score in self.joined]

    @cached_property
    def gain(self) -> float:
        """Gain of all that was found beyond what naming it takes, in log likelihood [nats]."""
        named = len(self.rounds) + bool(self.reading.findings)
        gains = self.reading.gain + sum(score.gain for score in self.joined)
        return gains - CLEAR * named

    @property
    def explains(self) -> bool:
        """Whether no more is left unexplained than right logs leave, also where it is blamed.

        A fit in which friction drives a joint explains nothing, however little it leaves.
        """
        return self.is_little and self.reading.explains and not drives(self.current)

    @property
    def is_little(self) -> bool:
        """Whether of all torque no more is left unexplained than right logs leave."""
        return self.current.unexplained_share < UNEXPLAINED

    @cached_property
    def rank(self) -> tuple[bool, bool, float]:
        """What is right first: that which explains the log, in newton metres, and gains most."""
        return self.is_little, not is_foreign(self.reading.fit), self.gain

    def with_score(self, ties: tuple[Score, ...]) -> State:
        """Return the state that the first of equally likely explanations has joined."""
        joining = ties[0]
        current = fit_with(joining.fitted, [joining.explanation.effect])
        least = self.least
        if not self.rounds:
            least = min(least, current.unexplained_share)
        return replace(self, current=current, rounds=(*self.rounds, ties), least=least)


def step(state: State, evidence: Evidence) -> State:
    """Return the state that the likeliest fault has joined; the same one where none gains."""
    evidence.advance()
    if len(state.rounds) == MOST_ROUNDS:
        return state
    start = state.reading.fit
    errors = start.errors[start.at(asked_names(start))]
    is_time_right = evidence.time_share == 0.0
    offered = candidates(state.current, state.effects, errors, is_time_right)
    ties = equally_likely(offered)
    return state.with_score(ties) if ties else state


def run(state: S, step: Callable[[S], S]) -> S:
    """Return the state at which steps from another one end: the one that is its own next."""
    while (after := step(state)) is not state:
        state = after
    return state


def read_as(reading: Correction, evidence: Evidence) -> State:
    """Return what is found in a log that is read in one way."""
    return run(State.of(reading), partial(step, evidence=evidence))


def found_in(
    fitted: Fit, search: ReadingSearch, scales: ScaleCorrections, evidence: Evidence
) -> State:
    """Return what is found in a log, as it came or in its likeliest reading.

    Args:
        fitted: the fit of the log, with the columns of ``fault_columns``.
        search: of its readings.
        scales: its torque scales.
        evidence: what is known beside its rows.
    """
    state = read_as(Correction((), 0.0, fitted), evidence)
    for reading in readings(fitted, state, search, scales, evidence):
        other = read_as(reading, evidence)
        state = max(state, other, key=lambda each: each.rank)
    return state


def readings(
    fitted: Fit,
    state: State,
    search: ReadingSearch,
    scales: ScaleCorrections,
    evidence: Evidence,
) -> Iterator[Correction]:
    """Yield the other readings of a log that are likely, the cheapest to find first.

    In a log that fits, mistakes hide of which a single joint hardly makes torque, and those that
    links take up; all others leave torque that is not explained.
    """
    tried = [*sign_correction(search, evidence), *search.unit_corrections]
    is_right = fits(fitted) and not any(map(is_like_gravity, state.joined))
    if scales.alone is not None:
        tried.append(scales.alone)
    is_noted = all(score.level is Level.SAYS for score in state.joined)
    if not (is_right and is_noted):
        tried += zero_correction(search, evidence)
    if not is_right:
        tried += scales.each()
        tried += column_correction(search, search.mistakes, evidence)
    else:
        tried += exchange_correction(search, evidence)
        if fitted.arm.robot.gravity is not None:
            # Links that may be off hide much of a direction that was stated the wrong way round.
            tried += column_correction(search, search.mountings, evidence)
    for each in tried:
        if is_likely(each, fitted):
            yield each


def is_likely(tried: Correction, fitted: Fit) -> bool:
    """Return whether a correction of a log gains clearly, and leaves an arm that may exist.

    A log that does not fit has to fit clearly better.
    """
    before, after = fitted.unexplained_share, tried.fit.unexplained_share
    is_less = after < CLEARLY_LESS * before or after < LITTLE
    is_turned_back = drives(fitted) and not drives(tried.fit)
    is_clear = tried.gain > CLEAR and (is_less or is_turned_back)
    # Links fit torques in another unit, if they may be off by as much; one that is wrong makes them
    # look so, and fits better.
    is_unit = is_foreign(fitted) and (tried.gain > 0.0 or odd_link(fitted) is None)
    is_right = is_clear or is_unit
    # Columns of another arm's log fit its model no better in any order.
    is_other = is_sibling(tried.fit) and after > OTHER_ARM
    return is_right and is_plausible(tried.fit) and not is_other


def is_like_gravity(score: Score) -> bool:
    """Return whether an explanation may stand for gravity in another direction."""
    is_of_arm = score.explanation.effect.joint is None
    is_harmful = score.level is not Level.SAYS
    stands_for = score.name.stands_for
    return is_of_arm and is_harmful and bool(stands_for & StandsFor.GRAVITY)


def equally_likely(offered: Sequence[Score]) -> tuple[Score, ...]:
    """Return the explanations within ``TIE`` of the likeliest; () where none of them explains.

    The first one is to join the fit: of equally likely ones, a sure one with a single value.
    """
    if not offered or offered[0].gain < CLEAR:
        return ()
    ties = [score for score in offered if score.gain > offered[0].gain - TIE]
    ties.sort(key=lambda score: (not score.is_sure, len(score.offer.values) > 1))
    return tuple(ties) if ties[0].is_sure else ()


def name_faults(rounds: Sequence[Sequence[Score]]) -> Iterator[Finding]:
    """Yield a finding for each round whose winner is reportable and has a new subject.

    Those that tie with the winner and are reportable, too, are named in its finding, the best one
    of each name. The finding has the name of the winner, and the most severe level of all.
    """
    known: set[object] = set()
    for scores in rounds:
        best: dict[FaultName, Score] = {}
        for score in scores:
            if score.is_reportable and score.explanation.subject not in known:
                best.setdefault(score.name, score)
        name = scores[0].name
        if best.get(name) is scores[0]:
            known |= {score.explanation.subject for score in scores}
            level = min((score.level for score in best.values()), key=[*Level].index)
            text = "; or ".join(dict.fromkeys(score.text for score in best.values()))
            remedies = dict.fromkeys(score.remedy for score in best.values())
            yield Finding(level, name, text, ", or ".join(filter(None, remedies)))
