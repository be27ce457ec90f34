"""Cards of simulators hold the numbers of the written model, and what reads them swings like it."""

from __future__ import annotations

import ast
import importlib.util
import itertools
import re
import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from rigs.arms.small_arms import random_theta
from rigs.files.model_files import write_files
from rigs.files.notes import NoteRecorder
from rigs.files.recorded_files import as_run
from rigs.files.releases import since
from robot_sysid import spatial
from robot_sysid.config import IdentifyConfig
from robot_sysid.errors import InputError
from robot_sysid.export import save
from robot_sysid.model.bodies import body_theta
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Traces
from robot_sysid.records.controllers import ALL, AUTO, CHOICES, DRIVERS, SIMULATORS
from robot_sysid.records.file_access import SIMULATOR_CARD_NAMES
from robot_sysid.records.quantities import DATA, MODEL, Quantity
from robot_sysid.results import cards
from tests.results.test_written_model import checkpoints, file_of, result_of

INERTIAL = (
    '<inertial mass="{}" pos="{}" euler="10 20 30" diaginertia="0.02 0.03 0.02"/>'
)
BALL = '<geom type="sphere" size="0.01" contype="0" conaffinity="0"/>'
ARM = f"""<mujoco model="arm"><worldbody><body name="base">
{INERTIAL.format(1, "0 0 0")}{BALL}
<body name="upper arm" pos="0 0 0.1"><joint name="arm/joint-1" axis="0 1 0"/>
 {INERTIAL.format(2, "0.1 0 0.02")}{BALL}
 <body name="fore" pos="0.3 0 0.1" euler="0 0 40"><joint name="2nd" axis="1 0.2 0"/>
  {INERTIAL.format(1.5, "0.02 0.1 0")}{BALL}
  <body name="hand" pos="0 0.25 0"><joint name="lift" type="slide" axis="0 0.3 1"/>
   {INERTIAL.format(0.8, "0 0.03 0")}{BALL}
   <body name="tool" pos="0 0.1 0.02" euler="30 0 50">
    {INERTIAL.format(0.4, "0.01 0.02 0.05")}{BALL}
</body></body></body></body></body></worldbody><actuator>
<motor joint="arm/joint-1" forcerange="-40 40"/><motor joint="2nd" forcerange="-20 20"/>
<motor joint="lift"/></actuator></mujoco>"""
JOINTS = {
    "arm/joint-1": {"armature": 0.11, "damping": 1.7, "frictionloss": 0.7},
    "2nd": {"armature": 0.07, "damping": 0.9, "frictionloss": 0.3},
    "lift": {"armature": 0.9, "damping": 60.0, "frictionloss": 2.0},
}
"""Numbers of the joints in the written model."""
FIELDS = {
    "armature": "armature",
    "friction": "frictionloss",
    "dynamic_friction": "frictionloss",
    "viscous_friction": "damping",
}
"""Field of Isaac Lab to the number of a joint."""
NO_STRIBECK = (
    "friction_stribeck",
    "load_friction_external",
    "load_friction_motor_stribeck",
    "load_friction_external_stribeck",
)
GRAVITY = np.array([0.4, -0.3, -9.7])
TARGETS = pytest.mark.parametrize("simulator", [*SIMULATORS])


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """The arm before the identification."""
    path = write_files(tmp_path_factory.mktemp("in"), {"arm.xml": ARM})
    return load_robot_model(path)


def identified(robot):
    """A result with other numbers of all links but the first, of joints and of gravity."""
    rng = np.random.default_rng(3)
    thetas = robot.thetas
    for k in range(1, robot.n_joints):
        thetas[k] += random_theta(rng, 0.3)
    result = result_of(robot, thetas[-1], **file_of(JOINTS, gravity=GRAVITY))
    return replace(result, thetas=thetas, checkpoints=checkpoints(robot))


def written_files(robot, folder, choice):
    """Paths of the files of a run with ``--cards``."""
    config = IdentifyConfig.of(
        robot.path, measurements=("log.csv",), output_dir=folder, cards=choice
    )
    return save(identified(robot), config, NoteRecorder()).files


