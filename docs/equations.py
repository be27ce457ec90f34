"""Turns the equations of the pages into MathML, so that the site needs no script to show them."""

from __future__ import annotations

import re
from typing import Any

from latex2mathml.converter import convert

_BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(
    r"(?<![\\\w`$])\$(?=\S)([^$\n`]*(?:\n[^$\n`]+)?)(?<=\S)\$(?![\w`$])"
)
_CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.DOTALL | re.MULTILINE)


def _display(match: re.Match[str]) -> str:
    # The sixty entries of the regressor are wider than a phone.
    """Return an equation block as MathML."""
    return f'<div style="overflow: auto hidden">{convert(match[1], display="block")}</div>\n'


def _inline(match: re.Match[str]) -> str:
    # A span, because a line that begins with an unknown tag would become a paragraph of its own.
    """Return an equation within a line as MathML."""
    return f"<span>{convert(match[1])}</span>"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page's text with its equations as MathML; code stays as it is."""
    text = _BLOCK.sub(_display, markdown)
    pieces = _CODE.split(text)
    pieces[::2] = [_INLINE.sub(_inline, piece) for piece in pieces[::2]]
    return "".join(pieces)
