"""The tables of docs/evidence.md: torque errors of models on logs of real arms.

Run from the checkout, a quarter of an hour on one core; ``--write`` puts them into the page:

    pip install -e ".[dev,bench]"
    OMP_NUM_THREADS=1 python -m benchmarks.accuracy.real_logs [--write]

The logs lie in ../shared/data beside the checkout. robot-sysid runs with its defaults; the other
tools get the same stretches of the same logs with its cut-off. Every model file is evaluated by
MuJoCo's inverse dynamics, on a stretch that did not make it. A joint's mean error, which is the
offset of its sensor, is taken out everywhere.
"""

from __future__ import annotations

import platform
import sys
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np

from benchmarks.accuracy import against_mujoco_sysid as rollouts
from rigs.files.page_tables import PageTable
from rigs.files.places import DATA, ROOT
from rigs.logs.log_files import arm_of
from robot_sysid import spatial
from robot_sysid.api.calls import identify, payload
from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.model.chain import joint_friction
from robot_sysid.model.compilation import compile_model
from robot_sysid.records import Recording
from robot_sysid.records.file_access import curved_file_in
from robot_sysid.signals.process import low_pass_recordings

TABLE = PageTable(
    ROOT / "docs" / "evidence.md", "evidence", "python -m benchmarks.accuracy.real_logs"
)
ROWS = {
    "catalogue": "catalogue model, as it came",
    "friction": "its links, with friction and rotor inertia by least squares",
    "curved": "**the MJCF that robot-sysid writes**, whose friction bends",
    "mjcf": "the MJCF beside it, with straight friction",
    "urdf": "the URDF that robot-sysid writes",
    "least": "plain least squares, its parameters",
    "least file": "plain least squares, as a model file",
    "sysid": "mujoco.sysid's file: friction and rotors, links kept",
    "published": "published, of a fit",
}
WEIGHT = 2.805
STEPS = 12
# Of rotors [kg m^2], viscous [N m s/rad] and dry friction and offsets [N m]: wider than any arm.
BOUNDS = {
    "armature": (0.0, 20.0),
    "damping": (0.0, 100.0),
    "frictionloss": (0.0, 50.0),
    "offset": (-20.0, 20.0),
}


@dataclass(frozen=True)
class Case:
    """A column of the table: stretches (file, from, to [s]) of logs of one arm.

    Attributes:
        fitted, other: what makes a model, and what it is judged on.
        empty: of the arm without what it carries in the others.
        shared: two joints that one motor turns.
        rotors: whether the torque is the motors', so that rotors are in it.
    """

    title: str
    model: str
    fitted: tuple
    other: tuple
    published: str
    empty: tuple | None = None
    shared: tuple = ()
    rotors: bool = True


def split_log(log: str, start: float, end: float) -> tuple:
    """Return two stretches of a log: the first four fifths of its motion, and the last fifth."""
    middle = start + 0.8 * (end - start)
    return (log, start, middle), (log, middle, end)


LWR4 = [(f"kuka_lwr4/lwr4_hw{run}_200Hz.csv", 0.0, 99.0) for run in (1, 2, 3)]
KUKA = "kuka_lwr4/kuka_lwr4.urdf"
TX40 = "tx40/tx40.urdf"
UR10E = "ur10e_payload/ur10e.urdf"
EMPTY = "ur10e_payload/empty_100Hz.csv"
LOADED = "ur10e_payload/loaded_2p805kg_100Hz.csv"
NONE = "not published"
CASES = (
    Case(
        "KUKA LWR4+, the same motion again",
        KUKA,
        LWR4[0],
        LWR4[1],
        "3.3 to 4.1 %",
        rotors=False,
    ),
    Case(
        "KUKA LWR4+, another motion",
        KUKA,
        LWR4[0],
        LWR4[2],
        "3.3 to 4.1 %",
        rotors=False,
    ),
    Case(
        "TX40, last fifth",
        TX40,
        *split_log("tx40/tx40_500Hz.csv", 0.0, 7.66),
        "5.2 %",
        shared=(4, 5),
    ),
    Case("UR10e, last fifth", UR10E, *split_log(EMPTY, 1.1, 25.3), NONE),
    Case(
        "UR10e with a load, last fifth",
        UR10E,
        *split_log(LOADED, 1.1, 25.3),
        NONE,
        (EMPTY, 0, 99),
    ),
)


