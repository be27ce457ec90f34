"""Every form of recording reads to the same numbers as the CSV file of the same motion."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.logs.reader import write_measurement_csv
from tests.support import recorded
from tests.support.log_files import JOINTS, motion, read_measurements

DATA = motion(120)
pytest.importorskip("rosbags")
pytest.importorskip("pyarrow")
h5py = pytest.importorskip("h5py")


@pytest.mark.parametrize("form", recorded.FORMS)
def test_every_form_reads_like_the_csv_file_without_options(tmp_path, form):
    write_measurement_csv(tmp_path / "same.csv", JOINTS, [DATA])
    expected = read_measurements(tmp_path / "same.csv", JOINTS).samples
    log = read_measurements(recorded.FORMS[form](tmp_path, DATA), JOINTS)
    for name in ("time", "q", "qd", "tau"):
        got = getattr(log.samples, name)
        np.testing.assert_allclose(got, getattr(expected, name), rtol=0, atol=1e-12, err_msg=name)
    assert log.notes[0].startswith("log layout: ")


def test_a_log_in_a_folder_without_a_known_form_is_refused(tmp_path):
    with pytest.raises(InputError, match="folder of no known form; a log is a text table"):
        read_measurements(tmp_path, JOINTS)
    with pytest.raises(InputError, match="cannot read the log"):
        read_measurements(tmp_path / "nothing.bag", JOINTS)
    with pytest.raises(InputError, match="cannot read the log .*too long"):
        read_measurements(tmp_path / ("a" * 5000), JOINTS)


def test_options_of_one_form_are_refused_for_another(tmp_path):
    path = recorded.npz(tmp_path, DATA)
    with pytest.raises(InputError, match="--topic is about a ROS bag"):
        read_measurements(path, JOINTS, topic="/joint_states")
    with pytest.raises(InputError, match="--episode is about a LeRobot"):
        read_measurements(path, JOINTS, episode=(0,))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\x89MCAP0\r\n rubbish", "as a ROS bag"),
        (b"#ROSBAG V2.0\n rubbish", "as a ROS bag"),
        (b"\x89HDF\r\n\x1a\n rubbish", "as an HDF5 file"),
        (b"PK\x03\x04 rubbish", "as a NumPy .npz file"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path, content, said):
    path = tmp_path / "log.bag"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read_measurements(path, JOINTS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ({"features": "none"}, "holds no torque"),
        ({"features": {"observation.state": "none"}}, "holds no torque"),
        ({"features": {"observation.state": {"names": 3}}}, "holds no torque"),
        ({"features": {"observation.state": {"names": ["wrist.torque"]}}}, "names 1 numbers"),
    ],
)
def test_an_odd_description_of_a_data_set_is_refused(tmp_path, odd, said):
    path = recorded.FORMS["LeRobot v2"](tmp_path, DATA)
    description = path / "meta" / "info.json"
    description.write_text(json.dumps({**json.loads(description.read_text()), **odd}))
    with pytest.raises(InputError, match=said):
        read_measurements(path, JOINTS)


def test_an_odd_rate_of_a_data_set_is_shown_as_it_is(tmp_path):
    path = recorded.FORMS["LeRobot v2"](tmp_path, DATA)
    description = path / "meta" / "info.json"
    description.write_text(json.dumps({**json.loads(description.read_text()), "fps": {}}))
    assert "at {} Hz" in read_measurements(path, JOINTS).notes[0]


@pytest.mark.parametrize("row", ["StateMotor", 'StateMotor,0,"[a]","[]","[]"'])
def test_a_sage_recording_without_positions_is_refused(tmp_path, row):
    path = recorded.FORMS["SAGE"](tmp_path, DATA)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], row, *lines[1:]]))
    with pytest.raises(InputError, match="lists no positions"):
        read_measurements(path, JOINTS)


def test_names_of_a_sage_recording_in_another_encoding_are_no_error(tmp_path):
    path = recorded.FORMS["SAGE"](tmp_path, DATA)
    (tmp_path / "joint_list.txt").write_bytes(b"\xff\n")
    with pytest.raises(InputError, match="name|column"):
        read_measurements(path, ("a", "b", "c", "d"))


def test_a_library_that_is_missing_is_named_with_the_command(tmp_path, monkeypatch):
    import sys

    for module in ("rosbags.highlevel", "pyarrow.parquet", "h5py"):
        monkeypatch.setitem(sys.modules, module, None)
    for form, extra in (("ROS 1 bag", "rosbag"), ("robomimic", "hdf5")):
        monkeypatch.undo()
        path = recorded.FORMS[form](tmp_path, DATA)
        for module in ("rosbags.highlevel", "pyarrow.parquet", "h5py"):
            monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(InputError, match=rf"pip install 'robot-sysid\[{extra}\]'"):
            read_measurements(path, JOINTS)


class TestRosBags:
    def test_several_topics_need_a_choice(self, tmp_path):
        store = recorded.typestore()
        topics = [
            (name, recorded.STATE, recorded.shuffled_states(store.types, DATA))
            for name in ("/left/joint_states", "/right/joint_states")
        ]
        path = recorded.write_bag2(tmp_path / "bag", topics, store)
        with pytest.raises(InputError, match=r"/left/joint_states.*/right/.*--topic"):
            read_measurements(path, JOINTS)
        log = read_measurements(path, JOINTS, topic="/right/joint_states")
        assert len(log.samples) == len(DATA) and "/right/joint_states" in log.notes[0]
        with pytest.raises(InputError, match="no joint states in topic '/up'; its topics"):
            read_measurements(path, JOINTS, topic="/up")

    def test_a_topic_without_the_arm_or_without_effort_is_no_rival(self, tmp_path):
        store = recorded.typestore()
        types = store.types
        fingers = [recorded.joint_state(types, t, ["f"], [0.0], [0.0], [0.0]) for t in DATA.time]
        wanted = [
            recorded.joint_state(types, t, JOINTS, q, None, None) for t, q in zip(DATA.time, DATA.q)
        ]
        topics = [
            ("/gripper", recorded.STATE, fingers),
            ("/desired", recorded.STATE, wanted),
            ("/joint_states", recorded.STATE, recorded.shuffled_states(types, DATA)),
        ]
        log = read_measurements(recorded.write_bag2(tmp_path / "bag", topics, store), JOINTS)
        assert "topic /joint_states" in log.notes[0]
        with pytest.raises(InputError, match="topic /desired has no effort"):
            read_measurements(tmp_path / "bag", JOINTS, topic="/desired")

    def test_names_that_differ_in_a_prefix_are_the_models_unless_two_do(self, tmp_path):
        store = recorded.typestore()

        def bag(name, prefixes):
            names = [f"{p}{j}" for p in prefixes for j in JOINTS]
            wide = [
                recorded.joint_state(store.types, t, names, *(np.tile(v, len(prefixes)) for v in s))
                for t, *s in zip(DATA.time, DATA.q, DATA.qd, DATA.tau)
            ]
            return recorded.write_bag2(tmp_path / name, [("/js", recorded.STATE, wide)], store)

        log = read_measurements(bag("one", ["panda_"]), JOINTS)
        np.testing.assert_array_equal(log.samples.q, DATA.q)
        with pytest.raises(InputError, match="one position column for each"):
            read_measurements(bag("two", ["left_", "right_"]), JOINTS)

    def test_currents_are_taken_with_torque_constants_only(self, tmp_path):
        store = recorded.typestore()
        value = store.types["control_msgs/msg/InterfaceValue"]
        message = store.types[recorded.DYNAMIC]
        messages = [
            message(
                recorded.header(store.types, t),
                list(JOINTS),
                [value(["position", "current"], np.array(pair)) for pair in zip(q, tau)],
            )
            for t, q, tau in zip(DATA.time, DATA.q, DATA.tau)
        ]
        path = recorded.write_bag2(tmp_path / "b", [("/d", recorded.DYNAMIC, messages)], store)
        with pytest.raises(InputError, match="motor currents: give --torque-constants"):
            read_measurements(path, JOINTS)
        log = read_measurements(path, JOINTS, torque_constants=(10.0, 20.0, 30.0))
        np.testing.assert_allclose(log.samples.tau, DATA.tau * [10.0, 20.0, 30.0], rtol=1e-14)


class TestLeRobot:
    @pytest.mark.parametrize("version", ["v2.1", "v3.0"])
    def test_every_episode_is_a_piece(self, tmp_path, version):
        long = motion(1000)
        path = recorded.lerobot(version, 3)(tmp_path, long)
        log = read_measurements(path, JOINTS)
        assert [len(piece) for piece in log.pieces] == [1000] * 3
        np.testing.assert_allclose(log.pieces[2].q, long.q, rtol=0, atol=1e-12)
        one = read_measurements(path, JOINTS, episode=(1,))
        assert len(one.pieces) == 1 and "1 episodes" in one.notes[0]
        with pytest.raises(InputError, match="no episode 7; it has 0 to 2"):
            read_measurements(path, JOINTS, episode=(7,))

    def test_a_data_set_without_torque_says_what_to_record(self, tmp_path):
        path = recorded.lerobot("v2.1")(tmp_path, DATA)
        info = path / "meta" / "info.json"
        info.write_text(info.read_text().replace(".torque", ".load"))
        with pytest.raises(InputError, match=r"holds no torque.*use_velocity_and_torque"):
            read_measurements(path, JOINTS)


class TestHdf5:
    def aloha(self, path, names, effort):
        with h5py.File(path, "w") as file:
            group = file.create_group("observations")
            wide = np.zeros((len(DATA), 14))
            for quantity, values in (("qpos", DATA.q), ("qvel", DATA.qd), ("effort", effort)):
                wide[:, names] = values
                group[quantity] = wide
            file["action"] = wide
        return path

    def test_alohas_two_arms_are_told_apart_by_name_and_time_is_its_rate(self, tmp_path):
        path = self.aloha(tmp_path / "episode_0.hdf5", [7, 8, 9], DATA.tau)
        names = ("right/waist", "right/shoulder", "right/elbow")
        log = read_measurements(path, names)
        np.testing.assert_array_equal(log.samples.q, DATA.q)
        np.testing.assert_allclose(log.samples.time, np.arange(len(DATA)) / 50.0, atol=1e-12)
        assert "without time stamps: rows taken to be 50 Hz" in log.notes[0]

    def test_effort_that_is_zero_is_refused(self, tmp_path):
        path = self.aloha(tmp_path / "episode_0.hdf5", [0, 1, 2], np.zeros_like(DATA.tau))
        with pytest.raises(InputError, match="torque of joint left/waist is zero"):
            read_measurements(path, ("left/waist", "left/shoulder", "left/elbow"))

    def test_a_demonstration_without_torque_says_what_to_record(self, tmp_path):
        path = recorded.robomimic(tmp_path, DATA)
        with h5py.File(path, "a") as file:
            del file["data/demo_0/obs/robot0_joint_torque"]
        with pytest.raises(InputError, match="demonstration demo_0 has no joint torques"):
            read_measurements(path, JOINTS)


class TestRtde:
    def test_current_and_target_moment_are_no_torque(self, tmp_path):
        path = recorded.rtde(tmp_path, DATA, torque="actual_current")
        with pytest.raises(InputError, match="target_moment is the controller's model"):
            read_measurements(path, JOINTS)
        log = read_measurements(path, JOINTS, torque_constants=10.0)
        np.testing.assert_allclose(log.samples.tau, 10.0 * DATA.tau, rtol=1e-14)
