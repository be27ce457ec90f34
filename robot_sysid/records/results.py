"""What an identification found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from robot_sysid.records.arm import Array, InertialParameters, check_arrays

DELAY_NAME = "delay"
"""Name of the parameter by which torque lags position."""


@dataclass(frozen=True)
class Identifiability:
    """What the equations can and cannot see of the ten inertial and the terminal joint's friction.

    Attributes:
        rank: number of identifiable combinations.
        condition_number: of the stacked regressor; of its identifiable part where that is smaller.
        scaled_condition_number: the same after scaling each column to unit length.
        identified: (p,) per parameter, whether the data alone determines it.
        unidentifiable: the combinations that do not show, in words, for instance "mass".
    """

    rank: int
    n_parameters: int
    condition_number: float
    scaled_condition_number: float
    identified: tuple[bool, ...]
    unidentifiable: tuple[str, ...]


@dataclass(frozen=True)
class Estimate:
    """Result of one solver run.

    Attributes:
        names: (p,) parameter names, as in the information.
        rmse, rmse_per_joint: root mean square torque residual, of all and by joint name [N m].
        covariance: (p, p), where one was computed; zero along directions the data cannot see.
        standard_errors: (p,) standard deviation of each value, all causes together; infinite where
            only the model's value is known.
        noise_per_joint: joint name to standard deviation of its torque noise [N m], where used.
        samples, effective_samples: joint name to the number of samples its equations used, and of
            the independent ones that its noise leaves.
        constrained: whether the plain estimate was replaced by the best possible rigid body.
    """

    names: tuple[str, ...]
    values: Array
    identifiability: Identifiability
    rmse: float
    rmse_per_joint: Mapping[str, float]
    method: str = "ols"
    covariance: Array | None = None
    standard_errors: Array | None = None
    noise_per_joint: Mapping[str, float] = field(default_factory=dict)
    samples: Mapping[str, int] = field(default_factory=dict)
    effective_samples: Mapping[str, float] = field(default_factory=dict)
    constrained: bool = False

    def __post_init__(self) -> None:
        check_arrays(self, values=(len(self.names),))

    @property
    def inertial(self) -> InertialParameters:
        """The ten inertial parameters."""
        return InertialParameters(self.values[:10])

    @property
    def independent_share(self) -> dict[str, float]:
        """Joint name to independent samples per sample; small where residuals change slowly."""
        return {
            joint: self.effective_samples[joint] / count
            for joint, count in self.samples.items()
            if count and joint in self.effective_samples
        }

    def value(self, name: str) -> float | None:
        """Return one parameter by name, or None where it was not estimated."""
        return (
            float(self.values[self.names.index(name)]) if name in self.names else None
        )

    def error(self, name: str) -> float | None:
        """Return the standard error of one parameter by name, or None where there is none."""
        if self.standard_errors is None or name not in self.names:
            return None
        return float(self.standard_errors[self.names.index(name)])


@dataclass(frozen=True)
class Validation:
    """Torque prediction error on data that was not fitted, of all joints and by joint name: root
    mean square [N m], and relative, ||tau - prediction|| / ||tau||, None where torque is zero; and
    whether the fitted data says enough of such a motion for the error to speak against the fit.
    """

    source: str
    n_samples: int
    rmse: float
    relative_error: float | None
    rmse_per_joint: Mapping[str, float]
    relative_error_per_joint: Mapping[str, float | None]
    is_informative: bool = True


def validation_of(
    joints: Sequence[str], wrong: Array, squares: Array, counts: Array, source: str
) -> Validation:
    """Return errors as a record, of sums (joints,) of squared errors and squared torque [N^2 m^2]
    over so many samples each.
    """

    def ratio(error: float, torque: float) -> float | None:
        return float(np.sqrt(error / torque)) if torque > 0.0 else None

    return Validation(
        source=source,
        n_samples=int(np.max(counts, initial=0)),
        rmse=float(np.sqrt(np.sum(wrong) / max(np.sum(counts), 1.0))),
        relative_error=ratio(float(np.sum(wrong)), float(np.sum(squares))),
        rmse_per_joint=dict(
            zip(joints, np.sqrt(wrong / np.maximum(counts, 1.0)).tolist())
        ),
        relative_error_per_joint={
            j: ratio(*pair) for j, *pair in zip(joints, wrong, squares)
        },
    )


@dataclass(frozen=True)
class WrongLink:
    """A link of the model that recordings contradict.

    Attributes:
        name: the body's.
        first_moment_of_model, first_moment: mass times distance of the centre of mass from the
            link's joint [kg m], in the model and as the recordings have it, along the model's
            direction.
        error: standard error of the latter [kg m].
    """

    name: str
    first_moment_of_model: float
    first_moment: float
    error: float


@dataclass(frozen=True)
class PriorConflict:
    """A cause of error, such as "links", that the data asks for more of than was thought.

    Attributes:
        members: whose numbers are off most, the worst first.
        asked: how far they are off, in units of what was allowed.
        scale: the factor by which the prior was widened; 1 where it was enough.
    """

    cause: str
    members: tuple[str, ...]
    asked: float
    scale: float


class Source(Enum):
    """What the torques of an identification come from, in words."""

    ITSELF = "simulation of the model itself"
    SIMULATED_ARM = "simulated plant"
    LOG = "log"


@dataclass(frozen=True)
class DataOrigin:
    """Where the data of an identification comes from, its duration [s] and sample rate [Hz].

    Attributes:
        detail: which file, say; added to the source's words.
        seed: of trajectory and simulated noise; None for a log.
        files: whole paths of the logs.
    """

    source: Source
    detail: str
    duration: float
    sample_rate: float
    seed: int | None = None
    files: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The source in words."""
        return f"{self.source.value} {self.detail}".rstrip()


OPEN = "open loop"
CLOSED = "closed loop"
"""Measured torques alone; a servo that holds the model near the measured motion, or commands."""


@dataclass(frozen=True)
class RolloutError:
    """Root mean square position errors of the two models (n,) [rad or m] over windows of a length
    (horizon [s]), loop ``OPEN`` or ``CLOSED``; how many windows of each ran away, which count with
    the largest error.
    """

    loop: str
    horizon: float
    windows: int
    before: Array
    after: Array
    diverged: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        check_arrays(self, before=(None,), after=(np.size(self.before),))

    @property
    def overall(self) -> tuple[float, float]:
        """The error of all joints together (before, after)."""
        before, after = (
            float(np.sqrt(np.mean(e**2))) for e in (self.before, self.after)
        )
        return before, after

    @property
    def ratio(self) -> float | None:
        """Error of all joints, after by before; None where there was none before."""
        before, after = self.overall
        return after / before if before > 0.0 else None


@dataclass(frozen=True)
class RolloutTest:
    """The old and the new model, played on pieces of the logs that were not fitted.

    Attributes:
        held_out, servo: which pieces, and what held the model in closed loop, in words.
        errors: one per loop and horizon that could be played.
        notes: what could not be, one sentence each.
    """

    joint_names: tuple[str, ...]
    held_out: str
    servo: str
    errors: tuple[RolloutError, ...]
    notes: tuple[str, ...] = ()

    @property
    def score(self) -> float | None:
        """Geometric mean of the ratios of all loops and horizons; None where nothing was played."""
        ratios = [error.ratio for error in self.errors]
        known = [max(ratio, 1e-12) for ratio in ratios if ratio is not None]
        return float(np.exp(np.mean(np.log(known)))) if known else None

    @property
    def is_better(self) -> bool:
        """Whether the new model moves more like the arm."""
        return self.score is not None and self.score < 1.0
