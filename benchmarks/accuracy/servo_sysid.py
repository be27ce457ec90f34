"""One log of an SO-101 behind position servos: mujoco.sysid's rollouts, and robot-sysid.

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.servo_sysid

MuJoCo alone makes two logs of 20 s at 50 Hz: it plays sines and steps with servos, friction and
rotor inertia other than the file's, commands that act late, and positions in steps of a 4096th of a
turn. Both tools read the first and begin at the file's numbers. They seek gain, damping (of joint
and servo together, whose shares stay as they are), dry friction and rotor inertia of five joints,
and the delay. mujoco.sysid simulates the whole log from rest; its bounds are a tenth and ten times
the file's numbers, and factors of these are what it moves; its derivatives are by finite
differences, once of its own step and once of 0.001. MuJoCo alone then plays the second log from
rest with the model of each, in the time step of the file. Printed is processor time, of robot-sysid
with imports and files.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.accuracy import servo_arm
from rigs.files.places import MODELS
from robot_sysid.parser import load_robot_model

FILE = MODELS / "so101/so101_new_calib.xml"
TIP = "wrist_roll"
SECONDS = 20.0
RATE = 50.0
ENCODER = 2.0 * np.pi / 4096
TRUE_STEP = 5e-4
DELAY = 0.035
SETTLING = 2.0
"""Time for which the first command is held before a log begins [s]."""
RANGES = {
    "gain": (0.4, 0.8),
    "damping": (0.4, 0.8),
    "frictionloss": (1.5, 3.0),
    "armature": (0.4, 0.8),
}
"""True numbers over the file's: between these."""
FACTOR_BOUNDS = (0.1, 10.0)
DELAY_BOUNDS = (0.0, 0.2)
START_DELAY = 0.01
"""Delay at which mujoco.sysid begins [s]; at a bound it may stay there, as it says itself."""
JUMP = 0.04
"""Change of a command between two samples that is a jump [rad]: sines stay below."""
AFTER_JUMP = 0.3
"""Time after a jump in which a servo is at its torque limit or settles [s]."""
WIDE_STEP = 1e-3
"""Step of finite differences that its derivatives get in one run; its own is 1.5e-8."""


def first_of(value) -> float:
    """Return a number of a spec's joint; damping is a polynomial from MuJoCo 3.7 on."""
    return float(np.ravel(value)[0])


def bare_spec(path=FILE) -> mujoco.MjSpec:
    """Return a model without geoms and contacts, with a position sensor for each servo."""
    spec = mujoco.MjSpec.from_file(str(path))
    for geom in list(spec.geoms):
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    spec.option.disableflags |= int(off)
    for servo in spec.actuators:
        spec.add_sensor(
            name=f"{servo.name}_pos",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=servo.target,
        )
    return spec


def numbers_of(spec, names) -> dict:
    """Return gain, damping of joint and servo, friction and rotor inertia of joints, each (n,)."""
    joints = [spec.joint(name) for name in names]
    servos = [spec.actuator(name) for name in names]
    own = np.array([first_of(joint.damping) for joint in joints])
    return {
        "gain": np.array([servo.gainprm[0] for servo in servos]),
        "damping": own - np.array([servo.biasprm[2] for servo in servos]),
        "frictionloss": np.array([joint.frictionloss for joint in joints]),
        "armature": np.array([joint.armature for joint in joints]),
    }


def set_number(spec, name, number, value, start) -> None:
    """Give a joint and its servo a number; damping is shared as in the ``start`` spec."""
    joint = spec.joint(name)
    servo = spec.actuator(name)
    if number == "gain":
        servo.gainprm[0] = value
        servo.biasprm[1] = -value
    elif number == "damping":
        own = first_of(start.joint(name).damping)
        kv = -start.actuator(name).biasprm[2]
        share = kv / (own + kv)
        servo.biasprm[2] = -share * value
        old = joint.damping
        rest = (1.0 - share) * value
        joint.damping = rest if np.isscalar(old) else [rest, *old[1:]]
    else:
        setattr(joint, number, value)


