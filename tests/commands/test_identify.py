"""``robot-sysid identify MODEL LOG...``: from logs, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from robot_sysid.commands import identify as module
from robot_sysid.config import config_from
from tests.support import arms, option_samples, schemas
from tests.support.measured_logs import JOINT

TAKEN = option_samples.keys_of(module.build_parser())
SAMPLES = [sample for sample in option_samples.samples() if sample.option.key in TAKEN]
LOGS = (Path("a.csv"), Path("b.csv"))


def test_it_takes_what_logs_need_and_nothing_of_a_motion():
    assert {sample.option.key for sample in SAMPLES} == TAKEN
    assert {sample.option.needs for sample in SAMPLES} == {
        "",
        "log",
        "measured",
        "friction",
        "estimate",
        "prior",
    }


def test_the_logs_stand_after_the_model(asked):
    for logs in (LOGS[:1], LOGS):
        assert asked("arm.xml", *logs) == config_from("arm.xml", measurements=logs)


@pytest.mark.parametrize("sample", SAMPLES, ids=str)
def test_every_option_reaches_its_record(sample, asked):
    there = ["--prior", "entropic"] if sample.option.needs == "prior" else []
    config = asked("arm.xml", "a.csv", *there, *sample.words)
    assert getattr(getattr(config, sample.record), sample.field) == sample.value
    assert config.log.measurements == LOGS[:1]


def test_without_a_log_it_says_so(command, arm_file):
    message = command.refused("identify", arm_file(arms.THREE))
    assert "the following arguments are required: LOG" in message


def test_it_does_what_the_option_of_the_main_command_does(command, arm_file):
    path = arm_file(arms.SEVEN)
    short = ("--duration", "3", "--sample-rate", "200", "--seed", "1")
    known = [f"--{cause}-uncertainty=0" for cause in ("link", "scale", "zero", "gravity")]
    made = ("--plant-model", path, *short, "--save-measurements", "log.csv")
    command.run(path, *made, *known)
    plain = command.run("identify", path, "log.csv", *known)
    same = command.run(path, "--measurements", "log.csv", *known)
    assert plain == same
    assert "Mass: 0.800 kg" in plain.out


@pytest.mark.slow
def test_the_link_is_played_before_it_is_written(command, arm_file):
    truth = arm_file(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT), "truth.xml")
    heavy = arms.TIP.replace('mass=".8"', 'mass="1.6"')
    guess = arm_file(arms.serial_arm((arms.Z, arms.Y, arms.X), joint=JOINT, tip_inertial=heavy))
    known = [f"--{cause}-uncertainty=0" for cause in ("link", "scale", "zero", "gravity")]
    made = ("--plant-model", truth, "--duration", "12", "--sample-rate", "200", "--seed", "1")
    command.run(truth, *made, "--save-measurements", "log.csv", "--noise-torque", "0.05", *known)
    words = ("identify", guess, "log.csv", "--verify-rollout", *known, "--accept", "model")
    out = command.run(*words, "--output-dir", "new").out
    folder = guess.parent / "new"
    schemas.check(folder / "params.json")
    entry = json.loads((folder / "params.json").read_text())["rollout"]
    assert entry["is_better"] and entry["score"] < 0.5 and "closed loop, 1 s" in out
    # A model that is the arm already gains nothing by an estimate with noise in it.
    words = ("identify", truth, "log.csv", "--verify-rollout", *known, "--output-dir", "same")
    command.run(*words, "--accept", "rollout")
    same = json.loads((truth.parent / "same" / "params.json").read_text())["rollout"]
    assert same["score"] > entry["score"]
