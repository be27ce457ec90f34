"""Keywords are those of the commands' option records, for readers and programs alike."""

from __future__ import annotations

import ast
import inspect
import re
from functools import partial
from itertools import chain
from pathlib import Path

import pytest

import robot_sysid as rs
from rigs.files.command_line import COMMANDS, require_names
from rigs.files.option_samples import samples
from robot_sysid.config import IdentifyConfig, PayloadConfig, PlanConfig, SelfTestConfig
from robot_sysid.wording import (
    in_python,
    option_name,
    option_setting,
    with_option_names,
)
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


A_MODEL = "a model is the path of an MJCF or URDF file, or a"
REFUSED = {
    "rs.identify('m', 'l', unit='deg')": "unknown option 'unit'; did you mean",
    "rs.identify('m', 'l', output_dir='x')": "unknown option 'output_dir'",
    "rs.identify('m', 'l', units=5)": "units must be a text (got 5)",
    "rs.identify('m', 'l', torques='all')": 'torques="all": choose one of chain, terminal',
    "rs.identify(5, 'l')": A_MODEL,
    "rs.read_log('l', 5)": A_MODEL,
    "rs.identify('m', 5)": "a log is a path, arrays by name",
    "rs.identify('m', [])": "the list of logs is empty",
    "rs.identify('m', {'time': [[[0.0]]]})": "arrays holds no arrays with a row per s",
    "rs.payload('m', [], 'b')": "empty=LOG... is missing: a payload is weighed",
    "rs.identify('m', 'l', priors={'link_uncertainty': 5.0})": (
        "there is no prior 'link_uncertainty'; priors are numbers by these names: link"
    ),
    "rs.plan('m', max_velocity=-1)": "max_velocity must be positive (got -1)",
}


@pytest.mark.parametrize("call", REFUSED)
def test_what_cannot_be_used_is_said_in_the_words_of_python(call):
    with pytest.raises(rs.InputError) as caught:
        eval(call)
    assert str(caught.value).startswith(REFUSED[call])


def test_every_option_is_named_as_a_keyword_with_its_value():
    """What a message advises in Python, Python takes as the message has it."""
    with in_python():
        for function, config in FUNCTIONS.items():
            for sample in samples(config):
                option = sample.option
                is_text = isinstance(sample.value, (str, Path))
                if option.key not in inspect.signature(function).parameters:
                    continue
                assert option.name == option.key
                if is_text:
                    text = option_setting(option.key, str(sample.value))
                    (value,) = eval(f"dict({text})").values()
                    assert option.parse(value) == sample.value, text


def test_texts_name_options_for_their_reader():
    template = "{known_mass}, {columns FILE} or {units=deg}"
    several = partial(option_setting, "accept", "zero", "tilt")
    quoted = partial(option_setting, "torques", "'all'")
    assert with_option_names(template) == "--known-mass, --columns FILE or --units deg"
    assert (several(), quoted()) == ("--accept zero --accept tilt", "--torques 'all'")
    assert option_name("for_") == "--for"
    with in_python():
        assert with_option_names(template) == 'known_mass, columns=FILE or units="deg"'
        assert (several(), quoted()) == ('accept=["zero", "tilt"]', 'torques="all"')
        assert option_name("rate", "250") == "rate=250"


@pytest.mark.parametrize("name", COMMANDS)
def test_no_help_has_a_field_in_the_place_of_a_name(name):
    for option in chain(*COMMANDS[name].groups.values()):
        for template in (option.help, option.default_text):
            require_names(with_option_names(template))
            with in_python():
                require_names(with_option_names(template))
    with pytest.raises(AssertionError):
        require_names("give {columns FILE}")


KEYS = {
    key.rstrip("_")
    for function in (*FUNCTIONS, rs.check, rs.motors.play, rs.read_log)
    for key in inspect.signature(function).parameters
}

SPELLING = ("option_name", "option_setting")


def test_no_text_that_python_may_print_spells_an_option_itself():
    for name, source in package_sources().items():
        if ".commands" in name or name.endswith(("cli", "next_steps", "wording")):
            continue
        if not any(mark in source for mark in ("--", *SPELLING)):
            continue
        nodes = nodes_of(source)
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            text = getattr(node, "value", None)
            if isinstance(node, ast.Constant) and isinstance(text, str):
                flags = re.findall(r"(?<![\w-])--([a-z][a-z-]*)", text)
                # An option alone is a word of a command line.
                if id(node) not in docstrings and text != f"--{''.join(flags)}":
                    keys = {flag.replace("-", "_") for flag in flags}
                    assert KEYS.isdisjoint(keys), (name, text)
            elif isinstance(node, ast.Call) and ast.unparse(node.func) in SPELLING:
                key = node.args[0]
                if isinstance(key, ast.Constant):
                    assert key.value.rstrip("_") in KEYS, (name, key.value)
