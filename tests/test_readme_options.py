"""The option tables of README and docs/options.md say what the records say, option by option."""

from __future__ import annotations

from rigs.files import option_tables
from rigs.files.option_tables import TABLES
from robot_sysid.estimate.options import Priors
from robot_sysid.motion.problem import DEFAULT_NOISE_TORQUE
from robot_sysid.records.option_fields import options_of

TEXTS = [path.read_text(encoding="utf-8") for path in option_tables.PAGES]


def test_the_tables_are_what_the_generator_writes():
    """``python -m rigs.files.option_tables`` brings them up to date."""
    assert [option_tables.with_tables(text) for text in TEXTS] == TEXTS


def test_every_table_is_there_once():
    assert sorted(n for text in TEXTS for n in option_tables.tables_in(text)) == sorted(
        TABLES
    )


def test_the_noise_of_a_plan_is_what_its_prior_says():
    assert options_of(Priors)["noise"].default_text == f"{DEFAULT_NOISE_TORQUE:g}"