def samples(stretch) -> dict:
    """Return the samples of a stretch of a log."""
    name, start, end = stretch
    table = np.loadtxt(DATA / name, delimiter=",", skiprows=1)
    table = table[(table[:, 0] >= start) & (table[:, 0] < end)]
    q, tau = np.split(table[:, 1:], 2, axis=1)
    return {"time": table[:, 0], "q": q, "tau": tau}


def signals(stretch, joints, cutoff: float):
    """Return a stretch of a log, low-passed at a cut-off [Hz]."""
    log = samples(stretch)
    measured = Recording(log["time"], log["q"], None, log["tau"])
    return low_pass_recordings(arm_of(joints), [measured], cutoff)[0][0]


def as_mjcf(urdf: str) -> str:
    """Return the arm of a URDF as MJCF, which has a place for rotor inertia."""
    spec = mujoco.MjSpec.from_file(str(DATA / urdf))
    spec.compile()
    return spec.to_xml()


def column(case: Case, folder: Path) -> dict[str, str]:
    """Return the cells of the table's column of a case, by row; masses under "... mass"."""
    mjcf = folder / "arm.xml"
    cells = {"published": case.published}
    mjcf.write_text(as_mjcf(case.model))
    for file_format, model in (("urdf", DATA / case.model), ("mjcf", mjcf)):
        result = identify_case(case, model)
        cutoff = result.cutoff
        test = signals(case.other, result.robot.joint_names, cutoff)
        suffix = {"mjcf": ".xml", "urdf": ".urdf"}[file_format]
        written = [
            path for path in result.save(folder / file_format) if path.suffix == suffix
        ]
        error = [percent(file_error(path, result.robot, test)) for path in written[:1]]
        cells[file_format] = error[0] if error else "none is written"
        curved = curved_file_in(written)
        cells["curved"] = cells[file_format]
        if curved:
            cells["curved"] = percent(file_error(curved, result.robot, test))
    cells["catalogue"] = percent(file_error(mjcf, result.robot, test))
    cells["mjcf mass"] = f"{result.mass:.3f} ± {result.standard_errors['m']:.3f}"
    plain = LeastSquares(case, result.robot, cutoff)
    cells["friction"] = percent(plain.error(plain.solution(links=False), test))
    values = plain.solution()
    cells["least"] = percent(plain.error(values, test))
    cells["least file"] = plain.file(values)
    cells["least mass"] = f"{values[-10]:.3f}"
    stretches = tuple(
        stretch for stretch in (case.empty, case.fitted) if stretch is not None
    )
    model, mass = by_rollouts(case.model, stretches, cutoff, case.rotors)
    cells["sysid"] = percent(file_error(model, result.robot, test))
    cells["sysid mass"] = f"{mass:.3f}"
    return cells


def identify_case(case: Case, model: Path):
    """Return robot-sysid's result, with defaults."""
    if case.empty is None:
        return identify(model, samples(case.fitted))
    return payload(model, samples(case.empty), samples(case.fitted))


def file_error(model, robot, test) -> float:
    """Return the relative torque error of a model by ``mj_inverse``, each joint's mean out."""
    return relative(test, test.low_pass.decimate(file_torque(model, robot, test)))


def file_torque(model, robot, motion):
    """Return the torque (N, n) of a model, or of its file, in a motion by ``mj_inverse``."""
    model = compile_model(model).mj_model if isinstance(model, Path) else model
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.reference_qpos
    torque = np.empty_like(motion.q)
    for k, (q, qd, qdd) in enumerate(zip(motion.q, motion.qd, motion.qdd)):
        data.qpos[robot.qpos_index] = q
        data.qvel[robot.dof_index] = qd
        data.qacc[robot.dof_index] = qdd
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[robot.dof_index]
    # Its dry friction is a constraint.
    return torque + joint_friction(model, robot.dof_index).dry(motion.qd)


