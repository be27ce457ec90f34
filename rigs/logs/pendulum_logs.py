"""Recordings of a pendulum behind a position servo, and two simulations that play them.

Rhoban's BAM (https://github.com/Rhoban/bam) records servos so. MuJoCo plays what a model file
holds: gain, limit, viscous and dry friction. Real gears rub more under load and before they move:
a simulation of one joint plays that, which is BAM's model M4. It shares no code with the rollouts
that find the numbers.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

STEP = 5e-4
"""Step of both simulations [s]."""
GRAVITY = 9.81
"""Gravity of model files [m/s^2]."""
GYRATION = 0.0202
"""Radius of gyration of a weight about its own centre [m], as of a disc of 4 cm."""
MODEL = """<mujoco model="pendulum">
  <compiler angle="radian"/>
  <worldbody>
    <body name="arm" pos="0 0 0.3">
      <joint name="servo" type="hinge" axis="0 1 0" range="-3.2 3.2"/>
      <inertial mass="{mass}" pos="0 0 -{length}" diaginertia="{own} {own} {half}"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="servo" kp="{gain}"/></actuator>
</mujoco>
"""


@dataclass(frozen=True)
class Pendulum:
    """A weight at a length from a level axis, which hangs down at zero.

    Attributes:
        mass: [kg].
        length: [m].
    """

    mass: float
    length: float

    @property
    def own_inertia(self) -> float:
        """Inertia of the weight about its own centre [kg m^2]."""
        return self.mass * GYRATION**2

    @property
    def inertia(self) -> float:
        """Inertia about the axis [kg m^2]."""
        return self.mass * self.length**2 + self.own_inertia

    def torque(self, q) -> float:
        """Return the torque of gravity at a position [N m]."""
        return -self.mass * GRAVITY * self.length * math.sin(q)

    def model(self, gain=1.0) -> str:
        """Return a model file of it behind a position servo of this gain [N m/rad]."""
        own = self.own_inertia
        return MODEL.format(
            mass=self.mass, length=self.length, own=own, half=own / 2.0, gain=gain
        )


@dataclass(frozen=True)
class Recording:
    """Times, positions and commands (N,) of a servo whose gain is ``kp`` [s, rad]."""

    path: Path
    pendulum: Pendulum
    kp: float
    time: np.ndarray
    q: np.ndarray
    command: np.ndarray

    def error(self, times, q) -> float:
        """Return the root mean square difference of a played motion from it [rad].

        Args:
            times: (M,) of the motion [s].
            q: (M,) its positions [rad].
        """
        off = np.interp(self.time, times, q) - self.q
        return float(np.sqrt(np.mean(off**2)))


def read(path) -> Recording:
    """Return a recording of BAM's; of one that lets go of the joint, while it is held."""
    text = Path(path).read_text(encoding="utf-8")
    held = json.loads(text)
    rows = [row for row in held["entries"] if row["torque_enable"]]
    names = ("timestamp", "position", "goal_position")
    columns = np.array([[row[name] for name in names] for row in rows], float)
    pendulum = Pendulum(held["mass"], held["length"])
    return Recording(Path(path), pendulum, held["kp"], *columns.T)


def recordings_of(folder, servo) -> dict[str, Recording]:
    """Return recordings of a servo that is on throughout, by gain and motion."""
    paths = sorted(Path(folder).glob(f"{servo}_*.json"))
    names = {path.stem[len(servo) + 1 :]: path for path in paths}
    return {name: read(path) for name, path in names.items() if "drop" not in name}


def model_plays(model, recording, *, times=1.0, delay=0.0):
    """Return times and positions (N,) that MuJoCo plays from the recording's start, at rest.

    Args:
        model: a compiled model of one joint and one position servo.
        recording: whose commands are played, straight between samples.
        times: factor of the servo's gain.
        delay: of the commands [s].
    """
    model = model.__copy__()
    model.opt.timestep = STEP
    model.actuator_gainprm[0, 0] *= times
    model.actuator_biasprm[0, 1] *= times
    clock = np.arange(recording.time[0], recording.time[-1], STEP)
    data = mujoco.MjData(model)
    data.qpos[0] = recording.q[0]
    positions = np.empty(len(clock))
    goals = np.interp(clock - delay, recording.time, recording.command)
    for sample, goal in enumerate(goals):
        positions[sample] = data.qpos[0]
        data.ctrl[0] = goal
        mujoco.mj_step(model, data)
    return clock, positions


@dataclass(frozen=True)
class Card:
    """Numbers of a servo and its joint.

    Attributes:
        gain: torque over position error [N m/rad].
        limit: largest torque of the motor at rest [N m].
        back_emf: torque that the motor loses with speed [N m s/rad]: limit over no-load speed.
        damping: viscous friction [N m s/rad].
        coulomb: dry friction of a joint that moves without load [N m].
        armature: inertia of the rotor at the joint [kg m^2].
        load_share: dry friction over the torque in the gears, of a joint that moves.
        stribeck: dry friction at rest beyond Coulomb's [N m].
        load_stribeck: share of the load at rest beyond that of motion.
        stribeck_speed: speed at which 1/e of both is left [rad/s].
        stribeck_curve: exponent of the speed in their fall.
        delay: of the commands [s].
    """

    gain: float
    limit: float = math.inf
    back_emf: float = 0.0
    damping: float = 0.0
    coulomb: float = 0.0
    armature: float = 0.0
    load_share: float = 0.0
    stribeck: float = 0.0
    load_stribeck: float = 0.0
    stribeck_speed: float = 1.0
    stribeck_curve: float = 1.0
    delay: float = 0.0

    def dry_friction(self, speed, in_gears) -> float:
        """Return the dry friction [N m] at a speed [rad/s], with a torque [N m] in the gears.

        F = coulomb + load_share |in_gears| + (stribeck + load_stribeck |in_gears|)
            * exp(-(|speed| / stribeck_speed)^stribeck_curve)
        """
        load = abs(in_gears)
        ratio = abs(speed) / self.stribeck_speed
        at_rest = math.exp(-(ratio**self.stribeck_curve))
        more = at_rest * (self.stribeck + self.load_stribeck * load)
        return self.coulomb + self.load_share * load + more


def card_plays(card, recording, *, times=1.0):
    """Return times and positions (N,) of a card's numbers from the recording's start, at rest.

    The motor gives the position error times the gain, within its limit, less back-EMF; gears carry
    motor less gravity. Dry friction is implicit: it stops the joint within a step where it can, and
    acts against the motion where it cannot.

    Args:
        card: numbers of the servo.
        recording: whose commands are played, straight between samples.
        times: factor of the gain.
    """
    clock = np.arange(recording.time[0], recording.time[-1], STEP)
    inertia = recording.pendulum.inertia + card.armature
    gain = times * card.gain
    q, speed = float(recording.q[0]), 0.0
    positions = np.empty(len(clock))
    goals = np.interp(clock - card.delay, recording.time, recording.command)
    for sample, goal in enumerate(goals.tolist()):
        positions[sample] = q
        gravity = recording.pendulum.torque(q)
        motor = min(max(gain * (goal - q), -card.limit), card.limit)
        motor -= card.back_emf * speed
        moving = motor + gravity - card.damping * speed
        stopping = inertia / STEP * speed + moving
        dry = card.dry_friction(speed, motor - gravity)
        rubbing = math.copysign(min(dry, abs(stopping)), stopping)
        speed += STEP * (moving - rubbing) / inertia
        q += STEP * speed
    return clock, positions
