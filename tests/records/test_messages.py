"""Numbers as text: as many digits as the error deserves, without exponents of rounding noise."""

from __future__ import annotations

import json
import shlex
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.dynamics.friction import TERMS
from robot_sysid.records.messages import (
    number_text,
    percent,
    position_unit,
    printable,
    quoted_text,
    shell_line,
    size_text,
    torque_unit,
)
from robot_sysid.records.parameters import ZERO

NUMBERS = st.floats(1e-12, 1e6) | st.floats(-1e6, -1e-12)


@given(NUMBERS, st.floats(1e-12, 1e6))
def test_a_number_is_rounded_at_the_second_digit_of_its_error(value, error):
    text = number_text(value, error)
    assert abs(float(text) - value) <= 0.051 * error + 1e-12 * abs(value)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (-6e-5, 0.0012, "-0.0001"),
        (-2e-5, 0.0012, "0.0000"),
        (1e-15, 1e-5, "0.000000"),
        (-1e-15, 1e-9, "0"),
        (3.21e-7, 1.1e-8, "3.21e-07"),
        (0.0, 0.1, "0"),
        (1234.5, 130.0, "1234"),
    ],
)
def test_what_is_far_below_its_error_is_a_zero_without_sign(value, error, text):
    assert number_text(value, error) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0, "0 %"),
        (3.1e-7, "under 0.01 %"),
        (-3.1e-7, "under 0.01 %"),
        (1e-4, "0.01 %"),
        (0.0123, "1.2 %"),
        (-0.65, "-65 %"),
        (1.05, "105 %"),
        (11.0, "over 1000 %"),
        (float("nan"), "not known"),
    ],
)
def test_a_percentage_has_two_digits_and_no_exponent(share, text):
    assert percent(share) == text


@given(NUMBERS)
def test_without_an_error_four_digits_count(value):
    assert float(number_text(value)) == pytest.approx(value, rel=5.1e-4)


@pytest.mark.parametrize("is_slide", [False, True])
def test_every_friction_term_has_a_unit_but_the_loss_per_load(is_slide):
    for name, term in TERMS.items():
        unit = term.at("j", is_slide).unit
        assert (unit == "") == (name == "load")
        assert is_slide or not unit.startswith("N·s")
    assert TERMS["coulomb"].at("j", is_slide).unit == torque_unit(is_slide)
    assert ZERO.at("j", is_slide).unit == position_unit(is_slide)


TEXTS = st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)))


@given(TEXTS)
def test_no_text_begins_a_line_or_steers_a_terminal(text):
    """But for words without control characters, which stay as they are."""
    for line in (printable(text), quoted_text(text), shell_line([text])):
        assert (
            len(line.splitlines()) <= 1 and "\x1b" not in line and "\u202e" not in line
        )
    assert json.loads(quoted_text(text)) == text
    if text.isprintable():
        assert shell_line([text]) == shlex.quote(text)


def test_a_shell_reads_the_words_of_a_line_again():
    words = ["a b", "it's\n\\x", "\x1b[31m", "\udcff", "é\u202e"]
    line = shell_line(["printf", r"%s\0", *words])
    printed = subprocess.run(
        ["bash", "-c", line], capture_output=True, env={"LC_ALL": "C.UTF-8"}
    ).stdout
    assert printed.decode(errors="surrogateescape").split("\0")[:-1] == words


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0.0, "0 mm"),
        (6.3e-20, "under 0.01 mm"),
        (0.0123, "0.012 mm"),
        (3.06, "3.1 mm"),
        (212.4, "212 mm"),
    ],
)
def test_a_size_has_two_digits_and_no_exponent(size, text):
    assert size_text(size, 0.01, "mm") == text
