"""What a user may choose about the estimation besides the method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robot_sysid.errors import InputError

CONSISTENCY_CHOICES = ("auto", "enforce", "off")
PRIOR_CHOICES = ("none", "entropic")


@dataclass(frozen=True)
class EstimatorOptions:
    """Choices that apply to every method.

    Attributes:
        consistency: "off" (default) takes the plain estimate, "enforce" the best possible rigid
            body, "auto" the plain estimate unless it is not a possible rigid body.
        prior: "none", or "entropic" to pull towards the model's body by the log-det divergence.
        prior_weight: how strongly; 1 counts one unit of divergence like one squared residual of
            one noise standard deviation.
        nonnegative: names of parameters that are kept at or above zero, such as friction.
        huber_threshold: of the robust method: residuals beyond so many noise standard deviations
            lose weight; 1.345 costs 5 % efficiency where there are no outliers (Huber 1964).
        max_iterations: of methods that find their weights by iteration.
    """

    consistency: str = "off"
    prior: str = "none"
    prior_weight: float = 1.0
    nonnegative: tuple[str, ...] = ()
    huber_threshold: float = 1.345
    max_iterations: int = 30

    def __post_init__(self) -> None:
        _one_of("--consistency", self.consistency, CONSISTENCY_CHOICES)
        _one_of("--prior", self.prior, PRIOR_CHOICES)
        _positive("--prior-weight", self.prior_weight)
        _positive("the Huber threshold", self.huber_threshold)
        if self.max_iterations < 1:
            raise InputError(f"at least 1 iteration is needed, got {self.max_iterations}")

    @property
    def entropic_weight(self) -> float:
        """Weight of the divergence from the model's body; 0 without a prior."""
        return self.prior_weight if self.prior == "entropic" else 0.0


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise InputError(f"{name} {value!r} is unknown; valid: {', '.join(choices)}")


def _positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{name} must be a positive number, got {value}")
