"""What a run was asked to do is checked once, before any work, with the option in the message."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.files.command_line import COMMANDS
from rigs.files.refusals import refused
from robot_sysid.config import (
    IdentifyConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
    with_scale_prior,
)
from robot_sysid.estimate.options import (
    DEFAULT_FRICTION,
    DEFAULT_TERMINAL,
    EstimationOptions,
    Priors,
    friction_terms,
    read_priors,
)
from robot_sysid.records.option_fields import write_torque_scale

MODEL = Path("arm.xml")
LOG = {"measurements": (Path("log.csv"),)}
LOGS = {"empty": (Path("a.csv"),), "loaded": (Path("b.csv"),)}
PAYLOAD = "payload a.xml --empty a.csv --loaded b.csv"
CONFIGS = {
    "": SelfTestConfig,
    "plan": PlanConfig,
    "identify": IdentifyConfig,
    "payload": PayloadConfig,
}
"""Class of the options of each command that estimates or plans."""


def refusal(config, **values):
    """The one line with which options are refused."""
    with refused() as caught:
        config.of(MODEL, **values)
    return str(caught.value)


REFUSED = {
    "a.xml --noise-torque 0.1": "--noise-torque belongs to a simulated plant",
    "a.xml --duration 0": "--duration must be positive",
    "plan a.xml --for servos --goal-rate 0": "--goal-rate must be positive",
    "identify a.xml b.csv --torque-scale 1e308": "--torque-scale must be positive, from 1e-09 to",
    "identify a.xml b.csv --torque-scale 1,1e-308": "--torque-scale must be positive, from",
    "identify a.xml b.csv --torque-constants 1e308": "--torque-constants must be positive, f",
    "identify a.xml b.csv --mass-scale 1e308": "--mass-scale must be positive, from 1e-09",
    "identify a.xml b.csv --gravity nan 0 0": "--gravity must be a number (got nan)",
    "identify a.xml b.csv --gravity 0 inf 0": "--gravity must be a number (got inf)",
    # From Python 3.13 on argparse says it itself.
    "a.xml --duration=--": (
        "argument --duration: invalid float"
        if sys.version_info >= (3, 13)
        else "--duration must be a number"
    ),
    "a.xml --duration long": "argument --duration: invalid float value",
    "a.xml --speed 1e-12": "a trajectory of 1.5e+13 s with --sample-rate 1000 has",
    "a.xml --torques all": "argument --torques: invalid choice: 'all'",
    "a.xml --output-di a": "unrecognized arguments: --output-di a; --output-di: did you mean --ou",
    "a.xml --export-damiao": "--export-damiao requires at least one --motor-type; ",
    "plan a.xml --joint-map m.csv": "--joint-map is about motors; add --motor-type",
    "a.xml --trajectory b.json --duration 3": "--trajectory and --duration ex",
    "identify a.xml b.csv --friction-model glue": "unknown friction term",
    "identify a.xml b.csv --no-friction --friction-model coulomb": (
        "--friction-model and --no-friction exclude each other"
    ),
    "identify a.xml b.csv --no-friction --keep friction": "--keep friction and --no-friction ex",
    "identify a.xml b.csv --torque-from position-error --torque-scale 2": (
        "--torque-scale is about measured torques"
    ),
    "identify a.xml b.csv --torque-from position-error --links": "--links is about measured",
    "identify a.xml b.csv --torque-from position-error --report": "--report is about measured",
    "identify a.xml b.csv --torque-from position-error --keep links": (
        "--keep is about measured torques"
    ),
    "identify a.xml b.csv --servo-setting kp=400": "--servo-setting is about servos; add --tor",
    "identify a.xml b.csv --torque-from position-error --servo-setting gain=4": (
        "argument --servo-setting: 'gain=4' is no part of a setting; valid keys: kp (the servos'"
    ),
    "identify a.xml b.csv --polish": "unrecognized arguments: --polish",
    f"{PAYLOAD} --torque-from position-error": "unrecognized arguments: --torque-from",
    "plan a.xml --torque-from position-error": "unrecognized arguments: --torque-from",
    "a.xml --torque-from position-error": "unrecognized arguments: --torque-from",
    "payload a.xml": "--empty LOG... is missing",
    "payload a.xml --empty a.csv": "--loaded LOG... is missing",
    f"{PAYLOAD} --known-mass 1 --as-body load": "--known-mass writes no model",
    f"{PAYLOAD} --save-torque-scale s": "--save-torque-scale is about",
    "a.xml --save-trajectory a.xml": "--save-trajectory would overwrite",
    "a.xml --trajectory b.json --save-trajectory b.json": "--save-trajectory would ov",
    "a.xml --save-measurements a.xml": "--save-measurements would overwrite",
    "a.xml --save-trajectory a.json --save-measurements a.csv": (
        "--save-measurements would overwrite what the CSV file beside --save-trajectory writes"
    ),
    "plan a.xml --trajectory sysid_output/trajectory.json": "--output-dir would overwrite",
    "identify a.xml sysid_output/params.json": "--output-dir would overwrite",
    f"{PAYLOAD} sysid_output/payload_card.txt": "--output-dir would overwrite",
}
"""Command line to the beginning of the message with which it is refused before any work."""


@pytest.mark.parametrize("line", REFUSED)
def test_what_means_nothing_or_excludes_each_other_is_refused(line):
    name, *words = line.split()
    if name not in COMMANDS:
        name, words = "", [name, *words]
    with refused() as caught:
        values, _ = COMMANDS[name].parse(words)
        CONFIGS[name].of(**values)
    assert str(caught.value).startswith(REFUSED[line])


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (SelfTestConfig, LOG, "unknown option 'measurements'"),
        (IdentifyConfig, {**LOG, "frictio_model": "x"}, "unknown option 'frictio_mod"),
        (SelfTestConfig, {"torques": "all"}, "--torques 'all': choose one of"),
        (
            PayloadConfig,
            {**LOGS, "known_mass": 1.0, "priors": {"scale": 0.0}},
            "--known-mass estimates torque scales",
        ),
    ],
)
def test_what_no_command_line_can_say_is_refused(config, values, message):
    assert refusal(config, **values).startswith(message)


def test_scales_are_as_sure_as_their_file_says_unless_the_user_says(tmp_path):
    path = tmp_path / "scale.json"
    scales = {"two": (2.0, 0.02), "other": (3.0, 1.0), "one": (1.1, 0.0055)}
    write_torque_scale(path, scales)

    def sure(**values):
        config = PayloadConfig.of(MODEL, **LOGS, **values)
        names = ("one", "two")
        return with_scale_prior(config.estimation, config.log, names).priors.scale

    assert sure(torque_scale=path) == pytest.approx((0.5, 1.0))
    assert sure(torque_scale=path, priors={"scale": 2.0}) == 2.0
    path.write_text('{"version": 1, "torque_scale": {"one": 1.1, "two": 2}}')
    assert sure(torque_scale=path) is sure(torque_scale=1.1) is sure() is None


def test_all_scales_may_be_off_together_by_what_the_option_or_the_user_says():
    def sure(**values):
        config = PayloadConfig.of(MODEL, **LOGS, **values)
        priors = with_scale_prior(config.estimation, config.log, ("one", "two")).priors
        return priors.scale, priors.common_scale

    for text in ("1.7+-16%", "1.7,1.8 ± 16 %"):
        assert sure(torque_scale=text) == (None, 16.0)
    assert sure(torque_scale="1.7+-16%", priors={"common_scale": 3.0}) == (None, 3.0)
    assert sure(torque_scale=1.7) == sure() == (None, 0.0)


@given(st.floats(0.01, 1e5), st.floats(0.01, 1e5))
def test_any_duration_and_rate_with_two_samples_or_more_and_not_too_many_is_accepted(
    duration, rate
):
    values = {"duration": duration, "sample_rate": rate}
    if duration * rate > 1e9:
        assert "more than the 1e+09 a run can take" in refusal(SelfTestConfig, **values)
    elif duration * rate >= 1.0:
        config = SelfTestConfig.of(MODEL, **values)
        assert config.trajectory.duration == duration
    else:
        assert "less than two samples" in refusal(SelfTestConfig, **values)


def test_friction_has_the_usual_terms_unless_it_is_said():
    for terms, options in (
        (DEFAULT_FRICTION, {}),
        ("none", {"no_friction": True}),
        ("coulomb-load", {"friction_model": "coulomb-load"}),
        (DEFAULT_TERMINAL, {"torques": "terminal"}),
    ):
        assert EstimationOptions(**options).friction == friction_terms(terms)


def test_priors_are_read_from_toml_and_json_and_are_else_the_usual_ones(tmp_path):
    toml = tmp_path / "priors.toml"
    toml.write_text("scale = [1, 2.5]\nlink = 20\nnoise = 0.1\n")
    json = tmp_path / "priors.json"
    json.write_text('{"scale": [1, 2.5], "link": 20, "noise": 0.1}')
    expected = Priors(link=20, scale=(1, 2.5), noise=0.1)
    assert vars(read_priors(toml)) == {**vars(expected), "file": toml}
    for value in (str(json), json, {"scale": [1, 2.5], "link": 20, "noise": 0.1}):
        priors = IdentifyConfig.of(MODEL, **LOG, priors=value).estimation.priors
        assert vars(priors) == {**vars(expected), "file": priors.file}


COMPLAINTS = {
    "scal = 1": "there is no prior 'scal'; priors are numbers by these names: link,",
    "link = 'x'": "link must be a number (got 'x'); priors are numbers by",
    "link = -1": "link must be a number that is not negative (got -1); priors",
    "noise = 0": "noise must be positive (got 0); priors are",
    "link = nan": "link must be a number that is not negative",
    "link": "cannot read ",
}


@pytest.mark.parametrize("text", COMPLAINTS)
def test_a_file_of_priors_that_cannot_be_used_is_refused(tmp_path, text):
    path = tmp_path / "priors.toml"
    path.write_text(text)
    with refused(r"priors\.toml") as caught:
        read_priors(path)
    assert COMPLAINTS[text] in str(caught.value)
