"""Positions in one file and torques in another are one log, as if one file had both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigs.files.refusals import refused
from rigs.logs.log_files import JOINTS, arm_of, assert_samples, motion, notes_of, write
from robot_sysid.logs import LogOptions
from robot_sysid.logs.reader import open_logs
from robot_sysid.records import Recording

DATA = motion(600)
Q = ("q1", "q2", "q3")
TAU = ("tau0", "tau1", "tau2")


def write_half(folder, name, time, values, titles):
    """Write quantities with a column of time, or without where ``time`` is None."""
    if time is not None:
        values = np.column_stack((time, values))
        titles = ("time", *titles)
    return write(folder / name, values, titles)


def halves(folder, q_time, tau_time, q=DATA.q, tau=DATA.tau, name=""):
    positions = write_half(folder, f"q{name}.csv", q_time, q, Q)
    torques = write_half(folder, f"tau{name}.csv", tau_time, tau, TAU)
    return [positions, torques]


def read(paths, **options) -> list[Recording]:
    return open_logs(arm_of(JOINTS), paths, LogOptions(**options))


def assert_joined(
    paths, expected=DATA, names=("time", "q", "tau"), atol=0.0, **options
):
    """Assert that files are one log with these samples, and return its notes."""
    (log,) = read(paths, **options)
    assert_samples(expected, log, names, atol)
    assert log.name == str(paths[0]) and log.qd is None
    return notes_of(log)


@pytest.mark.parametrize("timed", [(0, 1), (0,), (1,)])
def test_two_halves_read_as_the_file_with_both(tmp_path, timed):
    times = [DATA.time if k in timed else None for k in range(2)]
    paths = halves(tmp_path, *times)
    notes = assert_joined(paths)
    assert "q.csv and torques of " in notes and "row by row" in notes
    (log,) = read(paths[::-1])
    assert_samples(DATA, log, ("time", "q", "tau"))


def test_halves_without_time_need_a_rate_and_as_many_rows(tmp_path):
    paths = halves(tmp_path, None, None)
    with refused("no time column"):
        read(paths)
    assert_joined(paths, atol=1e-15, columns="rate = 200")
    for times in ((None, None), (DATA.time[:-1], None)):
        paths = halves(tmp_path, *times, q=DATA.q[:-1])
        with refused("599 rows of positions and .* 600 of torques"):
            read(paths, columns="rate = 200")


def test_a_torque_that_was_read_later_is_interpolated_by_its_time(tmp_path):
    """Half a step beside the positions, and 0.3 s later: rows of one index are other instants."""
    torque_time = DATA.time + 0.3 + 0.0025
    later = np.sin(np.outer(torque_time, [2.0, 3.0, 4.0]))
    (log,) = read(halves(tmp_path, DATA.time, torque_time, tau=later))
    expected = np.sin(np.outer(log.time, [2.0, 3.0, 4.0]))
    np.testing.assert_allclose(log.tau, expected, rtol=0.0, atol=1e-6)
    assert (
        "interpolated at the times of positions, which both have in 539 of 600"
        in notes_of(log)
    )
    np.testing.assert_array_equal(log.q, DATA.q[61:])


DATES = np.datetime64("2024-05-01T12:00:00", "ns")


def dates_at(time):
    """Return times [s] as dates, to the nanosecond."""
    return DATES + (1e9 * time).round().astype("m8[ns]")


def write_dated(path, time, values, titles):
    """Write quantities with a column of dates, as text, or as Parquet by the ending of the file."""
    dates = dates_at(time)
    if path.suffix == ".parquet":
        pa = pytest.importorskip("pyarrow")
        table = pa.table({"time": dates, **dict(zip(titles, values.T))})
        pytest.importorskip("pyarrow.parquet").write_table(table, path)
        return path
    rows = zip(dates.astype(str), values.tolist())
    lines = [",".join([date, *map(repr, row)]) for date, row in rows]
    path.write_text("\n".join([",".join(("time", *titles)), *lines]))
    return path


@pytest.mark.parametrize("endings", [("csv", "csv"), ("csv", "parquet")])
def test_dates_of_two_files_are_those_of_one_clock(tmp_path, endings):
    """Each file's times count from its own first date: rows of one index are other instants."""
    later = DATA.time + 0.3 + 0.0025
    tau = np.sin(np.outer(later, [2.0, 3.0, 4.0]))
    of_files = ("q", DATA.time, DATA.q, Q), ("tau", later, tau, TAU)
    (log,) = read(
        write_dated(tmp_path / f"{name}.{ending}", *columns)
        for (name, *columns), ending in zip(of_files, endings)
    )
    np.testing.assert_array_equal(log.q, DATA.q[61:])
    expected = np.sin(np.outer(DATA.time[61:], [2.0, 3.0, 4.0]))
    np.testing.assert_allclose(log.tau, expected, rtol=0.0, atol=1e-6)


def test_nothing_is_interpolated_within_a_hole_of_the_torques(tmp_path):
    kept = np.r_[0:200, 210:600]
    paths = halves(tmp_path, DATA.time, DATA.time[kept], tau=DATA.tau[kept])
    assert "empty or NaN cells: 10 " in assert_joined(paths, DATA[kept], atol=1e-9)


