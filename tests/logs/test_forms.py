"""Every form of recording reads to the same numbers as the CSV file of the same motion."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from robot_sysid.errors import InputError
from tests.support import recorded
from tests.support.log_files import JOINTS, motion, read_measurements

DATA = motion(60)
pytest.importorskip("rosbags")
pytest.importorskip("pyarrow")
h5py = pytest.importorskip("h5py")


@pytest.mark.parametrize("form", recorded.FORMS)
def test_every_form_reads_the_same_without_options(tmp_path, form):
    log = read_measurements(recorded.FORMS[form](tmp_path, DATA), JOINTS)
    for name in ("time", "q", "qd", "tau"):
        got = getattr(log.samples, name)
        expected = getattr(DATA, name)
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12, err_msg=name)


def test_what_is_no_recording_is_refused_in_one_line(tmp_path):
    with pytest.raises(
        InputError, match="folder of no known form; a log is a text table"
    ):
        read_measurements(tmp_path, JOINTS)
    with pytest.raises(InputError, match="cannot read the log .*too long"):
        read_measurements(tmp_path / ("a" * 5000), JOINTS)
    for begins, form in (
        (b"\x89MCAP0\r\n", "a ROS bag"),
        (b"#ROSBAG V2.0\n", "a ROS bag"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (b"PK\x03\x04", "a NumPy .npz file"),
        (b"PAR1", "a Parquet file"),
        (b"ARROW1\x00\x00", "a Feather file"),
    ):
        path = tmp_path / "log.bag"
        path.write_bytes(begins + b" rubbish")
        with pytest.raises(InputError, match=f"as {form}") as caught:
            read_measurements(path, JOINTS)
        assert "\n" not in str(caught.value)


def test_a_library_that_is_missing_is_named_with_the_command(tmp_path, monkeypatch):
    path = recorded.FORMS["ROS 1 bag"](tmp_path, DATA)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"pip install 'robot-sysid\[rosbag\]'"):
        read_measurements(path, JOINTS)


class TestRosBags:
    def test_several_topics_need_a_choice_but_not_one_without_the_arm_or_effort(
        self, tmp_path
    ):
        store = recorded.typestore()
        types = store.types
        fingers = [
            recorded.joint_state(types, t, ["f"], [0.0], [0.0], [0.0])
            for t in DATA.time
        ]
        wanted = [
            recorded.joint_state(types, t, JOINTS, q, None, None)
            for t, q in zip(DATA.time, DATA.q)
        ]
        topics = [
            ("/gripper", recorded.STATE, fingers),
            ("/desired", recorded.STATE, wanted),
            (
                "/joint_states",
                recorded.STATE,
                list(recorded.shuffled_states(types, DATA)),
            ),
        ]
        path = recorded.write_bag2(tmp_path / "bag", topics, store)
        assert "topic /joint_states" in read_measurements(path, JOINTS).notes[0]
        with pytest.raises(InputError, match="topic /desired has no effort"):
            read_measurements(path, JOINTS, topic="/desired")
        with pytest.raises(
            InputError, match="no joint states in topic '/up'; its topics"
        ):
            read_measurements(path, JOINTS, topic="/up")
        both = [("/left", *topics[2][1:]), ("/right", *topics[2][1:])]
        path = recorded.write_bag2(tmp_path / "both", both, store)
        with pytest.raises(InputError, match=r"/left .*/right .*--topic"):
            read_measurements(path, JOINTS)
        assert len(read_measurements(path, JOINTS, topic="/right").samples) == len(DATA)

    def test_names_that_differ_in_a_prefix_are_the_models_unless_two_do(self, tmp_path):
        store = recorded.typestore()
        names = [f"{side}_{joint}" for side in ("left", "right") for joint in JOINTS]
        wide = [
            recorded.joint_state(
                store.types, t, names, *(np.tile(v, 2) for v in values)
            )
            for t, *values in zip(DATA.time, DATA.q, DATA.qd, DATA.tau)
        ]
        path = recorded.write_bag2(
            tmp_path / "bag", [("/js", recorded.STATE, wide)], store
        )
        with pytest.raises(InputError, match="one position column for each"):
            read_measurements(path, JOINTS)
        one = [f"left_{joint}" for joint in JOINTS]
        np.testing.assert_array_equal(read_measurements(path, one).samples.q, DATA.q)


def lerobot_without(path, words):
    """A data set whose description has other words in it."""
    info = path / "meta" / "info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), **words}))
    return path


class TestLeRobot:
    @pytest.mark.parametrize("version", ["v2.1", "v3.0"])
    def test_every_episode_is_a_piece(self, tmp_path, version):
        long = motion(1000)
        path = recorded.lerobot(version, 3)(tmp_path, long)
        log = read_measurements(path, JOINTS)
        assert [len(piece) for piece in log.pieces] == [1000] * 3
        np.testing.assert_allclose(log.pieces[2].q, long.q, rtol=0, atol=1e-12)
        assert len(read_measurements(path, JOINTS, episode=(1,)).pieces) == 1
        with pytest.raises(InputError, match="no episode 7; it has 0 to 2"):
            read_measurements(path, JOINTS, episode=(7,))

    @pytest.mark.parametrize(
        ("features", "said"),
        [
            ("none", "holds no torque"),
            (
                {"observation.state": {"names": 3}},
                "holds no torque.*use_velocity_and_torque",
            ),
            ({"observation.state": {"names": ["wrist.torque"]}}, "names 1 numbers"),
        ],
    )
    def test_an_odd_description_is_refused(self, tmp_path, features, said):
        path = lerobot_without(
            recorded.FORMS["LeRobot"](tmp_path, DATA), {"features": features}
        )
        with pytest.raises(InputError, match=said):
            read_measurements(path, JOINTS)

    def test_actions_are_commands(self, tmp_path):
        path = recorded.FORMS["LeRobot"](tmp_path, DATA)
        state = json.loads((path / "meta" / "info.json").read_text())["features"]
        (shape,) = state.values()
        parquet = pytest.importorskip("pyarrow.parquet")
        arrow = pytest.importorskip("pyarrow")
        (file,) = (path / "data").rglob("*.parquet")
        held = parquet.read_table(file).append_column(
            "action", arrow.array(np.degrees(np.roll(DATA.q, 3, axis=0)).tolist())
        )
        parquet.write_table(held, file)
        goal = {**shape, "names": [f"{joint}.pos" for joint in JOINTS]}
        lerobot_without(path, {"features": {**state, "action": goal}})
        log = read_measurements(path, JOINTS, commanded=True)
        np.testing.assert_allclose(log.samples.q, DATA.q, atol=1e-9)
        np.testing.assert_allclose(
            log.samples.command, np.roll(DATA.q, 3, axis=0), atol=1e-9
        )


def test_alohas_two_arms_are_told_apart_by_name_and_time_is_its_rate(tmp_path):
    path = tmp_path / "episode_0.hdf5"
    with h5py.File(path, "w") as file:
        for name, values in (("qpos", DATA.q), ("qvel", DATA.qd), ("effort", DATA.tau)):
            wide = np.zeros((len(DATA), 14))
            wide[:, [7, 8, 9]] = values
            file[f"observations/{name}"] = wide
        file["action"] = np.roll(file["observations/qpos"][()], 2, axis=0)
    names = ("right/waist", "right/shoulder", "right/elbow")
    log = read_measurements(path, names)
    np.testing.assert_array_equal(log.samples.q, DATA.q)
    np.testing.assert_array_equal(log.samples.tau, DATA.tau)
    np.testing.assert_allclose(
        log.samples.time, np.arange(len(DATA)) / 50.0, atol=1e-12
    )
    asked = read_measurements(path, names, commanded=True).samples.command
    np.testing.assert_array_equal(asked, np.roll(DATA.q, 2, axis=0))
    with pytest.raises(InputError, match="torque of joint left/waist is zero|at rest"):
        read_measurements(path, ("left/waist", "left/shoulder", "left/elbow"))


def test_motor_currents_are_taken_with_torque_constants_only(tmp_path):
    path = recorded.rtde(tmp_path, DATA, torque="actual_current")
    with pytest.raises(InputError, match="motor currents: give --torque-constants"):
        read_measurements(path, JOINTS)
    log = read_measurements(path, JOINTS, torque_constants=(10.0, 20.0, 30.0))
    np.testing.assert_allclose(
        log.samples.tau, DATA.tau * [10.0, 20.0, 30.0], rtol=1e-14
    )
