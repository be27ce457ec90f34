"""Which motion an arm moves along, and how finely it is sampled: options, checked once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.records.options import OptionRecord, option, speed_factor, whole_number

MOST_SAMPLES = 1e9
"""Samples of a run; more would take days."""


@dataclass(frozen=True)
class TrajectoryOptions(OptionRecord):
    """Which trajectory the arm moves along, and how finely it is sampled."""

    duration: float = option(
        15.0, "length; longer gives better conditioning", "[s] > 0"
    )
    sample_rate: float = option(
        1000.0, "samples per second; higher gives more equations", "RATE [Hz] > 0"
    )
    seed: int | None = option(
        None,
        "seed of the random trajectory and of simulated noise",
        ">= 0",
        parse=whole_number,
        usual="a fresh one",
    )
    speed: float = option(
        1.0, "slow the whole motion down, for a first run", "FACTOR", check=speed_factor
    )
    file: Path | None = option(
        None, "use a trajectory that was saved", "FILE", flag="--trajectory"
    )
    save: Path | None = option(
        None,
        "write the trajectory as JSON (coefficients), and as CSV (samples) beside it",
        "FILE",
        flag="--save-trajectory",
    )
    plan_only: bool = option(False, "make, check and write the trajectory, then stop")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.duration * self.sample_rate < 1.0:
            raise InputError(
                "--duration times --sample-rate gives less than two samples; raise one of them"
            )
        require_countable(self.duration / self.speed, self.sample_rate)


def require_countable(duration: float, rate: float) -> None:
    """Raise InputError where a trajectory of a duration [s] has too many samples at a rate [Hz]."""
    if not duration * rate <= MOST_SAMPLES:
        raise InputError(
            f"a trajectory of {duration:.3g} s with --sample-rate {rate:g} has "
            f"{duration * rate:.3g} samples, more than the {MOST_SAMPLES:.0e} a run can take; "
            "shorten it, raise --speed where that slows it down, or lower the rate"
        )
