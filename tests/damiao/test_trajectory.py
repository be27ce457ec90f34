"""The trajectory file, written and read; what is clamped."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rigs.motors.damiao_rig import export, swing
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.damiao.trajectory import read_damiao_trajectory
from robot_sysid.errors import InputError


def export_motion(chunks, types):
    text = io.StringIO()
    percent = export(chunks, types, text)
    return percent, text.getvalue()


def reread(path):
    result = read_damiao_trajectory(path)
    return result.time, result.q, result.qd, result.tau


def test_the_file_looks_as_specified():
    time = np.array([0.0, 0.001, 0.002])
    q = np.array([[0.0, 0.0], [0.0012, 0.0008], [0.0024, 0.0016]])
    qd = np.array([[0.0, 0.0], [0.31, 0.22], [0.315, 0.225]])
    tau = np.array([[0.0, -0.00001], [0.05, 0.03], [0.051, 0.0305]])
    percent, text = export_motion([(time, q, qd, tau)], ["DM4340", "DM4340"])
    assert text == (
        "# motor_type=DM4340,can_id=1,mode=MIT\n"
        "# motor_type=DM4340,can_id=2,mode=MIT\n"
        "time,j0_pos,j0_vel,j0_tau,j1_pos,j1_vel,j1_tau\n"
        "0.000,0.0000,0.0000,0.0000,0.0000,0.0000,0.0000\n"
        "0.001,0.0012,0.3100,0.0500,0.0008,0.2200,0.0300\n"
        "0.002,0.0024,0.3150,0.0510,0.0016,0.2250,0.0305\n"
    )
    np.testing.assert_array_equal(percent, [0.0, 0.0])


@given(data=st.data())
def test_what_is_written_is_read_back_within_the_printed_digits(data, tmp_path_factory):
    types = data.draw(st.lists(st.sampled_from(sorted(MOTORS)), min_size=1, max_size=7))
    samples = data.draw(st.integers(1, 30))
    rate = data.draw(st.sampled_from([1000.0, 500.0, 300.0, 250.0, 123.4, 4000.0]))
    limits = np.array([MOTORS[t].limits for t in types]).T
    share = hnp.arrays(float, (3, samples, len(types)), elements=st.floats(-1.3, 1.3))
    values = data.draw(share) * limits[:, None, :]
    time = np.arange(samples) / rate
    path = tmp_path_factory.mktemp("csv") / "damiao_trajectory.csv"
    percent = export([(time, *values)], types, path)
    inside = np.clip(values, -limits[:, None, :], limits[:, None, :])
    got_time, *got = reread(path)
    np.testing.assert_allclose(got_time, time, rtol=0, atol=5.1e-7)
    np.testing.assert_allclose(got, inside, rtol=0, atol=5.1e-5)
    assert np.all(np.abs(got) <= limits[:, None, :])
    changed = np.any(values != inside, axis=0).mean(axis=0) * 100
    np.testing.assert_allclose(percent, changed, rtol=0, atol=1e-9)


@given(cuts=st.lists(st.integers(1, 39), max_size=5))
def test_the_chunk_size_changes_nothing(cuts):
    motion_chunk = swing(2, 0.156)
    edges = [0, *sorted(set(cuts)), 40]
    pieces = (tuple(x[a:b] for x in motion_chunk) for a, b in zip(edges, edges[1:]))
    one = export_motion([motion_chunk], ["DM4340"] * 2)[1]
    assert export_motion(pieces, ["DM4340"] * 2)[1] == one


def test_ids_are_read_and_default_to_an_offset_of_sixteen(tmp_path):
    path = tmp_path / "t.csv"
    export([swing(2)], ["DM4340", "DM4310"], path)
    text = path.read_text().replace("can_id=1", "can_id=5")
    path.write_text(text.replace("can_id=2,mode=MIT", "can_id=3,mode=MIT,master_id=51"))
    joints = read_damiao_trajectory(path).joints
    assert [(j.motor_type, j.can_id, j.master_id) for j in joints] == [
        ("DM4340", 5, 0x15),
        ("DM4310", 3, 0x33),
    ]


@pytest.mark.parametrize("where", [1, 2, 3])
def test_values_that_are_not_finite_are_refused(where, tmp_path):
    chunk = [np.array(x) for x in swing(2)]
    chunk[where][2, 1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        export([tuple(chunk)], ["DM4340"] * 2, tmp_path / "t.csv")
    assert list(tmp_path.iterdir()) == []


GOOD = "# motor_type=DM4340,can_id=1,mode=MIT\ntime,j0_pos,j0_vel,j0_tau\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column line and rows"),
        ("time,j0_pos,j0_vel,j0_tau\n0,0,0,0\n", "no '# motor_type=...' lines"),
        (
            "# motor_type=DM1,can_id=1,mode=MIT\n",
            "line 1: unknown Damiao motor type 'DM1'",
        ),
        ("# motor_type=DM4340,can_id=x,mode=MIT\n", "line 1: expected"),
        ("# motor_type=DM4340,mode=MIT\n", "line 1: expected"),
        ("# motor_type=DM4340,can_id=1,mode=VEL\n", "line 1: expected"),
        (GOOD, "no column line and rows"),
        (GOOD.replace("tau", "torque") + "0,0,0,0\n", "line 2: expected the columns"),
        (GOOD + "0,0,0,0\n1,2,x,4\n", "below line 2: could not convert string"),
        (GOOD + "0,0,0,0\n1,2,3\n", "below line 2: .* columns"),
        (GOOD + "0,0,0\n1,2,4\n", "below line 2: expected 4 finite numbers"),
        (GOOD + "0,0,0,0\n1,2,nan,4\n", "below line 2: expected 4 finite numbers"),
        (GOOD + "0,0,0,0\n0,0,0,0\n", ": time does not increase after 0 s"),
    ],
)
def test_bad_files_are_refused_with_the_line(text, message, tmp_path):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_damiao_trajectory(path)


def test_windows_line_ends_and_blank_lines_are_fine_and_a_missing_file_is_named(
    tmp_path,
):
    with pytest.raises(InputError, match="cannot read .*nothing.csv: No such file"):
        read_damiao_trajectory(tmp_path / "nothing.csv")
    path = tmp_path / "t.csv"
    path.write_bytes(
        (GOOD + "0,0,0,0\n\n1,1,1,1\n\n").replace("\n", "\r\n").encode("utf-8-sig")
    )
    np.testing.assert_array_equal(reread(path)[0], [0.0, 1.0])