@pytest.fixture(scope="module")
def output(robot, tmp_path_factory):
    """The folder of a result with all cards."""
    folder = tmp_path_factory.mktemp("out")
    written_files(robot, folder, ALL)
    return folder


def constants(path):
    """Names of a card to their values, without the libraries that it imports."""
    tree = ast.parse(path.read_text())
    imports = (ast.Import, ast.ImportFrom)
    tree.body = [node for node in tree.body if not isinstance(node, imports)]
    values = {}
    exec(compile(tree, str(path), "exec"), values)
    return values


def theta_of(numbers):
    """Parameters (10,) of the numbers of a body."""
    inertia = np.array(numbers["inertia"])[[0, 3, 4, 1, 5, 2]]
    com = np.array(numbers["com"])
    return spatial.theta_from_com(
        numbers["mass"], com, spatial.symmetric_from_six(inertia)
    )


def test_each_template_has_its_row_and_each_row_its_template():
    names = {path.stem for path in cards.TEMPLATES.iterdir()}
    assert names == {"plain", "arm", *CHOICES, *SIMULATORS, *DRIVERS} - {AUTO, ALL}


@TARGETS
def test_a_card_is_python_and_has_the_numbers_of_the_written_model(output, simulator):
    path = output / SIMULATOR_CARD_NAMES[simulator]
    compile(path.read_text(), str(path), "exec")
    card = constants(path)
    model = mujoco.MjModel.from_xml_path(str(output / "updated_model.xml"))
    assert [*card["BODIES"]] == ["upper arm", "fore", "hand", "tool"]
    for name, numbers in card["BODIES"].items():
        theta = body_theta(model, model.body(name).id)
        assert_allclose(theta_of(numbers), theta, 1e-10, 1e-13, err_msg=name)
    limits = dict(zip(JOINTS, (40.0, 20.0, None)))
    assert card["JOINTS"] == {
        name: {**numbers, "effort_limit": limits[name]}
        for name, numbers in JOINTS.items()
    }
    assert card["GRAVITY"] == tuple(GRAVITY)


def test_a_link_that_is_one_body_there_has_the_identified_parameters(robot, output):
    card = constants(output / "drake_card.py")
    names = ["base", "upper arm", "fore", "hand"]
    thetas = [*map(theta_of, card["bodies_of"](names).values())]
    assert_allclose(thetas, identified(robot).thetas, 1e-9, 1e-12)
    assert card["bodies_of"]([*names, "tool"]) == card["BODIES"]
    assert [*card["MERGED"]] == ["hand"]
    with pytest.raises(ValueError, match=r"no body \['fore'\]; it has \['base'"):
        card["bodies_of"](["base", "upper arm", "hand", "tool"])


def test_what_is_the_models_own_is_marked(output):
    lines = (output / "newton_card.py").read_text().splitlines()
    marked = [line for line in lines if line.endswith("# as in the model before")]
    # The link of the tool changed, by its first body.
    assert [line.split("'")[1] for line in marked] == ["upper arm", "tool"]


def test_an_inertia_that_the_logs_do_not_show_is_marked(robot, output):
    """One that is the model's, and one within three errors of zero."""
    written = load_robot_model(output / "updated_model.xml")
    rows = [
        Quantity("Ixx_about_com", "upper arm", "kg·m²", 0.02, 0.03, 0.001, MODEL),
        Quantity("Ixx_about_com", "fore", "kg·m²", 0.02, 0.03, 0.001, DATA),
        Quantity("Izz_about_com", "fore", "kg·m²", 0.02, 0.03, 0.02, DATA),
        Quantity("Ixx_about_com", "hand", "kg·m²", None, 0.03, 0.02, DATA),
    ]
    result = result_of(written, quantities=tuple(rows))
    text = cards.arm_card("drake", robot, written, "m.xml", result=result)
    marked = [line for line in text.splitlines() if line.endswith(cards.NOT_SHOWN)]
    assert [line.split("'")[1] for line in marked] == ["hand"]


def test_only_the_card_of_the_choice_is_written_and_an_earlier_one_goes(
    robot, tmp_path
):
    with as_run(tmp_path):
        assert len(written_files(robot, tmp_path, ALL)) == 2 + len(SIMULATORS)
    names = [path.name for path in written_files(robot, tmp_path, "drake")]
    assert names == ["updated_model.xml", "drake_card.py", "params.json"]
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == sorted(names)


