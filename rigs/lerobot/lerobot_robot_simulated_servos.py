"""A robot of LeRobot that MuJoCo simulates in real time: an arm behind position servos.

It speaks LeRobot's interface and nothing else, as a plug-in that is found by the name of its
distribution: positions are degrees in steps of an encoder with 4096, or per cent of a motor's
range.
Its servos differ from the model's by factors, and commands act late.
"""

import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from lerobot.robots import Robot, RobotConfig

STEP = 2.0 * np.pi / 4096


@RobotConfig.register_subclass("simulated_servos")
@dataclass
class SimulatedServosConfig(RobotConfig):
    """Options: a model with position actuators, where it stands, and what its servos are like.

    Attributes:
        model: MJCF with one actuator per joint, called like it.
        start: positions of joints at the beginning, in the robot's units.
        per_cent: joints whose positions are per cent of their range.
        kp: gain of all servos [N m/rad].
        delay: of commands [s].
        friction, rotor: factors on the model's friction and rotor inertia.
    """

    model: Path
    start: dict[str, float] = field(default_factory=dict)
    per_cent: list[str] = field(default_factory=list)
    kp: float = 17.8
    delay: float = 0.02
    friction: float = 1.5
    rotor: float = 0.8


class SimulatedServos(Robot):
    """The simulated arm; each call moves it on to the clock."""

    config_class = SimulatedServosConfig
    name = "simulated_servos"

    def __init__(self, config):
        super().__init__(config)
        self.config = config
        self.cameras = {}
        model = mujoco.MjModel.from_xml_path(str(config.model))
        model.opt.timestep = 0.001
        model.actuator_gainprm[:, 0] = config.kp
        model.actuator_biasprm[:, 1] = -config.kp
        model.actuator_biasprm[:, 2] = 0.0
        model.dof_damping *= config.friction
        model.dof_frictionloss *= config.friction
        model.dof_armature *= config.rotor
        self.model = model
        self.data = mujoco.MjData(model)
        self.names = [model.actuator(i).name for i in range(model.nu)]
        joints = [model.joint(name) for name in self.names]
        self.address = [int(joint.qposadr[0]) for joint in joints]
        self.unit = np.full(model.nu, np.radians(1.0))
        self.zero = np.zeros(model.nu)
        for index, (name, joint) in enumerate(zip(self.names, joints)):
            if name in config.per_cent:
                self.zero[index] = joint.range[0]
                self.unit[index] = np.ptp(joint.range) / 100.0
        shown = [config.start.get(name, 0.0) for name in self.names]
        self.data.qpos[self.address] = self.zero + self.unit * np.array(shown)
        self.data.ctrl[:] = self.data.qpos[self.address]
        self.waiting = deque()
        self.begun = None
        self.largest_step = 0.0

    @property
    def observation_features(self):
        return {f"{name}.pos": float for name in self.names}

    action_features = observation_features

    @property
    def is_connected(self):
        return self.begun is not None

    @property
    def is_calibrated(self):
        return True

    def connect(self, calibrate=True):
        self.begun = time.monotonic()

    def calibrate(self):
        pass

    def configure(self):
        pass

    def disconnect(self):
        self.begun = None

    def _move_on(self):
        """Simulate up to now; goals act when they have waited for the delay."""
        now = time.monotonic() - self.begun
        while self.data.time < now:
            while self.waiting and self.waiting[0][0] <= self.data.time:
                self.data.ctrl[:] = self.waiting.popleft()[1]
            mujoco.mj_step(self.model, self.data)
        return now

    def get_observation(self):
        self._move_on()
        q = STEP * np.round(self.data.qpos[self.address] / STEP)
        shown = (q - self.zero) / self.unit
        return {f"{name}.pos": float(x) for name, x in zip(self.names, shown)}

    def send_action(self, action):
        now = self._move_on()
        shown = np.array([action[f"{name}.pos"] for name in self.names])
        goal = self.zero + self.unit * shown
        self.waiting.append((now + self.config.delay, goal))
        return action
