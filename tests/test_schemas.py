"""The shipped schemas are schemas, and what is written is what they say."""

from __future__ import annotations

import json

import jsonschema
import pytest

from robot_sysid.cli import main
from tests.support import arms, schemas

NAMES = ("params", "servo")


@pytest.mark.parametrize("name", NAMES)
def test_a_schema_is_one(name):
    jsonschema.Draft202012Validator.check_schema(schemas.schema(name))


@pytest.mark.parametrize("options", [[], ["--torques", "terminal"], ["--no-friction"]])
def test_what_a_simulation_writes_is_valid(tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(arms.THREE, encoding="utf-8")
    assert main(["arm.xml", "--duration", "2", "--quiet", *options]) == 0
    schemas.check(tmp_path / "sysid_output" / "params.json")


def test_a_key_too_many_or_too_few_is_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.xml").write_text(arms.THREE, encoding="utf-8")
    assert main(["arm.xml", "--duration", "2", "--quiet"]) == 0
    path = tmp_path / "sysid_output" / "params.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    fewer = {key: value for key, value in content.items() if key != "mass"}
    for wrong in ({**content, "weight": 1.0}, fewer, {**content, "mass": "1 kg"}):
        path.write_text(json.dumps(wrong), encoding="utf-8")
        with pytest.raises(jsonschema.ValidationError):
            schemas.check(path)
