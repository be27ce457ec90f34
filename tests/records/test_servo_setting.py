"""What servos were recorded with is read as it is typed, and stays with the recording."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.errors import InputError
from robot_sysid.records import Recording, join_recordings
from robot_sysid.records.servo_setting import UNKNOWN, ServoSetting, parse_servo_setting
from robot_sysid.signals.resampling import resample_uniformly, split_at_gaps

POSITIVE = st.floats(1e-3, 1e4).map(lambda x: float(f"{x:.9g}"))
PLACE = st.floats(-2.0, 2.0).map(lambda x: float(f"{x:.9g}"))
LOADS = st.one_of(
    st.just({}),
    st.just({"load_mass": 0.0}),
    st.fixed_dictionaries(
        {"load_mass": POSITIVE, "is_whole_link": st.booleans()}, optional={}
    ).flatmap(
        lambda load: st.one_of(
            st.tuples(PLACE, PLACE, PLACE).map(lambda p: {**load, "load_position": p}),
            POSITIVE.map(lambda d: {**load, "load_distance": d}),
        )
    ),
)
SETTINGS = st.builds(
    lambda register, voltage, load: ServoSetting(register, voltage, **load),
    st.none() | POSITIVE,
    st.none() | POSITIVE,
    LOADS,
)


@given(SETTINGS.filter(lambda setting: setting != UNKNOWN))
def test_a_setting_is_read_as_it_is_written(setting):
    assert parse_servo_setting(str(setting)) == setting


@given(SETTINGS, SETTINGS)
def test_what_is_stated_outranks_what_a_file_says_and_a_load_is_whole(stated, read):
    both = stated.over(read)
    assert stated.over(UNKNOWN) == stated and UNKNOWN.over(read) == read
    assert both.register == (stated.register or read.register)
    assert both.voltage == (stated.voltage or read.voltage)
    loaded = read if stated.load_mass is None else stated
    assert replace(both, register=None, voltage=None) == replace(
        loaded, register=None, voltage=None
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("gain=400", "'gain=400' is no part of a setting"),
        ("kp", "'kp' is no part of a setting"),
        ("kp=", "'kp=' is no part of a setting"),
        ("kp=400, , voltage=7", "'' is no part of a setting"),
        ("voltage=7.4 V", "'voltage=7.4 V' is no part of a setting"),
        ("kp=400, kp=200", "states 'kp' beside the same"),
        ("load=0.1 at 0.2, link=1 at 0.2", "states 'link' beside the same"),
        ("kp=0", "register kp must be positive (got 0)"),
        ("voltage=inf", "voltage must be positive (got inf)"),
        ("load=0.2", "a load is its mass and one place"),
        ("load=0 at 0.1", "a load is its mass and one place"),
        ("load=-1 at 0.1", "mass must not be negative (got -1)"),
        ("load=1 at 0 0", "three numbers (got 0 0)"),
        ("load=1 at 0 0 nan", "three numbers (got 0 0 nan)"),
        ("load=1 at -0.1", "distance from the joint must be positive (got -0.1)"),
        ("link=0", "a link has a mass that is positive"),
    ],
)
def test_a_wrong_text_is_refused_with_the_keys_that_are_right(text, fault):
    with pytest.raises(InputError) as caught:
        parse_servo_setting(text)
    message = str(caught.value)
    assert fault in message
    for key in ("kp", "voltage", "load", "link"):
        assert f"{key} (" in message


def test_parts_of_a_recording_have_its_setting():
    setting = ServoSetting(400.0, 7.4, 0.49, load_distance=0.1, is_whole_link=True)
    time = np.arange(2000) / 100.0
    time[1000:] += 5.0
    q = np.sin(time)[:, None]
    log = Recording(time, q, None, 0.0 * q, command=q, setting=setting)
    pieces = split_at_gaps(log)
    assert len(pieces) == 2
    parts = [
        log[10:50],
        *pieces,
        join_recordings(pieces),
        resample_uniformly(pieces[0]),
    ]
    assert [part.setting for part in parts] == [setting] * len(parts)
    assert Recording(time, q, None, q).setting == UNKNOWN
