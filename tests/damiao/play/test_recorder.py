"""What is recorded is what was measured."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_sysid.damiao.play.recorder import MeasurementRecorder, RecordingHead, read_recording
from robot_sysid.damiao.play.session import Replies
from robot_sysid.damiao.play.settings import PlaySettings
from robot_sysid.damiao.protocol.codec import (
    Feedback,
    MitCommand,
    Scaling,
    decode_feedback,
    encode_feedback,
)
from robot_sysid.damiao.protocol.joints import damiao_joints
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.simulated.motor import simulated_motor
from robot_sysid.errors import InputError
from robot_sysid.logs.reader import read_measurements


def head_for(types):
    joints = damiao_joints(types, len(types))
    registers = [simulated_motor(j.spec, j.can_id, j.master_id).registers for j in joints]
    registers = [{k: v for k, v in r.items() if k in (7, 8, 9, 10, 21, 22, 23)} for r in registers]
    one = np.ones(len(types))
    return RecordingHead(joints, registers, PlaySettings(20 * one, one), True, "swing.csv")


@st.composite
def cycles(draw, n):
    """Random frames as motors would send them, some missing, and the commands before them."""
    count = draw(st.integers(1, 6))
    rows = []
    for k in range(count):
        frames = [draw(st.binary(min_size=8, max_size=8)) for _ in range(n)]
        raw = np.frombuffer(b"".join(frames), dtype=np.uint8).reshape(n, 8)
        answered = np.array([draw(st.booleans()) for _ in range(n)])
        command = np.array([draw(st.floats(-10, 10)) for _ in range(3 * n)]).reshape(3, n)
        stamp = 0.004 * k + np.array([draw(st.floats(1e-4, 2e-3)) for _ in range(n)])
        rows.append((0.004 * k, raw, answered, command, stamp))
    return rows


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_every_frame_can_be_told_back_from_the_recording(data, tmp_path_factory):
    """The printed digits suffice to find the very codes the motor sent."""
    types = data.draw(st.lists(st.sampled_from(sorted(MOTORS)), min_size=1, max_size=4))
    n, scaling = len(types), Scaling.from_limits(MOTORS[t].limits for t in types)
    rows = data.draw(cycles(n))
    path = tmp_path_factory.mktemp("rec") / "measured.csv"
    with MeasurementRecorder(path, head_for(types)) as recorder:
        for time, raw, answered, command, stamp in rows:
            feedback = decode_feedback(raw, scaling, half_step=True)
            for values in (feedback.position, feedback.velocity, feedback.torque):
                values[~answered] = np.nan
            stamps = np.where(answered, stamp, np.nan)
            zero = np.zeros(n)
            replies = Replies(answered, stamps + 7.0, feedback)
            recorder.write(
                time, 7.0, replies, MitCommand(command[0], command[1], zero, zero, command[2])
            )
            recorder.end_cycle()
    recording = read_recording(path)
    assert recording.ending == "completed"
    assert len(recording.columns["time"]) == len(rows)
    for k, (time, raw, answered, command, stamp) in enumerate(rows):
        values = {w: recording.joint_values(w)[k] for w in ("pos", "vel", "tau", "status", "time")}
        assert recording.columns["time"][k] == pytest.approx(time, abs=1e-6)
        np.testing.assert_array_equal(np.isfinite(values["pos"]), answered)
        np.testing.assert_allclose(values["time"][answered], stamp[answered], atol=1e-6)
        told = Feedback(
            raw[:, 0] & 0xF,
            raw[:, 0] >> 4,
            *(np.nan_to_num(values[w]) for w in ("pos", "vel", "tau")),
            raw[:, 6],
            raw[:, 7],
        )
        again = encode_feedback(told, scaling)
        np.testing.assert_array_equal(again[answered], raw[answered])
        for row, what in enumerate(("cmd_pos", "cmd_vel", "cmd_tau")):
            np.testing.assert_allclose(recording.joint_values(what)[k], command[row], atol=6e-7)


def write_two_rows(path, gap=False):
    n, one = 2, np.ones(2)
    codes = np.ones(n, dtype=int)
    with MeasurementRecorder(path, head_for(["DM4340"] * n)) as recorder:
        for k in range(40):
            answered = np.array([True, not (gap and k == 1)])
            q = np.where(answered, 0.1 * np.sin(0.3 * k) * one, np.nan)
            feedback = Feedback(codes, codes, q, q, q, 30 * codes, 31 * codes)
            stamps = np.where(answered, 0.004 * k + np.array([0.0001, 0.0002]), np.nan)
            recorder.write(
                0.004 * k, 0.0, Replies(answered, stamps, feedback), MitCommand(*[one] * 5)
            )
            recorder.end_cycle()


@pytest.mark.parametrize("gap", [False, True])
def test_the_identification_reads_it_directly(tmp_path, gap):
    path = tmp_path / "measured.csv"
    write_two_rows(path, gap)
    log = read_measurements(path, ("first", "second"))
    assert [s.title for s in log.columns.position] == ["j0_pos", "j1_pos"]
    assert [s.title for s in log.columns.velocity] == ["j0_vel", "j1_vel"]
    assert [s.title for s in log.columns.torque] == ["j0_tau", "j1_tau"]
    assert [s.title for s in log.columns.joint_time] == ["j0_time", "j1_time"]
    assert log.columns.time.title == "time"


def test_the_head_tells_motors_registers_and_gains(tmp_path):
    path = tmp_path / "measured.csv"
    write_two_rows(path)
    head = "\n".join(read_recording(path).head)
    for words in (
        "motor_type=DM4340,can_id=2,mode=MIT,master_id=18",
        "registers_j1: MST_ID=18,ESC_ID=2,TIMEOUT=2000,CTRL_MODE=1,PMAX=12.5,VMAX=10,TMAX=28",
        "rate_hz=250,speed=1",
        "kp=20 20",
        "half_step=1",
    ):
        assert words in head


def test_rows_are_in_the_file_before_the_run_ends(tmp_path):
    path = tmp_path / "measured.csv"
    recorder = MeasurementRecorder(path, head_for(["DM4340"]))
    one = np.ones(1)
    feedback = Feedback(one, one, one, one, one, one, one)
    recorder.write(0.0, 0.0, Replies(one > 0, one, feedback), MitCommand(*[one] * 5))
    recorder.end_cycle()
    rows = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len(list(csv.reader(rows))) == 2
    assert read_recording(path).ending == "cut short"
    recorder.__exit__(None, None, None)


def test_an_error_is_written_at_the_end(tmp_path):
    path = tmp_path / "measured.csv"
    with pytest.raises(RuntimeError), MeasurementRecorder(path, head_for(["DM4340"])):
        raise RuntimeError("two\nlines")
    assert read_recording(path).ending == "stopped: two lines"


@pytest.mark.parametrize(
    ("name", "words"), [("no/such/folder.csv", "cannot write"), ("there.csv", "exists")]
)
def test_a_file_that_cannot_be_made_is_said(tmp_path, name, words):
    (tmp_path / "there.csv").write_text("precious")
    with pytest.raises(InputError, match=words):
        MeasurementRecorder(tmp_path / name, head_for(["DM4340"]))


def test_files_that_are_no_recordings_are_refused(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="not a recording"):
        read_recording(path)
    with pytest.raises(InputError, match="cannot read"):
        read_recording(tmp_path / "nothing.csv")
