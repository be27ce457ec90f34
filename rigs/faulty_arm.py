"""A simulated arm whose motors, encoders, supply and load may be at fault, and its true motion.

The motors' servo acts on what their encoders read, and the physics on the torque that they really
deliver; in a sound arm both are the joint's own. Positive directions, zeros and torque ratios are
the joints': motors are mounted straight here.
"""

from __future__ import annotations

import mujoco
import numpy as np

from robot_sysid.damiao import protocol
from robot_sysid.damiao.simulated import SimulatedArm


class FaultyArm(SimulatedArm):
    """A simulated arm in which something may be wrong.

    Attributes:
        truth: time [s], positions and velocities (n,) of its joints, as they really were, per step.
        torque_share: (n,) delivered torque per commanded torque.
        share_is_reported: (n,) whether a motor reports what it delivers.
        encoder_error: (n,) encoder minus joint position [rad].
        slip_rate: (n,) how fast that grows [rad/s].
        slip_is_felt: (n,) whether the encoder's speed includes the slip.
        frozen_encoder: (n,) what the servo and the feedback take for the position [rad], or NaN.
        jam_damping: (n,) damping of what holds a joint [N m s/rad].
        supply: share of their peak torque and top speed that all motors have.
        supply_rate: how fast the supply falls [1/s], down to ``least_supply``.
        push: force on the terminal link (3,) [N], in the world.
    """

    def __init__(self, mechanism, motors):
        super().__init__(mechanism, motors)
        n = mechanism.n_joints
        self.truth = []
        self.torque_share = np.ones(n)
        self.share_is_reported = np.zeros(n, bool)
        self.encoder_error = np.zeros(n)
        self.slip_rate = np.zeros(n)
        self.slip_is_felt = np.ones(n, bool)
        self.frozen_encoder = np.full(n, np.nan)
        self.jam_damping = np.zeros(n)
        self.supply = 1.0
        self.supply_rate = 0.0
        self.least_supply = 0.4
        self.push = None
        # Motors that have had a frame since the sensors were read.
        self._asked = set()
        self._top_speed = np.array([_top_speed(motor) for motor in motors[:n]])

    def advance(self, until):
        """Let physics run up to ``until`` [s], and keep the truth."""
        mechanism = self.mechanism
        if not self._was_enabled:
            self._rest(until)
        while self.time + mechanism.timestep <= until:
            self._has_moved = True
            self.time += mechanism.timestep
            for motor in self.motors:
                self._changed |= motor.tick(self.time)
            self._age(mechanism.timestep)
            ahead = mechanism.q + 0.5 * mechanism.timestep * mechanism.qd
            torque, damping = self._load(*self._motor_torques(ahead))
            mechanism.step(torque, damping)
            self._keep()

    def handle(self, frame, time):
        """Let the motors that listen to a frame take it at ``time`` [s]; return their answers."""
        self.advance(time)
        listeners = [motor for motor in self.motors if _listens(motor, frame)]
        if not listeners:
            return []
        asked = {id(motor) for motor in listeners}
        if self._has_moved or asked & self._asked:
            self._read_sensors()
            self._has_moved = False
            self._asked = set()
        self._asked |= asked
        answers = []
        for motor in sorted(listeners, key=lambda motor: not motor.answers_first):
            answer = motor.handle(frame, time)
            if answer is not None:
                answers.append(answer)
        self._changed = True
        self._was_enabled |= any(motor.driving for motor in listeners)
        return answers

    def _rest(self, until):
        self._has_moved = True
        self.time = max(self.time, until)
        self._keep()

    def _keep(self):
        mechanism = self.mechanism
        self.truth.append((self.time, mechanism.q.copy(), mechanism.qd.copy()))

    def _age(self, step):
        """Let slipping gears slip and the supply sag for a step [s]."""
        self.encoder_error = self.encoder_error + step * self.slip_rate
        if self.supply_rate:
            self.supply = max(self.supply - step * self.supply_rate, self.least_supply)

    def _encoder(self, q):
        """Return what the encoders read at positions q (n,): position and extra velocity (n,)."""
        is_frozen = np.isfinite(self.frozen_encoder)
        position = np.where(is_frozen, self.frozen_encoder, q + self.encoder_error)
        slip = np.where(self.slip_is_felt, self.slip_rate, 0.0)
        return position, np.where(is_frozen, 0.0, slip), is_frozen

    def _motor_torques(self, q):
        """Return what the motors believe to make at positions q (n,): torque, and damping (n,)."""
        if self._changed:
            self._gather()
        position, slip, is_frozen = self._encoder(q)
        qd = self.mechanism.qd
        driving = self._limited
        torque = self._kp * (self._p - position) + self._offset - self._kd * slip
        damping = np.where(is_frozen, 0.0, self._kd)
        total = torque - damping * qd
        is_too_fast = (np.abs(qd) > self.supply * self._top_speed) & (total * qd > 0.0)
        limit = np.where(is_too_fast, 0.0, self._peak * self.supply)
        is_limited = np.abs(total) > limit
        torque = np.where(is_limited, np.clip(total, -limit, limit), torque)
        damping = np.where(is_limited, 0.0, damping)
        return np.where(driving, torque, 0.0), np.where(driving, damping, self._kd)

    def _load(self, torque, damping):
        """Return the torque and damping (n,) that really act on the joints."""
        torque = self.torque_share * torque + self._push_torque()
        damping = self.torque_share * damping + self.jam_damping
        return torque, damping

    def _push_torque(self):
        if self.push is None:
            return 0.0
        robot = self.mechanism._robot
        model = self.mechanism._model
        data = self.mechanism._data
        jacobian = np.zeros((3, model.nv))
        self.mechanism.mobility()
        tip = data.xipos[robot.body_id]
        mujoco.mj_jac(model, data, jacobian, None, tip, robot.body_id)
        return jacobian[:, robot.dof_index].T @ self.push

    def _read_sensors(self):
        q = self.mechanism.q
        qd = self.mechanism.qd
        position, slip, is_frozen = self._encoder(q)
        velocity = np.where(is_frozen, 0.0, qd + slip)
        torque, damping = self._motor_torques(q)
        share = np.where(self.share_is_reported, self.torque_share, 1.0)
        delivered = share * (torque - damping * qd)
        for joint_index, motor in enumerate(self.motors[: self.mechanism.n_joints]):
            motor.position = position[joint_index]
            motor.velocity = velocity[joint_index]
            motor.torque = delivered[joint_index] if motor.driving else 0.0

    def grip(self, mass):
        """Add a mass [kg] at the terminal link's centre of mass, from now on."""
        model = self.mechanism._model
        model.body_mass[self.mechanism._robot.body_id] += mass
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def energy(self, q, qd):
        """Return the mechanical energy (N,) [J] at positions and velocities (N, n)."""
        robot = self.mechanism._robot
        model = self.mechanism._model
        data = mujoco.MjData(model)
        data.qpos[:] = robot.reference_qpos
        energy = []
        for position, velocity in zip(q, qd):
            data.qpos[robot.qpos_index] = position
            data.qvel[robot.dof_index] = velocity
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_energyPos(model, data)
            mujoco.mj_energyVel(model, data)
            energy.append(data.energy.sum())
        return np.array(energy)


def _listens(motor, frame):
    """Tell whether a frame is about a motor: by its id, or by the id in a question's data."""
    if frame.id == protocol.REGISTER_ID:
        return frame.data[0] | frame.data[1] << 8 == motor.can_id
    return frame.id & 0xFF == motor.can_id & 0xFF


def _top_speed(motor):
    """Return a motor's speed without load [rad/s], that of its scaling where it is not known."""
    spec = motor.joint.spec
    if spec.no_load_rpm is None:
        return spec.limits[1]
    return spec.no_load_rpm * 2.0 * np.pi / 60.0