def relative(test, torque) -> float:
    """Return norm(measured - predicted) / norm(measured) of torques (K, n), all joints stacked."""
    measured = np.where(test.is_used, test.low_pass.decimate(test.tau), np.nan)
    off = measured - torque
    off -= np.nanmean(off, axis=0)
    return float(np.sqrt(np.nansum(off**2) / np.nansum(measured**2)))


class LeastSquares:
    """numpy's lstsq on all links, dry and viscous friction, rotor inertia and offsets; a payload.

    Sought is the deviation from the catalogue; nothing is weighed, bounded or held.
    """

    def __init__(self, case: Case, robot, cutoff: float) -> None:
        self.robot = robot
        self.case = case
        fitted = [(case.fitted, case.empty is not None)]
        fitted += [] if case.empty is None else [(case.empty, False)]
        rows = [
            self.rows(signals(log, robot.joint_names, cutoff), load)
            for log, load in fitted
        ]
        self.matrix, self.torque = (np.concatenate(same) for same in zip(*rows))
        links = np.concatenate([link.theta for link in robot.links])
        self.start = np.concatenate(
            (links, np.zeros(self.matrix.shape[1] - len(links)))
        )

    def columns(self, signals, is_loaded: bool):
        """Return filtered columns (K, n, p) of links, joints, shared motor and payload."""
        joints = len(self.robot.links)
        links = (
            LinkDynamics(self.robot)
            .motion(signals.q, signals.qd, signals.qdd)
            .columns(range(joints))
        )
        joint_columns = (
            np.sign(signals.qd),
            signals.qd,
            signals.qdd,
            np.ones_like(signals.qd),
        )
        joint_columns = [
            column[:, :, None] * np.eye(joints) for column in joint_columns
        ]
        if self.case.shared:
            pair = list(self.case.shared)
            other = list(self.case.shared)[::-1]
            both = np.zeros((*signals.q.shape, 3))
            both[:, pair, 0] = signals.qdd[:, other]
            both[:, pair, 1] = signals.qd[:, other]
            both[:, pair, 2] = np.sign(signals.qd[:, pair].sum(axis=1))[:, None]
            joint_columns.append(both)
        columns = np.concatenate(
            (links, *joint_columns, is_loaded * links[..., -10:]), axis=-1
        )
        return signals.low_pass.decimate(columns.reshape(len(columns), -1)).reshape(
            -1, *columns.shape[1:]
        )

    def rows(self, signals, is_loaded: bool):
        """Return the matrix and torques of the samples that may be used."""
        use = signals.is_used
        return self.columns(signals, is_loaded)[use], signals.low_pass.decimate(
            signals.tau
        )[use]

    def solution(self, links: bool = True):
        """Return parameters (p,) of links, joints and payload; ``links`` frees the links."""
        free = slice(0 if links else 10 * len(self.robot.links), None)
        residual = self.torque - self.matrix @ self.start
        values = self.start.copy()
        values[free] += np.linalg.lstsq(self.matrix[:, free], residual, rcond=None)[0]
        return values

    def error(self, values, test) -> float:
        """Return the relative torque error of parameters (p,) on another stretch."""
        return relative(test, self.columns(test, self.case.empty is not None) @ values)

    def file(self, values) -> str:
        """Return MuJoCo's answer to a model with these links, and how many are impossible."""
        links = values[: 10 * len(self.robot.links)].reshape(-1, 10).copy()
        links[-1] += values[-10:]
        spec = mujoco.MjSpec.from_string(as_mjcf(self.case.model))
        # What would bend impossible bodies to possible ones of another torque.
        spec.compiler.balanceinertia = False
        spec.compiler.boundmass = 0.0
        spec.compiler.boundinertia = 0.0
        for link, theta in zip(self.robot.links, links):
            put_body(spec.body(link.body_name), theta)
        impossible_count = sum(not spatial.is_consistent(theta) for theta in links)
        try:
            spec.compile()
        except ValueError:
            return f"refused, {impossible_count} of {len(links)} links impossible"
        return f"loads, {impossible_count} of {len(links)} links impossible"


