"""The fit of every link: which columns, which weight of the model, and what comes out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import BENT, friction_model, speed_name
from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.arm.consistent_links import LinksProblem
from robot_sysid.estimation.arm.fits import Columns, LinkFits, first_noise, is_clearly_lower
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.estimation.cross_validation import blocks
from robot_sysid.estimation.information import combined, sample_counts
from robot_sysid.identify.arm.columns import ArmColumns, Bends, usual_bends
from robot_sysid.identify.arm.couplings import Coupling, neighbours, read_couplings
from robot_sysid.identify.arm.friction_choice import (
    BASIC,
    CANDIDATES,
    CLEAR_SHARE,
    CLEARLY,
    Models,
    best_per_joint,
    errors_per_joint,
    same_for_all,
)
from robot_sysid.identify.samples import DecimatedSamples, joined
from robot_sysid.identify.traces import traced
from robot_sysid.records import Array, RobotModel, SquareRootInformation, Validation
from robot_sysid.records.progress import Progress
from robot_sysid.records.traces import Traces
from robot_sysid.signals.process import ProcessedSignals

BLOCKS, LONGEST_STRETCH = 5, 10.0
"""How many parts a log is predicted in, each from the others. A part is every fifth stretch of the
log; stretches are less than so long [s], as a motion may show a joint for a while only."""
GAMMAS = (1e3, 3e2, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 0.01, 1e-3)
"""Weights of the model that are tried."""
MOST_LOAD_LOSS = 0.2
"""Largest share of its torque that a gear may lose."""
_FIRST_GAMMA, _ROUNDS, _SETTLED = 1.0, 3, 1e-3
# Rounds of a fit with terms that are nonlinear in a speed, and the largest change of a speed, as a
# share of it, that is none; no step is meant to go further than the second share.
_BENT_ROUNDS, _SPEED_SETTLED, _SPEED_STEP = 8, 0.02, 0.5
# Squared errors of two weights of the model up to this ratio are as good as equal.
_AS_GOOD = 1.01

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ArmFit:
    """Result of a fit of every link.

    Attributes:
        columns: makes the equations.
        fits: the data around the estimate, in blocks.
        kept: (k,) which parameters were sought.
        values: (p,) estimate of all, zero where not sought.
        thetas: (n, 10) the links around which the equations were made.
        friction: joint name to the name of its friction model.
        couplings: motors that turn with several joints.
        gamma: weight of the model.
        choices: joint to friction model to held-out root mean square error [N m].
        held_out: (blocks, joints) squared error of what was predicted from the rest.
        samples: the fitted samples.
        bends: the speeds around which terms that are nonlinear in one were taken.
    """

    columns: ArmColumns
    fits: LinkFits
    kept: Columns
    values: Array
    thetas: Array
    friction: Mapping[str, str]
    couplings: tuple[Coupling, ...]
    gamma: float
    choices: Mapping[str, Mapping[str, float]]
    held_out: Array
    samples: tuple[DecimatedSamples, ...]
    bends: Bends

    def validation(self, source: str) -> Validation:
        """Return the error on stretches that were predicted from the others."""
        squares = np.sum([each.squared_torque() for each in self.samples], axis=0)
        counts = np.sum([sample_counts(part) for part in self.fits.parts], axis=0)
        return _validation(
            self.samples[0].joints, self.held_out.sum(axis=0), squares, counts, source
        )

    def traces(self, robot: RobotModel, signals: Sequence[ProcessedSignals]) -> Traces:
        """Return what was measured and what the fit predicts, for a report."""
        names = self.columns.names
        after, before = (dict(zip(names, v)) for v in (self.values, self.columns.prior))
        motions = [log.decimated_motion() for log in signals]
        return traced(robot, self.samples, motions, after, before)

    def validate_on(
        self,
        robot: RobotModel,
        signals: Sequence[ProcessedSignals],
        source: str,
        used: Mask | None = None,
    ) -> Validation:
        """Return the error on another log, or on other rows (K,) of a fitted one."""
        columns = ArmColumns(robot, signals, self.couplings)
        samples = joined(columns.samples(self.thetas, bends=self.bends))
        samples = samples if used is None else samples.where(used)
        values = dict(zip(self.columns.names, self.values))
        information = samples.information()
        wrong = information.squared_residuals(np.array([values[name] for name in samples.names]))
        counts = sample_counts(information)
        if not np.any(counts):
            raise InputError(f"no usable torque samples to validate on in {source}")
        return _validation(samples.joints, wrong, samples.squared_torque(), counts, source)


def fit_arm(
    robot: RobotModel,
    signals: Sequence[ProcessedSignals],
    options: ArmOptions,
    progress: Progress,
    used: Sequence[Mask] | None = None,
) -> ArmFit:
    """Identify every link from processed logs.

    Args:
        robot: the arm as its model describes it.
        signals: the logs.
        options: how.
        progress: where to tell how far it is.
        used: per log, which decimated rows (K,) may be used; None for all.

    Raises:
        InputError: a log is too short, or the couplings do not fit the arm.
    """
    search = _Search(robot, signals, options, used)
    progress.stage("Choosing couplings, friction and weight of the model...")
    search.settle(2)
    search.choose_couplings()
    search.choose_friction()
    search.choose_gamma()
    progress.stage("Solving for all links...")
    return search.result()


class _Search:
    """The choices in turn, each made with what is known after those before it."""

    def __init__(
        self,
        robot: RobotModel,
        signals: Sequence[ProcessedSignals],
        options: ArmOptions,
        used: Sequence[Mask] | None,
    ) -> None:
        self._robot, self._options = robot, options
        if options.coupling is None:
            self._couplings: tuple[Coupling, ...] = ()
            offered = tuple(neighbours(robot))
        else:
            self._couplings = offered = read_couplings(options.coupling, robot)
        self._offered = offered
        self._columns = ArmColumns(robot, signals, offered)
        self._used = used
        self._friction = same_for_all(options.friction or BASIC, robot.n_joints)
        self._bends = usual_bends(robot.n_joints)
        self._gamma = options.model_weight or _FIRST_GAMMA
        self._choices: Mapping[str, Mapping[str, float]] = {}
        self._comparing = False
        self._thetas = np.array([link.theta for link in robot.links])
        self._values = self._columns.prior
        self._noise: Array | None = None

    def settle(self, rounds: int = _ROUNDS) -> None:
        """Fit and make the columns anew until the links do not move any more."""
        bent = any(model.bent for model in self._friction)
        for _ in range(_BENT_ROUNDS if bent else rounds):
            self._fit()
            before, self._thetas = self._thetas, self._columns.thetas(self._values)
            scale = np.linalg.norm(before, axis=0) + 1e-12
            moved = self._bend()
            if np.max(np.abs(self._thetas - before) / scale) < _SETTLED and moved < _SPEED_SETTLED:
                break

    def _bend(self) -> float:
        """Take the speeds that the last fit asks for; return their largest relative change."""
        value = dict(zip(self._columns.names, self._values.tolist()))
        joints, speed, size, moved = self._robot.joint_names, {}, {}, 0.0
        for term, bent in BENT.items():
            here = self._bends.speed[term]
            step = np.array([value[speed_name(term, joint)] for joint in joints])
            speed[term] = np.clip(here + step, *bent.bounds)
            size[term] = np.array([value[f"{term}[{joint}]"] for joint in joints])
            moved = max(moved, float(np.max(np.abs(speed[term] / here - 1.0))))
        self._bends = Bends(speed, size)
        return moved

    def _fit(self) -> None:
        self._fits = self._data()
        self._fits, self._values = self._fits.weighed(self._kept(), self._gamma)
        self._noise = self._fits.noise

    def _data(self) -> LinkFits:
        """Return the data around the links as they are known now."""
        self._samples = tuple(self._columns.samples(self._thetas, *self._later()))
        if self._used is not None:
            self._samples = tuple(s.where(m) for s, m in zip(self._samples, self._used))
        parts = _blocks(self._samples)
        noise = first_noise(parts) if self._noise is None else self._noise
        return LinkFits(parts, self._problem(), self._known(), noise)

    def _later(self) -> tuple[bool, Bends | None]:
        """Return whether columns of load are needed, and around what those of bent terms are."""
        load = any("load" in model.terms for model in self._friction)
        bent = any(model.bent for model in self._friction)
        return self._comparing or load, self._bends if self._comparing or bent else None

    def choose_couplings(self) -> None:
        """Let neighbours share a motor where that predicts held-out torques clearly better."""
        offered = {each.name: each for each in self._offered if not self._couplings}
        best = self._rough_scores(self._couplings)
        while offered:
            trials = {k: self._rough_scores((*self._couplings, c)) for k, c in offered.items()}
            found = min(trials, key=lambda name: float(np.mean(trials[name])))
            if not is_clearly_lower(trials[found], best, CLEAR_SHARE, CLEARLY):
                break
            best = trials[found]
            self._couplings = (*self._couplings, offered.pop(found))
        self._columns = self._columns.with_couplings(self._couplings)
        self.settle(1)

    def _rough_scores(self, couplings: Sequence[Coupling]) -> Array:
        kept = self._kept(couplings=couplings)
        return self._fits.scores(self._fits.roughly_held_out(kept, self._gamma))

    def choose_friction(self) -> None:
        """Give each joint the terms that predict its held-out torques clearly better."""
        if self._options.friction is not None:
            return
        self._comparing = True
        self._try_speeds()
        joints = self._robot.joint_names
        squared = {name: self._held_out(self._same(name)) for name in CANDIDATES}
        counts = np.array([sample_counts(part) for part in self._fits.parts])
        self._choices = errors_per_joint(squared, counts, joints)
        self._friction = best_per_joint(squared, counts)
        self._comparing = False
        self.settle(2)

    def _same(self, name: str) -> Models:
        return same_for_all(name, self._robot.n_joints)

    def _held_out(self, models: Models) -> Array:
        return self._fits.held_out(self._kept(models, bending=False), (self._gamma,))[0]

    def _try_speeds(self) -> None:
        """Start each nonlinear term at the speed that predicts its joint's torques best."""
        start = usual_bends(self._robot.n_joints)
        best: dict[str, Array] = {}
        for number in range(max(len(bent.tried) for bent in BENT.values())):
            tried = {term: bent.tried[number] for term, bent in BENT.items()}
            self._bends = usual_bends(self._robot.n_joints, **tried)
            self._fits = self._data()
            for term, speed in tried.items():
                name = next(name for name in CANDIDATES if term in friction_model(name).terms)
                kept = self._kept(self._same(name), bending=False)
                error = self._fits.roughly_held_out(kept, self._gamma).sum(axis=0)
                before = best.get(term, np.full(len(error), np.inf))
                start.speed[term][error < before] = speed
                best[term] = np.minimum(error, before)
        self._bends = start
        self._fits = self._data()

    def choose_gamma(self) -> None:
        """Take the largest weight of the model that predicts held-out torques about as well."""
        if self._options.model_weight is None:
            squared = self._fits.held_out(self._kept(), GAMMAS)
            scores = self._fits.scores(squared)
            error = np.mean(scores, axis=1)
            self._gamma = GAMMAS[int(np.flatnonzero(error <= _AS_GOOD * np.min(error))[0])]
        self.settle()

    def result(self) -> ArmFit:
        """Return the fit to all rows, and what it predicts of held-out ones."""
        kept = self._kept()
        return ArmFit(
            columns=self._columns,
            fits=self._fits,
            kept=kept,
            values=self._values,
            thetas=self._thetas,
            friction=self._named(kept),
            couplings=self._couplings,
            gamma=self._gamma,
            choices={joint: self._choices[joint] for joint in self._moved(kept) if self._choices},
            held_out=self._fits.held_out(kept, (self._gamma,))[0],
            samples=self._samples,
            bends=self._bends,
        )

    def _moved(self, kept: Columns) -> list[str]:
        """Return the joints of which friction was sought."""
        names = [self._columns.names[index] for index in kept]
        own = {name.partition("[")[2][:-1] for name in names if not name.startswith("zero")}
        return [joint for joint in self._robot.joint_names if joint in own]

    def _named(self, kept: Columns) -> dict[str, str]:
        """Return joint to the name of its friction model, none where the joint does not move."""
        names = dict(zip(self._robot.joint_names, (model.name for model in self._friction)))
        moved = self._moved(kept)
        return {joint: name if joint in moved else "none" for joint, name in names.items()}

    def _kept(
        self,
        friction: Models | None = None,
        couplings: Sequence[Coupling] | None = None,
        bending: bool = True,
    ) -> Columns:
        """Return which parameters (k,) a choice of friction and couplings has.

        A motor of several joints has the terms of all of them; ``bending`` says whether speeds of
        nonlinear terms are sought too.
        """
        models = dict(zip(self._robot.joint_names, friction or self._friction))
        terms = {joint: {*model.terms} for joint, model in models.items()}
        if bending:
            for joint, model in models.items():
                terms[joint] |= {f"{term}_speed" for term in model.bent}
        for motor in self._couplings if couplings is None else couplings:
            turned = np.flatnonzero(motor.ratios)
            terms[motor.name] = set().union(*(terms[self._robot.joint_names[j]] for j in turned))
        # What no row shows is not sought: its value would be whatever the search began with.
        kept, known, shown = [], np.isfinite(self._known()), _shown(self._fits)
        for index, name in enumerate(self._columns.names):
            term, bracket, place = name.partition("[")
            if term == "zero" or name in TILT_NAMES:
                chosen = bool(known[index])
            else:
                chosen = not bracket or (term in terms.get(place[:-1], ()) and bool(shown[index]))
            if chosen:
                kept.append(index)
        return np.array(kept)

    def _known(self) -> Array:
        """Return (p,) standard deviation of what is known of zeros, tilt and speeds beforehand."""
        sigma = np.full(len(self._columns.names), np.inf)
        step = {
            speed_name(term, joint): _SPEED_STEP * speed
            for term, speeds in self._bends.speed.items()
            for joint, speed in zip(self._robot.joint_names, speeds.tolist())
        }
        for index, name in enumerate(self._columns.names):
            if name.startswith("zero["):
                sigma[index] = 1e-3 * self._options.zero_uncertainty or np.inf
            elif name in TILT_NAMES:
                sigma[index] = np.radians(self._options.gravity_uncertainty) or np.inf
            else:
                sigma[index] = step.get(name, np.inf)
        return sigma

    def _problem(self) -> LinksProblem:
        names = self._columns.names
        lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        free = {"offset", "sqrt", "zero"} | set(TILT_NAMES) | {f"{term}_speed" for term in BENT}
        curved = {
            f"viscous[{joint}]"
            for joint, model in zip(self._robot.joint_names, self._friction)
            if "sqrt" in model.terms
        }
        for index, name in enumerate(names):
            term, bracket, _ = name.partition("[")
            if bracket and term not in free and name not in curved:
                lower[index] = 0.0
                upper[index] = MOST_LOAD_LOSS if term == "load" else np.inf
        links = tuple(place for _, place in self._columns.links())
        told = [name.startswith("armature[") or "[" not in name for name in names]
        return LinksProblem(links, np.where(told, self._columns.prior, 0.0), lower, upper)


