"""Each thing that can be wrong with a log is found and said, with line numbers and a remedy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.logs.checks import sign_check
from robot_sysid.logs.reader import MeasurementLog
from robot_sysid.records import JointLimits
from tests.support.log_files import JOINTS, TITLES, limits, motion, read_measurements, table, write

# Titles stand in line 1, so row k stands in line k + 2.
FIRST = 2
# Rows in which something is put that is no row of numbers.
RUBBISH = (9, 20, 31, 42, 53)


def read(tmp_path, rows, titles=TITLES, **known) -> MeasurementLog:
    return read_measurements(write(tmp_path / "log.csv", rows, titles), JOINTS, **known)


def odd(log: MeasurementLog) -> str:
    """The notes beyond the layout and the columns."""
    return " | ".join(note for note in log.notes if not note.startswith("log "))


def test_a_good_log_draws_no_remark(tmp_path):
    data = motion()
    rows = np.column_stack((data.time, data.q, data.tau, data.qd))
    titles = (*TITLES, "qd1", "qd2", "qd3")
    assert odd(read(tmp_path, rows, titles, limits=limits())) == ""


def text_cells(rows):
    return [[*r[:2], "oops", *r[3:]] if k in RUBBISH else r for k, r in enumerate(rows.tolist())]


def short_rows(rows):
    return [r[:5] if k in RUBBISH else r for k, r in enumerate(rows.tolist())]


def changed(place, change):
    """A fault that changes some cells of the table."""

    def fault(rows):
        rows[place] = change(rows[place])
        return rows

    return fault


TIME, Q, TAU = np.s_[:, 0], np.s_[:, 1:4], np.s_[:, 4:]
# Each fault changes the table and is an error that says the words.
ERRORS: dict[str, tuple[Callable, list[str]]] = {
    "text cells": (
        text_cells,
        ["5 of 400 rows", "line 11, column 'q2': 'oops' is not a number", "1 %"],
    ),
    "short rows": (short_rows, ["5 of 400 rows", "line 11: 5 cells instead of 7"]),
    "absurd cells": (
        changed((list(RUBBISH), 4), lambda tau: np.full(len(tau), 1e30)),
        ["5 of 400 rows", "lines 11, 22, 33 and 2 more"],
    ),
    "backwards": (
        changed(([20, 21], 0), lambda time: time[::-1].copy()),
        ["log.csv: ", "line 23", "backwards", "0.005 s"],
    ),
    "many holes": (
        changed(np.s_[::10, 2], lambda q: np.nan * q),
        ["40 of 400 rows", "lines 2, 12, 22 and 37 more"],
    ),
    "coarse time": (
        changed(TIME, lambda time: np.floor(time * 50) / 50),
        ["repeat the time stamp", "more digits"],
    ),
    "milliseconds": (changed(TIME, lambda t: 1e3 * t), ["time steps of 5 s", "--units ms"]),
    "microseconds": (changed(TIME, lambda t: 1e6 * t), ["--units us"]),
    "nanoseconds since 1970": (changed(TIME, lambda t: 1.7e18 + 1e9 * t), ["--units ns"]),
    "tiny time": (changed(TIME, lambda t: 1e-3 * t), ["time steps of 5e-06 s", "declare the unit"]),
    "degrees": (changed(Q, np.degrees), ["look like degrees", "--units deg"]),
    "at rest": (changed(Q, lambda q: 0.3 + 1e-3 * q), ["at rest", "no joint moves"]),
    "spike": (changed((33, 3), lambda q: q + 2.0), ["joint wrist", "jumps at lines 35, 36"]),
    "zero torque": (
        changed(np.s_[:, 5], lambda tau: 0.0 * tau),
        ["torque of joint elbow is zero in every row"],
    ),
    "motor current": (
        changed(TAU, lambda tau: 2.69 * np.round(100.0 * tau)),
        ["multiples of 2.69", "currents in mA", "--torque-constants"],
    ),
    "stuck torque": (
        changed(np.s_[:, 6], lambda tau: np.full(len(tau), 1.25)),
        ["torque of joint wrist is the same (1.25 N m)"],
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_a_log_that_cannot_be_used_is_refused(tmp_path, name):
    fault, words = ERRORS[name]
    with pytest.raises(InputError) as caught:
        read(tmp_path, fault(table(motion())))
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_too_few_rows_are_refused(tmp_path):
    with pytest.raises(InputError, match="only 5 usable rows"):
        read(tmp_path, table(motion(5)))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sets(st.integers(1, 397), min_size=1, max_size=15), st.sampled_from(["", "nan", "NULL"]))
def test_rows_with_holes_are_left_out_and_counted(tmp_path, holes, written):
    data = motion()
    rows = table(data).tolist()
    for k in holes:
        rows[k][4] = written
    log = read(tmp_path, rows)
    kept = np.setdiff1d(np.arange(len(data)), list(holes))
    np.testing.assert_array_equal(log.samples.time, data.time[kept])
    first = ", ".join(str(k + FIRST) for k in sorted(holes)[:3])
    assert f"left out {len(holes)} rows with empty or NaN cells (line" in odd(log)
    assert f" {first}" in odd(log)
    assert "longest gap" in odd(log)


NOISE = st.binary(min_size=1, max_size=60).filter(lambda b: not set(b) & set(b"\r\n"))


@pytest.mark.slow
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sets(st.integers(1, 398), min_size=1, max_size=4), st.tuples(*[NOISE] * 4))
def test_noise_between_rows_is_left_out_and_counted(tmp_path, places, noise):
    """Lines of a serial port's rubbish, which have no reason to be text, stand between the rows."""
    data = motion()
    path = write(tmp_path / "log.csv", table(data))
    lines = path.read_bytes().splitlines()
    for place, text in zip(sorted(places, reverse=True), noise):
        lines.insert(place + 1, b"\x1b" + text)
    path.write_bytes(b"\n".join(lines) + b"\n")
    log = read_measurements(path, JOINTS)
    np.testing.assert_array_equal(log.samples.q, data.q)
    assert f"left out {len(places)} rows that are no rows of numbers" in odd(log)


