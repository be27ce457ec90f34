"""Text for the user: numbers with the digits their errors deserve, units, next steps, progress."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

LEAST_PERCENT = 0.01
"""Percentage below which a share that is not zero is no longer written as a number."""
WHOLE_PERCENT = 99.5
"""Percentage from which on two digits would be too few, so that it is written as a whole number."""
MOST_PERCENT = 1000.0
"""Percentage above which the number says no more than that it is too large."""
# What a title or a path from a file could do to a terminal or a page; the last two ranges are line
# ends and marks by which text runs from right to left.
_CONTROL_CODES = (
    *range(32),
    *range(127, 160),
    *range(0x2028, 0x202F),
    *range(0x2066, 0x206A),
)
# Characters that nobody sees: marks of the order of bytes and of text, soft hyphens, joiners and
# blanks without width, and choices of a character's form.
_INVISIBLE_CODES = (
    0xAD,
    0x34F,
    0x61C,
    0x180E,
    *range(0x200B, 0x2010),
    *range(0x2060, 0x2066),
    *range(0x206A, 0x2070),
    *range(0xFE00, 0xFE10),
    0xFEFF,
    *range(0xFFF9, 0xFFFC),
)
_NOTHING = dict.fromkeys(
    (*_INVISIBLE_CODES, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
)
_REPLACEMENTS = {
    **{code: f"\\u{code:04x}" for code in _INVISIBLE_CODES},
    **{code: "?" for code in _CONTROL_CODES if chr(code) != "\t"},
}
_ESCAPES = {code: f"\\u{code:04x}" for code in _CONTROL_CODES}
# Of a word for a shell; the byte of a path that is no UTF-8 is kept in a surrogate.
_SHELL_ESCAPES = {
    **{code: f"\\x{code:02x}" for code in range(128) if code in _CONTROL_CODES},
    **{c: f"\\u{c:04x}" for c in (*_CONTROL_CODES, *_INVISIBLE_CODES) if c >= 128},
    **{0xDC00 + byte: f"\\x{byte:02x}" for byte in range(128, 256)},
    ord("'"): "\\'",
    ord("\\"): "\\\\",
}


def printable(text: str) -> str:
    """Return a text with "?" in the place of control characters and ends of lines, and with the
    codes of characters that nobody sees.
    """
    return text.translate(_REPLACEMENTS)


def visible(text: str) -> str:
    """Return a text without the characters that nobody sees."""
    return text.translate(_NOTHING)


def quoted_text(text: str) -> str:
    """Return a text in quotation marks on one line, as Python, TOML and JSON read it."""
    return json.dumps(text, ensure_ascii=False).translate(_ESCAPES)


def shell_line(words: Iterable[str]) -> str:
    """Return a command on one line that a shell reads as these words.

    A word with control characters has the form $'a\\x0ab', which bash, zsh and ksh know.
    """
    return " ".join(map(shell_word, words))


def shell_word(word: str) -> str:
    """Return a word of a command as a shell reads it, see ``shell_line``."""
    if word.isprintable():
        return shlex.quote(word)
    return f"$'{word.translate(_SHELL_ESCAPES)}'"


def number_text(value: float, error: float | None = None) -> str:
    """Return a number with as many decimals as make two digits of its standard error.

    What these decimals round to zero has no sign. Four significant digits where the error is None,
    zero or infinite. "0" for zero itself. "not known" where the number is not finite.
    """
    if not math.isfinite(value):
        return "not known"
    if value == 0.0:
        return "0"
    if error is None or not 0.0 < error < math.inf:
        return f"{value:.4g}"
    decimals = 1 - math.floor(math.log10(error))
    # Adding zero takes the sign from the -0.00 that rounding leaves.
    rounded = round(value, max(decimals, 0)) + 0.0
    if decimals <= 6:  # more are written with an exponent
        return f"{rounded:.{max(decimals, 0)}f}"
    if rounded == 0.0:
        return "0"
    # As many significant digits as reach the last of these decimals.
    digits = math.floor(math.log10(abs(value))) + decimals + 1
    return f"{value:.{max(digits, 1)}g}"


def with_error(value: float, error: float | None, unit: str = "") -> str:
    """Return a number and its standard error, such as "1.551 ± 0.087 kg".

    "1.6 kg (± not known)" where the error is not finite; the number alone where it is None or 0.
    """
    if not error:
        return f"{number_text(value)} {unit}".rstrip()
    if not math.isfinite(error):
        return f"{value:.2g} {unit}".rstrip() + " (± not known)"
    return f"{number_text(value, error)} ± {number_text(error, error)} {unit}".rstrip()


def size_text(size: float, least: float, unit: str) -> str:
    """Return a size that is not negative with two digits and its unit, without an exponent.

    "under 0.01 mm" for one below ``least`` that is not zero.
    """
    if 0.0 < size < least:
        return f"under {least:g} {unit}"
    return f"{number_text(size, size)} {unit}"


def percent(share: float) -> str:
    """Return a share in percent with two digits, from 99.5 % on as a whole number.

    "over 1000 %" for a larger share, "under 0.01 %" for a smaller one that is not zero, "not known"
    for NaN.
    """
    size = 100.0 * abs(share)
    if not size <= MOST_PERCENT:
        return f"over {MOST_PERCENT:.0f} %" if size > MOST_PERCENT else "not known"
    if 0.0 < size < LEAST_PERCENT:
        return f"under {LEAST_PERCENT} %"
    return (
        f"{100.0 * share:.2g} %" if size < WHOLE_PERCENT else f"{100.0 * share:.0f} %"
    )


def count_text(count: int, noun: str) -> str:
    """Return a count with its noun, given in the singular: "1 row", "2 rows"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def torque_unit(is_slide: bool) -> str:
    """Return the unit of a joint's torque: N of a slide, N·m of a hinge."""
    return "N" if is_slide else "N·m"


