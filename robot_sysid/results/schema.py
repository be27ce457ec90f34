"""Whether a result file that was read has the form that this program writes, by its JSON Schema.

A folder of results may come from anybody. What its schema asks for is checked once, where the file
is read, so that nothing behind it meets a missing key or a word in the place of a number. Of the
language of schemas this knows what the shipped ones use; keys that are not in a schema pass.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

_FOLDER = Path(__file__).parents[1] / "schemas"
_TYPES: Mapping[str, tuple[type, ...]] = {
    "array": (list,),
    "boolean": (bool,),
    "integer": (int,),
    "null": (type(None),),
    "number": (int, float),
    "object": (dict,),
    "string": (str,),
}


def form_fault(content: Any, name: str) -> str:
    """Return where a content first differs from a shipped schema, and how; "" for nowhere.

    Args:
        content: of a JSON file.
        name: of the schema, "params" or "servo".
    """
    schema = _schema(name)
    return next(_faults(content, schema, schema["$defs"], ""), "")


@cache
def _schema(name: str) -> Any:
    return json.loads((_FOLDER / f"{name}.schema.json").read_text(encoding="utf-8"))


def _faults(value: Any, schema: Any, parts: Any, place: str) -> Iterator[str]:
    """Yield what differs in a value at a place from a schema, whose ``$defs`` are the parts."""
    if "$ref" in schema:
        schema = {**parts[schema["$ref"].rpartition("/")[2]], **schema}
    alternatives = schema.get("anyOf", ())
    if alternatives:
        found = [[*_faults(value, each, parts, place)] for each in alternatives]
        yield from min(found, key=len)
        return
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if kinds and not any(_is_of(value, kind) for kind in kinds):
        yield f"{place or 'it'} is no {' and no '.join(kinds)}"
        return
    allowed = schema.get("enum", [schema["const"]] if "const" in schema else [value])
    if value not in allowed:
        yield f"{place} is {value!r:.40}"
    if isinstance(value, list):
        size = len(value)
        if not schema.get("minItems", 0) <= size <= schema.get("maxItems", size):
            yield f"{place} has {size} entries"
        for index, item in enumerate(value):
            yield from _faults(
                item, schema.get("items", {}), parts, f"{place}[{index}]"
            )
    if isinstance(value, dict):
        for key in schema.get("required", ()):
            if key not in value:
                yield f"{place or 'it'} has no {key}"
        yield from _faults_of_keys(value, schema, parts, place)


def _faults_of_keys(value: Any, schema: Any, parts: Any, place: str) -> Iterator[str]:
    """Yield what differs in the values of an object's keys."""
    properties = schema.get("properties", {})
    others = schema.get("additionalProperties", True)
    for key, item in value.items():
        if key in properties:
            yield from _faults(
                item, properties[key], parts, f"{place}.{key}".strip(".")
            )
        elif isinstance(others, dict):
            yield from _faults(item, others, parts, f"{place}.{key:.40}".strip("."))


def _is_of(value: Any, kind: str) -> bool:
    """Return whether a value is of a type of JSON, in which a truth value is no number."""
    is_truth = isinstance(value, bool) and kind != "boolean"
    return isinstance(value, _TYPES[kind]) and not is_truth
