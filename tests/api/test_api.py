"""The face for Python programs: what the commands find, from arrays as from files, in silence."""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys

import numpy as np
import pytest

import robot_sysid as rs
from robot_sysid.api.threads import one_thread
from robot_sysid.cli import main
from robot_sysid.config import config_from
from robot_sysid.errors import InputError, SysidError
from robot_sysid.records import Measurement
from tests.support import pages

RECORDED = {"duration": 8.0, "sample_rate": 200.0, "noise_torque": 0.05, "seed": 1}


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with arm.xml, log.csv of it, and loaded.csv of it with a payload of 2 kg."""
    folder = tmp_path_factory.mktemp("api")
    pages.make_models(folder)
    for plant, log in (("truth", "log"), ("loaded", "loaded")):
        played = {
            "plant_model": folder / f"{plant}.xml",
            "save_measurements": folder / f"{log}.csv",
        }
        rs.identify(folder / "arm.xml", **RECORDED, **played)
    return folder


@pytest.fixture(scope="module")
def result(workshop):
    return rs.identify(workshop / "arm.xml", workshop / "log.csv")


@pytest.fixture(autouse=True)
def silent_and_without_files(workshop, tmp_path, monkeypatch, capfd):
    """Whatever a test calls prints nothing and leaves nothing where it is."""
    monkeypatch.chdir(tmp_path)
    before = sorted(workshop.iterdir())
    yield
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")
    assert sorted(workshop.iterdir()) == before


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
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    values = np.loadtxt(lines[1:], delimiter=",")
    table = dict(zip(lines[0].split(","), values.T))
    return Frame({"comment": np.array(["text"] * len(values)), **table})


def test_the_numbers_are_those_of_the_command(workshop, result, tmp_path):
    words = [str(workshop / "arm.xml"), "--measurements", str(workshop / "log.csv"), "--quiet"]
    # A process of its own would have one thread; in this one NumPy is there already.
    with one_thread():
        main([*words, "--output-dir", str(tmp_path / "out")])
    written = json.loads((tmp_path / "out" / "params.json").read_text())
    assert result.mass == written["mass"]
    assert result.center_of_mass.tolist() == written["center_of_mass"]
    assert result.standard_errors == written["standard_errors"]
    assert result.friction == written["friction_per_joint"]
    named = ("mass", "standard_errors", "rmse", "validation", "status")
    assert {k: result.to_dict()[k] for k in named} == {k: written[k] for k in named}


@pytest.mark.slow
def test_arrays_frames_and_logs_are_what_the_file_is(workshop, result):
    log = rs.read_log(workshop / "log.csv", workshop / "arm.xml")
    s = log.samples
    arrays = {"time": s.time, "q": s.q, "qd": s.qd, "tau": s.tau}
    forms = (log, arrays, Measurement(s.time, s.q, s.qd, s.tau), frame_of(workshop / "log.csv"))
    for form in forms:
        again = rs.identify(workshop / "arm.xml", form)
        np.testing.assert_allclose(again.theta, result.theta, rtol=1e-9)
    both = rs.identify(workshop / "arm.xml", [log, arrays], validation=arrays)
    assert both.mass == pytest.approx(result.mass, rel=0.01)
    assert len(both.identification.validation) >= 2


def test_named_values_fit_together(result):
    assert result.theta[0] == result.mass
    np.testing.assert_allclose(result.theta[1:4], result.mass * result.center_of_mass)
    assert result.inertia.shape == (3, 3) and np.all(np.linalg.eigvalsh(result.inertia) > 0.0)
    assert abs(result.mass - 4.0) < 3.0 * result.standard_errors["m"]
    assert result.failure is None
    assert "mass" in result._repr_html_() and "<td>kg</td>" in result._repr_html_()
    assert str(result).startswith("Identified parameters:\n  Mass: ")


def test_a_saved_result_is_that_of_the_command(workshop, result, tmp_path):
    files = result.save(tmp_path / "out", bundle=True)
    assert {path.name for path in files} == {"params.json", "updated_model.xml"}
    written = rs.load_robot_model(tmp_path / "out" / "bundle" / "updated_model.xml")
    assert written.prior.mass == pytest.approx(result.mass, rel=1e-9)
    assert written.friction.coulomb[-1] == pytest.approx(result.friction["joint3"]["coulomb"])


def test_a_spec_has_the_result_in_it(result):
    pytest.importorskip("mujoco", minversion="3.2.5")
    compiled = result.spec(keep_friction=True).compile()
    own = result.robot.mj_model
    assert compiled.body_subtreemass[result.robot.body_id] == pytest.approx(result.mass)
    np.testing.assert_array_equal(compiled.dof_frictionloss, own.dof_frictionloss)
    changed = result.spec().compile()
    assert not np.array_equal(changed.dof_frictionloss, own.dof_frictionloss)


def test_a_result_that_must_not_be_used_says_so_and_makes_no_model(workshop, tmp_path):
    unsure = rs.identify(workshop / "arm.xml", workshop / "log.csv", scale_uncertainty=25.0)
    assert "not known to 10 %" in unsure.failure
    assert "Not to be used" in unsure._repr_html_()
    assert [path.name for path in unsure.save(tmp_path / "out")] == ["params.json"]
    with pytest.raises(SysidError, match="not known to 10 %"):
        unsure.spec()


def test_a_plot_shows_every_joint(result):
    pytest.importorskip("matplotlib")
    axes = result.plot().axes
    assert [axis.get_ylabel() for axis in axes] == [f"joint{k}\n[N m]" for k in range(4)]


def test_without_matplotlib_a_plot_is_one_clear_error(result, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(InputError, match="pip install matplotlib"):
        result.plot()


@pytest.mark.slow
def test_a_payload_is_the_difference(workshop, tmp_path):
    model, logs = workshop / "arm.xml", (workshop / "log.csv", workshop / "loaded.csv")
    found = rs.payload(model, *logs)
    arrays = rs.read_log(logs[1], model)
    assert rs.payload(model, [logs[0]], [arrays]).mass == found.mass
    assert abs(found.mass - 2.0) < 3.0 * found.standard_errors["m"]
    assert found.failure is None and found.to_dict()["payload"]["mass"] == found.mass
    assert found.theta[0] == found.mass and found.center_of_mass.shape == (3,)
    assert "<td>centre of mass x</td>" in found._repr_html_()
    names = {path.name for path in found.save(tmp_path / "out")}
    assert names == {"params.json", "updated_model.xml", "payload_card.txt"}


@pytest.mark.slow
def test_every_link_has_its_numbers(workshop, tmp_path):
    found = rs.identify_arm(workshop / "arm.xml", workshop / "log.csv")
    assert set(found.links) == set(found.standard_errors)
    last = list(found.links)[-1]
    assert abs(found.links[last].mass - 4.0) < 3.0 * found.standard_errors[last]["m"]
    assert found.theta.shape == (4, 10) and found.friction["joint3"]["coulomb"] > 0.0
    assert found.to_dict()["links"][-1]["identified"]["mass"] == found.links[last].mass
    assert "arm.json" in {path.name for path in found.save(tmp_path / "out")}
    assert str(found).startswith("Identified links, before -> after")


def test_a_plan_gives_arrays_to_play(workshop, tmp_path):
    plan = rs.plan(workshop / "arm.xml", excitation="sines", duration=4.0, seed=1)
    motion = plan.sampled(100.0)
    assert plan.failure is None and motion.q.shape == (401, 4)
    np.testing.assert_allclose(motion.qd[[0, -1]], 0.0, atol=1e-9)
    assert any("standard deviations" in line for line in plan.to_dict()["promised"])
    files = plan.save(tmp_path / "plan.json")
    again = rs.plan(workshop / "arm.xml", trajectory=str(files[0]))
    np.testing.assert_allclose(again.motion(motion.time).q, motion.q, atol=1e-9)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: rs.identify(m, sped=3), "unknown option 'sped'; valid: "),
        (lambda m: rs.identify(m, 5), "a log is a path, arrays by name"),
        (lambda m: rs.identify(m, {"time": [1.0, 2.0]}), "tau|torque|position"),
        (
            lambda m: rs.identify(m, {"time": np.zeros((3, 2, 2))}),
            "no arrays with a row per sample",
        ),
        (lambda m: rs.identify(m, "missing.csv"), "missing.csv"),
        (lambda m: rs.identify("missing.xml"), "missing.xml not found"),
        (lambda m: rs.identify(m, plan_only=True), "call plan instead"),
        (lambda m: rs.payload(m), "give --empty LOG"),
        (lambda m: rs.payload(m, sped=3), "unknown option 'sped'"),
        (lambda m: rs.identify_arm(m, "a.csv", sped=3), "unknown option 'sped'"),
        (lambda m: rs.identify_arm(m, "a.csv", verify_rollout=True), "needs the command"),
        (lambda m: rs.identify_arm(m, "a.csv", torque_from="position-error"), "needs the command"),
        (lambda m: rs.read_log("a.csv", m, sped=3), "unknown option 'sped'"),
    ],
)
def test_what_cannot_be_used_is_one_clear_error(call, words, workshop):
    with pytest.raises(InputError, match=words):
        call(workshop / "arm.xml")


def test_the_package_is_light_and_its_functions_survive_imports_of_their_folders():
    code = (
        "import sys, robot_sysid as rs; light = 'numpy' not in sys.modules; "
        "import robot_sysid.identify.simulated, robot_sysid.payload; "
        "named = [callable(getattr(rs, name)) for name in rs.FACE]; "
        "sys.exit(0 if light and all(named) and set(rs.FACE) <= set(dir(rs)) else 1)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_functions_are_typed_and_documented():
    for name in rs.FACE:
        function = getattr(importlib.import_module("robot_sysid.api"), name)
        assert inspect.signature(getattr(rs, name)) == inspect.signature(function)
        assert "Args:" in function.__doc__ and "Raises:" in function.__doc__
        hints = inspect.signature(function).parameters.values()
        assert all(each.annotation is not inspect.Parameter.empty for each in hints)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = rs.nothing


def test_options_are_those_of_the_commands(workshop):
    """A path may be a text, a tuple a list."""
    model = workshop / "arm.xml"
    result = rs.identify(str(model), None, mesh_dir=str(workshop), seed=1, duration=2.0)
    assert result.config == config_from(model, mesh_dir=workshop, seed=1, duration=2.0)
    assert result.standard_errors == {}
