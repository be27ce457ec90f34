"""Keywords are those of the commands' option records, for readers and programs alike."""

from __future__ import annotations

import inspect

import pytest

import robot_sysid as rs
from robot_sysid.api.keywords import python_words
from robot_sysid.config import IdentifyConfig, PayloadConfig, PlanConfig, SelfTestConfig

FUNCTIONS = {
    rs.identify: IdentifyConfig,
    rs.self_test: SelfTestConfig,
    rs.plan: PlanConfig,
    rs.payload: PayloadConfig,
}


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_signature_and_its_help_have_every_keyword(function):
    parameters = inspect.signature(function).parameters
    missing = FUNCTIONS[function].option_keys() - set(parameters)
    printed = {"links", "torque_from", "report", "output_dir"}
    assert missing <= {*printed, "measurements"} and "options" not in parameters
    assert printed.isdisjoint(parameters)
    text = function.__doc__
    assert "options:" not in text and max(map(len, text.splitlines())) <= 100
    for key in parameters:
        assert f"\n    {key}:" in text or f"\n    {key} (" in text, key


def test_help_says_type_unit_and_default():
    words = " ".join(rs.identify.__doc__.split())
    assert 'keep ("friction", "rotors", "gravity" or "links", or a list of th' in words
    assert 'torques ("chain" or "terminal"; default "chain"): use' in words
    assert words.endswith("or a log cannot be used; says why.")
    parameters = inspect.signature(rs.motors.play).parameters
    assert parameters["max_velocity"].default is None
    assert "below_base" not in parameters
    assert inspect.signature(rs.plan).parameters["excitation"].default == "optimal"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: rs.identify("m", "l", unit="deg"),
            "unknown option 'unit'; did you mea",
        ),
        (lambda: rs.identify("m", "l", output_dir="x"), "unknown option 'output_dir'"),
        (lambda: rs.identify("m", "l", units=5), "units must be a text (got 5)"),
        (
            lambda: rs.identify(5, "l"),
            "a model is the path of an MJCF or URDF file, or a",
        ),
        (lambda: rs.payload("m", [], "b"), "empty LOG... is missing: a payload is wei"),
        (
            lambda: rs.read_log("l", 5),
            "a model is the path of an MJCF or URDF file, or a",
        ),
        (
            lambda: rs.identify("m", "l", validation_measurements=["a", "b"]),
            "validation_measurements is one log, not a list",
        ),
        (
            lambda: rs.identify("m", "l", priors={"link_uncertainty": 5.0}),
            "there is no prior 'link_uncertainty'; priors are numbers by these names: link",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_the_words_of_python(call, message):
    with pytest.raises(rs.InputError) as caught:
        call()
    assert str(caught.value).startswith(message)


def test_options_are_said_as_keywords():
    text = "--known-mass and --units deg of a-- b\n  robot-sysid log a.csv --units deg"
    assert python_words(text) == (
        "known_mass and units deg of a-- b\n  robot-sysid log a.csv --units deg"
    )
