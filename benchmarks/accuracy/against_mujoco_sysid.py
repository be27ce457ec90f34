"""Friction, damping and rotor inertia of seven joints: inverse dynamics against mujoco.sysid.

Run from the checkout, one core is enough, a few minutes:

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.against_mujoco_sysid

Both get the same log of 15 s: positions with encoder steps and held torques with noise, of an arm
that MuJoCo moved with its own armature, damping and frictionloss. Both seek these 21 numbers from
the same start, links known. mujoco.sysid simulates the log in pieces of 0.3 s, as its users do (in
15 s an open loop runs away), and minimises the position error; robot-sysid fits torques. Then
another log is simulated with both results, in pieces, each from the same measured state.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.accuracy.arm_results import result_of_logs
from rigs.arms import small_arms
from rigs.arms.core_fits import BASIC, NOISE_ONLY
from rigs.arms.stepped_arm import stepped_log
from robot_sysid.estimate.options import EstimationOptions

STEP = 0.002
SECONDS = 15.0
PIECE = 0.3
HORIZON = 0.5
START = {"armature": 0.1, "damping": 1.0, "frictionloss": 0.5, "offset": 0.0}
BOUNDS = {"armature": (1e-3, 2.0), "damping": (0.0, 20.0), "frictionloss": (0.0, 20.0)}
TERMS = {"armature": "armature", "damping": "viscous", "frictionloss": "coulomb"}
NAMES = tuple(f"joint{index}" for index in range(7))


def spec_of(values=None) -> mujoco.MjSpec:
    """Return the arm as MjSpec with motors and position sensors; ``values`` maps a name to (7,)."""
    spec = mujoco.MjSpec.from_string(
        small_arms.serial_arm(small_arms.SEVEN_AXES, joint="")
    )
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for index, name in enumerate(NAMES):
        for number in BOUNDS:
            value = START[number] if values is None else float(values[number][index])
            _set(spec, name, number, value)
    return with_motors(spec, NAMES)


def with_motors(spec, names) -> mujoco.MjSpec:
    """Add a motor and a position sensor, named like the joint, to each joint; return the spec."""
    joint = mujoco.mjtTrn.mjTRN_JOINT
    affine = mujoco.mjtBias.mjBIAS_AFFINE
    for name in names:
        gain = [1.0] + [0.0] * 9
        spec.add_actuator(
            name=name, target=name, trntype=joint, gainprm=gain, biastype=affine
        )
        spec.add_sensor(
            name=f"{name}_pos",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def truth(rng) -> dict:
    """Return the true armature, damping and frictionloss of the joints, each (7,)."""
    return {
        "armature": np.geomspace(0.5, 0.02, 7),
        "damping": np.geomspace(3.0, 0.5, 7) * rng.uniform(0.7, 1.3, 7),
        "frictionloss": np.geomspace(4.0, 0.5, 7) * rng.uniform(0.7, 1.3, 7),
    }


def by_torques(robot, log) -> dict:
    """Return the joints' numbers identified by robot-sysid's inverse dynamics."""
    result = result_of_logs(
        robot, [log], EstimationOptions(friction_model=BASIC, **NOISE_ONLY)
    )
    return {
        number: np.array([result.quantity(term, name).value for name in NAMES])
        for number, term in TERMS.items()
    }


def speeds(q):
    """Return velocities (N, n): central differences of smoothed positions (N, n)."""
    from scipy.signal import savgol_filter

    return savgol_filter(q, 31, 3, deriv=1, delta=STEP, axis=0)


def pieces(model, log, seconds: float):
    """Return (initial states, torques, positions) of consecutive pieces of a log."""
    clock, q, qd, tau = log
    size = round(seconds / (clock[1] - clock[0]))
    states = []
    torques = []
    positions = []
    for start in range(50, len(clock) - size - 50, size):
        data = mujoco.MjData(model)
        data.qpos[:] = q[start]
        data.qvel[:] = qd[start]
        state = np.empty(
            mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        )
        mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states.append(state)
        torques.append(tau[start : start + size])
        positions.append(q[start : start + size])
    return np.array(states), np.array(torques), np.array(positions)


def joint_parameters(names=NAMES, bounds=BOUNDS):
    """Return mujoco.sysid's parameters of each joint, with their bounds."""
    from mujoco import sysid

    if not hasattr(sysid, "ParameterDict"):
        raise SystemExit(
            "mujoco.sysid lacks what it imports; pip install -e '.[dev,bench]'"
        )
    params = sysid.ParameterDict()
    for number, (low, high) in bounds.items():
        for name in names:
            params.add(
                sysid.Parameter(
                    f"{name}_{number}",
                    nominal=START[number],
                    min_value=low,
                    max_value=high,
                    modifier=lambda s, p, n=name, a=number: _set(s, n, a, p.value[0]),
                )
            )
    return params


