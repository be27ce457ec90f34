"""What a plan leaves beside its motion, and what follows from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_sysid.errors import InputError
from robot_sysid.records.plan_settings import (
    command_after_weighing,
    read_toml,
    settings_of,
)


@pytest.mark.parametrize(
    ("content", "follows"),
    [
        ('path = "arm.xml"\nfor_ = "weight"', True),
        ('path = "arm.xml"', False),
        ('path = "other.xml"\nfor_ = "weight"', False),
        (None, False),
    ],
)
def test_a_plan_follows_where_this_arm_was_weighed(tmp_path, content, follows):
    if content is not None:
        (tmp_path / "trajectory.toml").write_text(content)
    written = tmp_path / "updated_model.xml"
    command = command_after_weighing(tmp_path, Path("arm.xml"), written)
    words = f"--config {tmp_path}/trajectory.toml --for link --output-dir {tmp_path}/planned"
    assert command == (f"robot-sysid plan {written} {words}" if follows else "")


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    assert settings_of(tmp_path) is None
    path = tmp_path / "trajectory.toml"
    with pytest.raises(InputError, match="cannot read"):
        read_toml(path)
    path.write_text("path = ")
    with pytest.raises(InputError, match="is no TOML file"):
        read_toml(path)
    # A next step is made of it after a run, whose own words are to be read.
    assert settings_of(tmp_path) is None
