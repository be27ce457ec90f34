"""Gains, speeds and limits of a run, and what is chosen where they were left open."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol.codec import KD_MAX, KP_MAX, MitCommand, Scaling, encode_mit
from robot_sysid.damiao.protocol.frames import PLANNING_LIMIT, BusTiming, bus_load, default_rate
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import InputError
from robot_sysid.records.options import options_of

SPECS = st.lists(st.sampled_from(list(MOTORS.values())), min_size=1, max_size=8)
TIMINGS = st.builds(BusTiming, fd=st.booleans())
KP, KD = st.floats(0.0, KP_MAX), st.floats(0.01, KD_MAX)
RATES = st.floats(1.0, 1000.0)


@given(specs=SPECS, timing=TIMINGS)
def test_what_is_left_open_suits_motors_and_bus(specs, timing):
    chosen = PlaySettings().for_motors(specs, timing)
    for spec, kp, kd in zip(specs, chosen.kp, chosen.kd):
        # A twentieth of a radian asks for rated torque, where a frame can carry that stiffness.
        assert kp == min(20.0 * spec.rated_torque, KP_MAX)
        assert kd == pytest.approx(min(max(kp / 40.0, 0.05), KD_MAX), rel=1e-12)
    assert len(chosen.kp) == len(chosen.kd) == len(specs)
    assert chosen.rate == default_rate(len(specs), timing)
    assert bus_load(len(specs), chosen.rate, timing) <= PLANNING_LIMIT
    assert chosen.period == 1.0 / chosen.rate


@pytest.mark.parametrize("name", sorted(MOTORS))
def test_default_gains_fit_into_the_frames_of_every_type(name):
    chosen = PlaySettings().for_motors([MOTORS[name]], BusTiming())
    zero = np.zeros(1)
    command = MitCommand(zero, zero, np.array(chosen.kp), np.array(chosen.kd), zero)
    assert encode_mit(command, Scaling([MOTORS[name].limits])).shape == (1, 8)
    assert chosen.kp[0] > 0.0 and chosen.kd[0] > 0.0


@given(specs=SPECS, timing=TIMINGS, kp=KP, kd=KD, rate=RATES)
def test_one_number_is_for_all_joints(specs, timing, kp, kd, rate):
    chosen = PlaySettings(kp=(kp,), kd=(kd,), rate=rate).for_motors(specs, timing)
    assert chosen.kp == (kp,) * len(specs) and chosen.kd == (kd,) * len(specs)
    assert chosen.rate == rate


@given(specs=SPECS, timing=TIMINGS, data=st.data())
def test_one_number_per_joint_is_kept_in_order(specs, timing, data):
    kp = tuple(data.draw(KP) for _ in specs)
    kd = tuple(data.draw(KD) for _ in specs)
    chosen = PlaySettings(kp=kp, kd=kd).for_motors(specs, timing)
    assert (chosen.kp, chosen.kd) == (kp, kd)


@given(specs=SPECS, timing=TIMINGS, given_kp=st.booleans(), given_kd=st.booleans())
def test_choosing_again_changes_nothing_and_nothing_else_is_touched(
    specs, timing, given_kp, given_kd
):
    asked = PlaySettings(
        kp=(20.0,) if given_kp else (),
        kd=(1.0,) if given_kd else (),
        **{"speed": 0.3, "max_missed": 7, "ramp_time": 0.7},
    )
    chosen = asked.for_motors(specs, timing)
    assert chosen.for_motors(specs, timing) == chosen
    chosen_ones = {"kp", "kd", "rate", "max_torque_error"}
    others = {each.name for each in fields(PlaySettings)} - chosen_ones
    assert all(getattr(chosen, name) == getattr(asked, name) for name in others)


@pytest.mark.parametrize("name", ["kp", "kd"])
@pytest.mark.parametrize("count", [2, 4])
def test_another_number_of_gains_is_refused(name, count):
    settings = PlaySettings(**{name: (1.0,) * count})
    with pytest.raises(InputError, match=rf"--{name} takes one number, or .* 3 joints \(got "):
        settings.for_motors([MOTORS["DM4340"]] * 3, BusTiming())


@pytest.mark.parametrize(
    "name", [n for n, each in options_of(PlaySettings).items() if each.check and not each.several]
)
@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_settings_that_are_no_sensible_numbers_are_refused(name, bad):
    flag = options_of(PlaySettings)[name].flag
    with pytest.raises(InputError, match=rf"^{flag} must be"):
        PlaySettings(**{name: bad})


@pytest.mark.parametrize(
    ("name", "bad"),
    [("kp", x) for x in (-1.0, 500.1, np.nan)]
    + [("kd", x) for x in (0.0, 5e-4, -1.0, 5.1, np.nan)],
)
def test_gains_that_a_frame_cannot_carry_are_refused(name, bad):
    with pytest.raises(InputError, match=rf"^--{name} must be"):
        PlaySettings(**{name: (1.0, bad)})


@given(top=st.floats(0.0, 120.0))
def test_a_motor_may_start_no_warmer_than_it_may_get(top):
    assert PlaySettings(max_temperature=top).start_temperature == min(60.0, top)


def test_lateness_is_typed_in_milliseconds():
    assert options_of(PlaySettings)["max_lateness"].parse("20") == PlaySettings().max_lateness


@given(specs=SPECS, timing=TIMINGS, data=st.data())
def test_a_light_joint_is_damped_less(specs, timing, data):
    inertia = np.array([data.draw(st.floats(1e-4, 10.0)) for _ in specs])
    usual, chosen = (PlaySettings().for_motors(specs, timing, i) for i in (None, inertia))
    assert chosen.kp == usual.kp
    for i, kd, kd_usual, kp in zip(inertia, chosen.kd, usual.kd, usual.kp):
        # Never less than 40 %: models often lack the rotors' inertia.
        least = max(0.4 * kp / 40.0, 0.05)
        assert kd == pytest.approx(np.clip(min(kp / 40.0, i * chosen.rate), least, KD_MAX))
        assert kd <= kd_usual * (1.0 + 1e-12)