@pytest.mark.parametrize("cell", ["1e30", "1e308", "x" * 200_000, "-1e8"])
def test_a_cell_that_cannot_be_true_is_left_out(tmp_path, cell):
    rows = table(motion()).tolist()
    rows[50][5] = cell
    log = read(tmp_path, rows)
    assert len(log.samples) == 399 and np.max(np.abs(log.samples.tau)) < 10.0
    assert "left out 1 rows that are no rows of numbers (line 52)" in odd(log)


def test_a_repeated_time_stamp_is_left_out_and_counted(tmp_path):
    rows = table(motion())
    rows[50, 0] = rows[49, 0]
    log = read(tmp_path, rows)
    assert len(log.samples) == 399
    assert "left out 1 rows that repeat a time stamp (line 52)" in odd(log)


def test_a_gap_is_named_with_its_length(tmp_path):
    rows = np.delete(table(motion()), slice(100, 120), axis=0)
    log = read(tmp_path, rows)
    assert "samples are missing before line 102" in odd(log)
    assert "105 ms where 5 ms is usual" in odd(log)


def test_uneven_sampling_is_said(tmp_path):
    rows = table(motion())
    keep = np.random.default_rng(0).random(len(rows)) < 0.7
    assert "unevenly spaced" in odd(read(tmp_path, rows[keep]))


def test_a_last_row_that_is_cut_off_is_left_out(tmp_path):
    path = write(tmp_path / "log.csv", table(motion()))
    path.write_text(path.read_text()[:-40])
    log = read_measurements(path, JOINTS)
    assert len(log.samples) == 399
    assert "left out the last row, which is cut off (line 401)" in odd(log)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(3.5, 12.0), st.floats(-20.0, 20.0))
def test_wrapped_positions_are_unwrapped(tmp_path, amplitude, offset):
    data = motion()
    rows = table(data)
    true = offset + amplitude * data.q[:, 0]
    rows[:, 1] = np.angle(np.exp(1j * true))
    log = read(tmp_path, rows, units="rad")
    found = log.samples.q[:, 0]
    turns = np.round((true - found) / (2.0 * np.pi))[0]
    np.testing.assert_allclose(found + 2.0 * np.pi * turns, true, rtol=0.0, atol=1e-12)
    wrapped = bool(np.any(np.abs(np.diff(rows[:, 1])) > np.pi))
    assert ("full turn" in odd(log)) == wrapped


def test_a_slide_has_no_full_turn(tmp_path):
    rows = table(motion())
    rows[200:, 1] += 2.0 * np.pi
    with pytest.raises(InputError, match="joint base jumps at line 202"):
        read(tmp_path, rows, is_slide=(True, False, False))


