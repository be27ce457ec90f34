"""How much of a CAN bus a stream of commands and replies takes.

Every control cycle puts two frames of eight bytes on the bus per motor: the command and its reply.
An 8-byte standard frame has 44 + 64 bits of frame and 3 bits of gap, and at worst one stuff bit for
every four of the 34 + 64 bits that are stuffed. CAN-FD sends the arbitration part at the nominal
and the rest at the data bit rate.
"""

from __future__ import annotations

from dataclasses import dataclass

from robot_sysid.records.options import OptionRecord, option, positive

PLANNING_LIMIT = 0.70
HANDY_RATES = (1000.0, 500.0, 250.0, 200.0, 125.0, 100.0, 50.0, 40.0, 25.0, 20.0, 10.0)
"""Cycle rates to propose [Hz], highest first."""
_FRAMES_PER_CYCLE = 2
_CLASSIC_BITS = 111 + 24
_FD_NOMINAL_BITS = 30 + 4
_FD_DATA_BITS = 96 + 17
_CLASSIC_RATE_HZ, _FD_RATE_HZ = 250.0, 500.0


@dataclass(frozen=True)
class BusTiming(OptionRecord):
    """Bit rates of a bus."""

    fd: bool = option(False, "use CAN-FD frames")
    bitrate: float = option(
        1e6, "nominal bit rate", unit="bit/s", metavar="RATE", check=positive, usual="1000000"
    )
    data_bitrate: float = option(
        5e6,
        "bit rate of the data part of CAN-FD frames",
        unit="bit/s",
        metavar="RATE",
        check=positive,
        usual="5000000",
    )

    @property
    def frame_time(self) -> float:
        """Longest time one 8-byte frame occupies the bus [s]."""
        if not self.fd:
            return _CLASSIC_BITS / self.bitrate
        return _FD_NOMINAL_BITS / self.bitrate + _FD_DATA_BITS / self.data_bitrate

    @property
    def name(self) -> str:
        """How messages call this bus."""
        return "CAN-FD" if self.fd else "classic CAN"


def bus_load(n_motors: int, rate: float, timing: BusTiming) -> float:
    """Return the worst-case share of the bus that n motors at ``rate`` [Hz] take (1 = full)."""
    return n_motors * _FRAMES_PER_CYCLE * timing.frame_time * rate


def highest_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the highest cycle rate [Hz] that keeps the bus load at or below 70 %."""
    return PLANNING_LIMIT / (n_motors * _FRAMES_PER_CYCLE * timing.frame_time)


def default_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the cycle rate to use [Hz]: 250 (classic) or 500 (FD), less where it does not fit."""
    wanted = _FD_RATE_HZ if timing.fd else _CLASSIC_RATE_HZ
    top = highest_rate(n_motors, timing)
    return wanted if top >= wanted else suggested_rate(n_motors, timing)


def suggested_rate(n_motors: int, timing: BusTiming) -> float:
    """Return the highest handy rate [Hz] that the bus can carry for n motors."""
    top = highest_rate(n_motors, timing)
    return next((rate for rate in HANDY_RATES if rate <= top), top)
