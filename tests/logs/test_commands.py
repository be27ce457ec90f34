"""Commanded positions are found where a log is read for them, and nowhere else."""

import json

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.columns import joint_kind, read_title, with_meaning
from tests.support.log_files import JOINTS, motion, read_measurements, write

COMMANDS = ("q_des[{}]", "action[{}]", "joint{}_command", "j{} goal_position", "jointTarget[{}]")


@pytest.mark.parametrize(
    ("title", "is_command"),
    [
        *((title.format(0), True) for title in COMMANDS),
        ("state.q_d[0]", True),
        ("cmd_q1 [deg]", True),
        *((title, False) for title in ("qd_des[0]", "tau_ref1", "current_ref1", "q_ff[0]", "q[0]")),
        ("ref_joint_position", False),
    ],
)
def test_titles_of_commanded_positions_are_told_from_others(title, is_command):
    found = with_meaning([read_title(title)], ("ref_joint", "joint1"), commanded=True)[0]
    assert (joint_kind(found) == "command") == is_command


@pytest.mark.parametrize("title", COMMANDS)
def test_commands_take_the_place_of_torques(tmp_path, title):
    data = motion()
    rows = np.column_stack((data.time, data.q, np.roll(data.q, 2, axis=0)))
    titles = ["time", "q0", "q1", "q2", *(title.format(k) for k in range(3))]
    path = write(tmp_path / "log.csv", rows, titles)
    log = read_measurements(path, JOINTS, commanded=True)
    np.testing.assert_allclose(log.samples.command, rows[:, 4:])
    np.testing.assert_allclose(log.samples.tau, rows[:, 4:] - data.q)
    assert any("command from" in note for note in log.notes)
    assert all(piece.command is not None for piece in log.pieces)
    with pytest.raises(InputError, match="one torque column for each"):
        read_measurements(path, JOINTS)


def test_commands_in_a_columns_file_and_in_degrees(tmp_path):
    data = motion()
    rows = np.column_stack((data.time, data.q, np.degrees(data.q)))
    path = write(tmp_path / "log.csv", rows, ["time", "q1", "q2", "q3", "a", "b", "c"])
    columns = tmp_path / "columns.txt"
    columns.write_text("command = 0.017453292519943295 * a, 0.017453292519943295 * b, #7\n")
    log = read_measurements(path, JOINTS, commanded=True, columns=columns)
    np.testing.assert_allclose(log.samples.command[:, :2], data.q[:, :2], atol=1e-9)
    np.testing.assert_allclose(log.samples.command[:, 2], np.degrees(data.q[:, 2]))


def test_a_lerobot_data_set_gives_its_actions(tmp_path):
    parquet, arrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    data = motion()
    q, action = np.degrees(data.q), np.degrees(np.roll(data.q, 3, axis=0))
    names = [f"{joint}.pos" for joint in JOINTS]
    shape = {"dtype": "float32", "shape": [3], "names": names}
    info = {"fps": 200, "features": {"observation.state": shape, "action": shape}}
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    columns = {"timestamp": data.time, "episode_index": np.zeros(len(data), int)}
    columns |= {"observation.state": q.tolist(), "action": action.tolist()}
    parquet.write_table(arrow.table(columns), tmp_path / "data" / "file.parquet")
    log = read_measurements(tmp_path, JOINTS, commanded=True)
    np.testing.assert_allclose(log.samples.q, data.q, atol=1e-9)
    np.testing.assert_allclose(log.samples.command, np.radians(action), atol=1e-9)
    with pytest.raises(InputError, match="holds no torque"):
        read_measurements(tmp_path, JOINTS)
