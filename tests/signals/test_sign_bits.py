"""Registers with a sign in one of their bits are read with their signs; other numbers stay."""

from __future__ import annotations

import numpy as np
import pytest

from rigs.logs.log_files import (
    JOINTS,
    TITLES,
    motion,
    notes_of,
    read_measurements,
    write,
)
from rigs.logs.log_files import table as table_of
from robot_sysid.signals.sign_bits import decode_signs

SIGNED = np.round(346.0 * np.sin(np.outer(np.arange(400), [0.031, 0.043, 0.057]) + 0.4))


def sign_and_magnitude(values, bit):
    return np.where(values < 0.0, 2.0**bit - values, values)


@pytest.mark.parametrize("bit", range(6, 32))
def test_sign_and_magnitude_of_any_width_is_read(bit):
    size = min(346.0, 2.0**bit - 1.0)
    values = np.round(SIGNED * size / 346.0)
    found = decode_signs(sign_and_magnitude(values, bit))
    assert found is not None and f"sign in bit {bit}" in found[1]
    np.testing.assert_array_equal(found[0], values)


@pytest.mark.parametrize("width", [16, 32])
def test_twos_complement_is_read(width):
    found = decode_signs(SIGNED % 2.0**width)
    assert found is not None and f"complement of {width} bits" in found[1]
    np.testing.assert_array_equal(found[0], SIGNED)


def test_noise_that_changes_the_sign_again_and_again_is_no_other_number():
    noise = np.random.default_rng(0).normal(size=SIGNED.shape)
    values = np.round(SIGNED / 20.0 + 3.0 * noise)
    found = decode_signs(sign_and_magnitude(values, 10))
    assert found is not None
    np.testing.assert_array_equal(found[0], values)


@pytest.mark.parametrize(
    "values",
    [
        SIGNED,
        SIGNED + 0.5,
        np.abs(SIGNED),
        # Counts of an encoder, which turns past its zero.
        2048.0 + 3.0 * SIGNED,
        (2048.0 + 8.0 * SIGNED) % 4096.0,
        np.outer(np.arange(400) * 41 % 4096, [1, 1, 1]),
        # Two values, as of a switch.
        np.where(SIGNED > 0.0, 64.0, 0.0),
        np.full_like(SIGNED, np.nan),
        SIGNED[:2] % 65536.0,
    ],
)
def test_other_numbers_stay_as_they_are(values):
    assert decode_signs(values) is None


@pytest.mark.parametrize("quantity", ["position", "torque", "velocity"])
def test_columns_of_a_log_are_read_with_their_signs(tmp_path, quantity):
    data = motion()
    columns = {"q": data.q, "tau": data.tau - 2.0, "qd": data.qd}
    key = {"position": "q", "torque": "tau", "velocity": "qd"}[quantity]
    counts = np.round(1000.0 * columns[key])
    columns[key] = sign_and_magnitude(counts, 13)
    rows = np.column_stack((data.time, *columns.values()))
    titles = [*TITLES, "qd1", "qd2", "qd3"]
    path = write(tmp_path / "log.csv", rows, titles)
    line = f"{quantity} = 0.001 * {key}*"
    log = read_measurements(path, JOINTS, columns=line)
    np.testing.assert_allclose(getattr(log, key), 1e-3 * counts)
    assert f"columns of {quantity} are numbers as sign and magnitude" in notes_of(log)
    plain = read_measurements(
        write(tmp_path / "plain.csv", table_of(data)[:, :7]), JOINTS
    )
    assert "magnitude" not in notes_of(plain)
