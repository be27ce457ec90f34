"""Frames of Damiao motors: commands and feedback, refused frames, registers, rates and status."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.damiao_rig import mit_command
from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.joints import MOTORS, damiao_joints
from robot_sysid.damiao.protocol import (
    KD_MAX,
    KP_MAX,
    READ,
    REGISTER_ID,
    CanFrame,
    MitCommand,
    Register,
    Scaling,
    bytes_from_value,
    decode_feedback,
    decode_mit,
    encode_mit,
    register_frame,
    special_frame,
    value_from_bytes,
)
from robot_sysid.damiao.simulated import simulated_motor
from robot_sysid.errors import InputError, SysidError

TYPES = sorted(MOTORS)
TYPE_LISTS = st.lists(st.sampled_from(TYPES), min_size=1, max_size=6)
SEEDS = st.integers(0, 2**32 - 1)
FIELDS = ("position", "velocity", "kp", "kd", "torque")
KP_STEP = KP_MAX / 4095
KD_STEP = KD_MAX / 4095


def scaling_of(*names: str) -> Scaling:
    return Scaling(MOTORS[name].limits for name in names)


def refusal(*arguments):
    """What ``encode_mit`` says against a command."""
    with pytest.raises(InputError) as refused:
        encode_mit(*arguments)
    return str(refused.value)


@pytest.mark.parametrize(
    ("values", "limits", "expected"),
    [
        ((0, 0, 0, 0, 0), (12.5, 30, 10), "80 00 80 00 00 00 08 00"),
        ((1.0, 2.0, 20, 1, 0.5), (12.5, 30, 10), "8A 3D 88 80 A4 33 38 66"),
        ((-0.7854, -1.5, 240, 3, -6.25), (12.5, 10, 28), "77 F5 6C C7 AE 99 96 36"),
    ],
)
def test_known_commands_have_known_bytes(values, limits, expected):
    assert encode_mit(
        mit_command(*values), Scaling([limits])
    ).tobytes() == bytes.fromhex(expected)


@pytest.mark.parametrize(
    ("limits", "p", "v", "t"),
    [
        ((12.5, 10, 28), 1.08701, -0.21734, 1.40171),
        ((12.5, 30, 10), 1.08701, -0.65201, 0.50061),
    ],
)
def test_known_feedback_has_known_values(limits, p, v, t):
    frame = np.frombuffer(bytes.fromhex("138B217D3866231F"), dtype=np.uint8)[None]
    scaling = Scaling([limits])
    feedback = decode_feedback(frame, scaling)
    assert feedback.status[0] == 1
    measured = feedback.position, feedback.velocity, feedback.torque
    codes = np.subtract(measured, 0.5 * np.array(scaling.steps))
    np.testing.assert_allclose(codes[:, 0], (p, v, t), atol=5e-6)
    assert (feedback.temperature_mos[0], feedback.temperature_rotor[0]) == (35, 31)


@given(names=TYPE_LISTS, seed=SEEDS, shape=st.lists(st.integers(0, 3), max_size=2))
def test_many_joints_and_samples_survive_within_half_a_step(names, seed, shape):
    """As a whole trajectory or one by one, each joint in the scaling of its own type."""
    rng = np.random.default_rng(seed)
    n = len(names)
    scaling = scaling_of(*names)
    p, v, t = (
        rng.uniform(-0.8, 0.8, (*shape, n)) * limit for limit in scaling.limits.T
    )
    kp = rng.uniform(0.0, KP_MAX, (*shape, n))
    kd = rng.uniform(0.01, KD_MAX, (*shape, n))
    frames = encode_mit(MitCommand(p, v, kp, kd, t), scaling)
    assert frames.shape == (*shape, n, 8)
    back = decode_mit(frames, scaling)
    position, velocity, torque = scaling.steps
    steps = position, velocity, KP_STEP, KD_STEP, torque
    for sent, came, step in zip((p, v, kp, kd, t), back, steps):
        assert np.all(np.abs(came - sent) <= 0.5 * step * (1 + 1e-9))
    for index in np.ndindex(*shape):
        for j, name in enumerate(names):
            at = (*index, j)
            alone = encode_mit(
                mit_command(p[at], v[at], kp[at], kd[at], t[at]), scaling_of(name)
            )
            assert alone[0].tobytes() == frames[at].tobytes()


@given(names=TYPE_LISTS, seed=SEEDS)
def test_feedback_survives_within_half_a_step(names, seed):
    """A motor drops the fraction, and says its limit where the truth is beyond it."""
    rng = np.random.default_rng(seed)
    scaling = scaling_of(*names)
    truth = rng.uniform(-1.3, 1.3, (3, len(names))) * scaling.limits.T
    joints = damiao_joints(names, len(names))
    packed = [
        simulated_motor(joint, 0.1)._pack(*sample)
        for joint, sample in zip(joints, truth.T)
    ]
    frames = np.array([list(data) for data in packed], np.uint8)
    feedback = decode_feedback(frames, scaling)
    inside = np.clip(truth, -scaling.limits.T, scaling.limits.T)
    for field, value, step in zip(
        ("position", "velocity", "torque"), inside, scaling.steps
    ):
        error = np.abs(value - getattr(feedback, field))
        assert np.all(error <= 0.5 * step * (1 + 1e-9))


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_is_beyond_its_limit_by_a_millionth_of_it_is_refused(field, sign):
    """Registers hold float32; what is sent is the limit."""
    limits = dict(zip(FIELDS, (12.5, 0.3, KP_MAX, KD_MAX, 28.0)))
    scaling = Scaling([(12.5, 0.3, 28.0)])
    values = dict(zip(FIELDS, (0.0, 0.0, 0.0, 1.0, 0.0)))
    low = 0.0 if field in ("kp", "kd") else -limits[field]
    exact = values | {field: limits[field] if sign > 0 else low}
    almost, beyond = (
        values | {field: exact[field] + sign * share * limits[field]}
        for share in (0.9e-6, 1.1e-6)
    )
    frames = [encode_mit(mit_command(**v), scaling).tobytes() for v in (exact, almost)]
    assert frames[0] == frames[1]
    assert f"{field} " in refusal(mit_command(**beyond), scaling)
    for limit_value in (np.nan, np.inf):
        assert field in refusal(mit_command(**{**values, field: limit_value}), scaling)


def test_stiffness_without_damping_is_refused():
    damping = np.array([[1.0, 1.0], [1.0, 0.0]])
    shaky = mit_command(0.0, 0.0, 10.0, damping)
    assert refusal(shaky, scaling_of("DM4340", "DM4310")) == (
        "the command of motor number 2 has kp > 0, which needs kd of at least 0.0012"
    )
    # The least that a frame carries will do; the nearest code to anything below half of it is 0.
    encode_mit(mit_command(0, 0, 10, 0.51 * KD_STEP, 0), scaling_of("DM4340"))
    refusal(mit_command(0, 0, 10, 0.49 * KD_STEP, 0), scaling_of("DM4340"))
    refusal(mit_command(0, 0, 1e-9, 0, 0), scaling_of("DM4340"))
    encode_mit(mit_command(0, 0, 0, 0, 0), scaling_of("DM4340"))


@pytest.mark.parametrize("share", [0.876, 1.0])
def test_a_command_that_looks_like_a_special_frame_is_refused_by_the_motors_number(
    share,
):
    commands = MitCommand(
        *np.array([[0, 0, 1, 1, 0], [12.5, 10, 500, 5, 28 * share]], float).T
    )
    assert refusal(commands, scaling_of("DM4310", "DM4340")) == (
        "the command of motor number 2 would read as a special frame; lower its gains or "
        "torque"
    )


@pytest.mark.parametrize("limit_value", [0.0, -12.5, np.nan, np.inf])
def test_scaling_has_to_be_positive(limit_value):
    with pytest.raises(InputError, match="PMAX, VMAX and TMAX must be positive"):
        Scaling([(1.0, 2.0, 3.0), (12.5, limit_value, 28.0)])


# Typed from the maker's protocol description.
SET_ZERO = 0xFE
CLEAR_ERROR = 0xFB
STORE = 0xAA


@pytest.mark.parametrize(
    "frame",
    [
        *(special_frame(code, 1) for code in (SET_ZERO, CLEAR_ERROR, 0x00, 0xFF)),
        *(register_frame(operation, 1, 1) for operation in (STORE, 0x00, 0xFF)),
    ],
)
def test_a_link_sends_no_harmful_frames(frame):
    """They reach no bus, as there is none here."""
    with pytest.raises(SysidError, match="refused to send"):
        GuardedLink(None, None).send(frame)


@given(number=st.sampled_from([*Register]), data=st.data())
def test_register_values_survive_their_four_bytes(number, data):
    is_integer = number not in (Register.PMAX, Register.VMAX, Register.TMAX)
    values = (
        st.integers(0, 2**32 - 1)
        if is_integer
        else st.floats(width=32, allow_nan=False)
    )
    value = data.draw(values)
    assert value_from_bytes(number, bytes_from_value(number, value)) == value


def test_a_request_holds_both_bytes_of_the_motors_number():
    frame = register_frame(READ, 0x123, register=7)
    assert frame == CanFrame(REGISTER_ID, bytes([0x23, 0x01, 0x33, 7, 0, 0, 0, 0]))