def position_unit(is_slide: bool) -> str:
    """Return the unit of a joint's position: m of a slide, rad of a hinge."""
    return "m" if is_slide else "rad"


def aligned_lines(
    rows: Iterable[Sequence[str]], right_aligned: Collection[str] = ()
) -> list[str]:
    """Return rows of cells as lines of text with aligned columns, two blanks between columns.

    Args:
        rows: texts of the cells, equally many in each row; the first row holds the headings.
        right_aligned: headings of the columns whose cells end at the same place.
    """
    columns = []
    for cells in zip(*rows):
        align = str.rjust if cells[0] in right_aligned else str.ljust
        width = max(map(len, cells))
        columns.append([align(cell, width) for cell in cells])
    return ["  ".join(cells).rstrip() for cells in zip(*columns)]


class Detail(str):
    """A line or note of minor interest, which the console prints with --verbose only.

    Result files and Python programs have it in any case.
    """


class MeshesLeftOut(Detail):
    """A note that collision meshes, which MuJoCo does not find or read, were left out.

    It is a detail but for who plans a motion, which may touch what they would have shown.
    """


class LeastMassGiven(str):
    """A note that links without mass got the least that MuJoCo takes."""


class Level(Enum):
    """Weight of a remark, in the order in which remarks are printed.

    What REFUSES forbids the use of a log or a result, what DOUBTS needs consent or limits
    the use, what SAYS only informs.
    """

    REFUSES = "refuses"
    DOUBTS = "doubts"
    SAYS = "says"


@dataclass(frozen=True)
class Remark:
    """What the user should know of a log, a model or a result: one sentence.

    Attributes:
        level: its weight.
        about: what it is about: a log's check, a joint, a body or the written file; "" for the run.
        text: the sentence, without an end mark.
        remedy: what to do, without an end mark; "" where nothing has to be done.
    """

    level: Level
    about: str
    text: str
    remedy: str = ""

    @property
    def sentence(self) -> str:
        """The sentence and the remedy behind it."""
        return "; ".join(filter(None, (self.text, self.remedy)))


def says(sentences: Iterable[str]) -> Iterator[Remark]:
    """Yield a remark that informs of each of several sentences, each once."""
    for sentence in dict.fromkeys(sentences):
        yield Remark(Level.SAYS, "", sentence)


@dataclass(frozen=True)
class NextStep:
    """What to do after a command, and the command that does it.

    Attributes:
        sentence: what to do and what for, without an end mark.
        command: words of the command line that does it.
        then: what to do after that; None for nothing that is known before.
    """

    sentence: str
    command: tuple[str, ...]
    then: NextStep | None = None

    def before(self, last: NextStep) -> NextStep:
        """Return this with another step after all that it has after it."""
        return replace(self, then=self.then.before(last) if self.then else last)

    def lines(self) -> tuple[str, ...]:
        """Return the sentence, and below it the command, quoted for a shell, alone on its line.

        So for what to do after that.
        """
        own = f"{self.sentence}:", f"  {shell_line(self.command)}"
        return own if self.then is None else (*own, *self.then.lines())


class Progress:
    """Receives the progress of a long run; the methods of this base class print nothing.

    The console's subclass prints lines and a progress bar.
    """

    def stage(self, *messages: str) -> None:
        """Print lines that announce a stage of the run or state its outcome."""

    def track(self, items: Iterator[Any], label: str, total: int) -> Iterator[Any]:
        """Yield the items, ``total`` in number, and call ``advance`` after each.

        A line "LABEL: 100%" is printed after the last.
        """
        for count, item in enumerate(items, start=1):
            yield item
            self.advance(label, count, total, "")
        self.stage(f"{label}: 100%")

    def advance(self, label: str, done: float, total: float, text: str) -> None:
        """Show that ``done`` of ``total`` steps are finished.

        Args:
            label: names the stage.
            done: number of finished steps.
            total: number of all steps.
            text: state of the stage, such as an error so far; "" for none.
        """

    def note(self, *messages: str) -> None:
        """Print notes, such as warnings, which do not stop the run."""

    def remark(self, *remarks: Remark) -> None:
        """Print what limits a result, then what informs; a verdict states what refuses it."""
        for level in (Level.DOUBTS, Level.SAYS):
            for each in remarks:
                if each.level is level:
                    # A detail stays one.
                    self.note(type(each.text)(each.sentence))
