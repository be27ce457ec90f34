"""The option tables of README and docs/options.md say what the records say, option by option."""

from __future__ import annotations

import argparse

from robot_sysid.commands import identify, payload, plan, run
from robot_sysid.commands.arguments import PYTHON_ONLY, ConsoleOptions
from robot_sysid.motion.problem import DEFAULT_NOISE_TORQUE
from robot_sysid.records.options import options_of
from tests.support import option_tables
from tests.support.option_tables import TABLES

TEXTS = [path.read_text(encoding="utf-8") for path in option_tables.PAGES]
PAGE = TEXTS[1]
CONSOLE = {"--help", "-h", "--help-all", "--version"}


def flags(parser: argparse.ArgumentParser) -> set[str]:
    """Return the options of a command, those that every command has left out."""
    common = CONSOLE | {o.flag for o in options_of(ConsoleOptions).values()} | {"-v"}
    return {name for action in parser._actions for name in action.option_strings} - common


def group(*names: str) -> set[str]:
    """Return the options of some groups."""
    records = [record for name in names for record in TABLES[name]]
    found = [each for record in records for each in options_of(record).values()]
    return {each.flag for each in found if each.key not in PYTHON_ONLY}


def test_the_tables_are_what_the_generator_writes():
    """``python -m tests.support.option_tables`` brings them up to date."""
    assert [option_tables.with_tables(text) for text in TEXTS] == TEXTS


def test_every_table_is_there_once():
    assert sorted(n for text in TEXTS for n in option_tables.tables_in(text)) == sorted(TABLES)


OF_EXCITATION = {"--excitation", "--excitation-time-budget"}


def test_the_main_command_takes_the_groups_it_is_said_to_take():
    said = group(*(title for title in run.GROUPS if title != "excitation"))
    assert flags(run.build_parser()) == said | OF_EXCITATION


def test_plan_takes_the_groups_it_is_said_to_take():
    said = ("model and output", "trajectory", "excitation", "plan for a payload", "limits")
    said = (*said, "Damiao motors", "preview")
    no_result = {"--keep", "--links", "--bundle", "--report", "--plots"}
    expected = group(*said) - no_result | {"--torques", "--noise-torque"}
    assert flags(plan.build_parser()) == expected


def test_identify_takes_the_groups_it_is_said_to_take():
    said = ("model and output", "measurements", "estimation")
    assert flags(identify.build_parser()) == group(*said) - {"--measurements"}


def test_payload_takes_the_groups_it_is_said_to_take():
    whole = ("payload", "model and output", "measurements", "trajectory", "limits")
    of_estimation = {"--cutoff", "--velocity-deadband", "--friction-model"}
    of_estimation |= {
        f"--{what}-uncertainty" for what in ("link", "scale", "zero", "gravity", "delay")
    }
    left_out = {"--measurements", "--validation-measurements", "--save-trajectory", "--append"}
    left_out |= {"--plant-model", "--save-measurements", "--verify-rollout", "--links"}
    expected = group(*whole, "simulated plant") | of_estimation | OF_EXCITATION
    assert flags(payload.build_parser()) == expected - left_out


def test_the_noise_of_a_plan_is_what_the_page_says():
    assert f"without `--noise-torque` is judged for {DEFAULT_NOISE_TORQUE:g} N·m." in PAGE
