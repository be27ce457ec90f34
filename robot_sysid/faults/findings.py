"""What is wrong with a log or its model: everything that is asked of it, in order.

The fit of a log is judged as it stands. Where it does not fit, mistakes of its columns and torque
scales are tried first; then faults of the table are offered to the fit of the log as it came, and
of the likeliest correction of it. A fault is named when it explains (``judge``); otherwise the log
does not fit: how much is unexplained, at which joints, and what is missing there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from robot_sysid.estimate.choose import answer_of
from robot_sysid.estimate.contacts import LITTLE
from robot_sysid.estimate.fit import Fit
from robot_sysid.faults import Finding
from robot_sysid.faults.judge import Score
from robot_sysid.faults.misfits import (
    delay_findings,
    external_findings,
    friction_findings,
    misfit,
    model_findings,
    own_findings,
    time_findings,
    weight_alone,
    weight_findings,
)
from robot_sysid.faults.plausibility import (
    drives,
    fits,
    is_foreign,
    is_of_single_joints,
    is_plausible,
    is_sibling,
)
from robot_sysid.faults.reading_search import (
    ColumnSearch,
    Correction,
    Evidence,
    column_correction,
    sign_correction,
    unit_correction,
    zero_correction,
)
from robot_sysid.faults.readings import OF_COLUMNS
from robot_sysid.faults.scales import ScaleCorrections, TorqueScales, odd_unit
from robot_sysid.faults.search import OF_SCALES, Search, name_faults, search_faults
from robot_sysid.faults.shares import shares_of
from robot_sysid.records.fault_names import FaultName
from robot_sysid.records.levels import CLEAR
from robot_sysid.records.messages import Level

LIKE_GRAVITY = (
    FaultName.FORCE,
    FaultName.GRAVITY,
    FaultName.TILT,
    FaultName.PAYLOAD_STEP,
)
"""Faults that may stand for gravity in another direction."""
MISTAKES = (*OF_COLUMNS, FaultName.ZERO, FaultName.TILT, FaultName.CLOCK)
"""What another reading of a log puts right."""
UNMEASURED = (FaultName.COMPUTED, FaultName.TORQUE_UNIT)
"""What is no torque of this arm, or in no known unit, shows nothing else."""
OF_LINKS = (
    FaultName.TORQUE_SCALE,
    FaultName.TORQUE_UNIT,
    FaultName.MODEL,
    FaultName.TILT,
    FaultName.GRAVITY,
    FaultName.FORCE,
    FaultName.ORDER,
    FaultName.ZERO,
)
"""Faults that an experiment on single joints says nothing of."""
CLEARLY_LESS = 0.7
"""What a correction leaves unexplained, over what is without it, below which it leaves less."""
STEADY = 0.1
"""Relative error of one joint's factor below which blocks of a log agree on it: with factors of 0.5
to 2 it is 0.03 to 0.06, also beside a contact, of a ripple in the joint's torque 0.14."""
MOST_NAMED = 3
"""Faults that are named: of more that act together, the others are small."""


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
        fitted: the fit of the log, with the columns of ``readings``.
        evidence: what is known beside its rows.
    """
    columns = ColumnSearch(fitted)
    # What class the torque is of comes first: where it is no torque of this arm, it shows no more.
    found = [
        *class_findings(fitted, columns),
        *friction_findings(fitted),
        *time_findings(fitted, evidence),
    ]
    if found:
        return Found(found[:1], fitted)
    is_experiment = is_of_single_joints(fitted)
    scales = ScaleCorrections(fitted, evidence)
    search = search_faults(Correction((), 0.0, fitted), evidence, scales)
    # An arm that is compared with its model has played the motion: its columns are those of its
    # motors, and a sign or an order would pass for what has happened to it.
    is_of_model = fitted.question.differing is not None
    if not (is_experiment or is_of_model):
        search = search_or_single(search, columns, evidence, scales)
    # Links and a factor on them take up positions or times in another unit, and fit.
    is_fitting = is_read_right(search) and not columns.other_units
    if not (is_experiment or is_fitting or is_of_model):
        search = search_or_corrected(search, columns, evidence, scales)
    right = search.start.fit
    named = [*search.start.findings]
    is_corrected = any(each.about in MISTAKES for each in named)
    if not (is_experiment or is_corrected or is_fitting):
        found += odd_unit(fitted)
    if not (search.explains and named):
        found += weight_findings(fitted)
    if found:
        return Found(found[:1], fitted)
    if not search.explains:
        return Found(unexplained_findings(fitted, search), right)
    named += name_faults(search.rounds[:MOST_NAMED])
    if not any(each.about is FaultName.DELAY for each in named):
        # One that explains too little torque to be named may be most of a joint's friction.
        late = (each.fitted for each in search.winners if each.name is FaultName.DELAY)
        named += delay_findings(right, next(late, search.current))
    unmeasured = [each for each in named if each.about in UNMEASURED]
    if unmeasured:
        return Found(unmeasured, right)
    if is_experiment:
        return Found([each for each in named if each.about not in OF_LINKS], right)
    if any(finding.level is not Level.SAYS for finding in named):
        return Found(named, right)
    answer = answer_of(search.current)
    if right is not fitted:
        scales = ScaleCorrections(right, evidence)
    named += [*model_findings(search, scales, answer), *own_findings(right)]
    return Found(named, right, answer if search.current is fitted else None)


def class_findings(fitted: Fit, columns: ColumnSearch) -> Iterator[Finding]:
    """Yield the finding that the torque has none of the links' weight, or nothing else of them."""
    if not fitted.arm.has_gravity or not fitted.arm.others:
        return
    shares = shares_of(fitted)
    yield from external_findings(fitted, shares)
    # Where inertia has gone, the view leaves less than links that have to have some. Time that is
    # too short hides inertia as well, all but for a part.
    is_less = shares.left < CLEARLY_LESS * fitted.unexplained_share
    if shares.is_weight_alone and is_less and not any(unit_correction(columns)):
        yield weight_alone()


