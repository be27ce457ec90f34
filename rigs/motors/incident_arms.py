"""Arms on which incidents are played that no case is tuned to: they are not as their models say."""

from __future__ import annotations

from dataclasses import replace

from rigs.arms.small_arms import Y, Z, serial_arm
from rigs.motors.worn_arms import WORN_ARMS, WornSetUp

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
