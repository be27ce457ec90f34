"""Damage to files: in bytes, cells of tables, JSON values, XML attributes and elements."""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from random import Random
from typing import Any

from lxml import etree

NUMBERS = (
    *(
        "nan",
        "inf",
        "-inf",
        "0",
        "-0",
        "-1",
        "1",
        "1e308",
        "-1e308",
        "1e-308",
        "1e400",
        "1e12",
    ),
    *(
        "1e6",
        "1e-9",
        "0.5",
        "2147483648",
        "9" * 40,
        "1,5",
        "0x10",
        "1_000",
        "\u0661\u0662",
        "1 2",
    ),
    *("1 2 3 4", "0 0 0", "0 0 0 0", "nan nan nan", "1e300 1 1", "true", "-3"),
)
TEXTS = (
    *(
        "",
        " ",
        "<script>alert(1)</script>",
        "a" * 300,
        "a" * 5000,
        "../../../../etc/passwd",
    ),
    *(
        "/dev/zero",
        "/dev/null",
        "/",
        ".",
        "..",
        "\u202e",
        "\u95a2\u7bc0",
        "\x1b[31m",
        "%s%n%d",
    ),
    *(
        "'",
        '"',
        "{}",
        "{0}",
        "$x$",
        "\\",
        "&amp;",
        "-",
        "#1",
        "none",
        "null",
        "a/b",
        "a\nb",
        "*",
        "a\0b",
    ),
)
_ODD_JSON = (
    *(None, True, False, 0, -1, 1, 2, 1.5, 1e308, -1e308, 1e-308, 10**400, 10**18),
    *(
        float("nan"),
        float("inf"),
        [],
        {},
        [[]],
        [{}],
        {"": []},
        [0.0] * 9,
        [[1.0, 2.0]],
        "1",
        "nan",
    ),
)

_FACTORS = (-1.0, 0.0, 0.5, 0.999, 2.0, 1e-3, 1e3, 1e9, 1e-12)


def odd(random: Random) -> str:
    """Return a number or a text that breaks a careless reader."""
    return random.choice(NUMBERS if random.random() < 0.7 else TEXTS)


def damage_bytes(random: Random, data: bytes, limit: int = 4) -> bytes:
    """Return bytes of which a few are changed, lost, repeated or inserted."""
    for _ in range(random.randint(1, limit)):
        data = _damaged_once(random, data)
    return data


def _damaged_once(random: Random, data: bytes) -> bytes:
    """Return bytes with one damage."""
    position = random.randint(0, len(data))
    length = 2 ** random.randint(0, 8)
    piece = data[position : position + length]
    damage = random.randint(0, 6)
    if damage == 0:
        return data[:position]
    if damage == 1:
        return data[:position] + data[position + length :]
    if damage == 2:
        return (
            data[:position] + piece * random.randint(2, 4) + data[position + length :]
        )
    if damage == 3:
        other = random.randint(0, len(data))
        return (
            data[:position] + data[other : other + length] + data[position + length :]
        )
    if damage == 4:
        new = random.choice(
            (b"\0", b"\xff", b"\xff\xff\xff\x7f", b"\r\n", b'"', odd(random).encode())
        )
        return data[:position] + new + data[position + len(new) :]
    changed = bytearray(data or b"\0")
    for _ in range(random.randint(1, 4)):
        changed[random.randrange(len(changed))] ^= 1 << random.randint(0, 7)
    return bytes(changed)


def damaged_table(random: Random, text: str, separator: str = ",") -> bytes:
    """Return a table with a few cells, columns or lines changed; sometimes bytes too."""
    rows = [line.split(separator) for line in text.split("\n")]
    for _ in range(random.choice((1, 1, 2, 4))):
        _damage_rows(random, rows)
    mark = random.choice((";", "\t", " ", "|")) if random.random() < 0.1 else separator
    end = "\r\n" if random.random() < 0.05 else "\n"
    data = end.join(mark.join(row) for row in rows).encode()
    if random.random() < 0.03:
        data = data.decode().encode("utf-16")
    return damage_bytes(random, data) if random.random() < 0.2 else data