def test_an_unknown_simulator_is_refused_with_the_choices(robot):
    with pytest.raises(InputError, match="choose one of all, isaaclab, mjlab, newton"):
        IdentifyConfig.of(robot.path, measurements=("log.csv",), cards="gazebo")


def test_a_body_without_a_name_is_pointed_out(tmp_path):
    path = write_files(tmp_path, {"arm.xml": ARM.replace(' name="fore"', "")})
    arm = load_robot_model(path)
    text = cards.arm_card("drake", arm, arm, "updated_model.xml")
    assert "'#3': {" in text and "stands for a body or joint without" in text


def module_of(path):
    """A card as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    card = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(card)
    return card


@dataclass
class ImplicitActuatorCfg:
    """The fields that Isaac Lab 3.0.0 documents of its class of this name."""

    joint_names_expr: list
    stiffness: object
    damping: object
    joint_effort_limit: object = None
    armature: object = None
    friction: object = None
    dynamic_friction: object = None
    viscous_friction: object = None


@dataclass
class EarlierActuatorCfg(ImplicitActuatorCfg):
    """The same of Isaac Lab 2.3, which has another name for the limit."""

    effort_limit_sim: object = None


del EarlierActuatorCfg.__dataclass_fields__["joint_effort_limit"]


@pytest.mark.parametrize("cfg", [ImplicitActuatorCfg, EarlierActuatorCfg])
def test_isaac_lab_gets_the_joints_by_the_names_that_usd_gives_them(
    output, monkeypatch, cfg
):
    """With stand-ins for the classes, which need a program that is not installed here."""
    usd = SimpleNamespace(MakeValidIdentifier=lambda name: re.sub(r"\W|^\d", "_", name))
    pxr = SimpleNamespace(Gf=None, Tf=usd, Usd=None, UsdGeom=None, UsdPhysics=None)
    actuators = SimpleNamespace(ImplicitActuatorCfg=cfg)
    for name, module in (("isaaclab.actuators", actuators), ("pxr", pxr)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "isaaclab", SimpleNamespace(actuators=actuators))
    arm = module_of(output / "isaaclab_card.py").actuators(400.0, {"lift": 20.0})
    names = ["arm_joint_1", "_nd", "lift"]
    assert arm.joint_names_expr == names
    for field, key in FIELDS.items():
        values = [numbers[key] for numbers in JOINTS.values()]
        assert getattr(arm, field) == dict(zip(names, values))
    limits = {"arm_joint_1": 40.0, "_nd": 20.0}
    is_new = cfg is ImplicitActuatorCfg
    assert (arm.joint_effort_limit if is_new else arm.effort_limit_sim) == limits


def snippet(path):
    """The lines at the head of a card that load and swing the arm."""
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("#     "))
    block = itertools.takewhile(lambda line: line.startswith("#     "), lines[first:])
    return [line[6:] for line in block]


@TARGETS
def test_the_head_of_a_card_loads_and_swings_the_arm_in_ten_lines(output, simulator):
    lines = snippet(output / SIMULATOR_CARD_NAMES[simulator])
    ast.parse("\n".join(lines))
    assert 5 < len(lines) <= 10
    assert any(f"{simulator}_card" in line for line in lines)
    # What it calls is there.
    card = constants(output / SIMULATOR_CARD_NAMES[simulator])
    called = re.findall(rf"{simulator}_card\.(\w+)", "\n".join(lines))
    assert called and all(name in card for name in called)


def run_snippet(output, simulator, monkeypatch):
    """Run the head of a card in the folder of the card, and return its names."""
    monkeypatch.chdir(output)
    monkeypatch.syspath_prepend(str(output))
    names = {}
    try:
        exec("\n".join(snippet(output / SIMULATOR_CARD_NAMES[simulator])), names)
    finally:
        sys.modules.pop(f"{simulator}_card", None)
    return names


def test_the_snippet_of_mjlab_runs_in_mujoco_itself(output, monkeypatch):
    """With a stand-in for the one class of mjlab that the card imports."""
    pytest.importorskip("mujoco", minversion="3.3")
    for name in ("mjlab", "mjlab.actuator"):
        stand_in = SimpleNamespace(BuiltinMotorActuatorCfg=dict)
        monkeypatch.setitem(sys.modules, name, stand_in)
    model = run_snippet(output, "mjlab", monkeypatch)["model"]
    assert_allclose(model.opt.gravity, GRAVITY)
    written = mujoco.MjModel.from_xml_path(str(output / "updated_model.xml"))
    for field in ("dof_armature", "dof_damping", "dof_frictionloss"):
        assert_allclose(getattr(model, field), getattr(written, field))


@pytest.mark.slow
@pytest.mark.parametrize("simulator", ["drake", "pinocchio", "bam"])
def test_the_snippet_of_a_card_runs(output, simulator, monkeypatch):
    pytest.importorskip({"drake": "pydrake"}.get(simulator, simulator))
    names = run_snippet(output, simulator, monkeypatch)
    if simulator == "drake":
        q = names["plant"].GetPositions(names["context"])
    elif simulator == "pinocchio":
        q = names["q"]
    else:
        q = names["data"].qpos
    assert np.all(np.isfinite(q)) and np.max(np.abs(q)) > 0.1


POLYNOMIAL_JOINT = 'damping="0.4 0.3 0.05"'


@since(3, 7)
def test_damping_that_is_a_polynomial_is_a_line_in_a_card_which_says_so(tmp_path):
    """The line that is nearest over the speeds of the log, dry friction in it."""
    xml = ARM.replace(
        'axis="1 0.2 0"', f'axis="1 0.2 0" frictionloss="1" {POLYNOMIAL_JOINT}'
    )
    arm = load_robot_model(write_files(tmp_path, {"arm.xml": xml}))
    rng = np.random.default_rng(0)
    qd = rng.normal(size=(300, 3))
    qd[:, 1] = rng.uniform(-1.5, 1.5, 300)
    log = made_traces(arm, qd)
    text = cards.arm_card(
        "drake", arm, arm, "updated_model.xml", result=result_of(arm, traces=log)
    )
    (line,) = [line for line in text.splitlines() if line.startswith("#   '2nd': ")]
    assert line.startswith("#   '2nd': 0.4 v + 0.3 v |v| + 0.05 v^3, line up to 1.")
    assert line.endswith(" rad/s") and "polynomial of speed v" in text
    values = {}
    exec(text.replace("import", "# import").replace("from", "# from"), values)
    joint = values["JOINTS"]["2nd"]
    speed = np.abs(qd[:, 1])
    stated = 1.0 + 0.4 * speed + 0.3 * speed**2 + 0.05 * speed**3
    lines = np.column_stack((np.ones(300), speed))
    nearest = np.linalg.lstsq(lines, stated, rcond=None)[0]
    assert np.all(nearest > 0.0)
    assert_allclose((joint["frictionloss"], joint["damping"]), nearest, atol=1e-9)


def made_traces(arm, qd, load=None):
    """Series of a log with speeds (K, n) and torques of motors (K, n), as a result has them."""
    zeros = np.zeros_like(qd)
    load = zeros if load is None else load
    series = Traces(
        arm.joint_names,
        tuple(arm.is_slide),
        np.arange(len(qd)),
        qd,
        zeros,
        load,
        zeros,
        zeros,
    )
    return lambda every_sample: series


def test_friction_of_a_load_is_in_the_card_of_bam_alone(robot, output):
    """Over the log it is the friction of the file; where nothing shows it, model m1."""
    card = constants(output / "bam_card.py")
    assert card["friction"]("2nd") == {
        "model": "m1",
        "friction_base": 0.3,
        "friction_viscous": 0.9,
        "load_friction_motor": 0.0,
        **dict.fromkeys(NO_STRIBECK, 0.0),
        "dtheta_stribeck": 1.0,
        "alpha": 1.0,
    }
    rng = np.random.default_rng(1)
    qd = rng.normal(size=(500, 3))
    load = 10.0 * rng.normal(size=(500, 3))
    rows = [Quantity("further_load", "2nd", "", 0.0, 0.02, 0.005, "data")]
    rows += [Quantity("further_load", "lift", "", 0.0, 0.02, 0.015, "data")]
    arm = load_robot_model(output / "updated_model.xml")
    result = result_of(arm, traces=made_traces(arm, qd, load), quantities=tuple(rows))
    text = cards.arm_card("bam", robot, arm, "updated_model.xml", result=result)
    card = {}
    exec(text, card)
    assert [card["friction"](name)["model"] for name in JOINTS] == ["m1", "m5", "m1"]
    numbers = card["friction"]("2nd")
    speed = np.abs(qd[:, 1])
    torque = numbers["friction_base"] + numbers["friction_viscous"] * speed
    torque += numbers["load_friction_motor"] * np.abs(load[:, 1])
    assert np.mean(torque) == pytest.approx(np.mean(0.3 + 0.9 * speed))
    assert (
        0.0 < numbers["friction_base"] < 0.3 and numbers["load_friction_motor"] == 0.02
    )
    assert card["JOINTS"]["2nd"]["frictionloss"] == 0.3
    parameters = card["parameters"]("2nd", "mx64", kt=1.0, R=2.0)
    assert parameters == {
        "actuator": "mx64",
        "armature": 0.07,
        **numbers,
        "kt": 1.0,
        "R": 2.0,
    }


# What follows needs the libraries themselves.

TIMES = np.linspace(0.0, 2.0, 41)
START = np.array([0.6, -0.4, 0.02])
STEP = 5e-4
FREE = mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONTACT


def swing_of_mujoco(path, with_dry_friction):
    """Positions (41, 3) of the written model that swings freely."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= int(FREE)
    if not with_dry_friction:
        model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = START
    return sampled(lambda: data.qpos, lambda: mujoco.mj_step(model, data))


