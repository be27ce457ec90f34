"""The face for Python programs: what the commands find, from arrays as from files, in silence."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.files import pages, params
from rigs.files.places import ROOT
from rigs.files.refusals import refused
from rigs.logs import recorded
from robot_sysid.config import IdentifyConfig
from robot_sysid.errors import InputError, SysidError
from robot_sysid.motion.goals import load_goals
from robot_sysid.records import Recording
from robot_sysid.records.data import SIGNAL_NAMES
from robot_sysid.report.runs import load_run
from robot_sysid.results.verdicts import Verdict


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with arm.xml, a log of the arm, of it with a payload of 2 kg, and of its model."""
    folder = tmp_path_factory.mktemp("api")
    pages.make_models(folder)
    for plant, log in (("truth", "log"), ("loaded", "loaded"), ("arm", "model")):
        pages.record(folder, f"{plant}.xml", f"{log}.csv", duration=8.0)
    return folder


@pytest.fixture(scope="module")
def model(workshop):
    return workshop / "arm.xml"


@pytest.fixture(scope="module")
def log(workshop, model):
    return rs.read_log(workshop / "log.csv", model)


@pytest.fixture(scope="module")
def result(workshop, model):
    return rs.identify(model, workshop / "log.csv")


@pytest.fixture(autouse=True)
def silent_and_without_files(workshop, tmp_path, monkeypatch, capfd):
    """Whatever a test calls prints nothing and leaves nothing where it is."""
    monkeypatch.chdir(tmp_path)
    files_before = sorted(workshop.iterdir())
    yield
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")
    assert sorted(workshop.iterdir()) == files_before


class Frame:
    """What a data frame of pandas or polars can do that is needed here."""

    def __init__(self, table):
        self._table = table

    @property
    def columns(self):
        return list(self._table)

    def __getitem__(self, name):
        return self._table[name]


def frame_of(path):
    table = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    columns = {name: table[name] for name in table.dtype.names}
    return Frame({"comment": np.array(["text"] * len(table)), **columns})


ZEROS = np.zeros((9, 2))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"tau": ZEROS[1:]},
            "^tau .float64, shape .8, 2.. holds no real numbers with a row",
        ),
        (
            {"tau": ZEROS.astype(complex)},
            "^tau .complex128, shape .9, 2.. holds no real numbers",
        ),
        ({"q": ZEROS.astype(str)}, "^q .<U32, shape .9, 2.. holds no real numbers"),
        ({"q": [[0.0], [0.0, 1.0]]}, "^q is no array: its rows differ in length$"),
        (
            {"q": np.zeros((9, 4)), "tau": np.zeros((9, 4))},
            "each joint of the chain .joint0, joint1.*found q.0., q.1.",
        ),
    ],
)
def test_arrays_that_are_no_columns_are_named_with_what_is_wrong(changed, message):
    robot = small_arms.robot_of(small_arms.serial_arm((small_arms.Z, small_arms.Y)))
    log = {"time": np.arange(9.0), "q": ZEROS, "tau": ZEROS, "tau_limit": [1.0, 2.0]}
    with refused(message):
        rs.read_log({**log, **changed}, robot)


def test_a_text_stands_in_for_a_columns_file(workshop, model):
    log = rs.read_log(workshop / "log.csv", model, columns="position = joint*_position")
    assert_allclose(log.q, rs.read_log(workshop / "log.csv", model).q)
    with pytest.raises(InputError, match="no single column 't'"):
        rs.read_log(workshop / "log.csv", model, columns="time = t\nrate = 2\n")
    with pytest.raises(
        InputError, match="^cannot read time.txt: .*; give a columns file"
    ):
        rs.read_log(workshop / "log.csv", model, columns="time.txt")


