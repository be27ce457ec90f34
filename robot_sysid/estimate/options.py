"""The user's options of an estimate, and what is known of arms before any data (``Priors``)."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Optional

import robot_sysid.records.usual_errors as usual_errors
from robot_sysid.errors import InputError
from robot_sysid.records.file_access import read_json, read_toml
from robot_sysid.records.option_fields import (
    OptionRecord,
    PerJoint,
    option,
    options_of,
    record_from,
)
from robot_sysid.wording import option_name, option_setting

TORQUE_CHOICES = ("chain", "terminal")
"""Values of the option ``torques``: equations of all joints that carry the terminal link, or of
the last joint only."""
DEFAULT_TERMINAL = "coulomb-viscous-offset"
"""Friction model of one joint's torque where no option names another; it has no rotor inertia,
which this torque does not tell from the inertia of the link."""
DEFAULT_FRICTION = f"{DEFAULT_TERMINAL}-armature"
"""Friction model of the torques of all joints where no option names another."""

# Names of the parts of a model file that may stay as they are (``Question.unchanged_parts``).
# Friction of joints and motors.
FILE_FRICTION = "friction"
# Rotor inertia.
FILE_ROTORS = "rotors"
# Direction of gravity.
FILE_GRAVITY = "gravity"
# All links but the terminal one.
FILE_LINKS = "links"


@dataclass(frozen=True)
class Priors(OptionRecord):
    """How wrong arms, models and sensors usually are: standard deviations of priors.

    A file of ``--priors`` has these names as keys. docs/options.md says where each was seen.
    """

    link: float = option(
        usual_errors.LINK,
        "how well the model knows the other links: their mass, their centre of mass as part of "
        "their size, half of what their inertia is off by",
        "P [%] >= 0",
    )
    scale: Optional[PerJoint] = option(
        None,
        "how far each joint's torque scale may be off, one number or one per joint",
        "P [%] >= 0",
        default_text="2; 3 of payloads, 40 with a known mass; what a file of torque scales says of "
        "itself",
    )
    common_scale: float = option(
        0.0,
        "how far all torque scales may be off together",
        "P [%] >= 0",
        default_text="0, as in most sensors, or what the factor of torques says of itself",
    )
    zero: float = option(
        usual_errors.ZERO,
        "how far each joint's zero position may be off",
        "P [mrad] >= 0",
    )
    gravity: float = option(
        usual_errors.GRAVITY,
        "how far the base may be tilted against gravity",
        "P [deg] >= 0",
    )
    delay: float = option(
        usual_errors.DELAY,
        "how late or early the torque may be beside the position",
        "P [ms] >= 0",
    )
    friction: float = option(
        usual_errors.LOAD_LOSS,
        "how much friction may grow with the torque of the gear where the friction model has no "
        "term for it; it may also bend with speed, by twenty times that part of its dry friction",
        "P [%] >= 0",
    )
    noise: Optional[PerJoint] = option(
        None,
        "of a plan: noise of the torques to expect, one number or one per joint",
        "P [N·m] > 0",
        default_text="0.3",
    )
    file: Optional[Path] = None

    def __str__(self) -> str:
        """Return the file that the priors were read from, as it is typed."""
        return str(self.file or "")


def read_priors(path: str | os.PathLike[str]) -> Priors:
    """Return the priors in a TOML or JSON file; those that it does not name have their defaults.

    InputError where the file cannot be read, or has a key or value that is no prior's.
    """
    path = Path(path)
    if path.suffix == ".json":
        content = read_json(path, "a file of priors is JSON or TOML")
    else:
        content = read_toml(path)
    try:
        return replace(priors_of(content), file=path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def priors_of(content: object) -> Priors:
    """Return the priors in a table of numbers by name; InputError where it is no such table."""
    names = options_of(Priors)
    form = f"priors are numbers by these names: {', '.join(names)}"
    if not isinstance(content, Mapping):
        raise InputError(f"there is no table; {form}")
    for key in content:
        if key not in names:
            raise InputError(f"there is no prior {key!r}; {form}")
    try:
        return record_from(Priors, content)
    except InputError as error:
        raise InputError(f"{str(error).lstrip('-')}; {form}") from None


@dataclass(frozen=True)
class EstimationOptions(OptionRecord):
    """Options of the user: how parameters are estimated from torques.

    Each field's text says what it means. ``cutoff`` of the low-pass that all signals go through
    [Hz] is no option; None chooses it from the data.
    """

    torques: str = option(
        "chain",
        "use the torques of all joints that carry the link, or of the last joint only",
        choices=TORQUE_CHOICES,
    )
    no_friction: bool = option(
        False, "leave friction out and identify the 10 inertial parameters only"
    )
    friction_model: Optional[str] = option(
        None,
        f"friction terms of every joint, such as {DEFAULT_TERMINAL}",
        "TERMS",
        default_text=f"{DEFAULT_FRICTION}, and what priors allow for; of the last joint's torque "
        f"alone {DEFAULT_TERMINAL}",
    )
    priors: Priors = option(
        Priors(),
        "file that says how wrong model and sensors may be",
        "FILE",
        parse=read_priors,
        default_text="as usual arms are",
    )
    keep: tuple[str, ...] = option(
        (),
        "leave this of the model as it is: friction or rotor inertia of its joints, gravity, or "
        "all links but the terminal one; may be repeated",
        choices=(FILE_FRICTION, FILE_ROTORS, FILE_GRAVITY, FILE_LINKS),
        repeats=True,
    )
    cutoff: Optional[float] = None

    def __post_init__(self) -> None:
        """Check each value, that the friction model exists, and that options do not conflict.

        Raises:
            InputError: a check failed.
        """
        super().__post_init__()
        # A program may give a file's path or a table.
        if not isinstance(self.priors, Priors):
            is_file = isinstance(self.priors, os.PathLike)
            priors = (read_priors if is_file else priors_of)(self.priors)
            object.__setattr__(self, "priors", priors)
        if self.no_friction:
            for name, is_given in (
                (option_name("friction_model"), self.friction_model is not None),
                (option_setting("keep", FILE_FRICTION), FILE_FRICTION in self.keep),
            ):
                if is_given:
                    raise InputError(
                        f"{name} and {option_name('no_friction')} exclude each other"
                    )
        if self.friction_model is not None:
            friction_terms(str(self.friction_model))

    @property
    def friction(self) -> tuple[str, ...]:
        """Friction terms of every joint; none with the option ``no_friction``."""
        if self.no_friction:
            return ()
        return friction_terms(self.friction_model or self._default_friction)

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the parts of a model file that stay as they are, sorted."""
        friction = (FILE_FRICTION, FILE_ROTORS) if self.no_friction else ()
        return tuple(sorted({*self.keep, *friction}))

    @property
    def _default_friction(self) -> str:
        """Friction model where no option names one."""
        return DEFAULT_TERMINAL if self.torques == "terminal" else DEFAULT_FRICTION

    @property
    def left_out_terms(self) -> tuple[str, ...]:
        """Terms of the default friction model that the user's own friction model lacks.

        Dry friction that reverses smoothly is no lack of Coulomb friction.
        """
        from robot_sysid.dynamics.friction import COULOMB, TERMS

        given = {*self.friction}
        if any(TERMS[name].is_coulomb for name in given):
            given.add(COULOMB.name)
        default = friction_terms(self._default_friction)
        return tuple(term for term in default if term not in given)


def friction_terms(name: str) -> tuple[str, ...]:
    """Return the terms of a friction model: "none", or names joined by "-" or "+".

    A leading "+" adds terms to the default, so "+sqrt" is "coulomb-viscous-offset-armature-sqrt".

    Raises:
        InputError: a term is unknown, or named twice.
    """
    # Options do not wait for numpy.
    from robot_sysid.dynamics.friction import CHOICES

    terms = () if name == "none" else tuple(re.split(r"[-+]", name.lstrip("+")))
    if name.startswith("+"):
        default = DEFAULT_FRICTION.split("-")
        terms = (*default, *(term for term in terms if term not in default))
    for term in terms:
        if term not in CHOICES:
            raise InputError(
                f"unknown friction term {term!r} in {name!r}; join any of {', '.join(CHOICES)} "
                f"with '-', as in {DEFAULT_FRICTION}, or use none"
            )
    if len(set(terms)) != len(terms):
        raise InputError(
            f"friction terms {list(terms)} name a term twice; use each once"
        )
    return terms
