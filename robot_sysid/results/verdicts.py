"""What decides on the use of a result: verdicts, what follows from each, and how they are found.

A rule names a verdict and the condition that leads to it, a function of what was found that yields
a sentence per reason. The remarks of a result are those of all rules that hold, in their order; its
verdict is the first of them that forbids the use, else the first that limits it, else the first.
The rules are the tables of ``rules``, of results from recordings, and of ``self_test``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Generic, NamedTuple, TypeVar

from robot_sysid.records.messages import Level, Remark
from robot_sysid.wording import with_option_names


class Verdict(str, Enum):
    """What decides on the use of a result; its string is its name, as in params.json."""

    SWAPPED = "SWAPPED"
    DISAGREE = "DISAGREE"
    NOT_SEEN = "NOT_SEEN"
    WRONG_WEIGHT = "WRONG_WEIGHT"
    UNEXPLAINED = "UNEXPLAINED"
    IMPLAUSIBLE = "IMPLAUSIBLE"
    TOO_WEAK = "TOO_WEAK"
    NO_BETTER = "NO_BETTER"
    TORQUES_ONLY = "TORQUES_ONLY"
    LIKE_MOTIONS = "LIKE_MOTIONS"
    ACCEPTED = "ACCEPTED"
    INERTIA_NOT_KNOWN = "INERTIA_NOT_KNOWN"
    PARTLY_FROM_MODEL = "PARTLY_FROM_MODEL"
    BETTER = "BETTER"
    AS_GOOD = "AS_GOOD"
    OK = "OK"

    __str__ = str.__str__

    @property
    def value(self) -> str:
        """What it means, or what to do, with options named for the reader."""
        return with_option_names(MEANINGS[self].text)

    @property
    def level(self) -> Level:
        """Whether it forbids the use of a result, limits it, or only informs."""
        return MEANINGS[self].level

    @property
    def use(self) -> str:
        """What a result may be used for, in words, with "{usable}" and "{unseen}" to be filled."""
        return MEANINGS[self].use

    @property
    def is_trustworthy(self) -> bool:
        """Whether the result may go into a model or a controller."""
        return self.level is Level.SAYS

    def remark(self, reason: str = "") -> Remark:
        """Return the remark by which this verdict follows from a reason, one phrase."""
        return Remark(self.level, self, *filter(None, (reason, self.value)))


class Meaning(NamedTuple):
    """What follows from a verdict.

    Attributes:
        level: whether it forbids the use of a result, limits it, or only informs.
        text: what it means, or what to do.
        use: what a result may be used for, on the console.
    """

    level: Level
    text: str
    use: str = "{usable}"


MEANINGS: Mapping[Verdict, Meaning] = {
    Verdict.SWAPPED: Meaning(
        Level.REFUSES,
        "the loaded recordings weigh less than the empty ones: {empty} and {loaded} look swapped; "
        "exchange them",
    ),
    Verdict.DISAGREE: Meaning(
        Level.REFUSES,
        "the recordings contradict each other about the payload: one of them was made with "
        "another payload, or with it turned or moved, or is listed on the wrong side",
    ),
    Verdict.NOT_SEEN: Meaning(
        Level.REFUSES,
        "the payload's mass does not differ significantly from zero: move joints that lift it, "
        "faster, wider or longer, or check that the loaded recordings were made with the payload",
    ),
    Verdict.WRONG_WEIGHT: Meaning(
        Level.REFUSES,
        "the known mass does not fit the recordings: weighed with torques as they are it comes "
        "out far from what {known_mass} says; check the weight, its unit (kg), and that nothing "
        "else was changed between empty and loaded",
    ),
    Verdict.UNEXPLAINED: Meaning(
        Level.REFUSES,
        "the torques do not follow from the motion as far as noise would let them, so the log, its "
        "units, its friction or the rest of the model are not what they are taken for",
    ),
    Verdict.IMPLAUSIBLE: Meaning(
        Level.REFUSES,
        "the result is not what a link of this arm can be, so the log, its units or the rest of "
        "the model are not what they are taken for",
    ),
    Verdict.TOO_WEAK: Meaning(
        Level.REFUSES,
        "the link's mass does not differ significantly from zero (it is less than two standard "
        "errors); move faster, wider or longer ({excitation=optimal})",
    ),
    Verdict.NO_BETTER: Meaning(
        Level.REFUSES,
        "torques that were not fitted are predicted no better than the model does already; check "
        "that the log belongs to this arm, its units and signs, or record a richer motion",
    ),
    Verdict.TORQUES_ONLY: Meaning(
        Level.DOUBTS,
        "a part of the torque follows from nothing that was fitted: use the written model for "
        "torques of motions like the log's, not for the numbers",
        "Only for torques of motions like the log's, not for the numbers",
    ),
    Verdict.LIKE_MOTIONS: Meaning(
        Level.DOUBTS,
        "the log shows too little of the arm for other motions than its own: record one in which "
        "all joints move, and identify the arm from both",
        "Only for motions like the log's",
    ),
    Verdict.ACCEPTED: Meaning(
        Level.DOUBTS,
        "nothing in the log can tell whether that does harm: before a controller uses the result, "
        "compare it with something known, such as a weighed mass",
        "Usable only if the accepted doubts do no harm",
    ),
    Verdict.INERTIA_NOT_KNOWN: Meaning(
        Level.SAYS,
        "mass and centre of mass are identified; the inertia is not known, a ball of aluminium of "
        "that mass stands in its place (joints that swing the payload faster and wider show it)",
        "Usable for mass and centre of mass (the inertia is not known)",
    ),
    Verdict.PARTLY_FROM_MODEL: Meaning(
        Level.SAYS,
        "some parameter combinations are not identifiable from these torques and keep the model's "
        "values; use {torques=chain}, or a longer or wider motion, to identify more",
        "{usable} (not identifiable, model's values kept: {unseen})",
    ),
    Verdict.BETTER: Meaning(
        Level.SAYS,
        "the written model predicts torques that were not fitted clearly better than before",
    ),
    Verdict.AS_GOOD: Meaning(
        Level.SAYS,
        "the model predicted torques that were not fitted about as well as noise allows before, "
        "and so does the written one",
        "Usable, but with torque offsets aside the model was about as good here",
    ),
    Verdict.OK: Meaning(
        Level.SAYS, "all requested parameters are identified from the data"
    ),
}
"""Each verdict and what follows from it."""
Evidence = TypeVar("Evidence")


@dataclass(frozen=True)
class Rule(Generic[Evidence]):
    """A row of the table: a verdict and the condition that leads to it.

    Attributes:
        verdict: what follows.
        reasons: returns a sentence for each reason for it in what was found, none where it does not
            hold; "" where it needs no reason.
    """

    verdict: Verdict
    reasons: Callable[[Evidence], Iterable[str]]


def judge(rules: Iterable[Rule[Evidence]], evidence: Evidence) -> list[Remark]:
    """Return the remarks of all rules that hold, in their order."""
    return [
        rule.verdict.remark(reason)
        for rule in rules
        for reason in rule.reasons(evidence)
    ]


def verdict_of(remarks: Sequence[Remark]) -> Verdict:
    """Return the verdict of the first remark of the highest level that has one; else ``OK``."""
    verdicts = [each.about for each in remarks if isinstance(each.about, Verdict)]
    order = [*Level]
    return min(verdicts, key=lambda v: order.index(v.level), default=Verdict.OK)


def condition_alone(holds: object) -> tuple[str, ...]:
    """Return what a condition without a reason yields: "" where it holds."""
    return ("",) if holds else ()
