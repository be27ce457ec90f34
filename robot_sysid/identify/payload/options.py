"""What the payload command is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from robot_sysid.errors import InputError
from robot_sysid.records.options import OptionRecord, option, positive

EMPTY, LOADED = "A", "B"
"""Letters of ``--order``."""


@dataclass(frozen=True)
class PayloadOptions(OptionRecord):
    """Which recordings are empty and which are loaded, and what is wanted of the payload."""

    empty: tuple[Path, ...] = option(
        (), "logs of the arm without the payload", metavar="LOG", several=True
    )
    loaded: tuple[Path, ...] = option(
        (), "logs of the arm with the payload", metavar="LOG", several=True
    )
    empty_model: Path | None = option(
        None, "instead of logs: model that plays the arm without the payload", metavar="XML"
    )
    loaded_model: Path | None = option(
        None, "instead of logs: model that plays the arm with the payload", metavar="XML"
    )
    order: str | None = option(
        None,
        "order in which the logs were recorded, A for the next empty one and B for the next "
        "loaded one, such as ABBA; a drift of friction is then estimated",
        metavar="LETTERS",
        usual="from the logs' clock, where they share one",
    )
    flange: str | None = option(
        None,
        "frame of the payload: a site or body fixed to the terminal body, or x,y,z in metres",
        metavar="FRAME",
        usual="found by its name, else the terminal body's",
    )
    as_body: str | None = option(
        None,
        "write the payload as a welded body of this name instead of merging it into the terminal "
        "link",
        metavar="NAME",
    )
    known_mass: float | None = option(
        None,
        "the payload is a weight of this mass: estimate each joint's torque scale with it",
        unit="kg",
        metavar="KG",
        check=positive,
    )
    scale_prior: float | None = option(
        None,
        "with --known-mass, how far each joint's torque scale may be off",
        unit="%",
        metavar="P",
        check=positive,
        usual="3",
    )
    save_torque_scale: Path | None = option(
        None, "with --known-mass, write the scales as a file for --torque-scale", metavar="FILE"
    )
    static: bool = option(
        False, "use resting poses only, each approached from both sides: mass and centre of mass"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        logs = bool(self.empty or self.loaded)
        models = self.empty_model is not None or self.loaded_model is not None
        if logs and models:
            raise InputError("logs and --empty-model, --loaded-model exclude each other")
        if logs and not (self.empty and self.loaded):
            missing = "--empty" if self.loaded else "--loaded"
            raise InputError(
                f"{missing} is missing: a payload is found from the difference between logs "
                "without and with it"
            )
        if not logs and (self.empty_model is None or self.loaded_model is None):
            raise InputError(
                "give --empty LOG... and --loaded LOG..., or --empty-model and --loaded-model "
                "to simulate both"
            )
        self._check_order()
        for flag, given in (
            ("--scale-prior", self.scale_prior),
            ("--save-torque-scale", self.save_torque_scale),
        ):
            if given is not None and self.known_mass is None:
                raise InputError(f"{flag} is about torque scales; add --known-mass KG")
        if self.known_mass is not None and self.as_body is not None:
            raise InputError("--known-mass writes no model; leave --as-body out")

    def _check_order(self) -> None:
        if self.order is None:
            return
        wanted = EMPTY * len(self.empty) + LOADED * len(self.loaded)
        if sorted(self.order) != sorted(wanted):
            raise InputError(
                f"--order {self.order}: needs {len(self.empty)} times A (the empty logs) and "
                f"{len(self.loaded)} times B (the loaded ones), such as {wanted}"
            )