@pytest.mark.slow
def test_arrays_frames_and_logs_are_what_the_file_is(workshop, result, model, log):
    arrays = recorded.arrays_of(log)
    turned = {n: arrays[n][:, ::-1] for n in ("q", "tau")}
    turned.update(time=log.time, joint_names=log.joint_names[::-1])
    frame = frame_of(workshop / "log.csv")
    forms = (log, arrays, Recording(**arrays), frame, turned)
    for form in forms:
        from_form = rs.identify(model, form)
        assert_allclose(from_form.theta, result.theta, rtol=1e-9)
        # Samples in memory are not kept with it.
        assert len(pickle.dumps(from_form.config)) < 2e4
    columns = ("time", "q", "tau")
    shorter, shortest = ({n: arrays[n][k:] for n in columns} for k in (1, 2))
    halves = [{n: shortest[n] for n in ("time", half)} for half in ("q", "tau")]
    both = rs.identify(model, [log, shorter], validation_measurements=halves)
    assert both.mass == pytest.approx(result.mass, rel=0.01)
    assert len(both.file.others) == 1 and len(both.validation) >= 2


@pytest.mark.slow
def test_a_model_that_is_worse_than_the_given_one_on_another_log_is_refused(
    workshop, model, log
):
    """Also where the fitted log is too noisy to be contradicted by the other one."""
    noise = np.random.default_rng(0).standard_normal(log.tau.shape)
    arrays = {**recorded.arrays_of(log), "tau": log.tau + noise}
    other = rs.read_log(workshop / "model.csv", model)[:1200]
    worse = rs.identify(model, arrays, validation_measurements=other)
    assert worse.verdict is Verdict.NO_BETTER
    ((before, after),) = re.findall(
        r"on \S*model\.csv: (\S+) % -> (\S+) %", worse.failure
    )
    assert float(before) < 1.0 and float(after) > 10.0


def test_a_log_that_was_read_is_not_read_otherwise(workshop, tmp_path, model):
    log = rs.read_log(workshop / "log.csv", model, units="rad")
    others = {
        "torque_scale": 2.0,
        "torque_constants": 0.5,
        "units": "deg",
        "episode": 1,
    }
    for name, value in others.items():
        with refused(f"was read without {name}, or with"):
            rs.identify(model, log, **{name: value})
        with refused(f"was read without {name}, or with"):
            rs.payload(model, log, log, **{name: value})
    scaled = rs.read_log(workshop / "log.csv", model, torque_scale=1.02)
    with refused("without torque_scale, or .* give read_log"):
        rs.identify(model, scaled)
    mass = rs.identify(model, scaled, torque_scale=1.02).mass
    assert mass == rs.identify(model, workshop / "log.csv", torque_scale=1.02).mass
    other = tmp_path / "other.xml"
    other.write_text(model.read_text().replace('"joint', '"hinge'))
    with refused("joint3, and .* hinge3; read it with"):
        rs.identify(other, log)


def test_masked_numbers_are_missing(model, log):
    tau = np.ma.masked_array(log.tau.copy())
    tau[100:140] = np.ma.masked
    arrays = {"time": log.time, "q": log.q, "tau": tau}
    masked = rs.read_log(arrays, model)
    assert len(masked) == len(log) - 40
    assert any(re.match("left out rows .*: 40 ", note) for note in masked.notes)
    with refused("tau|torque|position"):
        rs.read_log({"time": log.time}, model)


def test_a_recording_does_not_count_twice(workshop, tmp_path, model):
    log = workshop / "log.csv"
    copy = tmp_path / "copy.csv"
    copy.write_bytes(log.read_bytes())
    for call in (
        lambda: rs.identify(model, [log, copy]),
        lambda: rs.payload(model, [log, copy], workshop / "loaded.csv"),
        lambda: rs.payload(model, log, copy),
    ):
        with refused("copy.csv has the samples of .*log.csv"):
            call()