def _damage_rows(random: Random, rows: list[list[str]]) -> None:
    """Change one cell, row or the order of the rows."""
    row = random.randrange(min(len(rows), 3) if random.random() < 0.4 else len(rows))
    cell = random.randrange(len(rows[row]))
    damage = random.randint(0, 9)
    if damage < 4:
        rows[row][cell] = odd(random)
    elif damage == 4:
        rows[row][cell] = rows[random.randrange(len(rows))][-1]
    elif damage == 5:
        rows[row] = rows[row][: cell + 1] if random.random() < 0.5 else rows[row] * 2
    elif damage == 6:
        rows.insert(row, list(rows[random.randrange(len(rows))]))
    elif damage == 7:
        del rows[row : row + random.randint(0, len(rows) - 1) or None]
        rows += [[""]]
    elif damage == 8:
        value = odd(random)
        for cells in rows[1:]:
            cells[min(cell, len(cells) - 1)] = value
    else:
        rows.reverse()


def damaged_json(random: Random, content: Any) -> bytes:
    """Return JSON with a few values changed; sometimes bytes too, or nested without end."""
    content = copy.deepcopy(content)
    for _ in range(random.choice((1, 1, 2, 4))):
        content = _damaged_value(random, content)
    data = json.dumps(content).encode()
    if random.random() < 0.01:
        depth = random.choice((50, 900, 100_000))
        data = data.replace(b"1", b"[" * depth + b"]" * depth, 1)
    return damage_bytes(random, data) if random.random() < 0.15 else data


def _odd_value(random: Random) -> Any:
    """Return a JSON value that breaks a careless reader."""
    return (
        copy.deepcopy(random.choice(_ODD_JSON))
        if random.random() < 0.7
        else odd(random)
    )


def _damaged_value(random: Random, content: Any) -> Any:
    """Change something in a nested value, in place where that is possible."""
    keys: list[Any] = []
    if isinstance(content, dict):
        keys = list(content)
    elif isinstance(content, list):
        keys = list(range(len(content)))
    if isinstance(content, float) and random.random() < 0.5:
        return content * random.choice(_FACTORS)
    if not keys or random.random() < 0.02:
        return _odd_value(random)
    key = random.choice(keys)
    draw = random.random()
    if draw < 0.08:
        del content[key]
    elif draw < 0.12 and isinstance(content, list):
        content.append(copy.deepcopy(content[key]))
    elif draw < 0.15 and isinstance(content, dict):
        content[odd(random)] = content.pop(key)
    elif draw < 0.3:
        content[key] = _odd_value(random)
    else:
        content[key] = _damaged_value(random, content[key])
    return content


def damaged_xml(
    random: Random, root: Any, attributes: Sequence[str], tags: Sequence[str]
) -> bytes:
    """Return XML with a few attributes and elements changed; sometimes bytes too."""
    root = copy.deepcopy(root)
    for _ in range(random.choice((1, 1, 2, 4))):
        elements = list(root.iter(etree.Element))
        _damage_element(random, random.choice(elements), elements, attributes, tags)
    data = etree.tostring(root)
    return damage_bytes(random, data) if random.random() < 0.15 else data


def _damage_element(
    random: Random,
    element: Any,
    elements: list[Any],
    attributes: Sequence[str],
    tags: Sequence[str],
) -> None:
    """Change, repeat, move or remove one element or attribute."""
    draw = random.random()
    held = list(element.attrib)
    parent = element.getparent()
    if draw < 0.4 and held:
        _set(element, random.choice(held), odd(random))
    elif draw < 0.5 and held:
        del element.attrib[random.choice(held)]
    elif draw < 0.65:
        _set(element, random.choice(attributes), odd(random))
    elif draw < 0.8:
        element.append(etree.fromstring(random.choice(tags)))
    elif draw < 0.88 and parent is not None:
        parent.remove(element)
    elif draw < 0.95:
        element.append(copy.deepcopy(random.choice(elements[len(elements) // 2 :])))
    else:
        element.tag = random.choice(elements).tag


def _set(element: Any, name: str, value: str) -> None:
    """Set an attribute, without characters that XML cannot hold."""
    element.set(name, "".join(c for c in value if c >= " " or c in "\t\n"))
