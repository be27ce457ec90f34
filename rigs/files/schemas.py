"""Result files against the schemas that are shipped."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import jsonschema

from rigs.files.places import ROOT


def schema(name: str) -> dict:
    """Return the schema of a kind of result file: params or servo."""
    path = ROOT / "robot_sysid" / "schemas" / f"{name}.schema.json"
    content: dict = json.loads(path.read_text(encoding="utf-8"))
    return content


@functools.cache
def _check_text(name: str, text: str) -> None:
    """Raise where the text of a result file breaks its schema; one text is validated once."""
    jsonschema.validate(json.loads(text), schema(name), jsonschema.Draft202012Validator)


def check(path: Path) -> dict[str, Any]:
    """Return a result file; raise jsonschema's error where it is not what its schema says."""
    text = path.read_text(encoding="utf-8")
    _check_text(path.stem, text)
    content: dict[str, Any] = json.loads(text)
    return content


def check_results(folder: Path) -> None:
    """Check every params.json and servo.json in the subfolders of a folder."""
    for name in ("params.json", "servo.json"):
        for path in folder.glob(f"*/{name}"):
            check(path)
