"""Logs of an arm that MuJoCo moves step by step, under its own dry friction."""

import mujoco
import numpy as np

from robot_sysid.records import Recording
from robot_sysid.trajectory import generate_excitation_trajectory

TORQUE_NOISE = 0.05
ENCODER = 1e-4


def stepped_log(model, robot, seed, seconds):
    """Return the log of a controlled motion of a compiled arm of seven joints.

    Between two steps the torque is held, and the second difference of positions around a sample is
    the acceleration by its torque.
    """
    rng = np.random.default_rng(seed)
    plan = generate_excitation_trajectory(robot, rng, seconds)
    plan = plan.scale_amplitudes(np.array([3.0] * 6 + [1.0]))
    motion = plan.evaluate(np.arange(0.0, seconds, model.opt.timestep))
    data = mujoco.MjData(model)
    data.qpos[:] = motion.q[0]
    q = np.empty_like(motion.q)
    tau = np.empty_like(motion.q)
    pushed = np.empty(7)
    for k in range(len(q)):
        mujoco.mj_forward(model, data)
        q[k] = data.qpos
        commanded = motion.qdd[k] + 900.0 * (motion.q[k] - data.qpos)
        commanded = commanded + 60.0 * (motion.qd[k] - data.qvel)
        dry = model.dof_frictionloss * np.tanh(motion.qd[k] / 0.02)
        mujoco.mj_mulM(model, data, pushed, commanded)
        tau[k] = pushed + data.qfrc_bias + model.dof_damping * data.qvel + dry
        data.qfrc_applied[:] = tau[k]
        mujoco.mj_step(model, data)
    tau += TORQUE_NOISE * rng.normal(size=tau.shape)
    return Recording(motion.time, np.round(q / ENCODER) * ENCODER, None, tau)
