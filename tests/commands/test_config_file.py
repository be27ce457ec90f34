"""``--config FILE``: every option arrives from a file as it does when it is typed."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import get_type_hints

import pytest

from robot_sysid.commands.arguments import parse_command
from robot_sysid.commands.identify import SPECS, build_parser, settings_text
from robot_sysid.config import PayloadConfig, SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import default_of, options_of
from tests.support import option_samples

IDENTIFY = partial(build_parser, "identify")
MODEL = Path("an 'arm'.xml")


def file_text(config_type, sample):
    """The settings file of a run with one option that is not at its default."""
    record = get_type_hints(config_type)[sample.record]
    # Its options are not checked, as one may need another.
    values = object.__new__(record)
    for name in options_of(record):
        vars(values)[name] = default_of(record, name)
    vars(values)[sample.field] = sample.value
    return settings_text("robot-sysid", MODEL, [values], {})


@pytest.mark.parametrize("name", SPECS)
def test_every_option_that_is_written_is_read_again(name, tmp_path):
    config_type = PayloadConfig if name == "payload" else SysidConfig
    option_keys = option_samples.keys_of(build_parser(name))
    file = tmp_path / "run.toml"
    logs = {"measurements": (Path("log.csv"),)} if name == "identify" else {}
    for sample in option_samples.samples(config_type):
        if sample.option.key in option_keys:
            file.write_text(
                file_text(config_type, sample)
                + 'measurements = ["log.csv"]\n' * len(logs)
            )
            values, _ = parse_command(
                partial(build_parser, name), ["--config", str(file)]
            )
            assert values == {"path": MODEL, **logs, sample.option.key: sample.value}


def test_what_is_typed_counts_before_the_file(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text(
        'path = "arm.xml"\ncutoff = 8\nkeep = ["friction"]\nverbose = true\n'
    )
    arguments = [
        "other.xml",
        "b.csv",
        f"--config={file}",
        "--cutoff",
        "9",
        "--keep",
        "links",
    ]
    values, console = parse_command(IDENTIFY, arguments)
    assert values == {
        **{"path": Path("other.xml"), "measurements": (Path("b.csv"),)},
        **{"cutoff": 9.0, "keep": ("links",)},
    }
    assert console.verbose and console.config == file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "cutoff = 'high'",
            "mine.toml: argument --cutoff: invalid float value: 'high'",
        ),
        ("cutof = 8", "robot-sysid identify has no option cutof"),
        ("links = 'false'", "mine.toml: links takes true or false (got 'false')"),
        ("cutoff = true", "mine.toml: cutoff takes a value (got True)"),
        ("help = true", "robot-sysid identify has no option help"),
        ("cutoff = ", "mine.toml is no TOML file: "),
        ("cutoff = 8", "the following arguments are required: MODEL, LOG"),
        (None, "mine.toml: No such file"),
    ],
)
def test_what_is_wrong_with_it_is_said_in_one_line(tmp_path, text, message):
    file = tmp_path / "mine.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError) as error:
        parse_command(IDENTIFY, ["--config", str(file)])
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("folder", "path"),
    [([], "old/plan.json"), (["--output-dir", "new"], "new/plan.json")],
)
def test_a_run_in_another_folder_replaces_no_file_of_the_run_that_it_repeats(
    folder, path, tmp_path
):
    file = tmp_path / "plan.toml"
    file.write_text('path = "arm.xml"\nsave_trajectory = "old/plan.json"\n')
    arguments = ["--config", str(file), *folder]
    values, _ = parse_command(partial(build_parser, "plan"), arguments)
    assert values["save_trajectory"] == Path(path)
