"""Logs of real arms, where they are at hand: a KUKA LWR4+ and a Staubli TX40.

Only the terminal link and every joint's friction are fitted; the other links keep the model's
numbers. That is less than a whole-arm fit may reach on the fitted motion, and it carries over to
another motion better than one.
"""

from __future__ import annotations

import json

import pytest

from robot_sysid.cli import main
from tests.support.places import DATA

KUKA, TX40 = DATA / "kuka_lwr4", DATA / "tx40"

pytestmark = pytest.mark.skipif(not DATA.exists(), reason="the logs of real arms are not here")


def identified(folder, model, log, *options):
    """(exit code, params.json) of one run."""
    code = main([str(model), "--measurements", str(log), "--output-dir", str(folder), *options])
    return code, json.loads((folder / "params.json").read_text())


def kuka(folder, fitted, tested, *options):
    logs = [KUKA / f"lwr4_hw{run}_200Hz.csv" for run in (fitted, tested)]
    more = ("--validate", "0", "--validation-measurements", str(logs[1]), *options)
    return identified(folder, KUKA / "kuka_lwr4.urdf", logs[0], *more)


@pytest.mark.parametrize(("tested", "limit"), [(2, 0.03), (3, 0.07)])
def test_kuka_predicts_its_other_runs(tmp_path, tested, limit):
    """Relative torque error; a whole-arm fit reaches 1.8 % on run 2 and 13 % on run 3."""
    _, params = kuka(tmp_path, 1, tested)
    assert params["validation"][0]["relative_error"] < limit
    assert params["valid"]["physically_consistent"]


def test_kukas_weak_result_is_not_trusted_and_says_why(tmp_path, capsys):
    """A last link of 0.3 kg among torques of 60 N m, and no other trajectory to tell it."""
    code, params = kuka(tmp_path, 1, 2)
    assert code == 1 and params["status"] == "TOO_WEAK"
    assert not list(tmp_path.glob("updated_model*"))
    assert "no model was written: the data does not tell" in capsys.readouterr().err
    assert "other links do not fit this arm" in " ".join(params["limitations"])


def test_what_the_model_says_of_kukas_link_does_not_count_as_measured(tmp_path):
    code, params = kuka(tmp_path, 1, 3, "--prior", "entropic", "--prior-weight", "100")
    assert code == 1 and not (tmp_path / "updated_model.urdf").exists()
    assert params["validation"][0]["relative_error"] < 0.07


@pytest.mark.parametrize("method", ["ols", "wls", "robust"])
def test_tx40_needs_rotor_inertia_and_says_so_by_choosing_it(tmp_path, method):
    """Motor torques: without rotor inertia the error is several times larger."""
    log, model = TX40 / "tx40_500Hz.csv", TX40 / "tx40.urdf"
    known = [f"--{cause}-uncertainty=0" for cause in ("link", "scale", "zero", "friction")]
    auto = ("--friction-model", "auto", "--method", method, *known)
    _, chosen = identified(tmp_path / "auto", model, log, *auto)
    without = ("--friction-model", "coulomb-viscous-offset", "--method", method, *known)
    _, plain = identified(tmp_path / "plain", model, log, *without)
    assert "armature" in chosen["friction_model"]
    assert chosen["rmse"] < 0.5 * plain["rmse"]
    assert chosen["valid"]["physically_consistent"] and plain["valid"]["physically_consistent"]
    assert any("stands still from line 3707 on" in note for note in chosen["notes"])


def test_tx40s_weightless_flange_does_not_stop_the_model_from_being_written(tmp_path):
    code, params = identified(tmp_path, TX40 / "tx40.urdf", TX40 / "tx40_500Hz.csv")
    assert code == (0 if params["valid"]["trustworthy"] else 1)
    assert (tmp_path / "updated_model.urdf").exists() == params["valid"]["trustworthy"]
