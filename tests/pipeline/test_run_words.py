"""What to do after an identification, with the command that does it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from robot_sysid.config import IdentifyConfig
from robot_sysid.pipeline.run_words import step_after_run
from robot_sysid.results.quantities import BEYOND, MOMENT
from robot_sysid.results.record import Quantity
from tests.support import results as made


@pytest.mark.parametrize(
    ("part", "error", "command"),
    [
        (0.8, 1.2, "plan"),
        (0.8, 0.2, "payload"),
        (0.3, 0.2, None),
        (-0.8, 0.2, None),
        (0.8, 0.02, None),
    ],
)
def test_what_is_bolted_on_is_weighed_where_one_log_shows_it_roughly(
    part, error, command
):
    result = made.found(made.with_value("m", 2.0, error))
    rows = [Quantity(MOMENT, BEYOND, "kg·m", None, 0.1 * part, 0.1 * error)]
    rows += [Quantity("mass", BEYOND, "kg", None, part, error)]
    result = replace(result, quantities=(*result.quantities, *rows))
    config = IdentifyConfig.of(path="arm.xml", measurements=("log.csv",), units="deg")
    step = step_after_run(config, result)
    if command is None:
        assert step is None
        return
    assert step.command[1:3] == (command, "arm.xml")
    if command == "payload":
        at = step.command.index("--loaded")
        assert step.command[at + 1 : at + 4] == ("log.csv", "--units", "deg")


def test_a_part_whose_mass_one_log_does_not_show_is_weighed_by_its_moment():
    """Mass times distance is clearly there, the mass alone is not."""
    rows = (
        Quantity(MOMENT, BEYOND, "kg·m", None, 0.1, 0.01),
        Quantity("mass", BEYOND, "kg", None, 0.8, 0.7),
    )
    found = made.found(made.with_value("m", 2.0, 0.7))
    result = replace(found, quantities=(*found.quantities, *rows))
    config = IdentifyConfig.of(path="arm.xml", measurements=("log.csv",))
    assert step_after_run(config, result).command[1] == "payload"
