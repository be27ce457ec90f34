"""What decides on the use of a result: a table of conditions and the verdicts that follow.

A rule names a verdict and the condition that leads to it, a function of what was found that yields
a sentence per reason. The remarks of a result are those of all rules that hold, in their order; its
verdict is the first of them that forbids the use, else the first that limits it, else the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.payload import Contradiction
from robot_sysid.estimate.trust import MissedFriction
from robot_sysid.records import FitQuality, Flange, ModelErrors, RobotModel, Validation
from robot_sysid.records.levels import INTERVAL, UNEXPLAINED
from robot_sysid.records.messages import Level, Remark, percent
from robot_sysid.records.quantities import BodyEstimate, Quantity
from robot_sysid.results import reasons
from robot_sysid.wording import with_option_names

WELL_KNOWN_MASS = 0.5
"""Largest standard error of the mass of a self-test, over the mass."""
SMALL_MASS = 1e-6
"""Standard error of a mass that is small enough whatever the mass is [kg]."""


class Verdict(str, Enum):
    """What decides on the use of a result; its string is its name, as in params.json."""

    @staticmethod
    def _generate_next_value_(
        name: str, start: int, count: int, last: list[Any]
    ) -> str:
        """Return the name of a member, which is its string."""
        return name

    SWAPPED = auto()
    DISAGREE = auto()
    NOT_SEEN = auto()
    WRONG_WEIGHT = auto()
    UNEXPLAINED = auto()
    IMPLAUSIBLE = auto()
    TOO_WEAK = auto()
    NO_BETTER = auto()
    TORQUES_ONLY = auto()
    INERTIA_NOT_KNOWN = auto()
    PARTLY_FROM_MODEL = auto()
    BETTER = auto()
    AS_GOOD = auto()
    OK = auto()

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
        "Usable, but the model was about as good before",
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


def _if_true(condition: object) -> tuple[str, ...]:
    """Return what a condition without a reason yields: "" where it holds."""
    return ("",) if condition else ()


# ---- a written file


def _is_no_worse(files: Sequence[ModelErrors]) -> bool:
    """Return whether no file is worse than the given model."""
    return not any(reasons.file_faults(files))


OF_FILES: tuple[Rule[Sequence[ModelErrors]], ...] = (
    Rule(Verdict.NO_BETTER, reasons.file_faults),
    Rule(
        Verdict.BETTER,
        lambda files: _if_true(_is_no_worse(files) and reasons.is_better(files[0])),
    ),
    Rule(
        Verdict.AS_GOOD,
        lambda files: _if_true(_is_no_worse(files) and not reasons.is_better(files[0])),
    ),
)
"""Rules on the errors of written files on held-out data, the file to use first."""


# ---- an arm


@dataclass(frozen=True)
class ArmEvidence:
    """What verdicts on an identified arm follow from.

    Attributes:
        fitted: the fit of all terms.
        tests: its errors on held-out data and on other logs.
        link: the terminal link.
        rows: identified numbers, among them those of joints.
        files: errors of the files that are judged, the one to use first.
        others: their errors on other logs.
        missed: friction that was left out; None where none shows.
    """

    fitted: Fit
    tests: Sequence[Validation]
    link: BodyEstimate
    rows: Sequence[Quantity]
    files: Sequence[ModelErrors]
    others: Sequence[ModelErrors]
    missed: MissedFriction | None

    @property
    def robot(self) -> RobotModel:
        """The arm with its model."""
        return self.fitted.arm.robot

    @property
    def has_better_file(self) -> bool:
        """Whether the file is clearly better than the model, on held-out data."""
        return verdict_of(judge(OF_FILES, self.files)) is Verdict.BETTER

    def doubts(self) -> Iterator[str]:
        """Yield why the numbers may be off although the file predicts well."""
        if self.fitted.unexplained_share > UNEXPLAINED:
            yield reasons.unexplained_torque(self.fitted)
        if self.missed is not None:
            no_friction = self.fitted.question.options.no_friction
            yield reasons.missed_terms(self.missed, no_friction)


def _rule_of_files(rule: Rule[Sequence[ModelErrors]]) -> Rule[ArmEvidence]:
    """Return a rule on written files as one on the arm whose files they are."""
    return Rule(rule.verdict, lambda evidence: rule.reasons(evidence.files))


OF_ARM: tuple[Rule[ArmEvidence], ...] = (
    Rule(Verdict.UNEXPLAINED, lambda e: reasons.torque_misfits(e.fitted, e.tests)),
    Rule(Verdict.IMPLAUSIBLE, lambda e: reasons.impossible_link(e.robot, e.link)),
    Rule(
        Verdict.IMPLAUSIBLE,
        lambda e: reasons.impossible_joints(e.robot, e.rows, e.fitted.torque),
    ),
    *map(_rule_of_files, OF_FILES),
    # A file that clearly predicts better is written all the same, for torques only.
    Rule(Verdict.TORQUES_ONLY, lambda e: e.doubts() if e.has_better_file else ()),
    Rule(Verdict.UNEXPLAINED, lambda e: () if e.has_better_file else e.doubts()),
    Rule(Verdict.NO_BETTER, lambda e: reasons.faults_on_other_logs(e.others)),
)
"""Rules on an arm that was identified from recordings."""


# ---- a payload


@dataclass(frozen=True)
class PayloadEvidence:
    """What verdicts on a payload follow from.

    Attributes:
        robot: the arm with its model.
        payload: in the flange frame, from the estimate with bodies that may be inconsistent and
            without the known mass: making bodies possible hides a negative mass.
        contradiction: between recordings; None where they agree.
        flange: the frame in which payloads are stated.
        test: held-out error of the fit.
        known_mass: the payload's weight as the user states it [kg]; None where it is unknown.
        needs_ball: whether a ball stands in the place of an inertia that is not identified.
    """

    robot: RobotModel
    payload: BodyEstimate
    contradiction: Contradiction | None
    flange: Flange
    test: Validation
    known_mass: float | None = None
    needs_ball: bool = False

    @property
    def is_negative(self) -> bool:
        """Whether its mass is clearly negative."""
        return bool(self.payload.mass < -INTERVAL * self.payload.errors[0])

    @property
    def is_seen(self) -> bool:
        """Whether its mass is clearly positive."""
        error = self.payload.errors[0]
        return bool(np.isfinite(error) and self.payload.mass > INTERVAL * error)

    @property
    def misfit(self) -> float:
        """Held-out torque error, over the torque."""
        return self.test.relative_error or 0.0

    def weight_if(self, condition: bool) -> tuple[str, ...]:
        """Return the sentence on its weight, if a condition holds."""
        return (reasons.payload_weight(self.payload),) if condition else ()

    def misfits(self) -> Iterator[str]:
        """Yield why the torques do not follow from the motion."""
        if self.is_seen and self.misfit > reasons.WORST_WEIGHING:
            share = percent(self.misfit)
            yield f"held-out torques are predicted with an error of {share}"

    def sizes(self) -> Iterator[str]:
        """Yield why it is too large; its torque scales, which a known mass corrects, may be why."""
        is_fitted = self.is_seen and self.misfit <= reasons.WORST_WEIGHING
        if is_fitted and self.known_mass is None:
            yield from reasons.payload_size(self.robot, self.payload)


AGAINST_PAYLOAD: tuple[Rule[PayloadEvidence], ...] = (
    Rule(
        Verdict.DISAGREE,
        lambda e: reasons.contradicting_logs(e.contradiction, e.flange),
    ),
    Rule(Verdict.SWAPPED, lambda e: e.weight_if(e.is_negative)),
    Rule(Verdict.NOT_SEEN, lambda e: e.weight_if(not e.is_negative and not e.is_seen)),
    Rule(Verdict.UNEXPLAINED, lambda e: e.misfits()),
    Rule(Verdict.IMPLAUSIBLE, lambda e: e.sizes()),
    Rule(
        Verdict.WRONG_WEIGHT,
        lambda e: reasons.wrong_weight(e.payload.mass, e.known_mass),
    ),
)
"""Rules against a payload, or against torque scales from its known mass."""
OF_PAYLOAD: tuple[Rule[PayloadEvidence], ...] = (
    *AGAINST_PAYLOAD,
    Rule(
        Verdict.INERTIA_NOT_KNOWN,
        lambda e: _if_true(e.needs_ball and e.known_mass is None),
    ),
)
"""Rules on a payload."""


# ---- a self-test


@dataclass(frozen=True)
class SelfTestEvidence:
    """What verdicts on the identification of a model from its own simulation follow from.

    Attributes:
        mass: of the terminal link [kg].
        mass_error: its standard error [kg].
        quality: what the equations determine.
    """

    mass: float
    mass_error: float
    quality: FitQuality

    @property
    def is_weak(self) -> bool:
        """Whether the mass hardly shows."""
        largest = max(SMALL_MASS, WELL_KNOWN_MASS * self.mass)
        return bool(largest < self.mass_error < np.inf)

    @property
    def is_whole(self) -> bool:
        """Whether all parameters show."""
        return not self.quality.unidentifiable


OF_SELF_TEST: tuple[Rule[SelfTestEvidence], ...] = (
    Rule(Verdict.TOO_WEAK, lambda e: _if_true(e.is_weak)),
    Rule(
        Verdict.PARTLY_FROM_MODEL, lambda e: _if_true(not e.is_weak and not e.is_whole)
    ),
    Rule(Verdict.OK, lambda e: _if_true(not e.is_weak and e.is_whole)),
)
"""Rules on a self-test."""
