"""Right logs under conditions that are unusual and right, composed at random.

The arm is always another one than its model, but for arms that equal it, and has friction of its
own. One or two conditions are drawn of those that go together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.trust.confusion_causes import Scene, draw_scene, payload_of
from benchmarks.trust.confusion_mistakes import record
from benchmarks.trust.drawn_changes import Random, log_uniform
from rigs.arms.motions import of_joints, slow
from rigs.arms.wrong_arms import RATE, noise_samples

USUAL_DURATION = 20.0
"""[s]"""
SHORT_DURATION = 6.0
"""[s]"""
SELDOM = 30.0
"""Rate of a log with few samples [Hz]."""
HANGING = (0.0, 0.0, 1.0)
"""Direction of gravity of an arm that hangs."""


@dataclass(frozen=True)
class OddLog:
    """A right log.

    Attributes:
        words: of its conditions.
        kind: the names of its conditions.
        scene: the arm and its log.
        options: with which commands read its model.
    """

    words: str
    kind: str
    scene: Scene
    options: tuple[str, ...] = ()


Condition = Callable[[Random, Scene], tuple[Scene, str]]
"""Function that returns the scene under a condition, and words for it."""


def with_noise(scene: Scene, share: float, white: bool) -> Scene:
    """Return the scene with noise of a share of each joint's load in place of its own."""
    quiet = record(scene, scene.arm, scene.motion, 0.0)
    noise = noise_samples(scene.rng, quiet.log.tau.shape, white)
    return quiet.with_more_torque(share * scene.usual_torque * noise)


def more_noise(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return more noise, within what sensors have."""
    factor = float(rng.uniform(2.0, 5.0))
    noisy = record(scene, scene.arm, scene.motion, factor)
    return noisy, f"{factor:.1f} times the noise"


def seldom(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return 30 samples a second."""
    log = scene.log[:: round(RATE / SELDOM)]
    return replace(scene, log=log), "30 Hz"


def still_joint(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return a motion in which one joint stands still."""
    n = scene.robot.n_joints
    joint = int(rng.integers(n))
    moving = [place for place in range(n) if place != joint]
    motion = of_joints(moving, scene.motion)
    name = scene.robot.joint_names[joint]
    return record(scene, scene.arm, motion), f"{name} stands still"


def friction_times(rng: Random, scene: Scene, factor: float) -> tuple[Scene, str]:
    """Return an arm whose friction has a factor."""
    arm = scene.arm
    names = ("coulomb", "viscous", "stribeck", "loss", "root", "bend")
    sizes = {name: factor * np.asarray(getattr(arm, name)) for name in names}
    # What the load loses in gears never drives it.
    sizes["loss"] = np.minimum(sizes["loss"], 0.3)
    other = record(scene, replace(arm, **sizes), scene.motion)
    return other, f"{factor:.2g} times the friction"


def low_friction(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return an arm with little friction."""
    return friction_times(rng, scene, log_uniform(rng, 0.05, 0.4))


def high_friction(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return an arm with much friction."""
    return friction_times(rng, scene, log_uniform(rng, 2.0, 8.0))


def slow_motion(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return the motion at a third of its speed."""
    return record(scene, scene.arm, slow(scene.plan, rng)), "a third of the speed"


def behind_gears(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return sensors behind the gears: almost no friction, no rotor, white noise."""
    factor = log_uniform(rng, 0.003, 0.1)
    noise = log_uniform(rng, 0.01, 0.05)
    freed, _ = friction_times(rng, scene, factor)
    arm = replace(freed.arm, rotor=np.zeros(scene.robot.n_joints))
    sensed = record(freed, arm, scene.motion)
    words = f"sensors behind the gears, {factor:.2g} of the friction, noise {noise:.1%}"
    return with_noise(sensed, noise, True), words


def equal_model(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return an arm that equals its model, drawn as such, with noise."""
    noise = log_uniform(rng, 0.005, 0.03)
    white = bool(rng.integers(2))
    return with_noise(scene, noise, white), f"equals its model, noise {noise:.1%}"


def payload(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return an arm that carries what its model does not know."""
    share = float(rng.uniform(0.3, 1.5))
    carried = share * payload_of(scene)
    thetas = scene.arm.thetas.copy()
    thetas[-1] += carried
    loaded = record(scene, replace(scene.arm, thetas=thetas), scene.motion)
    masses = (float(thetas[-1, 0]),)
    return replace(loaded, last_masses=masses), f"{carried[0]:.2g} kg on the flange"


def as_drawn(rng: Random, scene: Scene) -> tuple[Scene, str]:
    """Return the scene, whose condition is in how it was drawn."""
    return scene, ""


CONDITIONS: Mapping[str, Condition] = {
    "noise": more_noise,
    "short": as_drawn,
    "30 Hz": seldom,
    "one joint still": still_joint,
    "low friction": low_friction,
    "high friction": high_friction,
    "slow": slow_motion,
    "behind gears": behind_gears,
    "equals its model": equal_model,
    "payload": payload,
    "hanging": as_drawn,
}
"""Condition by its name; that of samples comes last, in what is drawn of several."""
EXCLUDE_EACH_OTHER = (
    {"noise", "behind gears", "equals its model"},
    {"low friction", "high friction", "behind gears"},
    {"slow", "one joint still"},
    {"equals its model", "payload"},
    {"short", "slow"},
)
"""Conditions of which at most one is drawn."""
ORDER = (
    "slow",
    "one joint still",
    "payload",
    "low friction",
    "high friction",
    "noise",
    "behind gears",
    "equals its model",
    "short",
    "hanging",
    "30 Hz",
)
"""In this order: each records anew what the next ones change."""


def draw_conditions(rng: Random) -> list[str]:
    """Return one condition, or two that go together."""
    first = str(rng.choice(ORDER))
    second = str(rng.choice(ORDER))
    is_one = rng.random() < 0.5
    for group in EXCLUDE_EACH_OTHER:
        is_one = is_one or {first, second} <= group
    names = {first} if is_one else {first, second}
    return sorted(names, key=ORDER.index)


def draw_odd_log(rng: Random, path: Path, arm_name: str) -> OddLog:
    """Return a right log of an arm under conditions that are drawn."""
    names = draw_conditions(rng)
    deviation = "exact" if "equals its model" in names else "real"
    duration = SHORT_DURATION if "short" in names else USUAL_DURATION
    gravity = HANGING if "hanging" in names else None
    seed = int(rng.integers(2**31))
    scene = draw_scene(path, arm_name, deviation, duration, seed, gravity)
    described = []
    for name in names:
        scene, words = CONDITIONS[name](rng, scene)
        described.append(words or name)
    options = ("--gravity", *(f"{axis:g}" for axis in gravity)) if gravity else ()
    return OddLog(", ".join(described), " + ".join(names), scene, options)
