"""Whether a result file that was read has the form that this program writes, by its JSON Schema.

A folder of results may come from anybody. What its schema asks for is checked once, where the file
is read, so that nothing behind it meets a missing key or a word in the place of a number. Keys that
are not in a schema pass.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jsonschema.exceptions import ValidationError
    from jsonschema.protocols import Validator

_FOLDER = Path(__file__).parents[1] / "schemas"


def form_fault(content: Any, name: str) -> str:
    """Return where a content first differs from a shipped schema, and how; "" for nowhere.

    Args:
        content: of a JSON file.
        name: of the schema, "params" or "servo".
    """
    try:
        error = next(_validator(name).iter_errors(content), None)
    except RecursionError:
        return "it is nested too deeply"
    return "" if error is None else _sentence(_most_specific(error))


@cache
def _validator(name: str) -> Validator:
    """Return the validator of a schema, all of whose references lead to parts of its own."""
    from jsonschema import Draft202012Validator, validators

    other_keys = Draft202012Validator.VALIDATORS["additionalProperties"]

    def check_other_keys(
        validator: Validator, allowed: Any, instance: Any, schema: Any
    ) -> Iterator[ValidationError]:
        if allowed is not False:
            yield from other_keys(validator, allowed, instance, schema)

    lenient = validators.extend(
        Draft202012Validator, {"additionalProperties": check_other_keys}
    )
    text = (_FOLDER / f"{name}.schema.json").read_text(encoding="utf-8")
    return lenient(json.loads(text))


def _most_specific(error: ValidationError) -> ValidationError:
    """Return what is behind an error: of alternatives that all fail, where the nearest one does.

    That is the one of which most fits: what differs lies deepest in it, or is not even its type.
    """
    while error.context:
        error = max(
            error.context,
            key=lambda cause: (len(cause.path), cause.validator != "type"),
        )
    return error


def _sentence(error: ValidationError) -> str:
    """Return where a content breaks a rule, and how, without its size or what it is about."""
    place = "".join(
        f"[{key}]" if isinstance(key, int) else f".{key:.40}"
        for key in error.absolute_path
    )
    place = place.lstrip(".") or "it"
    rule = error.validator_value
    if error.validator == "type":
        return f"{place} is no {' and no '.join([rule] if isinstance(rule, str) else rule)}"
    if error.validator == "required":
        missing = [key for key in rule if key not in error.instance]
        return f"{place} has no {missing[0]}"
    if error.validator in ("minItems", "maxItems"):
        return f"{place} has {len(error.instance)} entries"
    return f"{place} is {reprlib.repr(error.instance):.40}"