def _shown(fits: LinkFits) -> NDArray[np.bool_]:
    """Return which parameters (p,) have a column that is not zero."""
    shown = np.zeros(len(fits.names), dtype=bool)
    for part in fits.parts:
        for joint in part.joints:
            shown[joint.columns] |= np.any(joint.triangle[:, :-1] != 0.0, axis=0)
    return shown


def _blocks(samples: Sequence[DecimatedSamples]) -> tuple[SquareRootInformation, ...]:
    """Return the information of each block: the same stretches of every log together."""
    parts: list[list[SquareRootInformation]] = [[] for _ in range(BLOCKS)]
    for log in samples:
        for informations, used in zip(parts, block_masks(log)):
            informations.append(log.where(used).information())
    return tuple(combined(informations) for informations in parts)


def block_masks(log: DecimatedSamples) -> list[Mask]:
    """Return, per block, which rows (K,) of a log are in it."""
    rows = np.flatnonzero(np.any([np.isfinite(tau) for tau in log.tau], axis=0))
    rounds = int(max((log.time[-1] - log.time[0]) // (BLOCKS * 0.5 * LONGEST_STRETCH), 1))
    stretches, masks = blocks(len(rows), BLOCKS * rounds), []
    for block in range(BLOCKS):
        masks.append(np.zeros(len(log), dtype=bool))
        for stretch in stretches[block::BLOCKS]:
            masks[block][rows[stretch]] = True
    return masks


def _validation(
    joints: Sequence[str], wrong: Array, squares: Array, counts: Array, source: str
) -> Validation:
    def ratio(error: float, torque: float) -> float | None:
        return float(np.sqrt(error / torque)) if torque > 0.0 else None

    return Validation(
        source=source,
        n_samples=int(np.max(counts)),
        rmse=float(np.sqrt(np.sum(wrong) / np.sum(counts))),
        relative_error=ratio(float(np.sum(wrong)), float(np.sum(squares))),
        rmse_per_joint=dict(zip(joints, np.sqrt(wrong / np.maximum(counts, 1.0)).tolist())),
        relative_error_per_joint={j: ratio(*pair) for j, *pair in zip(joints, wrong, squares)},
    )