def optimise(spec, log, params, residual=None, steps: int = 200):
    """Return mujoco.sysid's optimum of parameters on pieces of a log (time, q, qd, torque)."""
    from mujoco import sysid

    model = spec.compile()
    states, torques, positions = pieces(model, log, PIECE)
    clock = (log[0][1] - log[0][0]) * np.arange(torques.shape[1])
    sequences = sysid.ModelSequences(
        "arm",
        spec,
        [f"piece{k}" for k in range(len(states))],
        list(states),
        [sysid.TimeSeries(clock, signal) for signal in torques],
        [sysid.TimeSeries.from_names(clock, signal, model) for signal in positions],
    )
    built = {}

    def once(params, spec):
        """Return the model of these parameters, compiled once and not for each piece."""
        key = params.as_vector().tobytes()
        if key not in built:
            while len(built) > params.size + 1:
                del built[next(iter(built))]
            built[key] = sysid.apply_param_modifiers(params, spec)
        return built[key]

    residual_function = sysid.build_residual_fn(
        models_sequences=[sequences], build_model=once, modify_residual=residual
    )
    return sysid.optimize(
        params, residual_function, optimizer="mujoco", verbose=False, max_iters=steps
    )[0]


def in_radians(params, predicted, measured, model, all_of_it, **_):
    """Return position errors in radians.

    mujoco.sysid divides them by their norm, where a joint that rests at 0 outweighs all others.
    """
    from mujoco import sysid

    measured = sysid.apply_delayed_ts_window(measured, predicted, 0.0, 0.0)
    predicted = predicted.resample(measured.times)
    return predicted.data - measured.data, predicted, measured


def by_rollouts(log) -> dict:
    """Return the joints' numbers identified by mujoco.sysid's rollouts."""
    optimum = optimise(spec_of(), moving(log), joint_parameters())
    return {
        number: np.array([optimum[f"{name}_{number}"].value[0] for name in NAMES])
        for number in BOUNDS
    }


def moving(log):
    """Return (time, q, qd, torque) of a log, with velocities for the initial states of pieces."""
    return log.time, log.q, speeds(log.q), log.tau


def _set(spec, name, number, value) -> None:
    """Give a joint a number, or its motor a constant torque beside the recorded one."""
    if number == "offset":
        spec.actuator(name).biasprm[0] = value
        return
    joint = spec.joint(name)
    # A joint's damping is a polynomial from MuJoCo 3.7 on.
    old = getattr(joint, number)
    setattr(joint, number, value if np.isscalar(old) else [value, *old[1:]])


def rollout_error(values, log) -> float:
    """Return the root mean square position error over held-out pieces [mrad]."""
    model = spec_of(values).compile()
    states, torques, positions = pieces(model, moving(log), HORIZON)
    final_states, _ = rollout.rollout(
        model, mujoco.MjData(model), states, torques[:, :-1]
    )
    off = final_states[:, :, 1 : 1 + model.nq] - positions[:, 1:]
    return 1e3 * float(np.sqrt(np.mean(off**2)))


@dataclass(frozen=True)
class Side:
    """Result of one tool.

    Attributes:
        seconds: processor time [s].
        error: held-out rollout error [mrad].
        farthest: name of a quantity to its largest relative error.
    """

    seconds: float
    error: float
    farthest: dict


def compare_sides() -> dict[str, Side]:
    """Return numbers, processor time and error of both tools on one log, by name."""
    true = truth(np.random.default_rng(0))
    model = spec_of(true).compile()
    robot = small_arms.robot_of(spec_of().compile())
    log = stepped_log(model, robot, 1, SECONDS)
    other = stepped_log(model, robot, 2, SECONDS)
    print(
        f"start: held-out rollout error {rollout_error(None, other):.2f} mrad",
        file=sys.stderr,
    )
    print(
        f"truth: held-out rollout error {rollout_error(true, other):.2f} mrad",
        file=sys.stderr,
    )
    by_torques(robot, log)
    sides = {}
    for name, run in (
        ("robot-sysid (inverse dynamics)", lambda: by_torques(robot, log)),
        ("mujoco.sysid (rollouts)", lambda: by_rollouts(log)),
    ):
        start = time.process_time()
        values = run()
        seconds = time.process_time() - start
        off = {k: float(np.max(np.abs(v / true[k] - 1))) for k, v in values.items()}
        sides[name] = Side(seconds, rollout_error(values, other), off)
    return sides


def main() -> None:
    """Print the results of both tools."""
    sides = compare_sides()
    for name, side in sides.items():
        worst = {k: f"{100 * v:.1f} %" for k, v in side.farthest.items()}
        print(
            f"{name}: {side.seconds:.2f} s, held-out rollout error {side.error:.2f} mrad"
        )
        print(f"  farthest from the truth: {worst}")
    ours, theirs = sides.values()
    print(f"{theirs.seconds / ours.seconds:.0f} times faster, by processor time")


if __name__ == "__main__":
    main()