@pytest.mark.parametrize(
    ("time", "rows", "fault"),
    [
        (DATA.time + 2.0, 1, "from 0 to 2.995 and .* from 2 to 4.995: less than half"),
        (DATA.time + 1.7e9, 1, "less than half is common"),
        (np.nan * DATA.time, 1, "too few rows with times"),
        (DATA.time, 4, "a row each 0.005 and .* each 0.02 of time"),
    ],
)
def test_halves_of_other_times_or_rates_are_refused(tmp_path, time, rows, fault):
    paths = halves(tmp_path, DATA.time, time[::rows], tau=DATA.tau[::rows])
    with refused(fault):
        read(paths)


def test_a_gripper_makes_no_whole_log_of_a_half(tmp_path):
    columns = np.column_stack((DATA.q, DATA.tau, 0.1 * DATA.time))
    positions = (*Q, "gripper_force")
    torques = (*TAU, "gripper_position")
    paths = [
        write_half(tmp_path, "q.csv", DATA.time, columns[:, [0, 1, 2, 6]], positions),
        write_half(tmp_path, "tau.csv", DATA.time, columns[:, 3:], torques),
    ]
    assert_joined(paths)


def test_declared_columns_of_two_files_are_joined(tmp_path):
    """Each file has the titles of its own quantity alone."""
    paths = [
        write_half(tmp_path, "a.csv", DATA.time, DATA.q, ("A1", "A2", "A3")),
        write_half(tmp_path, "m.csv", DATA.time, DATA.tau, ("M1", "M2", "M3")),
    ]
    assert_joined(paths, columns="position = A*, torque = M*")
    single = "torque.base = M1, torque.elbow = none, torque.wrist = -M3"
    expected = replace(DATA, tau=DATA.tau * [1.0, 0.0, -1.0])
    assert_joined(paths, expected, columns=f"position = A*, {single}")


def test_units_of_time_in_titles_are_those_of_each_file(tmp_path):
    paths = halves(tmp_path, DATA.time, 1e3 * DATA.time)
    paths[1].write_text(paths[1].read_text().replace("time,", "time [ms],"))
    assert_joined(paths)


def test_several_halves_are_paired_in_their_order_beside_whole_logs(tmp_path):
    other = DATA[:500]
    first = halves(tmp_path, DATA.time, DATA.time)
    second = halves(tmp_path, other.time, other.time, other.q, -other.tau, "2")
    whole = write_half(
        tmp_path, "log.csv", DATA.time, np.hstack((DATA.q, DATA.tau)), Q + TAU
    )
    for paths in (
        [*first, *second, whole],
        [first[0], second[0], whole, first[1], second[1]],
    ):
        logs = read(paths)
        assert [len(log) for log in logs] == [600, 500, 600]
        np.testing.assert_array_equal(logs[1].tau, -other.tau)
    with refused("their numbers differ: .*q.csv, .*q2.csv; .*tau.csv"):
        read([first[0], second[0], first[1]])


def test_commanded_positions_in_a_file_of_their_own_are_read_for_servos(tmp_path):
    positions, _ = halves(tmp_path, DATA.time, DATA.time)
    titles = ("q_des1", "q_des2", "q_des3")
    commands = write_half(tmp_path, "command.csv", DATA.time, DATA.q + 0.01, titles)
    (log,) = read([positions, commands], commanded=True)
    np.testing.assert_allclose(log.tau, 0.01, rtol=0.0, atol=1e-15)


SAME_TITLES = [("j1", "j2", "j3"), ("Axis 1", "Axis 2", "Axis 3"), JOINTS, None]


@pytest.mark.parametrize("titles", SAME_TITLES)
@pytest.mark.parametrize(
    ("names", "factor"),
    [
        (("q", "tau"), 1.0),
        (("run1_position", "run1_torque_mNm"), 1e3),
        (("winkel", "drehmoment"), 1),
    ],
)
def test_of_files_with_the_same_titles_the_names_say_which_is_which(
    tmp_path, titles, names, factor
):
    paths = []
    for name, values in zip(names, (DATA.q, factor * DATA.tau)):
        rows = np.column_stack((DATA.time, values))
        header = ("time", *titles) if titles else ()
        paths.append(write(tmp_path / f"{name}.csv", rows, header))
    notes = assert_joined(paths, atol=1e-12)
    assert "taken for what its name says: position" in notes


def test_a_file_of_currents_by_its_name_and_unit(tmp_path):
    """The refusal prints the option that takes them."""
    titles = ("j1", "j2", "j3")
    paths = [
        write_half(tmp_path, "q_deg.csv", DATA.time, np.degrees(DATA.q), titles),
        write_half(tmp_path, "current_mA.csv", DATA.time, 1e3 * DATA.tau, titles),
    ]
    with refused("are motor currents: give --torque-constants") as caught:
        read(paths)
    assert "--torque-constants 1 leads to a weight of known mass" in str(caught.value)
    # Without the constants, no command would do.
    assert not caught.value.options
    assert_joined(paths, atol=1e-12, torque_constants=1.0)


def test_names_of_files_that_say_no_measurement_are_not_believed(tmp_path):
    titles = ("j1", "j2", "j3")
    paths = [
        write_half(tmp_path, "q.csv", DATA.time, DATA.q, titles),
        write_half(tmp_path, "tau_cmd.csv", DATA.time, DATA.tau, titles),
    ]
    with refused("torque"):
        read(paths)
