"""What is missing in a result file, or of another type, is named where the file is read."""

from __future__ import annotations

import json
import socket

import jsonschema
import pytest

from rigs.files import results as made
from rigs.files.refusals import refused
from rigs.files.reports import saved
from rigs.files.schemas import schema
from robot_sysid.report.runs import load_run
from robot_sysid.results.schema import form_fault


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    """The text of a result file."""
    folder = saved(tmp_path_factory.mktemp("run"), made.whole())
    return (folder / "params.json").read_text()


def places_in(content, path=()):
    """Every list and object in a content, with the keys that lead to each of its entries."""
    keys = range(len(content)) if isinstance(content, list) else [*content]
    for key in keys:
        yield content, key
        if isinstance(content[key], (dict, list)):
            yield from places_in(content[key])


def is_valid(content):
    """What the library of schemas says; keys that are not in a schema are let pass here."""
    validator = jsonschema.Draft202012Validator(schema("params"))
    faults = {error.validator for error in validator.iter_errors(content)}
    return not faults - {"additionalProperties"}


@pytest.mark.parametrize("odd", [None, 1.5, "a", [], {}, True])
def test_a_fault_is_found_where_the_library_of_schemas_finds_one(text, odd):
    """In some places of a result, each replaced by a value of another type."""
    content = json.loads(text)
    assert form_fault(content, "params") == "" and is_valid(content)
    for place, key in [*places_in(content)][::71]:
        old = place[key]
        place[key] = odd
        assert (form_fault(content, "params") == "") == is_valid(content), (key, odd)
        place[key] = old


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("body_name", None, "body_name is no string"),
        (
            "schema_version",
            "a" * 10**6,
            "schema_version is 'aaaaaaaaaaaa...aaaaaaaaaaaaa'",
        ),
        ("joint_names", [0] * 10**6, "joint_names[0] is no string"),
        ("versions", {"a" * 10**6: 1}, f"versions.{'a' * 40} is no string"),
        ("file", [], "file is no object"),
        ("file", {"name": 1}, "file.name is no string"),
    ],
)
def test_a_fault_is_named_with_its_place_and_not_with_its_size(text, key, value, words):
    content = {**json.loads(text), key: value}
    assert form_fault(content, "params") == words


def test_a_result_of_any_depth_is_one_sentence(text):
    """Python ends what calls itself too often by an exception of its own."""
    content = json.loads(text)
    for key in ("mass", "versions", "quantities", "new"):
        deep = []
        for _ in range(100_000):
            deep = [deep]
        assert len(form_fault({**content, key: deep}, "params")) < 100


@pytest.mark.parametrize("name", ["params", "servo"])
def test_all_parts_of_a_schema_are_in_its_file(name):
    lines = json.dumps(schema(name), indent=0).splitlines()
    references = [line for line in lines if line.startswith('"$ref"')]
    assert references
    assert all(line.startswith('"$ref": "#/$defs/') for line in references)


def test_no_address_in_a_result_is_asked(text, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("the network is asked")

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    address = "https://192.0.2.1/schema.json"
    content = json.loads(text)
    for keys in ("$schema", "$id", "$ref", "$dynamicRef"):
        content[keys] = address
        content["versions"][keys] = address
    assert form_fault(content, "params") == ""


def test_what_is_missing_is_named(text, tmp_path):
    content = json.loads(text)
    content["quantities"][3].pop("value")
    assert form_fault(content, "params") == "quantities[3] has no value"
    content = json.loads(text)
    rows = [row for row in content["quantities"] if row["name"] != "mass"]
    (tmp_path / "params.json").write_text(json.dumps({**content, "quantities": rows}))
    with refused(
        r"params.json is no whole result: link\d has no row mass; identify again"
    ):
        load_run(tmp_path)
