"""The next step of a plan repeats what its model was identified from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from robot_sysid.config import SysidConfig
from robot_sysid.pipeline.run_words import is_mass_out_of_reach, words_of_plan
from tests.support import arms
from tests.support import results as made

SETTINGS = 'path = "arm.xml"\nmeasurements = ["first.csv"]\nunits = "deg"\n'


def words_of(folder):
    """The words after a plan with the model that a run in a folder has written."""
    config = SysidConfig.of_plan(folder / "updated_model.xml", output_dir=folder)
    return words_of_plan(config)


@pytest.mark.parametrize("log_exists", [True, False])
def test_a_written_model_is_followed_by_the_files_that_it_came_from(
    tmp_path, monkeypatch, log_exists
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "updated_model.xml").touch()
    (folder / "run.toml").write_text(SETTINGS)
    (tmp_path / "arm.xml").touch()
    if log_exists:
        (tmp_path / "first.csv").touch()
    run = words_of(folder)
    assert run.origin == (("arm.xml", "first.csv") if log_exists else ())
    assert run.log == ("--units", "deg")


@pytest.mark.parametrize("settings", ["", "path = ", 'path = "arm.xml"\n'])
def test_a_model_without_a_run_of_logs_has_no_origin(tmp_path, settings):
    (tmp_path / "updated_model.xml").touch()
    (tmp_path / "run.toml").write_text(settings)
    assert words_of(tmp_path).origin == ()


@pytest.mark.parametrize(
    ("mass", "error", "is_out_of_reach"),
    [(0.01, 0.1, True), (0.01, 0.001, False), (1.0, 1.0, False)],
)
def test_a_mass_far_below_the_errors_of_other_links_is_out_of_reach(
    mass, error, is_out_of_reach
):
    """Links of 1.2 kg, known to 5 %, hide 10 g; a mass of 1 kg some other motion shows."""
    result = made.found(made.with_value("m", mass, error))
    result = replace(result, robot=arms.robot_of(arms.THREE))
    config = SysidConfig.of(Path("arm.xml"), measurements=(Path("log.csv"),))
    assert is_mass_out_of_reach(config, result) is is_out_of_reach
