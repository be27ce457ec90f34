"""Titles in other languages become English ones, and others stay what they are."""

from __future__ import annotations

import pytest

from robot_sysid.logs.guess.words import translate
from robot_sysid.logs.titles import read_title


@pytest.mark.parametrize(
    ("title", "quantity", "numbers", "unit"),
    [
        ("Gelenk 1 Pos [deg]", "position", (1,), "deg"),
        ("Istposition Achse 2 [Grad]", "position", (2,), "deg"),
        ("AchsIstmoment3", "torque", (3,), ""),
        ("Zeit [s]", "time", (), "s"),
        ("Moment [Nm]", "torque", (), "nm"),
        ("Moment [Nm] D", "torque", (), "nm"),
        ("Couple axe 3 (N.m)", "torque", (3,), "nm"),
        ("Temps (s)", "time", (), "s"),
        ("Posición 1 [°]", "position", (1,), "°"),
        ("Par articulación 1", "torque", (1,), ""),
        ("Velocità giunto 4 [rad/s]", "velocity", (4,), "rads"),
        ("关节2力矩(Nm)", "torque", (2,), "nm"),
        ("関節3 トルク [Nm]", "torque", (3,), "nm"),
        ("時間 [µs]", "time", (), "µs"),
        ("q_des[0]", None, (0,), ""),
        ("Sollposition A2 [°]", None, (2,), "°"),
        ("Temperatur 3 [°C]", None, (3,), "°c"),
        ("trq_base", None, (), ""),
    ],
)
def test_words_of_other_languages_are_understood(title, quantity, numbers, unit):
    english = read_title(translate(title))
    assert english.measured_quantity == quantity
    assert (english.numbers, english.unit) == (numbers, unit)