def sampled(positions, step):
    """Positions at ``TIMES`` of what a function steps by ``STEP``."""
    rows = [np.array(positions())]
    steps = round(TIMES[1] / STEP)
    for _ in TIMES[1:]:
        for _ in range(steps):
            step()
        rows.append(np.array(positions()))
    return np.array(rows)


def swing_of_pinocchio(card, path):
    """Positions (41, 3) by its forward dynamics; Heun's rule."""
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.buildModelFromMJCF(str(path))
    card.set_model(model)
    data = model.createData()
    state = [START.copy(), np.zeros(3)]

    def acceleration(q, v):
        return pinocchio.aba(model, data, q, v, -model.damping * v).copy()

    def step():
        q, v = state
        first = acceleration(q, v)
        second = acceleration(q + STEP * v, v + STEP * first)
        state[0] = q + STEP * v + 0.5 * STEP**2 * first
        state[1] = v + 0.5 * STEP * (first + second)

    return sampled(lambda: state[0], step)


def swing_of_drake(card, path):
    """Positions (41, 3) by its simulator."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.systems.analysis import Simulator

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(path))
    card.set_joints(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    card.set_bodies(plant, context)
    plant.get_actuation_input_port().FixValue(context, np.zeros(3))
    plant.SetPositions(context, START)
    simulator = Simulator(plant, context)

    def step():
        simulator.AdvanceTo(context.get_time() + STEP)

    return sampled(lambda: plant.GetPositions(context), step)


def swing_of_newton(card, path):
    """Positions (41, 3) by its MuJoCo solver."""
    newton = pytest.importorskip("newton")
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(str(path))
    card.set_model(builder)
    builder.joint_q[:] = START.tolist()
    model = builder.finalize(device="cpu")
    model.set_gravity(card.GRAVITY)
    solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True)
    solver.mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    solver.mj_model.opt.disableflags |= int(FREE)
    states = [model.state(), model.state()]
    newton.eval_fk(model, states[0].joint_q, states[0].joint_qd, states[0])

    def step():
        solver.step(*states, model.control(), None, STEP)
        states.reverse()

    return sampled(lambda: states[0].joint_q.numpy(), step)


def swing_of_mjlab(card, path):
    """Positions (41, 3) of the entity's model in MuJoCo itself."""
    entity = pytest.importorskip("mjlab.entity")

    def spec():
        spec = card.edited(mujoco.MjSpec.from_file(str(path)))
        for actuator in [*spec.actuators]:
            spec.delete(actuator)
        return spec

    articulation = entity.EntityArticulationInfoCfg(actuators=card.motors())
    cfg = entity.EntityCfg(spec_fn=spec, articulation=articulation)
    model = cfg.build().spec.compile()
    assert_allclose(model.actuator_forcerange, [(-40.0, 40.0), (-20.0, 20.0)])
    model.opt.timestep = STEP
    model.opt.gravity = card.GRAVITY
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= int(FREE)
    data = mujoco.MjData(model)
    data.qpos[:] = START
    return sampled(lambda: data.qpos, lambda: mujoco.mj_step(model, data))


