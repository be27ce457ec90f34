"""Keywords are those of the commands' option records, for readers and programs alike."""

from __future__ import annotations

import ast
import inspect
import re

import pytest

import robot_sysid as rs
from rigs.option_samples import samples
from robot_sysid.api.keywords import python_words
from robot_sysid.config import IdentifyConfig, PayloadConfig, PlanConfig, SelfTestConfig
from robot_sysid.records.option_fields import immutable_value
from tests.test_architecture import nodes_of, package_sources

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
        (lambda: rs.payload("m", [], "b"), "empty=LOG... is missing: a payload is wei"),
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "--known-mass and --units deg.\n  robot-sysid log a.csv --units deg",
            'known_mass and units="deg".\n  robot-sysid log a.csv --units deg',
        ),
        (
            "go on: --accept torque-scale --accept zero)",
            'go on: accept=["torque-scale", "zero"])',
        ),
        ("use --torque-scale 1000, or 0.1", "use torque_scale=1000, or 0.1"),
        ("--torque-scale 1.3,1.2.", "torque_scale=[1.3, 1.2]."),
        ("see --for weight of plan", 'see for_="weight" of plan'),
        ("--torques 'all': choose", 'torques="all": choose'),
        ("--joint left-1.a: no such joint", 'joint="left-1.a": no such joint'),
        ("--keep friction and --no-friction", 'keep="friction" and no_friction'),
        ("run --no-friction --keep links", 'run no_friction keep="links"'),
        ("with --columns FILE, of lines", "with columns=FILE, of lines"),
        ("motors setup --new-id 2 --store", "motors setup --new-id 2 --store"),
        ("of a-- b", "of a-- b"),
    ],
)
def test_options_are_keywords_with_their_values(text, words):
    assert python_words(text) == words


def test_every_option_is_a_keyword_with_the_value_that_was_typed():
    """What a message advises on the command line, Python takes as the message has it."""
    for function, config in FUNCTIONS.items():
        for sample in samples(config):
            option = sample.option
            is_row = isinstance(option.metavar, tuple) or option.takes_many
            # A file of priors would have to exist.
            is_left_out = is_row or option.key == "priors"
            if option.key not in inspect.signature(function).parameters or is_left_out:
                continue
            words = python_words(f"pass {' '.join(sample.words)}, please")
            text = words[len("pass ") : -len(", please")]
            if sample.value is True:
                assert text == option.key
                continue
            (value,) = eval(f"dict({text})").values()
            value = immutable_value(value, option.parse)
            assert sample.value in (value, (value,)), text


PLAIN = re.compile(
    "and|another|chooses|estimates|exclude|file|for|gives|has|have|if|in|is|leaves|lifts|look|of|off|or|"
    "plays|requires|says|states|takes|tells|times|to|where|writes"
)
"""Words behind an option in the package's sentences that are no values."""


def test_no_sentence_leaves_a_value_behind_a_keyword():
    for name, text in sentences():
        for option, word in re.findall(r"(?<![\w-])(--[a-z-]+[a-z]) (\w\S*)", text):
            key = option[2:].replace("-", "_")
            if python_words(option) == option or PLAIN.fullmatch(word.rstrip(".,;:)")):
                continue
            assert re.search(rf"\b{key}_?=", python_words(text)), (name, text)


def sentences():
    """Yield (module, text) of each text that Python may print, where no value interrupts it."""
    for name, source in package_sources().items():
        if ".commands" in name or name.endswith("next_steps"):
            continue
        for node in nodes_of(source):
            text = getattr(node, "value", None)
            is_text = isinstance(node, ast.Constant) and isinstance(text, str)
            if is_text and "``" not in text and "\n" not in text:
                yield name, text
