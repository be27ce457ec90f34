"""Gains, speeds and limits of a run, and what is chosen where they were left open."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rigs.motors.damiao_rig import mit_command, swing, trajectory_of
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.damiao.protocol import (
    KD_MAX,
    KP_MAX,
    PLANNING_LIMIT,
    BusTiming,
    Scaling,
    bus_load,
    default_rate,
    encode_mit,
)
from robot_sysid.damiao.references import Reference, transfer_reference
from robot_sysid.damiao.safety.holding import HoldingTorque
from robot_sysid.damiao.settings import Plan, PlaySettings
from robot_sysid.errors import InputError
from robot_sysid.records import Limits
from robot_sysid.records.option_fields import options_of

SPECS = st.lists(st.sampled_from(list(MOTORS.values())), min_size=1, max_size=8)
TIMINGS = st.builds(BusTiming, fd=st.booleans())
INERTIA = st.floats(1e-4, 10.0)


@given(specs=SPECS, timing=TIMINGS)
def test_what_is_left_open_suits_motors_and_bus(specs, timing):
    settings = PlaySettings().for_motors(specs, timing)
    for spec, kp, kd in zip(specs, settings.kp, settings.kd):
        # A twentieth of a radian asks for rated torque, where a frame can carry that stiffness.
        assert kp == min(20.0 * spec.rated_torque, KP_MAX)
        assert kd == pytest.approx(min(max(kp / 40.0, 0.05), KD_MAX), rel=1e-12)
    assert settings.rate == default_rate(len(specs), timing)
    assert bus_load(len(specs), settings.rate, timing) <= PLANNING_LIMIT
    command = mit_command(kp=settings.kp, kd=settings.kd)
    assert encode_mit(command, Scaling([s.limits for s in specs])).shape == (
        len(specs),
        8,
    )
    assert settings.for_motors(specs, timing) == settings


def test_another_number_of_gains_is_refused():
    with pytest.raises(
        InputError, match=r"--kp takes one number, or .* which has 3 \(got "
    ):
        PlaySettings(kp=(1.0,) * 2).for_motors([MOTORS["DM4340"]] * 3, BusTiming())


SINGLE_NUMBERS = [
    name
    for name, field in options_of(PlaySettings).items()
    if field.check and not field.takes_many
]


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        *((name, -1.0) for name in SINGLE_NUMBERS),
        ("kp", (1.0, 500.1)),
        ("kp", (1.0, np.nan)),
        ("kd", (1.0, 5e-4)),
        ("kd", (1.0, 5.1)),
    ],
)
def test_settings_that_are_no_sensible_numbers_are_refused(name, setting):
    flag = options_of(PlaySettings)[name].flag
    with pytest.raises(InputError, match=rf"^{flag} must be"):
        PlaySettings(**{name: setting})


@given(specs=SPECS, timing=TIMINGS, data=st.data())
def test_a_light_joint_is_damped_less(specs, timing, data):
    inertia = data.draw(hnp.arrays(float, len(specs), elements=INERTIA))
    plain = PlaySettings().for_motors(specs, timing)
    light = PlaySettings().for_motors(specs, timing, np.diag(1.0 / inertia))
    assert light.kp == plain.kp
    for i, kd, kp in zip(inertia, light.kd, plain.kp):
        # Never less than 40 %: models often lack the rotors' inertia.
        least = max(0.4 * kp / 40.0, 0.05)
        assert kd == pytest.approx(
            np.clip(min(kp / 40.0, i * light.rate), least, KD_MAX)
        )


@pytest.mark.parametrize("owner", ["user_limits", "model_limits"])
def test_transfers_keep_the_limits_of_user_and_model(owner):
    limits = Limits(velocity=np.array([0.1, 9.0]), acceleration=0.05)
    settings = Plan(trajectory_of(swing(2)), **{owner: limits}).settings
    begin = Reference(*np.zeros((3, 2)))
    for way in (0.01, 0.2, 0.5):
        target = begin._replace(position=np.full(2, way))
        speed = settings.approach_speed, settings.approach_time
        holding = HoldingTorque((), np.zeros_like, np.zeros(2))
        path, duration = transfer_reference(begin, target, *speed, holding)
        moments = np.linspace(0.0, duration, 501)
        velocity = np.array([path(moment).velocity[0] for moment in moments])
        assert np.max(velocity) <= 0.1 + 1e-9
        assert np.max(np.gradient(velocity, moments)) <= 0.05