def true_spec(names, rng):
    """Return the arm that makes the logs."""
    spec = bare_spec()
    start = bare_spec()
    for number, values in numbers_of(start, names).items():
        factors = rng.uniform(*RANGES[number], len(names))
        for name, value in zip(names, factors * values):
            set_number(spec, name, number, float(value), start)
    spec.option.timestep = TRUE_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def in_steps_of_file(truth):
    """Return the true arm in the step and with the integrator of the file."""
    spec = truth.copy()
    option = bare_spec().option
    spec.option.timestep = option.timestep
    spec.option.integrator = option.integrator
    return spec


def play(model, clock, command, ids):
    """Return positions (N, n) at times (N,) that MuJoCo plays with commands (N, n), from rest."""
    data = mujoco.MjData(model)
    joints = model.actuator_trnid[ids, 0]
    places = model.jnt_qposadr[joints]
    step = model.opt.timestep
    data.qpos[places] = command[0]
    data.ctrl[ids] = command[0]
    for _ in range(round(SETTLING / step)):
        mujoco.mj_step(model, data)
    count = round(clock[-1] / step) + 1
    times = step * np.arange(count)
    at = np.searchsorted(clock, times + step / 2, side="right") - 1
    positions = np.empty((count, len(ids)))
    for k in range(count):
        positions[k] = data.qpos[places]
        data.ctrl[ids] = command[at[k]]
        mujoco.mj_step(model, data)
    return times, positions


def late(times, positions, clock, delay):
    """Return positions at times (N,) of an arm that starts at rest and gets its commands late."""
    columns = [np.interp(clock - delay, times, column) for column in positions.T]
    return np.column_stack(columns)


@dataclass(frozen=True)
class Log:
    """Times (N,), commands (N, n) and positions (N, n) [s, rad]."""

    time: np.ndarray
    command: np.ndarray
    q: np.ndarray


def made_log(model, robot, ids, seed) -> Log:
    """Return a log of the true arm."""
    rng = np.random.default_rng(seed)
    clock, command = servo_arm.commands(robot, rng, SECONDS, RATE)
    command = ENCODER * np.round(command / ENCODER)
    q = late(*play(model, clock, command, ids), clock, DELAY)
    return Log(clock, command, ENCODER * np.round(q / ENCODER))


@dataclass(frozen=True)
class Found:
    """What a tool found.

    Attributes:
        spec: its model.
        delay: of the commands, for a simulation in the step of the file [s].
        seconds: processor time [s].
    """

    spec: mujoco.MjSpec
    delay: float
    seconds: float


def by_sysid(log, names, **options) -> Found:
    """Return what mujoco.sysid finds."""
    from mujoco import sysid

    spec = bare_spec()
    start = bare_spec()
    params = sysid.ParameterDict()
    for number, values in numbers_of(start, names).items():
        for name, value in zip(names, values):
            params.add(
                sysid.Parameter(
                    f"{name}_{number}",
                    nominal=1.0,
                    min_value=FACTOR_BOUNDS[0],
                    max_value=FACTOR_BOUNDS[1],
                    modifier=lambda s, p, at=(name, number, float(value)): set_number(
                        s, *at[:2], at[2] * float(p.value[0]), start
                    ),
                )
            )
    params.add(
        sysid.Parameter(
            "delay",
            nominal=START_DELAY,
            min_value=DELAY_BOUNDS[0],
            max_value=DELAY_BOUNDS[1],
            modifier=lambda s, p: None,
        )
    )
    model = spec.compile()
    ids = [model.actuator(name).id for name in names]
    places = 1 + model.jnt_qposadr[model.actuator_trnid[ids, 0]]
    step = model.opt.timestep
    held = np.zeros((len(log.time), model.nu))
    held[:, ids] = log.command
    commands = sysid.TimeSeries(log.time, held)
    # Its own resampling is linear; servos hold a command until the next.
    commands = commands.resample(
        step * np.arange(round(log.time[-1] / step) + 1), method="zoh"
    )
    qpos = np.zeros(model.nq)
    qpos[places - 1] = log.q[0]
    measured = sysid.TimeSeries.from_names(
        log.time, sensor_columns(model, ids, log.q), model
    )

    def in_radians(params, predicted, measured, model, return_all, state=None, **_):
        """Return position errors of the states, which come the delay later."""
        delay = params["delay"].value[0]
        q = late(state[:, 0], state[:, places], measured.times, delay)
        series = sysid.TimeSeries(
            measured.times, sensor_columns(model, ids, q), measured.signal_mapping
        )
        return q - measured.data[:, ids], series, measured

    sequences = sysid.ModelSequences(
        "arm",
        spec,
        "log",
        sysid.create_initial_state(model, qpos, np.zeros(model.nv)),
        commands,
        measured,
    )
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=in_radians, n_threads=1
    )
    begun = time.process_time()
    optimum, _ = sysid.optimize(
        params,
        residual,
        optimizer="mujoco",
        verbose=False,
        output=sys.stderr,
        **options,
    )
    spent = time.process_time() - begun
    found = bare_spec()
    sysid.apply_param_modifiers_spec(optimum, found)
    return Found(found, float(optimum["delay"].value[0]), spent)


