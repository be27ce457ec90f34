"""``--report`` and ``robot-sysid report``: results first, then the page, and what can go wrong."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import replace

import pytest

from rigs.arms import small_arms
from rigs.files.command_line import OUT
from rigs.logs import measured_logs
from robot_sysid.config import SelfTestConfig
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.pipeline.stages import identify, load_arm, write_results
from robot_sysid.records.messages import Progress
from robot_sysid.report.runs import load_run

RUN = ("--duration 2 --sample-rate 100 --seed 1",)


@pytest.fixture
def arm(arm_file):
    return arm_file(small_arms.THREE)


def without(monkeypatch, library):
    find_spec = importlib.util.find_spec

    def find_others(name, *arguments):
        return None if name == library else find_spec(name, *arguments)

    monkeypatch.setattr(importlib.util, "find_spec", find_others)


def test_a_missing_library_is_said_before_the_run(command, arm, monkeypatch):
    without(monkeypatch, "matplotlib")
    printed = command.run(arm, *RUN, "--report", code=2)
    assert "needs matplotlib" in printed.err and "pip install" in printed.err
    assert "Loading" not in printed.out
    printed = command.run("report", arm.parent, code=2)
    assert "pip install" in printed.err


def test_data_of_a_run_never_pass_for_those_of_another(command, arm):
    """A second run that ends while the first still counts its residuals."""
    options = {"duration": 2.0, "sample_rate": 100.0, "seed": 1}
    config = SelfTestConfig.of(arm, plant_model=arm, **options)
    silent = Progress()
    result, plan = identify(config, load_arm(config, silent), silent)

    def slowly(every_sample):
        (OUT / "params.json").write_text((OUT / "params.json").read_text() + "\n")
        return result.traces(every_sample)

    write_results(config, replace(result, traces=slowly), silent, plan)
    assert (OUT / "report_data.npz").is_file() and not (OUT / "report.html").exists()
    run = load_run(OUT)
    assert run.traces is None and "belongs to another run" in run.missing


@pytest.mark.parametrize(
    ("call", "option", "code", "message"),
    [
        (
            "jinja2.Environment.get_template",
            "--report",
            1,
            "the results are written, but the report is not",
        ),
        (
            "numpy.savez_compressed",
            "--no-friction",
            0,
            "nothing was left for a later report",
        ),
    ],
)
def test_a_report_that_fails_leaves_the_results(
    command, arm, monkeypatch, call, option, code, message
):
    def fail(*_, **__):
        raise OSError("ink is out")

    monkeypatch.setattr(call, fail)
    printed = command.run(arm, "--plant-model", arm, *RUN, option, code=code)
    assert message in printed.err and "ink is out" in printed.err
    assert (OUT / "updated_model.xml").is_file()


@pytest.mark.slow
def test_a_page_and_a_comparison(command, arm):
    printed = command.run(arm, "--plant-model", arm, *RUN, "--report")
    assert "Report:" in printed.out and (OUT / "report.html").is_file()
    page = (OUT / "report.html").read_text().splitlines()
    assert "Written" in command.run("report", OUT).out
    later = (OUT / "report.html").read_text().splitlines()
    # A command that the folder's file holds, and that this run has not made, may be a stranger's.
    own = [line for line in page if line not in later]
    assert [line for line in page if line in later] == later
    assert own[1].startswith(f"<pre>robot-sysid plan {arm}") and len(own) == 2
    command.run(arm, *RUN, "--output-dir second")
    printed = command.run("report", OUT, arm.parent / "second", "--output-dir both")
    assert "comparison.html" in printed.out
    text = (arm.parent / "both" / "comparison.html").read_text()
    assert "sysid_output" in text and "second" in text


@pytest.mark.slow
def test_two_runs_on_logs_are_compared_by_one_fit(command, arm_file):
    robot = measured_logs.true_arm()
    model = arm_file(measured_logs.XML)
    for seed, name in enumerate(("first", "second")):
        log = measured_logs.seeded_log(robot, seed, 20.0, noise_torque=0.05)
        path = model.parent / f"{name}.csv"
        write_measurement_csv(path, robot.joint_names, [log])
        command.run("identify", model, f"{name}.csv", "--output-dir", name)
    printed = command.run("report", "first", "second")
    assert (
        "no difference beyond the errors; less than this would not show" in printed.out
    )
    text = (model.parent / "first" / "comparison.html").read_text()
    assert "no difference beyond the errors" in text and "joint1: friction [%]" in text
    (model.parent / "second.csv").unlink()
    printed = command.run("report", "first", "second")
    assert (
        "no common fit of the two runs" in printed.out and "second.csv" in printed.out
    )