def test_declared_radians_are_believed(tmp_path):
    rows = table(motion())
    rows[:, 1] += 15.0
    with pytest.raises(InputError, match="look like degrees"):
        read(tmp_path, rows)
    assert len(read(tmp_path, rows, units="rad").samples) == 400
    assert len(read(tmp_path, rows, is_slide=(True, False, False)).samples) == 400


def test_positions_outside_the_limits_are_said(tmp_path):
    said = odd(read(tmp_path, table(motion()), limits=limits(0.85)))
    assert "joint limits: base by 0.05" in said and "line" in said


def test_missing_limits_allow_everything(tmp_path):
    free = JointLimits(np.full(3, -np.inf), np.full(3, np.inf), np.ones(3), np.ones(3))
    assert "limits" not in odd(read(tmp_path, table(motion()), limits=free))


def test_standing_still_at_either_end_is_said(tmp_path):
    data = motion(1000)
    rows = table(data)
    rows[:200, 1:4] = rows[200, 1:4]
    rows[700:, 1:4] = rows[700, 1:4]
    said = odd(read(tmp_path, rows))
    assert "stands still up to line 203 (1.00 s)" in said
    assert "stands still from line 702 on (1.50 s)" in said


def test_a_joint_that_does_not_move_is_named(tmp_path):
    rows = table(motion())
    rows[:, 2] = 0.5
    assert "do not move in this log: elbow" in odd(read(tmp_path, rows))


@pytest.mark.parametrize(
    ("factor", "words"), [(1.0, ""), (-1.0, "by -1 times"), (180 / np.pi, "0.0175 times")]
)
def test_a_velocity_column_that_does_not_fit_is_said(tmp_path, factor, words):
    data = motion()
    quantised = np.round(data.q / 1e-4) * 1e-4
    rows = np.column_stack((data.time, quantised, data.tau, data.qd))
    rows[:, 8] *= factor
    said = odd(read(tmp_path, rows, (*TITLES, "qd1", "qd2", "qd3")))
    assert words in said if words else said == ""
    assert factor == 1.0 or "velocity column of joint elbow" in said


def test_a_gap_says_nothing_about_a_velocity_column(tmp_path):
    data = motion()
    rows = np.delete(np.column_stack((data.time, data.q, data.tau, data.qd)), slice(100, 240), 0)
    said = odd(read(tmp_path, rows, (*TITLES, "qd1", "qd2", "qd3")))
    assert "samples are missing" in said and "velocity" not in said


def own_times(shift: float) -> tuple[np.ndarray, tuple[str, ...]]:
    rows = table(motion())
    stamps = rows[:, :1] + np.array([0.0, 1e-3, 2e-3]) + shift
    return np.column_stack((rows, stamps)), (*TITLES, *(f"{j}_time" for j in JOINTS))


def test_own_time_stamps_are_kept(tmp_path):
    rows, titles = own_times(0.0)
    np.testing.assert_array_equal(read(tmp_path, rows, titles).samples.joint_time, rows[:, 7:])


def test_own_time_stamps_of_another_clock_or_backwards_are_refused(tmp_path):
    rows, titles = own_times(5.0)
    with pytest.raises(InputError, match=r"5 s away.*joint_time = none"):
        read(tmp_path, rows, titles)
    rows, titles = own_times(0.0)
    rows[7, 8] -= 0.05
    with pytest.raises(InputError, match="runs backwards at line 9"):
        read(tmp_path, rows, titles)


@given(st.integers(0, 2**32), st.integers(0, 2), st.floats(0.1, 10.0))
def test_a_flipped_torque_is_found_and_a_right_one_is_not(seed, joint, scale):
    rng = np.random.default_rng(seed)
    model = rng.normal(size=(200, 3)) + 1.0
    measured = scale * (model + 0.3 * rng.normal(size=model.shape))
    assert sign_check(measured, model, JOINTS) == ()
    measured[:, joint] *= -1.0
    (note,) = sign_check(measured, model, JOINTS)
    assert f"torque of joint {JOINTS[joint]} runs against the model's" in note


def test_a_torque_that_only_leans_the_wrong_way_is_a_note():
    rng = np.random.default_rng(1)
    model = rng.normal(size=(2000, 3))
    measured = model + 0.0
    measured[:, 1] = -0.5 * model[:, 1] + 0.8 * rng.normal(size=2000)
    (note,) = sign_check(measured, model, JOINTS)
    assert "joint elbow runs against" in note


def test_a_torque_without_a_model_counterpart_has_no_sign():
    assert sign_check(np.ones((5, 3)), np.zeros((5, 3)), JOINTS) == ()