def sensor_columns(model, ids, q):
    """Return positions (N, n) as columns of all sensors (N, ns); those of other joints stay 0."""
    columns = np.zeros((len(q), model.nsensordata))
    columns[:, ids] = q
    return columns


def by_command(log, names) -> Found:
    """Return what the command finds, imports and files included."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        titles = ["time", *(f"{n}.pos" for n in names), *(f"action_{n}" for n in names)]
        rows = np.column_stack((log.time, log.q, log.command))
        np.savetxt(path, rows, "%.9g", ",", header=",".join(titles), comments="")
        words = f"-m robot_sysid identify {FILE} {path} --torque-from position-error"
        options = f"--joint {TIP} --output-dir {folder}/out"
        before = children_seconds()
        subprocess.run(
            [sys.executable, *words.split(), *options.split()],
            stdout=sys.stderr,
            check=True,
        )
        spent = children_seconds() - before
        (written,) = (Path(folder) / "out").glob("*.xml")
        servo = json.loads((Path(folder) / "out" / "servo.json").read_text("utf-8"))
        (delay,) = (
            row["value"]
            for row in servo["quantities"]
            if row["name"] == "simulated_delay"
        )
        return Found(bare_spec(written), delay, spent)


def children_seconds() -> float:
    """Return the processor time of ended child processes [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def errors(spec, delay, log, names) -> str:
    """Return the root mean square position errors of a model on a log, in words."""
    model = spec.compile()
    ids = [model.actuator(name).id for name in names]
    times, q = play(model, log.time, log.command, ids)
    off = 1e3 * (late(times, q, log.time, delay) - log.q)
    jumps = np.abs(np.diff(log.command, axis=0, prepend=log.command[:1])) > JUMP
    after = np.zeros_like(jumps)
    for sample, joint in zip(*np.nonzero(jumps)):
        after[sample : sample + round(AFTER_JUMP * RATE), joint] = True
    every, calm = (np.sqrt(np.mean(off[at] ** 2)) for at in (np.s_[:], ~after))
    share = 100.0 * np.mean(after)
    return (
        f"held-out error {every:.2f} mrad, without the {share:.0f} % of samples that follow jumps "
        f"{calm:.2f} mrad"
    )


def main() -> None:
    """Print error, numbers and time of both."""
    robot = load_robot_model(FILE, joint=TIP)
    names = robot.joint_names
    truth = true_spec(names, np.random.default_rng(0))
    model = truth.compile()
    ids = [model.actuator(name).id for name in names]
    log = made_log(model, robot, ids, 1)
    held_out = made_log(model, robot, ids, 2)
    true = numbers_of(truth, names)
    for title, spec in {"file": bare_spec(), "truth": in_steps_of_file(truth)}.items():
        print(f"{title}, true delay: {errors(spec, DELAY, held_out, names)}")
    sides: dict[str, Callable[..., Found]] = {
        "robot-sysid": by_command,
        "mujoco.sysid": by_sysid,
        "mujoco.sysid, wide differences": partial(by_sysid, eps=WIDE_STEP),
    }
    for title, run in sides.items():
        found = run(log, names)
        print(
            f"{title}: {found.seconds:.0f} s, delay {1e3 * found.delay:.1f} ms, "
            f"{errors(found.spec, found.delay, held_out, names)}"
        )
        for number, values in numbers_of(found.spec, names).items():
            worst = 100.0 * np.max(np.abs(values / true[number] - 1.0))
            print(f"  {number}: {worst:.0f} % off at most", flush=True)


if __name__ == "__main__":
    main()