@pytest.mark.slow
def test_named_values_fit_together(result):
    written = result.to_dict()
    rows = params.rows(written)
    assert list(result.links) == ["link0", "link1", "link2", "link3"]
    for name, link in result.links.items():
        assert rows[name, "mass"]["value"] == link.mass
    assert result.links["link3"].mass == result.mass
    assert rows["joint0", "coulomb"]["value"] > 0.0
    for axis, value in zip("xyz", result.center_of_mass.tolist()):
        assert rows["link3", f"com_{axis}"]["value"] == value
    for name in ("hx", "Ixx", "Izz"):
        assert rows["link3", name]["error"] == pytest.approx(
            result.standard_errors[name]
        )
    for row in result.quantities:
        if row.source != "file":
            assert rows[row.of, row.name]["value"] == row.value
    assert result.mass == written["mass"]
    assert result.theta[0] == result.mass
    assert_allclose(result.theta[1:4], result.mass * result.center_of_mass)
    assert result.inertia.shape == (3, 3) and np.all(
        np.linalg.eigvalsh(result.inertia) > 0.0
    )
    assert abs(result.mass - 4.0) < 3.0 * result.standard_errors["m"]
    assert result.failure is None
    lines = str(result).split("\n")
    assert lines[0].startswith("On the flange, not in the model: ")
    assert lines[1].startswith("  link3 and joint3 ")


def test_a_result_is_the_same_after_pickling(result, tmp_path):
    unpickled = pickle.loads(pickle.dumps(result))
    assert unpickled.to_dict() == result.to_dict() and str(unpickled) == str(result)
    assert_allclose(unpickled.traces().predicted, result.traces().predicted, rtol=1e-6)
    assert (tmp_path / "out" / "updated_model.xml") in unpickled.save(tmp_path / "out")
    itself = rs.self_test(result.robot.path, seed=1, duration=2.0)
    assert pickle.loads(pickle.dumps(itself)).mass == itself.mass
    assert "Self-test passed" in str(itself)
    simulated = rs.self_test(
        result.robot.path, plant_model=result.robot.path, seed=1, duration=4.0
    )
    unpickled = pickle.loads(pickle.dumps(simulated))
    assert len(unpickled.traces().time) == len(simulated.traces().time)


def test_a_pickle_holds_the_series_of_the_log_and_little_else(result, log):
    """No sums of the fit, no meshes of the model, and no samples of logs in memory."""
    path = ROOT / "examples/kinova/model/kinova_fullinertia_guess.xml"
    meshes = rs.load_robot_model(path)
    config = IdentifyConfig.of(path, measurements=(log,))
    large = replace(result, robot=meshes, config=config)
    assert len(pickle.dumps(meshes)) > 2e6
    series = result.traces()
    size = 4 * series.measured.size * len(SIGNAL_NAMES) + series.time.nbytes
    for kept in (result, large):
        assert len(pickle.dumps(kept)) < size + 2e5
    unpickled = pickle.loads(pickle.dumps(large)).robot
    assert unpickled.joint_names == meshes.joint_names
    assert unpickled.mj_model.nmeshvert == meshes.mj_model.nmeshvert > 0
    with pytest.raises(AttributeError, match="no attribute 'mass_of'"):
        _ = unpickled.mass_of


def test_a_model_that_changed_is_not_that_of_a_pickled_result(result, tmp_path):
    path = tmp_path / "arm.xml"
    path.write_bytes(result.robot.path.read_bytes())
    moved = replace(result.config.model, path=path)
    robot = rs.load_robot_model(path)
    kept = replace(result, config=replace(result.config, model=moved), robot=robot)
    unpickled = pickle.loads(pickle.dumps(kept))
    path.write_bytes(path.read_bytes().replace(b'mass="3.5"', b'mass="3.6"'))
    assert unpickled.mass == result.mass
    with refused("arm.xml has changed since the result was made; put back the file"):
        unpickled.save(tmp_path / "out")