def is_like_gravity(score: Score) -> bool:
    """Return whether an explanation may stand for gravity in another direction."""
    is_of_arm = score.explanation.effect.joint is None
    is_harmful = score.level is not Level.SAYS
    return is_of_arm and is_harmful and score.name in LIKE_GRAVITY


def is_read_right(search: Search) -> bool:
    """Return whether a log fits so well, as it is or with one mistake put right, that it has no
    other mistake in its columns, nor another direction of gravity.
    """
    fitted = search.start.fit
    # Links that may be off hide much of a direction that was stated the wrong way round.
    is_as_in_file = fitted.arm.robot.gravity is None
    return (
        fits(fitted) and is_as_in_file and not any(map(is_like_gravity, search.winners))
    )


def search_or_single(
    search: Search, columns: ColumnSearch, evidence: Evidence, scales: ScaleCorrections
) -> Search:
    """Return a search in a log, or the one in a log with mistakes of single joints put right.

    They may hide in a log that fits. Where the first search blames scales only, one joint that all
    others contradict is simpler.
    """
    fitted = scales.fitted
    is_fitting = fits(fitted)
    tried = [*sign_correction(columns, evidence)]
    if not any(fits(each.fit) for each in tried):
        alone = scales.alone
        if alone is not None and (is_fitting or is_steady(scales.scales)):
            tried.append(alone)
        if search.winners or not is_fitting or scales.scales.is_odd:
            turned = zero_correction(columns, evidence)
            tried += [each for each in turned if fits(each.fit)]
    for each in tried:
        # Columns of another arm's log fit its model no better in any order.
        is_this_arm = is_plausible(each.fit) and not is_sibling(each.fit)
        if each.gain < CLEAR or not is_this_arm:
            continue
        corrected = search_faults(each, evidence, scales)
        # A log that fits needs no other columns to be right in everything else: a wrong sign that
        # friction without a term suggests leaves a force or a tilt.
        leaves_none = all(score.level is Level.SAYS for score in corrected.winners)
        if is_fitting and not leaves_none:
            continue
        blamed = {score.name for score in search.winners}
        blamed |= {finding.about for finding in search.start.findings}
        is_simpler = each is scales.alone and blamed and blamed <= {*OF_SCALES}
        if corrected.explains and is_simpler:
            search = corrected
        else:
            searches = search, corrected
            search = max(searches, key=lambda each: (each.explains, each.gain))
    return search


def is_steady(scales: TorqueScales) -> bool:
    """Return whether one joint's factor is the same all over a log, which need not fit: links and
    the factor take up a part of whatever is wrong at the joint.
    """
    return scales.alone is not None and scales.alone[2] < STEADY


def search_or_corrected(
    search: Search, columns: ColumnSearch, evidence: Evidence, scales: ScaleCorrections
) -> Search:
    """Return a search in a log, or the one in its likeliest correction if that explains more.

    Gains are compared, so that corrections are of the log as it was recorded, which ``scales`` has,
    also where the search itself has corrected its torque scales.
    """
    tried = [*scales.each()]
    named = {finding.about for finding in search.start.findings}
    # A log that one joint's factor explains needs no search for columns, unless another time reads
    # better as well: it makes other inertias, of which a joint without weight has nothing else.
    is_factor = search.explains and named == {FaultName.TORQUE_SCALE}
    # Nor does one whose torques are in another unit, and fits in the right one, unless positions in
    # another unit read better: of an arm that hardly moves, weight is any factor.
    is_unit = is_foreign(scales.fitted)
    is_right = is_unit and any(fits(each.fit) for each in tried)
    tried += unit_correction(columns)
    if columns.other_units or not (is_factor or is_right):
        tried += column_correction(columns, evidence)
    likely = [each for each in tried if is_likely(each, scales.fitted)]
    best = sorted(likely, key=lambda each: -each.gain)
    # Whatever explains torques in another unit, they are not right as they are.
    searches = [search_faults(each, evidence, scales) for each in best[:1]]
    searches.append(search)
    return max(searches, key=lambda each: (each.explains, is_unit or each.gain))


def is_likely(tried: Correction, fitted: Fit) -> bool:
    """Return whether a correction of a log leaves clearly less, in an arm that may exist."""
    before = fitted.unexplained_share
    after = tried.fit.unexplained_share
    is_less = after < CLEARLY_LESS * before or after < LITTLE < before
    is_turned_back = drives(fitted) and not drives(tried.fit)
    is_clear = tried.gain > CLEAR and (is_less or is_turned_back)
    # Links fit torques in another unit, if they may be off by as much.
    is_right = is_clear or is_foreign(fitted)
    return is_right and is_plausible(tried.fit) and not is_sibling(tried.fit)


def unexplained_findings(fitted: Fit, search: Search) -> list[Finding]:
    """Return what is said of a log that nothing explains.

    Friction that drives a joint is a turned sign whatever the model, and nothing else.
    """
    named = [*search.start.findings]
    is_sign = {each.about for each in named} == {FaultName.SIGN}
    is_shown = is_sign and drives(fitted) and not drives(search.start.fit)
    return named if is_shown else [misfit(fitted, search.least)]
