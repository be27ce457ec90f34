"""Rehearsals of whole arms by the command line, and what identification makes of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rigs.arms.walk import run_here
from rigs.files.params import rows
from rigs.files.places import EXAMPLE, MODELS
from robot_sysid.records.quantities import BEYOND

FAST = 400.0
"""Rate above which seven motors need CAN-FD [Hz]."""


@dataclass(frozen=True)
class Arm:
    """A model, the option of its terminal joint if it needs one, and its motors, base first."""

    model: Path
    joint: str
    motors: tuple[str, ...]


_OPENARM_MOTORS = ("DM8009",) * 2 + ("DM4340",) * 2 + ("DM4310",) * 2 + ("DM3507",)
ARMS = {
    "openarm": Arm(
        MODELS / "openarm_v2" / "openarm_bimanual.xml",
        "--joint openarm_left_joint7",
        _OPENARM_MOTORS,
    ),
    "kinova": Arm(
        EXAMPLE / "model" / "kinova_fullinertia.xml",
        "",
        ("DM8009",) * 4 + ("DM4340",) * 3,
    ),
    "wxai": Arm(
        MODELS / "trossen" / "wxai" / "wxai_base.xml",
        "--joint joint_5",
        ("DM4340",) * 3 + ("DM4310",) * 3,
    ),
}


@dataclass(frozen=True)
class Estimate:
    """A number that was identified, its truth and its ±."""

    name: str
    truth: float
    value: float
    standard_error: float

    @property
    def stated_errors(self) -> float:
        """How many of its ± it is off."""
        return (self.value - self.truth) / self.standard_error


def plan(arm: Arm, folder: Path, duration: float) -> Path:
    """Return the exported trajectory that excites the whole arm."""
    types = " ".join(f"--motor-type {motor}" for motor in arm.motors)
    motion = f"--for arm --excitation sines --duration {duration} --seed 0 --output-dir {folder}"
    run(f"plan {arm.model} {arm.joint} --export-damiao {types} {motion}")
    return folder / "damiao_trajectory.csv"


def rehearse(arm: Arm, trajectory: Path, rate: float, folder: Path) -> list[Estimate]:
    """Play a trajectory at a rate [Hz], identify the arm, and return what was found."""
    record = folder / f"measured_{rate:g}.csv"
    identified = folder / f"identified_{rate:g}"
    fd = "--fd" * (rate > FAST)
    # What is found is compared with the model, so that the arm is exactly that.
    model = f"--model {arm.model} {arm.joint} --plant-model {arm.model}"
    run(f"motors simulate {trajectory} {model} --record {record} --rate {rate} {fd}")
    run(f"identify {arm.model} {record} {arm.joint} --output-dir {identified}")
    return list(estimates(json.loads((identified / "params.json").read_text())))


def estimates(result: dict) -> Iterator[Estimate]:
    """Yield rotors, friction and masses of the arm out of params.json."""
    for (owner, name), row in rows(result).items():
        is_wanted = name in ("armature", "viscous", "coulomb", "mass")
        if is_wanted and row["error"] and owner != BEYOND:
            truth = row["model"] or 0.0
            yield Estimate(f"{name} of {owner}", truth, row["value"], row["error"])


def run(line: str) -> None:
    """Run a command of robot-sysid; SystemExit with what it printed where it fails."""
    code, output = run_here(f"robot-sysid {line}")
    # Identification with code 1 has numbers too.
    if code not in (0, 1):
        raise SystemExit(output)