def test_traces_have_the_rate_of_the_log(result, log):
    series = result.traces()
    assert np.all(np.isin(series.time, log.time))
    assert_allclose(np.diff(series.time), log.time[1] - log.time[0])
    assert len(series.time) > 0.8 * len(log.time)
    rows = result.traces(every_sample=False)
    at_rows = np.isin(series.time, rows.time)
    assert np.count_nonzero(at_rows) == len(rows.time) < 0.3 * len(series.time)
    for name in SIGNAL_NAMES:
        of_rows = getattr(rows, name)
        assert_allclose(getattr(series, name)[at_rows], of_rows, rtol=1e-9, atol=1e-9)


def test_results_and_logs_say_what_they_are(result, log):
    assert repr(result).startswith("<Result link3 of arm.xml: 4.0")
    assert repr(result).endswith("kg, usable>")
    shown = replace(result, remarks=(Verdict.TORQUES_ONLY.remark("odd"),))
    assert shown.failure is None and "usable" not in repr(shown)
    assert repr(result.robot).endswith(
        "arm.xml: joint0, joint1, joint2, joint3 carry link3>"
    )
    assert repr(log).endswith("log.csv: 1601 samples of 4 joints in 8 s>")


def test_a_saved_result_is_that_of_the_command(result, tmp_path, log):
    """Of arrays, too; these are beside it, for the report."""
    in_memory = replace(result.config.log, measurements=(log,))
    of_arrays = replace(result, config=replace(result.config, log=in_memory))
    of_arrays.save(tmp_path / "arrays")
    assert load_run(tmp_path / "arrays").traces is not None
    files = result.save(tmp_path / "out")
    assert {path.name for path in files} == {"params.json", "updated_model.xml"}
    written = rs.load_robot_model(tmp_path / "out" / "updated_model.xml")
    mass = result.quantity("mass", result.robot.body_name).value
    assert written.prior.mass == pytest.approx(mass, rel=1e-9)
    coulomb = result.quantity("coulomb", "joint3", "file").value
    assert written.friction.coulomb[-1] == pytest.approx(coulomb)


def test_a_spec_has_the_result_in_it(result):
    pytest.importorskip("mujoco", minversion="3.2.5")
    compiled = result.spec().compile()
    assert compiled.body_subtreemass[result.robot.body_id] == pytest.approx(
        result.thetas[-1][0]
    )
    joints = result.robot.joint_names
    coulomb = [result.quantity("coulomb", joint, "file").value for joint in joints]
    assert_allclose(compiled.dof_frictionloss[result.robot.dof_index], coulomb)


def test_a_result_that_must_not_be_used_says_so_and_makes_no_model(result, tmp_path):
    doubtful = replace(result, remarks=(Verdict.TOO_WEAK.remark("so light"),))
    assert doubtful.failure.startswith("so light") and not doubtful.trustworthy
    assert [path.name for path in doubtful.save(tmp_path / "out")] == ["params.json"]
    with refused("so light", SysidError):
        doubtful.spec()


def test_a_plot_shows_every_joint(result, monkeypatch):
    pytest.importorskip("matplotlib")
    axes = result.plot().axes
    assert [axis.get_ylabel() for axis in axes] == [
        f"joint{k}\n[N·m]" for k in range(4)
    ]
    traces = result.traces()
    names = ("measured", "predicted before", "predicted after")
    series = (traces.measured, traces.prior_prediction, traces.predicted)
    for line, name, torque in zip(axes[2].lines, names, series):
        assert line.get_label() == name
        assert_array_equal(line.get_ydata(), torque[:, 2])
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(
        InputError, match="needs matplotlib; install with:\n  pip install "
    ):
        result.plot()


@pytest.mark.slow
def test_a_payload_is_the_difference(workshop, tmp_path, model):
    logs = (workshop / "log.csv", workshop / "loaded.csv")
    identified = rs.payload(model, *logs)
    arrays = rs.read_log(logs[1], model)
    of_arrays = rs.payload(model, [logs[0]], [arrays])
    assert of_arrays.mass == identified.mass
    assert [len(log) for log in of_arrays.config.payload.loaded] == [0]
    assert abs(identified.mass - 2.0) < 3.0 * identified.standard_errors["m"]
    assert (
        identified.failure is None
        and params.rows(identified.to_dict())["payload", "mass"]["value"]
        == identified.mass
    )
    assert identified.theta[
        0
    ] == identified.mass and identified.center_of_mass.shape == (3,)
    names = {path.name for path in identified.save(tmp_path / "out")}
    assert names == {"params.json", "updated_model.xml", "payload_card.txt"}


