"""Faults of motors, bus and set-up that an owner of an arm meets, on arms that no case is tuned to.

Arms and motors are not as the model says (``WornSetUp``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numpy as np

from rigs.arms import Y, Z, serial_arm
from rigs.damiao_rig import delay_cause, fault
from rigs.fault_bench import AT_START, OTHERS, Case
from rigs.worn_arms import WORN_ARMS, WornSetUp
from robot_sysid.damiao.protocol import DISABLED, Register

SMALL_ARM = serial_arm(
    (Z, Y, Y, Y),
    joint='range="-2.5 2.5" frictionloss=".1" damping=".1" armature=".02"',
    extra='<keyframe><key name="home" qpos="0 .9 .6 -.4"/></keyframe>',
)
"""An arm that is stretched out."""
SMALL = WornSetUp(
    model=SMALL_ARM, motors=("DM4340", "DM4340", "DM4340", "DM4310"), seed=3
)
SETUPS = {"small": SMALL, "ur5e": replace(WORN_ARMS["ur5e"], seed=1)}
SHOULDER = 1
WRIST = 3


def of_all(**values):
    """Return the cause of a fault of every motor."""
    return lambda run: [fault(j, **values)(run) for j in range(len(run.motors))]


def late(seconds):
    """Return the cause of answers that come late by a time [s]."""
    return lambda run: setattr(run.bus, "delay", lambda: seconds)


def losing(share):
    """Return the cause of answers of which a share is lost."""
    rng = np.random.default_rng(5)
    return lambda run: setattr(run.bus, "loses", lambda: rng.random() < share)


def off(seconds):
    """Return the cause of a bus that is off for a time [s]."""

    def cause(run):
        run.bus.is_off = True
        run.at(seconds, lambda: setattr(run.bus, "is_off", False))

    return cause


def exchanged(*joints):
    """Return the cause of two motors that have each other's ids."""

    def cause(run):
        first, second = (run.motors[j].registers for j in joints)
        for number in (Register.ESC_ID, Register.MST_ID):
            first[number], second[number] = second[number], first[number]

    return cause


def mounted(mountings):
    """Return the cause of motors that are mounted in another way than the map says, by joint."""

    return lambda run: [run.mount(j, **change) for j, change in mountings.items()]


def away(angle):
    """Return the cause of an arm that stands an angle [rad] away from its first point."""

    def cause(run):
        run.arm.mechanism.q = run.plan.trajectory.q[0] + angle
        run.during("playing", 0.0, begin)

    def begin(run):
        """The way there is another one: what counts begins here."""
        run._onset = run.clock.now()

    return cause


def carry(factor):
    """Return the cause of a terminal link that is heavier than the model's by a factor."""

    def cause(run):
        mechanism = run.arm.mechanism
        body = mechanism._robot.body_id
        mechanism._model.body_mass[body] *= factor
        mechanism._model.body_inertia[body] *= factor
        mujoco.mj_setConst(mechanism._model, mujoco.MjData(mechanism._model))

    return cause


@dataclass(frozen=True)
class PowerDip:
    """The supply of a motor is away for 50 ms, after which the motor is disabled."""

    joint: int

    def __call__(self, run):
        fault(self.joint, silent=True, status=DISABLED)(run)
        delay_cause(0.05, fault(self.joint, silent=False))(run)


@dataclass(frozen=True)
class Incident(Case):
    """A case with the ways in which its run may end.

    A departure that is there before anything moves, as that of a wrong zero, is in its bound.
    """

    bound: float = 0.05
    endings: tuple[str, ...] = ("stopped",)


shoulder = partial(fault, SHOULDER)
ANOTHER_ARM = {
    0: {"direction": -1, "offset": 0.2},
    2: {"direction": -1},
    3: {"offset": -0.3},
}
REFUSED = {**AT_START, "endings": ("refused",)}
COMPLETED = {**AT_START, "endings": ("completed",)}
UNSEEN = {**AT_START, "endings": ("stopped", "completed")}
CASES = (
    Incident("encoder jumps 0.3 rad", shoulder(encoder_error=0.3)),
    Incident("encoder jumps 0.1 rad", shoulder(encoder_error=0.1)),
    Incident("reported position jumps 0.3 rad", shoulder(shift=0.3), bound=0.1),
    Incident("answers of one motor frozen", shoulder(is_stale=True)),
    Incident("answers of all motors frozen", of_all(is_stale=True)),
    Incident("motor disabled", shoulder(status=DISABLED), "status 0", quantity=OTHERS),
    Incident("power dip of one motor", PowerDip(SHOULDER), "answer", quantity=OTHERS),
    Incident("power dip of all motors", of_all(status=DISABLED), "status 0"),
    Incident("gains ignored", shoulder(stiffness_share=0.0), bound=0.15, **AT_START),
    Incident("gains ignored suddenly", shoulder(stiffness_share=0.0)),
    Incident("gains ignored by all motors", of_all(stiffness_share=0.0), **AT_START),
    Incident("answers 5 ms late", late(5e-3), "did not answer in time"),
    Incident("answers 20 ms late", late(20e-3)),
    Incident("answers 50 ms late", late(50e-3), "did not answer in time", bound=0.15),
    Incident("30 % of the answers lost", losing(0.3), "did not answer in time"),
    Incident("bus off for 30 ms", off(0.03), "no more frames"),
    Incident("bus off for 1 s", off(1.0), "Cut their power"),
    Incident("bus off", off(100.0), "Cut their power"),
    Incident("ids of two types exchanged", exchanged(0, WRIST), "PMAX", **REFUSED),
    Incident("another arm's map", mounted(ANOTHER_ARM), "starts at", **REFUSED),
    Incident(
        "shoulder turned round", mounted({SHOULDER: {"direction": -1}}), "starts at",
        **REFUSED,
    ),
    Incident("offset 0.3 rad off", mounted({SHOULDER: {"offset": 0.3}}), bound=0.4, **UNSEEN),
    Incident("last link twice as heavy", carry(2.0), **COMPLETED),
    Incident("last link three times as heavy", carry(3.0), bound=0.1, **UNSEEN),
    Incident("starts 0.3 rad away", away(0.3), **COMPLETED),
    Incident("starts 0.6 rad away", away(0.6), "starts at", **REFUSED),
)  # fmt: skip
"""What may happen, on any arm."""
UNVERIFIED = (
    Incident("ids of equal motors exchanged", exchanged(SHOULDER, SHOULDER + 1), **UNSEEN),
    Incident("base turned round", mounted({0: {"direction": -1}}), **UNSEEN),
    Incident("wrist turned round", mounted({WRIST: {"direction": -1}}), **UNSEEN),
)  # fmt: skip
"""Mountings that nothing before a run shows but a joint map that somebody has verified by hand.

Here it was verified wrongly, and no torque tells: gravity hardly loads these joints, or alike.
"""


def cases_on(setup, cases=(*CASES, *UNVERIFIED)) -> list[Case]:
    """Return cases on an arm, with its model given and without."""
    return [
        replace(case, setup=replace(setup, model_is_given=is_given))
        for is_given in (True, False)
        for case in cases
    ]


def departure_of(case, outcome) -> float:
    """Return how far joints got from their paths [rad]; no motor was enabled by a refused run."""
    return 0.0 if outcome.ending == "refused" else outcome.figures[case.quantity]