def swing_of_genesis(card, path):
    """Positions (41, 3) by its rigid solver."""
    genesis = pytest.importorskip("genesis")
    genesis.init(backend=genesis.cpu, precision="64", logging_level="error")
    options = genesis.options
    scene = genesis.Scene(
        show_viewer=False,
        sim_options=options.SimOptions(dt=STEP, gravity=card.GRAVITY),
        rigid_options=options.RigidOptions(enable_collision=False),
    )
    arm = scene.add_entity(genesis.morphs.MJCF(file=str(path)))
    scene.build()
    card.set_entity(arm)
    arm.set_dofs_position(START)
    arm.control_dofs_force(np.zeros(3))
    return sampled(lambda: arm.get_dofs_position().numpy(), scene.step)


def swing_of_bam(card, path):
    """Positions (41, 3) of the written model, whose friction BAM sets in each step."""
    model = card.with_motors(mujoco.MjSpec.from_file(str(path))).compile()
    model.opt.timestep = STEP
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    # BAM sets rotors and friction itself.
    model.dof_frictionloss[:] = 0.0
    model.dof_damping[:] = 0.0
    data = mujoco.MjData(model)
    controllers = card.controllers(model, data, "mx64", kt=0.0, R=1.0)
    data.qpos[:] = START

    def step():
        for controller in controllers:
            controller.update()
        mujoco.mj_step(model, data)

    return sampled(lambda: data.qpos, step)


