"""Real servos on a pendulum: robot-sysid, mujoco.sysid and BAM on the same recordings.

    pip install -e ".[dev,bench]" better-actuator-models "optuna<4.4" cmaes wandb
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.servo_bam FOLDER --trials 1000 [--write]

FOLDER has recordings as Rhoban's BAM (https://github.com/Rhoban/bam) makes them: an XL330 with
0.49 kg at 0.1 m at several gains, an STS3250 with 1.13 kg at 0.12 m. Each tool fits the same of
them, and what it found is played on all of the servo, each whole from its first position, with the
gain in proportion to the servo's register and nothing fitted.

- robot-sysid reads them as they are. MuJoCo alone plays the file that it wrote, and a simulation
  of one joint what only its cards hold (``card_of``).
- mujoco.sysid seeks gain, torque limit, damping, dry friction and rotor inertia, each between a
  tenth and ten times the number of ``SERVOS``, by simulations of whole recordings and finite
  differences of 0.001: its own step of 1.5e-8 is lost in dry friction.
- BAM's own fit of its model M4 searches (CMA-ES, unseeded) in its own simulation, whose steps of
  5 ms play the result as well; 100 000 trials are its default. The numbers that it ships for the
  XL330 are of all recordings of its authors, these among them or not. It has no STS3250: that is an
  STS3215 to it, a servo whose gain its fit may change tenfold.

BAM wants Python 3.12. A tool that is not installed has no rows. Printed are root mean square errors
of the position, and processor time: of commands with imports and files.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import resource
import shutil
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

from rigs.files.page_tables import PageTable
from rigs.files.places import DATA, ROOT
from rigs.logs.pendulum_logs import STEP, Card, card_plays, model_plays, recordings_of

TABLE = PageTable(
    ROOT / "docs" / "gallery.md", "pendulum", "python -m benchmarks.accuracy.servo_bam"
)
FOLDER = DATA / "bam_xl330"
NUMBERS = ("gain", "limit", "damping", "frictionloss", "armature")
FACTOR_BOUNDS = (0.1, 10.0)
WIDE_STEP = 1e-3
"""Step of finite differences of mujoco.sysid, in factors of the numbers."""
TRIALS = 1000
BAM_STEP = 0.005
SHIPPED = ("m1", "m4", "m6")
"""Models of BAM that have a row with the numbers that it ships: simplest, M4, largest."""
HIGH_GAIN = ("kp400_sin_sin", "kp400_sin_time_square")


@dataclass(frozen=True)
class Servo:
    """A type of servo.

    Attributes:
        actuator: what BAM calls it.
        start: of ``NUMBERS``, roughly those of its data sheet; mujoco.sysid begins there.
        fits: the recordings of each fit.
    """

    actuator: str
    start: tuple[float, ...]
    fits: tuple[tuple[str, ...], ...]


SERVOS = {
    "xl330": Servo(
        "xl330",
        (2.0, 0.5, 0.02, 0.02, 0.002),
        (HIGH_GAIN, (*HIGH_GAIN, "kp100_sin_time_square")),
    ),
    "sts3250": Servo("sts3215", (20.0, 5.0, 0.5, 0.1, 0.02), (("kp32_sin_sin",),)),
}


@dataclass(frozen=True)
class Found:
    """What a tool found: its name, what plays a recording, and processor time [s]."""

    tool: str
    plays: Callable | None
    seconds: float | None = None


def children_seconds() -> float:
    """Return the processor time of ended child processes [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run(*words) -> int:
    """Run a module of this Python, its words to standard error, and return its exit code."""
    # BAM reports to a service on the net where it is not told otherwise.
    quiet = {**os.environ, "WANDB_MODE": "disabled"}
    command = [sys.executable, "-m", *map(str, words)]
    return subprocess.run(command, stdout=sys.stderr, env=quiet).returncode


def numbers_of(folder) -> dict[str, float]:
    """Return the numbers of a result of robot-sysid by name."""
    text = (folder / "servo.json").read_text(encoding="utf-8")
    rows = json.loads(text)["quantities"]
    return {row["name"]: row["value"] for row in rows if row["source"] != "file"}


def card_of(folder) -> Card:
    """Return all that the cards of a result of robot-sysid hold."""
    numbers = numbers_of(folder)
    limit = numbers["torque_limit"]
    return Card(
        gain=numbers["gain"],
        limit=math.inf if limit is None else limit,
        # All damping is in the torque that the gears carry.
        back_emf=numbers["damping"],
        coulomb=numbers["frictionloss"],
        armature=numbers["armature"],
        load_share=numbers["load_share"],
        stribeck=numbers["stribeck"],
        load_stribeck=numbers["load_stribeck"],
        stribeck_speed=numbers["slip_speed"],
        stribeck_curve=2.0,
        delay=numbers["command_delay"],
    )


def by_robot_sysid(fitted, folder) -> list[Found]:
    """Return what the command finds: its written file and its card, or that it refused."""
    kp = fitted[0].kp
    model = folder / "model.xml"
    model.write_text(fitted[0].pendulum.model(), encoding="utf-8")
    logs = [recording.path for recording in fitted]
    out = folder / "out"
    options = ("--torque-from", "position-error", "--output-dir", out)
    before = children_seconds()
    code = run("robot_sysid", "identify", model, *logs, *options)
    seconds = children_seconds() - before
    if code:
        return [Found("robot-sysid, refused", None, seconds)]
    (written,) = out.glob("*.xml")
    compiled = mujoco.MjModel.from_xml_path(str(written))
    delay = numbers_of(out)["simulated_delay"]
    card = card_of(out)

    def file_plays(recording):
        return model_plays(compiled, recording, times=recording.kp / kp, delay=delay)

    def its_card_plays(recording):
        return card_plays(card, recording, times=recording.kp / kp)

    return [
        Found("robot-sysid, file", file_plays, seconds),
        Found("robot-sysid, card", its_card_plays, seconds),
    ]


def set_number(spec, parameter, number, value) -> None:
    """Give the joint and servo of a spec a number; the spec's name is a factor of its gain."""
    (joint,) = spec.joints
    (servo,) = spec.actuators
    value *= float(parameter.value[0])
    if number == "gain":
        value *= float(spec.modelname)
        servo.gainprm[0] = value
        servo.biasprm[1] = -value
    elif number == "limit":
        servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        servo.forcerange = [-value, value]
    else:
        # Damping is a polynomial from MuJoCo 3.7 on.
        old = getattr(joint, number)
        setattr(joint, number, value if np.isscalar(old) else [value, *old[1:]])


def sensed_spec(recording, kp):
    """Return the pendulum of a recording with a position sensor, named by its gain over kp."""
    spec = mujoco.MjSpec.from_string(recording.pendulum.model())
    spec.modelname = str(recording.kp / kp)
    spec.option.timestep = STEP
    spec.add_sensor(
        name="position",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname="servo",
    )
    return spec


def by_mujoco_sysid(fitted, start) -> Found:
    """Return what mujoco.sysid finds of gain, limit, damping, dry friction and rotor."""
    from mujoco import sysid

    kp = fitted[0].kp
    params = sysid.ParameterDict()
    for number, value in zip(NUMBERS, start):
        modifier = partial(set_number, number=number, value=value)
        lower, upper = FACTOR_BOUNDS
        params.add(sysid.Parameter(number, 1.0, lower, upper, modifier=modifier))
    sequences = []
    for index, recording in enumerate(fitted):
        spec = sensed_spec(recording, kp)
        model = spec.compile()
        clock = recording.time - recording.time[0]
        steps = STEP * np.arange(round(clock[-1] / STEP) + 1)
        sequences.append(
            sysid.ModelSequences(
                f"pendulum{index}",
                spec,
                "log",
                sysid.create_initial_state(model, recording.q[:1], np.zeros(1)),
                sysid.TimeSeries(clock, recording.command[:, None]).resample(steps),
                sysid.TimeSeries.from_names(clock, recording.q[:, None], model),
            )
        )

    def in_radians(params, predicted, measured, model, return_all, state=None, **_):
        """Return position errors that are not divided by the deviation of the measured ones."""
        q = np.interp(measured.times, state[:, 0], state[:, 1])[:, None]
        series = sysid.TimeSeries(measured.times, q, measured.signal_mapping)
        return q - measured.data, series, measured

    residual = sysid.build_residual_fn(
        models_sequences=sequences, modify_residual=in_radians, n_threads=1
    )
    options = {"optimizer": "mujoco", "verbose": False, "output": sys.stderr}
    begun = time.process_time()
    optimum, _ = sysid.optimize(params, residual, eps=WIDE_STEP, **options)
    seconds = time.process_time() - begun
    found = sensed_spec(fitted[0], kp)
    sysid.apply_param_modifiers_spec(optimum, found)
    compiled = found.compile()

    def plays(recording):
        return model_plays(compiled, recording, times=recording.kp / kp)

    return Found("mujoco.sysid", plays, seconds)


def bam_plays(recording, model, processed):
    """Return times and positions (N,) of BAM's simulation of a recording."""
    from bam.logs import Logs
    from bam.simulate import Simulator

    logs = {Path(log["filename"]).name: log for log in Logs(str(processed)).logs}
    log = logs[recording.path.name]
    q, _, _ = Simulator(model).rollout_log(log, simulate_control=True)
    return BAM_STEP * np.arange(len(q)), np.array(q)


def by_bam(fitted, actuator, processed, folder, trials) -> Found:
    """Return what BAM's own fit of M4 finds."""
    from bam.model import load_model

    chosen = folder / "fitted"
    chosen.mkdir()
    for recording in fitted:
        shutil.copy(processed / recording.path.name, chosen)
    found = folder / "m4.json"
    options = ("--actuator", actuator, "--model", "m4", "--trials", trials)
    before = children_seconds()
    code = run("bam.fit", "--logdir", chosen, *options, "--output", found)
    seconds = children_seconds() - before
    if code:
        return Found("BAM, M4, failed", None, seconds)
    plays = partial(bam_plays, model=load_model(str(found)), processed=processed)
    return Found(f"BAM, M4, {trials} trials", plays, seconds)


def shipped(servo, processed) -> list[Found]:
    """Return the models whose numbers BAM ships for a servo."""
    from bam.model import load_model

    try:
        models = [load_model(motor_name=servo, model=name) for name in SHIPPED]
    except FileNotFoundError:
        return []
    return [
        Found(
            f"BAM, {name.upper()} as shipped",
            partial(bam_plays, model=model, processed=processed),
        )
        for name, model in zip(SHIPPED, models)
    ]


def row(found, fitted, recordings) -> str:
    """Return the row of a tool: errors on all recordings [mrad], those of the fit marked."""
    cells = ["–"] * len(recordings)
    if found.plays:
        errors = [one.error(*found.plays(one)) for one in recordings.values()]
        marks = ["*" * (name in fitted) for name in recordings]
        cells = [f"{1e3 * value:.0f}{mark}" for value, mark in zip(errors, marks)]
    spent = "" if found.seconds is None else f"{found.seconds:.0f}"
    return f"| {' | '.join([found.tool, *cells, spent])} |"


def tools(name, servo, recordings, place, trials):
    """Yield each tool's result with the names of what it fitted."""
    raw, processed = place / "raw", place / "processed"
    raw.mkdir()
    processed.mkdir()
    for recording in recordings.values():
        shutil.copy(recording.path, raw)
    has_bam = importlib.util.find_spec("bam") is not None
    if has_bam:
        run("bam.process", "--raw", raw, "--logdir", processed, "--dt", BAM_STEP)
        yield from ((found, ()) for found in shipped(name, processed))
    for number, names in enumerate(servo.fits):
        fitted = [recordings[one] for one in names]
        own = place / str(number)
        own.mkdir()
        yield from ((found, names) for found in by_robot_sysid(fitted, own))
        yield by_mujoco_sysid(fitted, servo.start), names
        if has_bam:
            yield by_bam(fitted, servo.actuator, processed, own, trials), names


def page_lines(folder, trials):
    """Yield the tables of all servos, a row as soon as it is found."""
    for name, servo in SERVOS.items():
        recordings = recordings_of(folder, name)
        yield f"### {name.upper()}"
        yield ""
        yield f"| {' | '.join(['mrad (* in the fit)', *recordings, 's'])} |"
        yield f"| --- |{' --- |' * (len(recordings) + 1)}"
        with tempfile.TemporaryDirectory() as place:
            found = tools(name, servo, recordings, Path(place), trials)
            for one, fitted in found:
                yield row(one, fitted, recordings)
        yield ""


def main() -> None:
    """Print the tables; write them where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--trials", type=int, default=TRIALS, help="of BAM's search")
    parser.add_argument("--write", action="store_true", help="put them into the page")
    arguments = parser.parse_args()
    lines = []
    for line in page_lines(arguments.folder, arguments.trials):
        print(line, flush=True)
        lines.append(line)
    if arguments.write:
        TABLE.write(lines[:-1])


if __name__ == "__main__":
    main()
