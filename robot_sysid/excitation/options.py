"""What an optimised excitation was asked to be: one frozen record, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from robot_sysid.collision.halfspaces import Box, Plane
from robot_sysid.errors import InputError
from robot_sysid.excitation.fourier import FourierBasis
from robot_sysid.excitation.information import CRITERIA
from robot_sysid.records.options import require_positive

ENDS = ("faded", "periodic")
LONGEST_FADE = 1.5
"""Fade of a faded trajectory [s]; shorter where the trajectory is short."""
TOP_FREQUENCY_HZ = 0.6
"""Highest frequency where --harmonics leaves the choice to us: that of the random sinusoids."""
FEWEST_HARMONICS = 3


@dataclass(frozen=True)
class ExcitationOptions:
    """Options of an optimised excitation; defaults are those of the command line.

    Attributes:
        criterion: "A", "D" or "cond".
        duration: trajectory length [s].
        sample_rate: samples per second of the data to come [Hz]; also how densely limits are
            checked, at least 1 kHz.
        harmonics: number of harmonics K; None takes what reaches 0.6 Hz.
        base_frequency: frequency of the first harmonic [Hz]; None takes 1 / duration.
        ends: "faded" or "periodic".
        max_acceleration: limit of every hinge joint [rad/s^2]; None takes what a motion at the
            speed limit and the highest frequency needs.
        max_torque: limit of every joint beside the model's own [N m]; one number, one per joint,
            or none.
        noise_torque: standard deviation of the torque noise [N m]; one number or one per joint.
        clearance: least distance between bodies that are apart at rest [m].
        workspace: box the terminal link must stay in.
        keep_out: planes no moving part may cross.
        torques: "chain" or "terminal": which joint torques will be used.
        time_budget: the search is cut after this time [s].
        draws: number of random trajectories to begin with.
        starts: how many of the best are improved; None takes two per minute of budget, at least 2.
        rounds: improvement rounds per start.
        iterations: optimiser iterations per round.
        workers: processes to use; 1 stays in this one.
    """

    criterion: str = "D"
    duration: float = 15.0
    sample_rate: float = 1000.0
    harmonics: int | None = None
    base_frequency: float | None = None
    ends: str = "faded"
    max_acceleration: float | None = None
    max_torque: tuple[float, ...] = ()
    noise_torque: tuple[float, ...] = (0.3,)
    clearance: float = 0.01
    workspace: Box | None = None
    keep_out: tuple[Plane, ...] = ()
    torques: str = "chain"
    time_budget: float = 60.0
    draws: int = 300
    starts: int | None = None
    rounds: int = 8
    iterations: int = 60
    workers: int = 1

    def __post_init__(self) -> None:
        _require_choice(self.criterion, tuple(CRITERIA), "--criterion")
        _require_choice(self.ends, ENDS, "--excitation-ends")
        _require_choice(self.torques, ("chain", "terminal"), "--torques")
        self._require_numbers()
        self._require_counts()
        self.basis()

    def _require_numbers(self) -> None:
        require_positive(self.duration, "--duration")
        require_positive(self.sample_rate, "--sample-rate")
        require_positive(self.time_budget, "--excitation-time-budget")
        for value, option in (
            (self.base_frequency, "--base-frequency"),
            (self.max_acceleration, "--max-acceleration"),
        ):
            if value is not None:
                require_positive(value, option)
        for values, option in (
            (self.noise_torque, "--noise-torque"),
            (self.max_torque, "--max-torque"),
        ):
            for value in values:
                require_positive(value, option)
        if not self.noise_torque:
            raise InputError("--noise-torque needs at least one number")
        if not (self.clearance >= 0.0 and math.isfinite(self.clearance)):
            raise InputError(f"--clearance must not be negative (got {self.clearance:g})")

    def _require_counts(self) -> None:
        least = {"draws": 1, "rounds": 0, "iterations": 1, "workers": 1}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise InputError(f"{name} must be at least {value} (got {getattr(self, name)})")

    def basis(self) -> FourierBasis:
        """Return the Fourier basis these options describe."""
        base = 1.0 / self.duration if self.base_frequency is None else self.base_frequency
        reaching = int(np.floor(TOP_FREQUENCY_HZ / base + 1e-9))
        chosen = max(FEWEST_HARMONICS, reaching) if self.harmonics is None else self.harmonics
        fade = min(LONGEST_FADE, 0.25 * self.duration) if self.ends == "faded" else 0.0
        return FourierBasis(self.duration, base, chosen, fade)

    @property
    def n_starts(self) -> int:
        """How many of the best random trajectories are improved."""
        per_budget = 2 * max(1, round(self.time_budget / 60.0))
        return per_budget if self.starts is None else self.starts


def per_joint(values: tuple[float, ...], joints: int, option: str) -> np.ndarray:
    """Return one value per joint of an option that takes one number or one per joint."""
    if len(values) not in (1, joints):
        raise InputError(
            f"{option} takes one number, or one for each of the {joints} joints (got {len(values)})"
        )
    return np.broadcast_to(np.asarray(values, dtype=float), (joints,)).copy()


def _require_choice(value: str, choices: tuple[str, ...], option: str) -> None:
    if value not in choices:
        raise InputError(f"{option} {value}: choose one of {', '.join(choices)}")
