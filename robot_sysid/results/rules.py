"""The verdicts on results from recordings: a table of conditions for files, arms and payloads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.payload import Contradiction
from robot_sysid.estimate.trust import MissedFriction
from robot_sysid.records import Flange, ModelErrors, RobotModel, Validation
from robot_sysid.records.levels import INTERVAL, UNEXPLAINED
from robot_sysid.records.messages import Remark, percent
from robot_sysid.records.quantities import BodyEstimate, Quantity
from robot_sysid.results import reasons
from robot_sysid.results.record import Elsewhere
from robot_sysid.results.verdicts import (
    Rule,
    Verdict,
    condition_alone,
    judge,
    verdict_of,
)

# ---- a written file


def is_no_worse(files: Sequence[ModelErrors]) -> bool:
    """Return whether no file is worse than the given model."""
    return not any(reasons.file_faults(files))


OF_FILES: tuple[Rule[Sequence[ModelErrors]], ...] = (
    Rule(Verdict.NO_BETTER, reasons.file_faults),
    Rule(
        Verdict.BETTER,
        lambda files: condition_alone(
            is_no_worse(files) and reasons.is_better(files[0])
        ),
    ),
    Rule(
        Verdict.AS_GOOD,
        lambda files: condition_alone(
            is_no_worse(files) and not reasons.is_better(files[0])
        ),
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
        lambda e: reasons.impossible_joints(e.robot, e.rows, e.fitted.measured_torque),
    ),
    *map(_rule_of_files, OF_FILES),
    # A file that clearly predicts better is written all the same, for torques only.
    Rule(Verdict.TORQUES_ONLY, lambda e: e.doubts() if e.has_better_file else ()),
    Rule(Verdict.UNEXPLAINED, lambda e: () if e.has_better_file else e.doubts()),
    Rule(Verdict.NO_BETTER, lambda e: reasons.faults_on_other_logs(e.others)),
)
"""Rules on an arm that was identified from recordings."""

OF_OTHER_MOTIONS: tuple[Rule[Elsewhere], ...] = (
    Rule(Verdict.LIKE_MOTIONS, reasons.poor_elsewhere),
)
"""Rules on the errors to expect of the file to use on motions that nobody recorded."""

OF_ACCEPTED: tuple[Rule[Sequence[Remark]], ...] = (
    Rule(Verdict.ACCEPTED, reasons.in_spite_of_doubts),
)
"""Rules on the doubts of logs that the user accepted. The user may know that one does no harm, a
result does not: it is right only if that is so."""


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
        lambda e: condition_alone(e.needs_ball and e.known_mass is None),
    ),
)
"""Rules on a payload."""
