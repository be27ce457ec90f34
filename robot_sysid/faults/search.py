"""The one loop: faults are offered to the fit of a log, the best one joins it, until none explains.

The likeliest fault joins the fit where it gains ``CLEAR`` nats and is sure, and the others are
offered again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.offers import Effect
from robot_sysid.faults import Finding
from robot_sysid.faults.judge import Score, asked_names, candidates, fit_with
from robot_sysid.faults.plausibility import is_plausible
from robot_sysid.faults.reading_search import Correction, Evidence
from robot_sysid.faults.scales import ScaleCorrections
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR, UNEXPLAINED
from robot_sysid.records.messages import Level

TIE = 6.0
"""Difference in gain within which two explanations count as equally likely [nats]."""
MOST_ROUNDS = 5
"""Largest number of faults that act together."""
OF_SCALES = (FaultName.TORQUE_SCALE, FaultName.TORQUE_UNIT)
"""Faults of torque scales."""


@dataclass(frozen=True)
class Search:
    """What was found in a log so far.

    Attributes:
        start: the log as it was corrected; a correction without findings for the log as it is. Its
            fit has the columns of ``readings``.
        current: the fit with all that have joined it.
        rounds: those that won, each with those that tie with it.
        least: what a single fault leaves unexplained, as a share of all torque.
    """

    start: Correction
    current: Fit
    rounds: tuple[tuple[Score, ...], ...]
    least: float

    @classmethod
    def of(cls, start: Correction) -> Search:
        """Return the state before the first round."""
        return cls(start, start.fit, (), start.fit.unexplained_share)

    @property
    def winners(self) -> list[Score]:
        """Explanations that have joined the fit."""
        return [ties[0] for ties in self.rounds]

    @property
    def effects(self) -> list[Effect]:
        """Their effects."""
        return [score.explanation.effect for score in self.winners]

    @property
    def gain(self) -> float:
        """Gain of all that was found, in log likelihood [nats]."""
        return self.start.gain + sum(score.gain for score in self.winners)

    @property
    def explains(self) -> bool:
        """Whether no more is left unexplained than right logs leave."""
        return self.current.unexplained_share < UNEXPLAINED

    def with_correction(self, correction: Correction) -> Search:
        """Return the state with the log as another correction has it."""
        return replace(self, start=correction, current=correction.fit)

    def with_winner(self, ties: tuple[Score, ...]) -> Search:
        """Return the state that the first of equally likely explanations has joined."""
        winner = ties[0]
        current = fit_with(winner.fitted, [winner.explanation.effect])
        least = self.least
        if not self.rounds:
            least = min(least, current.unexplained_share)
        return replace(self, current=current, rounds=(*self.rounds, ties), least=least)


def search_faults(
    start: Correction, evidence: Evidence, scales: ScaleCorrections
) -> Search:
    """Return what is found in a log, fault after fault, as long as one explains.

    Args:
        start: the log as it was corrected, as in ``Search``.
        evidence: what is known beside its rows.
        scales: torque scales of the log as it was recorded.
    """
    found = Search.of(start)
    errors = start.fit.errors[start.fit.at(asked_names(start.fit))]
    is_time_right = evidence.time_share == 0.0
    while len(found.rounds) < MOST_ROUNDS:
        evidence.advance()
        offered = candidates(found.current, found.effects, errors, is_time_right)
        if any(each.about in OF_SCALES for each in found.start.findings):
            # Joints whose scales no torque shows keep their share of the others'.
            offered = [score for score in offered if score.name not in OF_SCALES]
        correction = scales_beyond(offered, found, scales)
        ties = equally_likely(offered)
        if correction is not None:
            found = found.with_correction(correction)
        elif ties:
            found = found.with_winner(ties)
        else:
            break
    return found


def equally_likely(offered: Sequence[Score]) -> tuple[Score, ...]:
    """Return the explanations within ``TIE`` of the likeliest; () where none of them explains.

    The first one is to join the fit: of equally likely ones, a sure one with a single value.
    """
    if not offered or offered[0].gain < CLEAR:
        return ()
    ties = [score for score in offered if score.gain > offered[0].gain - TIE]
    ties.sort(key=lambda score: (not score.is_sure, len(score.offer.values) > 1))
    return tuple(ties) if ties[0].is_sure else ()


def scales_beyond(
    offered: Sequence[Score], found: Search, scales: ScaleCorrections
) -> Correction | None:
    """Return torque scales of all joints, where they explain more than the one that is likeliest.

    They correct a log as it was recorded only: beside other faults they would take these up.
    """
    if found.start.findings or found.rounds or not offered:
        return None
    likeliest = offered[0]
    if likeliest.gain < CLEAR or likeliest.name not in OF_SCALES:
        return None
    own = scales.own
    if own is None or not is_plausible(own.fit):
        return None
    return own if own.gain > likeliest.gain + TIE else None


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
