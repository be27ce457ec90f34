"""Model and logs in any order: what a file is tells its place."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rigs.files.command_line import COMMANDS
from rigs.files.refusals import refused
from rigs.logs import recorded
from rigs.logs.log_files import motion

DATA = motion(50)
MODELS = {
    "arm.xml": b"<mujoco><worldbody/></mujoco>",
    "arm.urdf": b'\xef\xbb\xbf\n<?xml version="1.0"?>\n<robot name="r"/>',
    "arm.urdf.xacro": b'<!-- an arm --><robot xmlns:xacro="x"/>',
    "wide.urdf": '<?xml version="1.0" encoding="utf-16"?><robot/>'.encode("utf-16"),
    "arm": b"<mujoco/>",
}
LOGS_OF = {"log": "log", "identify": "measurements", "check": "log"}
"""Command that takes a model and logs to the key of its logs."""


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,q1\n0,1\n")
    return path


def told_apart(command: str, *paths) -> tuple[Path | None, tuple[Path, ...]]:
    """Return the model and the logs of a command's words."""
    values, _ = COMMANDS[command].parse([*map(str, paths)])
    return values.get("path"), values.get(LOGS_OF[command], ())


@pytest.mark.parametrize("command", LOGS_OF)
@pytest.mark.parametrize("name", MODELS)
def test_a_model_stands_anywhere_among_logs(tmp_path, csv, command, name):
    model = tmp_path / name
    model.write_bytes(MODELS[name])
    other = tmp_path / "other.csv"
    other.write_text('"time";"q1"\n')
    for words in ((model, csv, other), (csv, model, other), (csv, other, model)):
        assert told_apart(command, *words) == (model, (csv, other))


@pytest.mark.parametrize("form", recorded.FORMS)
def test_a_log_of_every_form_is_none(tmp_path, form):
    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    log = recorded.FORMS[form](tmp_path, DATA)
    for command in LOGS_OF:
        assert told_apart(command, log, model) == (model, (log,))
        assert told_apart(command, model, log) == (model, (log,))


@pytest.mark.parametrize("command", LOGS_OF)
def test_two_models_and_logs_alone_are_refused(tmp_path, csv, command):
    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    both = f"{re.escape(str(model))} and {re.escape(str(model))}"
    with refused(f"^{both} are models; give one model, and logs of the arm"):
        told_apart(command, model, csv, model)
    with refused("log.csv and .*log.csv are logs; give the arm's model as well"):
        told_apart(command, csv, csv)
    with refused("log.csv is a log; give the arm's model as well"):
        told_apart(command, csv)
    with refused("the following arguments are required: LOG"):
        told_apart(command, model)


def test_a_model_stands_behind_an_option_that_takes_many_files(tmp_path, csv):
    """argparse gives the option all that follows it."""
    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    for words in (
        ("--validation-measurements", csv, model, csv),
        (csv, "--validation-measurements", csv, model),
    ):
        assert told_apart("identify", *words) == (model, (csv,))
    assert told_apart("check", "--since", csv, csv, model, csv) == (model, (csv,))
    for words in (
        ("--empty", csv, "--loaded", csv, csv, model),
        ("--empty", csv, model, "--loaded", csv, csv),
    ):
        values, _ = COMMANDS["payload"].parse([*map(str, words)])
        given = values["path"], values["empty"], values["loaded"]
        assert given == (model, (csv,), (csv, csv))
    with refused("the following arguments are required: MODEL"):
        told_apart("payload", "--empty", csv, "--loaded", csv)
    # Of two models, none is taken out of the logs.
    words = [*map(str, (model, "--empty", csv, "--loaded", csv, model))]
    assert COMMANDS["payload"].parse(words)[0]["loaded"] == (csv, model)


@pytest.mark.parametrize("command", LOGS_OF)
def test_what_is_missing_or_damaged_has_the_place_that_is_left(tmp_path, csv, command):
    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    missing = tmp_path / "missing"
    damaged = tmp_path / "damaged.urdf"
    damaged.write_bytes(b"")
    assert told_apart(command, missing, model) == (model, (missing,))
    assert told_apart(command, csv, missing) == (missing, (csv,))
    assert told_apart(command, csv, damaged) == (damaged, (csv,))


def test_what_cannot_be_read_stays_in_the_order_of_the_usage():
    assert told_apart("identify", "a", "b") == (Path("a"), (Path("b"),))
    assert told_apart("check", "a", "b") == (Path("a"), (Path("b"),))
    assert told_apart("log", "a", "b") == (Path("b"), (Path("a"),))


def test_one_of_both_may_be_in_a_file_of_options(tmp_path, csv):
    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    file = tmp_path / "run.toml"
    file.write_text('path = "other.xml"\nmeasurements = ["other.csv"]\n')
    config = f"--config={file}"
    other = Path("other.xml")
    # A list of a file stays one of texts until its record is made.
    assert told_apart("identify", config, csv) == (str(other), (csv,))
    assert told_apart("identify", config, model) == (model, ("other.csv",))


def test_a_model_in_the_place_of_a_log_is_called_one(tmp_path):
    from robot_sysid.logs import LogOptions
    from robot_sysid.logs.reader import open_table

    model = tmp_path / "arm.xml"
    model.write_bytes(MODELS["arm.xml"])
    with refused("arm.xml is XML, as models are, and no log"):
        open_table(model, ("joint1",), LogOptions())
