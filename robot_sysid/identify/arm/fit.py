"""The fit of every link: which columns, which weight of the model, and what comes out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.friction import friction_model
from robot_sysid.dynamics.gravity import TILT_NAMES
from robot_sysid.errors import InputError
from robot_sysid.estimation.arm.consistent_links import LinksProblem
from robot_sysid.estimation.arm.fits import (
    Columns,
    LinkFits,
    first_noise,
    is_clearly_lower,
)
from robot_sysid.estimation.arm.options import ArmOptions
from robot_sysid.estimation.cross_validation import blocks
from robot_sysid.estimation.information import combined, sample_counts
from robot_sysid.identify.arm.columns import ArmColumns
from robot_sysid.identify.arm.couplings import (
    Coupling,
    neighbours,
    read_couplings,
)
from robot_sysid.identify.samples import DecimatedSamples, joined
from robot_sysid.records import Array, RobotModel, Validation
from robot_sysid.records.progress import Progress
from robot_sysid.signals.process import ProcessedSignals

BLOCKS = 5
"""Into how many stretches of time each log is cut."""
GAMMAS = (1e3, 3e2, 1e2, 3e1, 1e1, 3.0, 1.0, 0.3, 0.1, 0.01, 1e-3)
"""Weights of the model that are tried."""
CANDIDATES = (
    "coulomb-offset-armature",
    "coulomb-viscous-offset-armature",
    "coulomb-viscous-offset-armature-sqrt",
    "coulomb-viscous-offset-armature-stribeck",
    "coulomb-viscous-offset-armature-load",
    "coulomb-viscous-offset-armature-sqrt-load",
    "coulomb-viscous-offset-armature-stribeck-load",
)
"""Friction models that are tried, the same for every arm, simplest first."""
BASIC = CANDIDATES[1]
MOST_LOAD_LOSS = 0.2
"""Largest share of its torque that a gear may lose."""
_FIRST_GAMMA, _ROUNDS, _SETTLED = 1.0, 3, 1e-3
# A coupling or a further term has to lower the held-out squared error by this share, and by this
# many standard errors.
_CLEAR_SHARE, _CLEARLY = 0.1, 2.0
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
        friction: name of the friction model.
        couplings: motors that turn with several joints.
        gamma: weight of the model.
        choices: friction model to held-out root mean square error [N m].
        held_out: (blocks, joints) squared error of what was predicted from the rest.
        samples: the fitted samples.
    """

    columns: ArmColumns
    fits: LinkFits
    kept: Columns
    values: Array
    thetas: Array
    friction: str
    couplings: tuple[Coupling, ...]
    gamma: float
    choices: Mapping[str, float]
    held_out: Array
    samples: tuple[DecimatedSamples, ...]

    def validation(self, source: str) -> Validation:
        """Return the error on stretches that were predicted from the others."""
        squares = np.sum([each.squared_torque() for each in self.samples], axis=0)
        counts = np.sum([sample_counts(part) for part in self.fits.parts], axis=0)
        return _validation(
            self.samples[0].joints, self.held_out.sum(axis=0), squares, counts, source
        )

    def validate_on(
        self,
        robot: RobotModel,
        signals: Sequence[ProcessedSignals],
        source: str,
        used: Mask | None = None,
    ) -> Validation:
        """Return the error on another log, or on other rows (K,) of a fitted one."""
        columns = ArmColumns(robot, signals, self.couplings)
        samples = joined(columns.samples(self.thetas))
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
        self._friction = (
            BASIC if options.friction is None else friction_model(options.friction).name
        )
        self._gamma = options.model_weight or _FIRST_GAMMA
        self._choices: Mapping[str, float] = {}
        self._comparing = False
        self._thetas = np.array([link.theta for link in robot.links])
        self._values = self._columns.prior
        self._noise: Array | None = None

    def settle(self, rounds: int = _ROUNDS) -> None:
        """Fit and make the columns anew until the links do not move any more."""
        for _ in range(rounds):
            self._fit()
            before, self._thetas = self._thetas, self._columns.thetas(self._values)
            scale = np.linalg.norm(before, axis=0) + 1e-12
            if np.max(np.abs(self._thetas - before) / scale) < _SETTLED:
                break

    def _fit(self) -> None:
        self._fits = self._data()
        self._fits, self._values = self._fits.weighed(self._kept(), self._gamma)
        self._noise = self._fits.noise

    def _data(self) -> LinkFits:
        """Return the data around the links as they are known now."""
        self._samples = tuple(self._columns.samples(self._thetas, self._needs_load()))
        if self._used is not None:
            self._samples = tuple(s.where(m) for s, m in zip(self._samples, self._used))
        parts = _blocks(self._samples)
        noise = first_noise(parts) if self._noise is None else self._noise
        return LinkFits(parts, self._problem(), self._known(), noise)

    def _needs_load(self) -> bool:
        return self._comparing or "load" in friction_model(self._friction).terms

    def choose_couplings(self) -> None:
        """Let neighbours share a motor where that predicts held-out torques clearly better."""
        offered = {each.name: each for each in self._offered if not self._couplings}
        best = self._rough_scores(self._couplings)
        while offered:
            trials = {k: self._rough_scores((*self._couplings, c)) for k, c in offered.items()}
            found = min(trials, key=lambda name: float(np.mean(trials[name])))
            if not is_clearly_lower(trials[found], best, _CLEAR_SHARE, _CLEARLY):
                break
            best = trials[found]
            self._couplings = (*self._couplings, offered.pop(found))
        self._columns = self._columns.with_couplings(self._couplings)
        self._comparing = self._options.friction is None
        self.settle(1)
        self._comparing = False

    def _rough_scores(self, couplings: Sequence[Coupling]) -> Array:
        kept = self._kept(couplings=couplings)
        return self._fits.scores(self._fits.roughly_held_out(kept, self._gamma))

    def choose_friction(self) -> None:
        """Take further friction terms as long as they predict held-out torques clearly better."""
        if self._options.friction is not None:
            return
        squared = {k: self._fits.held_out(self._kept(k), (self._gamma,))[0] for k in CANDIDATES}
        scores = {name: self._fits.scores(each) for name, each in squared.items()}
        total = sum(np.sum(sample_counts(part)) for part in self._fits.parts)
        self._choices = {k: float(np.sqrt(each.sum() / total)) for k, each in squared.items()}
        chosen = CANDIDATES[0]
        while True:
            here = scores[chosen]
            better = [
                name
                for name in CANDIDATES
                if is_clearly_lower(scores[name], here, _CLEAR_SHARE, _CLEARLY)
            ]
            if not better:
                break
            fewest = min(len(friction_model(name).terms) for name in better)
            short = [name for name in better if len(friction_model(name).terms) == fewest]
            chosen = min(short, key=lambda name: float(np.mean(scores[name])))
        self._friction = chosen
        self.settle(2)

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
            friction=self._friction,
            couplings=self._couplings,
            gamma=self._gamma,
            choices=self._choices,
            held_out=self._fits.held_out(kept, (self._gamma,))[0],
            samples=self._samples,
        )

    def _kept(
        self, friction: str | None = None, couplings: Sequence[Coupling] | None = None
    ) -> Columns:
        """Return which parameters (k,) a choice of friction and couplings has."""
        chosen = self._couplings if couplings is None else couplings
        terms = friction_model(friction or self._friction).terms
        motors = {each.name for each in chosen}
        kept = []
        for index, name in enumerate(self._columns.names):
            term, _, place = name.partition("[")
            is_own = place[:-1] in self._robot.joint_names or place[:-1] in motors
            known = term == "zero" or name in TILT_NAMES
            if (
                not place
                and not known
                or term in terms
                and is_own
                or known
                and np.isfinite(self._known()[index])
            ):
                kept.append(index)
        return np.array(kept)

    def _known(self) -> Array:
        """Return (p,) standard deviation of what is known of zeros and tilt beforehand."""
        sigma = np.full(len(self._columns.names), np.inf)
        for index, name in enumerate(self._columns.names):
            if name.startswith("zero["):
                sigma[index] = 1e-3 * self._options.zero_uncertainty or np.inf
            elif name in TILT_NAMES:
                sigma[index] = np.radians(self._options.gravity_uncertainty) or np.inf
        return sigma

    def _problem(self) -> LinksProblem:
        names = self._columns.names
        lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        free = {"offset", "sqrt", "zero"} | set(TILT_NAMES)
        if "sqrt" in friction_model(self._friction).terms:
            free.add("viscous")
        for index, name in enumerate(names):
            term, bracket, _ = name.partition("[")
            if bracket and term not in free:
                lower[index] = 0.0
                upper[index] = MOST_LOAD_LOSS if term == "load" else np.inf
        links = tuple(place for _, place in self._columns.links())
        told = [name.startswith("armature[") or "[" not in name for name in names]
        return LinksProblem(links, np.where(told, self._columns.prior, 0.0), lower, upper)


def _blocks(samples: Sequence[DecimatedSamples]) -> tuple:
    """Return the information of each block: the same stretch of every log together."""
    parts = []
    for block in range(BLOCKS):
        informations = []
        for log in samples:
            rows = np.flatnonzero(np.any([np.isfinite(tau) for tau in log.tau], axis=0))
            used = np.zeros(len(log), dtype=bool)
            used[rows[blocks(len(rows), BLOCKS)[block]]] = True
            informations.append(log.where(used).information())
        parts.append(combined(informations))
    return tuple(parts)


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