@pytest.mark.slow
def test_scales_by_a_known_mass_are_those_of_the_log_whatever_it_was_divided_by(
    workshop, tmp_path, model
):
    def scales(**options):
        logs = (workshop / "log.csv", workshop / "loaded.csv")
        identified = rs.payload(model, *logs, known_mass=2.0, **options)
        names = identified.robot.joint_names
        return {name: identified.quantity("torque_scale", name) for name in names}

    prior = {"priors": {"scale": 50.0}}
    scales_by_joint = scales(**prior)
    divided = scales(**prior, torque_scale=1.02)
    # Between two logs a scale may drift by 0.25 % of the arm's torque, 1 % of the weight's.
    assert scales_by_joint["joint1"].error < 0.02
    for joint, scale in scales_by_joint.items():
        difference = divided[joint].value - scale.value
        assert abs(difference) < max(1e-3, 0.1 * scale.error), joint


def test_a_plan_gives_arrays_to_play(tmp_path, model):
    plan = rs.plan(model, excitation="sines", duration=4.0, seed=1)
    motion = plan.sampled(100.0)
    assert plan.failure is None and motion.q.shape == (401, 4)
    assert_allclose(motion.qd[[0, -1]], 0.0, atol=1e-9)
    assert str(plan) == "\n".join(plan.prediction)
    assert any("with these errors" in line for line in plan.prediction)
    files = plan.save(tmp_path / "plan.json")
    assert repr(plan) == "<PlanResult 4 s for 4 joints of arm.xml, keeps all limits>"
    assert pickle.loads(pickle.dumps(plan)).duration == 4.0
    loaded = rs.plan(model, trajectory=str(files[0]))
    assert_allclose(loaded.motion(motion.time).q, motion.q, atol=1e-9)


def test_a_plan_for_servos_saves_the_goals_that_it_plays(tmp_path, model):
    options = {"for_": "servos", "goal_rate": 100.0, "excitation": "sines", "seed": 1}
    plan = rs.plan(model, duration=4.0, **options)
    files = plan.save(tmp_path / "plan.json")
    assert [path.name for path in files] == ["plan.json", "plan.csv", "goals.csv"]
    goals = load_goals(files[-1])
    assert goals.time[-1] == pytest.approx(plan.duration, abs=1e-6)
    assert_allclose(goals.q, plan.motion(goals.time).q, atol=1e-6)
    again = rs.plan(model, trajectory=str(files[0]), for_="servos")
    assert_allclose(again.motion(goals.time).q, goals.q, atol=1e-6)


def test_the_package_is_light_and_its_functions_survive_imports_of_their_folders():
    code = (
        "import sys, robot_sysid as rs, robot_sysid.config; dir(rs); "
        "light = 'numpy' not in sys.modules; "
        "import robot_sysid.commands.motors; light &= 'mujoco' not in sys.modules; "
        "import robot_sysid.commands.identify, robot_sysid.pipeline.recordings; "
        "functions = [callable(getattr(rs, name)) for name in rs.__all__ if name.islower()]; "
        "sys.exit(0 if light and functions.count(False) == 1 else 1)"  # motors is a module
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_options_are_those_of_the_commands(workshop, model):
    """A path may be a text, a tuple a list."""
    plain = {"seed": 1, "duration": 2.0}
    result = rs.self_test(str(model), mesh_dir=str(workshop), **plain)
    same = rs.self_test(model, mesh_dir=workshop, **plain)
    assert result.to_dict() == same.to_dict() and result.standard_errors == {}
