"""What is wrong with a log or its model: everything that is asked of it, in order.

What class the torque is of comes first: where it is no torque of this arm, it shows no more. Then
come the faults of the loop; where they explain the log, what is wrong as a whole. Otherwise the log
does not fit: how much is unexplained, at which joints, and what is missing there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robot_sysid.estimate.choose import answer_of
from robot_sysid.estimate.fit import Fit
from robot_sysid.faults import Finding
from robot_sysid.faults.loop import MOST_NAMED, State, found_in, name_faults, read_as
from robot_sysid.faults.misfits import (
    computed_findings,
    delay_findings,
    external_torque,
    misfit,
    model_findings,
    most_friction,
    own_findings,
    time_findings,
    weight_alone,
    weight_findings,
)
from robot_sysid.faults.plausibility import drives, is_of_single_joints
from robot_sysid.faults.reading_search import Correction, Evidence, ReadingSearch
from robot_sysid.faults.scales import ScaleCorrections, odd_unit
from robot_sysid.faults.shares import shares_of
from robot_sysid.records.fault_names import FaultName, Needs, StandsFor
from robot_sysid.records.messages import Level


@dataclass(frozen=True)
class Found:
    """What is found in a log.

    Attributes:
        findings: what is wrong with it or its model; () where it fits.
        right: the fit of the log that is right then.
        answer: the answer to the log as it was read, where it was looked at.
    """

    findings: Sequence[Finding]
    right: Fit
    answer: Fit | None = None


def findings(fitted: Fit, evidence: Evidence) -> Found:
    """Return what is wrong with a log or its model.

    Args:
        fitted: the fit of the log, with the columns of ``fault_columns``.
        evidence: what is known beside its rows.
    """
    search = ReadingSearch(fitted)
    friction = most_friction(fitted)
    found = [
        *class_findings(fitted, search),
        *computed_findings(fitted, friction),
        *time_findings(fitted, evidence),
    ]
    if found:
        return Found(found[:1], fitted)
    is_experiment = is_of_single_joints(fitted)
    scales = ScaleCorrections(fitted, evidence)
    # An arm that is compared with its model has played the motion: its columns are those of its
    # motors, and a sign or an order would pass for what has happened to it.
    if is_experiment or fitted.question.differing is not None:
        state = read_as(Correction((), 0.0, fitted), evidence)
    else:
        state = found_in(fitted, search, scales, evidence)
    right = state.reading.fit
    named = [*state.reading.findings]
    is_read_otherwise = any(each.about.needs <= Needs.COLUMNS for each in named)
    if not (is_experiment or is_read_otherwise):
        found += odd_unit(fitted)
    if not (state.explains and named):
        found += weight_findings(fitted)
    if found:
        return Found(found[:1], fitted)
    if not state.explains:
        return Found(unexplained_findings(fitted, state), right)
    named += name_faults(state.rounds[:MOST_NAMED])
    if not any(each.about is FaultName.DELAY for each in named):
        # One that explains too little torque to be named may be most of a joint's friction.
        late = (each.fitted for each in state.joined if each.name is FaultName.DELAY)
        named += delay_findings(right, next(late, state.current))
    unmeasured = [each for each in named if each.about.stands_for & StandsFor.ALL]
    if unmeasured:
        return Found(unmeasured, right)
    is_wrong = any(finding.level is not Level.SAYS for finding in named)
    if is_experiment or is_wrong:
        return Found(named, right)
    answer = answer_of(right)
    if right is not fitted:
        scales = ScaleCorrections(right, evidence)
    named += [*model_findings(state, scales, answer), *own_findings(right, friction)]
    return Found(named, right, answer if right is fitted else None)


def class_findings(fitted: Fit, search: ReadingSearch) -> Iterator[Finding]:
    """Yield the finding that the torque has none of the links' weight, or nothing else of them."""
    if not fitted.arm.has_gravity or not fitted.arm.others:
        return
    shares = shares_of(fitted)
    # Where inertia has gone, the view leaves less than links that have to have some.
    is_less = shares.left < fitted.unexplained_share
    is_alone = shares.is_weight_alone and is_less and not drives(fitted)
    # Time that is too short hides inertia, all but for a part, and degrees hide weight.
    if (is_alone or shares.has_no_weight) and not search.unit_corrections:
        yield weight_alone() if is_alone else external_torque(fitted, shares)


def unexplained_findings(fitted: Fit, state: State) -> list[Finding]:
    """Return what is said of a log that nothing explains.

    Friction that drives a joint is a turned sign whatever the model, and nothing else.
    """
    named = [*state.reading.findings]
    is_sign = {each.about for each in named} == {FaultName.SIGN}
    is_sure = is_sign and drives(fitted)
    return named if is_sure else [misfit(fitted, state.current, state.least)]
