"""Result files against the schemas that are shipped."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

from tests.support.places import ROOT

SCHEMAS = ROOT / "robot_sysid" / "schemas"


def schema(name: str) -> dict:
    """Return a schema: params or servo."""
    content: dict = json.loads((SCHEMAS / f"{name}.schema.json").read_text("utf-8"))
    return content


def check(path: Path) -> None:
    """Raise jsonschema's error where a result file is not what its schema says."""
    content = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.validate(content, schema(path.stem), jsonschema.Draft202012Validator)


def check_results(folder: Path) -> None:
    """Check every result file below a folder."""
    for name in ("params.json", "servo.json"):
        for path in folder.glob(f"*/{name}"):
            check(path)