@lru_cache
def by_rollouts(urdf: str, stretches: tuple, cutoff: float, rotors: bool) -> tuple:
    """Return mujoco.sysid's model, and the mass that the second stretch adds [kg]."""
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(as_mjcf(urdf))
    joints = [joint.name for joint in spec.joints]
    last = spec.joints[-1].parent.name
    rollouts.with_motors(
        spec, joints
    ).option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.timestep = rollouts.STEP
    mass = spec.compile().body(last).mass[0]
    bounds = {
        name: bound for name, bound in BOUNDS.items() if rotors or name != "armature"
    }
    params = rollouts.joint_parameters(joints, bounds)
    for stretch in stretches:
        log = signals(stretch, joints, cutoff)
        motion = log.time, log.q, log.qd, log.tau
        optimum = rollouts.optimise(spec, motion, params, rollouts.in_radians, STEPS)
        spec = sysid.apply_param_modifiers_spec(optimum, spec)
        params = sysid.ParameterDict()
        params.add(_inertia(spec, last))
    model = spec.compile()
    return model, model.body(last).mass[0] - mass


def _inertia(spec, body: str):
    """Return mujoco.sysid's ten parameters of a possible body."""
    from mujoco import sysid

    def put(spec, param) -> None:
        # Its own way to write them does not compile since MuJoCo 3.14.
        """Write the body's parameters into the model."""
        pseudo_inertia = sysid.model_modifier.pi_from_theta(param.value)
        inertia = pseudo_inertia[4:].reshape(3, 3)[np.triu_indices(3)]
        put_body(spec.body(body), np.concatenate((pseudo_inertia[:4], inertia)))

    return sysid.body_inertia_param(
        spec, spec.compile(), body, sysid.InertiaType.Pseudo, modifier=put
    )


def put_body(body, theta) -> None:
    """Give a body of an ``MjSpec`` ten parameters, whether or not a body can have them."""
    mass, com, inertia = spatial.com_from_theta(theta)
    body.mass = mass
    body.ipos = com
    body.iquat = [1, 0, 0, 0]
    body.inertia = np.zeros(3)
    body.fullinertia = [*np.diag(inertia), *inertia[np.triu_indices(3, 1)]]


def percent(share: float) -> str:
    """Return a fraction in percent."""
    return f"{100.0 * share:.3g} %"


def table(columns) -> list[str]:
    """Return the lines of the page's tables: torque errors, and masses of the payload."""
    lines = ["| Torque error | " + " | ".join(case.title for case in CASES) + " |"]
    lines.append("| --- |" + " --- |" * len(CASES))
    for key, name in ROWS.items():
        lines.append(
            f"| {name} | " + " | ".join(cells[key] for cells in columns) + " |"
        )
    lines += [
        "",
        "| Mass of the load | kg |",
        "| --- | --- |",
        f"| the scale | {WEIGHT} |",
    ]
    who = {
        "mjcf": "**robot-sysid**",
        "least": "plain least squares",
        "sysid": "mujoco.sysid",
    }
    lines += [f"| {name} | {columns[-1][f'{key} mass']} |" for key, name in who.items()]
    lines += ["", "| Mass of the last link, by robot-sysid | kg |", "| --- | --- |"]
    last_masses = {
        case.title.partition(",")[0]: cells["mjcf mass"]
        for case, cells in zip(CASES, columns)
        if case.empty is None
    }
    lines += [f"| {arm} | {mass} |" for arm, mass in last_masses.items()]
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "mujoco"))
    return [*lines, "", f"Python {platform.python_version()}, {versions}."]


def main(*options: str) -> None:
    """Print the tables; write them where that is asked for."""
    columns = []
    for case in CASES:
        with tempfile.TemporaryDirectory() as folder:
            columns.append(column(case, Path(folder)))
        print(case.title, columns[-1], file=sys.stderr)
    TABLE.show(table(columns), "--write" in options)


if __name__ == "__main__":
    main(*sys.argv[1:])
