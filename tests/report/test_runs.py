"""What a run leaves for its report is small whatever the log and read back as it was; folders of
earlier runs may be older, damaged, of another run, without their torques.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rigs.files.reports import traces
from robot_sysid.errors import InputError
from robot_sysid.records import SIGNAL_NAMES
from robot_sysid.records.data import Traces
from robot_sysid.records.file_access import DATA_NAME
from robot_sysid.report.runs import load_data, load_run, save_data


def test_signals_are_read_as_they_were_written(tmp_path):
    given = traces()
    save_data(tmp_path, given, "hash")
    content = (tmp_path / DATA_NAME).read_bytes()
    loaded = load_data(tmp_path / DATA_NAME, "hash")
    for name in SIGNAL_NAMES:
        assert_allclose(getattr(loaded, name), getattr(given, name), rtol=1e-6)
    for name in ("joints", "is_slide", "time"):
        assert_array_equal(getattr(loaded, name), getattr(given, name))
    save_data(tmp_path, given, "hash")
    assert (tmp_path / DATA_NAME).read_bytes() == content


def test_a_huge_log_is_thinned_and_logs_follow_one_another(tmp_path):
    log = traces(20_000)
    time = np.concatenate((log.time[:10_000], log.time[:10_000]))
    save_data(tmp_path, Traces(**{**vars(log), "time": time}), "hash")
    assert (tmp_path / DATA_NAME).stat().st_size < 500_000
    loaded = load_data(tmp_path / DATA_NAME, "hash")
    assert len(loaded.time) == 2000 and np.all(np.diff(loaded.time) > 0.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"version": np.array(99)},
        {"version": None},
        {"result": np.array("other")},
        {"measured": None},
        {"measured": np.zeros((3, 7))},
        {"qd": np.array(["a"])},
        {"qd": np.array([{}], dtype=object)},
        *(b"", b"PK\x03\x04 cut"),
    ],
)
def test_damaged_signals_and_those_of_another_run_are_refused(tmp_path, changes):
    path = tmp_path / DATA_NAME
    with pytest.raises(InputError):
        load_data(path, "hash")
    save_data(tmp_path, traces(), "hash")
    if isinstance(changes, bytes):
        path.write_bytes(changes)
    else:
        arrays = {**np.load(path), **changes}
        np.savez(path, **{k: array for k, array in arrays.items() if array is not None})
    with pytest.raises(InputError):
        load_data(path, "hash")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "holds no result: there is no params.json; give"),
        ("{", "cannot read"),
        ("[]", "no result of this program"),
        ("{}", "schema_version None"),
        ('{"schema_version": 3}', "this program reads 8; identify again"),
    ],
)
def test_a_damaged_result_or_one_of_another_version_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "params.json").write_text(text)
    with pytest.raises(InputError, match=message):
        load_run(tmp_path)


def test_of_servos_the_file_with_all_numbers_is_named(tmp_path):
    (tmp_path / "servo.json").write_text("{}")
    with pytest.raises(InputError, match="no page about servos; .*servo.json has all"):
        load_run(tmp_path)
