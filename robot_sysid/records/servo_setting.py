"""What a recording of servos was made with: gain register, supply voltage and load.

Recordings of one servo with several settings tell apart what follows the setting, such as the gain,
and what does not, such as friction. A setting is typed as ``kp=400, voltage=7.4, load=0.2 at 0 0
-0.1``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from robot_sysid.errors import InputError

FORM = "kp=REGISTER, voltage=V, load=KG at X Y Z"
"""How a setting is typed."""
_LOAD_FIELDS = ("load_mass", "load_position", "load_distance", "is_whole_link")


@dataclass(frozen=True)
class ServoSetting:
    """What a recording of servos was made with; None for what is not known.

    Attributes:
        register: the servos' register of the gain, to which the gain is proportional; its unit is
            the servo's own.
        voltage: of the supply [V].
        load_mass: what hangs on the terminal link [kg]; zero for nothing.
        load_position: of the load, in the frame of the terminal link's body [m].
        load_distance: in its place, how far the load is from the terminal joint, in the direction
            in which the model has the link's centre of mass [m].
        is_whole_link: whether the load is all of the terminal link's mass, as of a pendulum of
            known mass and length, or comes on top of the link, as a weight that hangs on the jaw.
    """

    register: float | None = None
    voltage: float | None = None
    load_mass: float | None = None
    load_position: tuple[float, float, float] | None = None
    load_distance: float | None = None
    is_whole_link: bool = False

    def __post_init__(self) -> None:
        """Raise InputError where a number is impossible, or a load has no place or two."""
        for name in ("register", "voltage", "load_distance"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"{_WORDS[name]} must be positive (got {value:g})")
        mass = self.load_mass
        if mass is not None and not 0.0 <= mass < math.inf:
            raise InputError(f"a load's mass must not be negative (got {mass:g})")
        if self.load_position is not None and (
            len(self.load_position) != 3
            or not all(map(math.isfinite, self.load_position))
        ):
            raise InputError(
                f"a load's position is three numbers (got {_numbers(self.load_position)})"
            )
        n_places = (self.load_position is not None) + (self.load_distance is not None)
        if n_places != bool(mass):
            raise InputError(
                "a load is its mass and one place: its position x y z in the frame of the last "
                "link, or its distance from the last joint"
            )
        if self.is_whole_link and not mass:
            raise InputError("a link has a mass that is positive")

    def __str__(self) -> str:
        """Return the setting as it is typed."""
        entries = []
        if self.register is not None:
            entries.append(f"kp={self.register:.12g}")
        if self.voltage is not None:
            entries.append(f"voltage={self.voltage:.12g}")
        if self.load_mass is not None:
            place = self.load_position or filter(None, [self.load_distance])
            at = f" at {_numbers(place)}" if self.load_mass else ""
            key = "link" if self.is_whole_link else "load"
            entries.append(f"{key}={self.load_mass:.12g}{at}")
        return ", ".join(entries)

    def over(self, fallback: ServoSetting) -> ServoSetting:
        """Return this setting, with what it does not state as the fallback has it.

        A load is stated as a whole.
        """
        stated = {
            entry.name: getattr(self, entry.name)
            for entry in fields(self)
            if entry.name not in _LOAD_FIELDS and getattr(self, entry.name) is not None
        }
        if self.load_mass is not None:
            stated.update((name, getattr(self, name)) for name in _LOAD_FIELDS)
        return replace(fallback, **stated)


UNKNOWN = ServoSetting()
"""Nothing is known."""
_WORDS: Mapping[str, str] = {
    "register": "the gain register kp",
    "voltage": "the supply's voltage",
    "load_distance": "a load's distance from the joint",
}


def _numbers(values: Any) -> str:
    """Return numbers with blanks between them."""
    return " ".join(f"{value:.12g}" for value in values)


def _one_number(field: str) -> Callable[[str], dict[str, Any]]:
    """Return a function of a text that returns the field with the number in it."""
    return lambda text: {field: float(text)}


def _load(text: str, is_whole_link: bool = False) -> dict[str, Any]:
    """Return the fields of a load: "0", "0.2 at 0 0 -0.1" or "0.49 at 0.1"."""
    mass, at, place = text.partition(" at ")
    load: dict[str, Any] = {"load_mass": float(mass), "is_whole_link": is_whole_link}
    numbers = tuple(map(float, place.split()))
    if len(numbers) == 1:
        load["load_distance"] = numbers[0]
    elif at:
        load["load_position"] = numbers
    return load


_KEYS: Mapping[str, Callable[[str], dict[str, Any]]] = {
    "kp": _one_number("register"),
    "voltage": _one_number("voltage"),
    "load": _load,
    "link": lambda text: _load(text, is_whole_link=True),
}
"""Key of a setting to a function of its text that returns the fields that it states."""


def parse_servo_setting(text: str) -> ServoSetting:
    """Return the setting in a text such as "kp=400, voltage=7.4, load=0.2 at 0 0 -0.1".

    Raises:
        InputError: a key is unknown or stated twice, or its value cannot be what it says.
    """
    stated: dict[str, Any] = {}
    for entry in text.split(","):
        key, _, value = map(str.strip, entry.partition("="))
        try:
            found = _KEYS[key](value)
        except (KeyError, ValueError):
            raise InputError(
                f"{entry.strip()!r} is no part of a setting; {_VALID}"
            ) from None
        if stated.keys() & found.keys():
            raise InputError(f"{text!r} states {key!r} beside the same; {_VALID}")
        stated.update(found)
    try:
        return ServoSetting(**stated)
    except InputError as error:
        raise InputError(f"{text!r}: {error}; {_VALID}") from None


_VALID = (
    "valid keys: kp (the servos' gain register), voltage (of the supply, V), load (kg, at its x y "
    "z in the frame of the last link or its distance from the last joint, in m; 0 for none), link "
    f"(as load, where this is all of the last link's mass), as in '{FORM}'"
)