@pytest.mark.slow
def test_bam_reads_friction_that_grows_with_load(output):
    model = pytest.importorskip("bam.model")
    card = module_of(output / "bam_card.py")
    card.FRICTION["2nd"]["load_friction_motor"] = 0.02
    parameters = card.parameters("2nd", "mx64", kt=1.0, R=1.0)
    friction = model.load_model_from_dict(parameters)
    assert friction.actuator.get_extra_inertia() == 0.07
    # The motor carries 10 N m, whatever acts outside and however fast the joint is.
    for outside, speed in ((-10.0, 0.0), (5.0, 1.0)):
        found = friction.compute_frictions(10.0, outside, speed)
        assert found == pytest.approx((0.3 + 0.02 * 10.0, 0.9))


SWINGS = {
    # Largest difference [rad]; whether dry friction is part of it.
    "pinocchio": (swing_of_pinocchio, 1e-3, False),
    "drake": (swing_of_drake, 1e-3, False),
    "newton": (swing_of_newton, 1e-4, True),
    "mjlab": (swing_of_mjlab, 1e-6, True),
    "genesis": (swing_of_genesis, 1e-2, True),
    "bam": (swing_of_bam, 1e-6, True),
}
HAS_BODIES = {"bam": "updated_model.xml"}
"""Library that takes bodies from MuJoCo to the file that it reads in place of the original."""


@pytest.mark.slow
@pytest.mark.parametrize("simulator", [*SWINGS])
def test_the_arm_swings_there_as_the_written_model_does(robot, output, simulator):
    """The library reads the ORIGINAL model; all that differs comes from the card.

    BAM reads the written one: it has friction and rotors alone.
    """
    swing, tolerance, with_dry_friction = SWINGS[simulator]
    path = output / SIMULATOR_CARD_NAMES[simulator]
    pytest.importorskip({"drake": "pydrake"}.get(simulator, simulator))
    card = module_of(path)
    expected = swing_of_mujoco(output / "updated_model.xml", with_dry_friction)
    assert np.all(np.ptp(expected[:, :2], axis=0) > 0.3)
    model = output / HAS_BODIES[simulator] if simulator in HAS_BODIES else robot.path
    assert_allclose(swing(card, model), expected, rtol=0, atol=tolerance)
