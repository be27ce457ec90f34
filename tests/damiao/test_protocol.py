"""Frames of Damiao motors: commands and feedback, refused frames, registers, rates and status."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import mit_command
from robot_sysid.damiao.bus import GuardedLink
from robot_sysid.damiao.joints import MOTORS
from robot_sysid.damiao.protocol import (
    KD_MAX,
    READ,
    REGISTER_ID,
    CanFrame,
    MitCommand,
    Register,
    Scaling,
    bytes_from_value,
    decode_feedback,
    decode_mit,
    encode_feedback,
    encode_mit,
    register_frame,
    special_frame,
    value_from_bytes,
)
from robot_sysid.errors import InputError, SysidError

TYPES = sorted(MOTORS)
TYPE_LISTS = st.lists(st.sampled_from(TYPES), min_size=1, max_size=6)
SEEDS = st.integers(0, 2**32 - 1)
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
        ((1.0, 2.0, 20, 1, 0.5), (12.5, 30, 10), "8A 3D 88 80 A4 33 38 66"),
        ((-0.7854, -1.5, 240, 3, -6.25), (12.5, 10, 28), "77 F5 6C C7 AE 99 96 36"),
    ],
)
def test_known_commands_have_known_bytes(values, limits, expected):
    frame = encode_mit(mit_command(*values), Scaling([limits]))
    assert frame.tobytes() == bytes.fromhex(expected)


def test_known_feedback_has_known_values():
    frame = np.frombuffer(bytes.fromhex("138B217D3866231F"), dtype=np.uint8)[None]
    scaling = Scaling([(12.5, 10, 28)])
    status, *measured, mos, rotor = vars(decode_feedback(frame, scaling)).values()
    codes = np.subtract(measured, 0.5 * np.array(scaling.steps))
    np.testing.assert_allclose(codes[:, 0], (1.08701, -0.21734, 1.40171), atol=5e-6)
    assert (status, mos, rotor) == (1, 35, 31)


@given(names=TYPE_LISTS, seed=SEEDS, shape=st.lists(st.integers(0, 3), max_size=2))
def test_many_joints_and_samples_survive_within_half_a_step(names, seed, shape):
    """As a whole trajectory or joint by joint, each in the scaling of its own type."""
    scaling = scaling_of(*names)
    share = np.random.default_rng(seed).uniform(0.01, 0.99, (5, *shape, len(names)))
    sent = scaling.low.T.reshape(5, *[1] * len(shape), -1)
    sent = sent + share * (scaling.high - scaling.low).T.reshape(sent.shape)
    frames = encode_mit(MitCommand(*sent), scaling)
    for error, step in zip(decode_mit(frames, scaling) - sent, scaling.command.steps.T):
        assert np.all(np.abs(error) <= 0.5 * step * (1 + 1e-9))
    for j, name in enumerate(names):
        alone = encode_mit(MitCommand(*sent[..., [j]]), scaling_of(name))
        np.testing.assert_array_equal(alone, frames[..., [j], :])


@given(names=TYPE_LISTS, seed=SEEDS)
def test_feedback_survives_within_half_a_step(names, seed):
    """A motor drops the fraction, and says its limit where the truth is beyond it."""
    scaling = scaling_of(*names)
    limits = scaling.limits.T
    truth = np.random.default_rng(seed).uniform(-1.3, 1.3, limits.shape) * limits
    codes = np.zeros((len(names), 2))
    frames = encode_feedback(np.hstack([codes, truth.T, codes]), scaling)
    feedback = decode_feedback(frames, scaling)
    measured = np.array([feedback.position, feedback.velocity, feedback.torque])
    error = np.abs(np.clip(truth, -limits, limits) - measured)
    assert np.all(error <= 0.5 * np.array(scaling.steps) * (1 + 1e-9))


@pytest.mark.parametrize("field", range(5))
@pytest.mark.parametrize(("end", "sign"), [("low", -1.0), ("high", 1.0)])
def test_what_is_beyond_its_limit_by_a_millionth_of_it_is_refused(field, end, sign):
    """Registers hold float32; what is sent is the limit."""
    scaling = Scaling([(12.5, 0.3, 28.0)])
    limit = getattr(scaling, end)[0, field]
    millionth = sign * 1e-6 * scaling.high[0, field]

    def command(value):
        values = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
        values[field] = value
        return mit_command(*values)

    at_limit, almost = (
        encode_mit(command(limit + share * millionth), scaling) for share in (0.0, 0.9)
    )
    np.testing.assert_array_equal(almost, at_limit)
    for value in (limit + 1.1 * millionth, np.nan, np.inf):
        assert f"{MitCommand._fields[field]} " in refusal(command(value), scaling)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 0, 10, 0.51 * KD_STEP, 0), None),
        ((0, 0, 10, 0.49 * KD_STEP, 0), "has kp > 0, which needs kd of at least 0.0012"),
        ((0, 0, 1e-9, 0, 0), "has kp > 0"),
        ((0, 0, 0, 0, 0), None),
        ((12.5, 10, 500, 5, 20), None),
        ((12.5, 10, 500, 5, 28), "would read as a special frame; lower its gains or torque"),
        ((12.5, 10, 500, 5, 28 * 0.876), "would read as a special frame"),
    ],
)  # fmt: skip
def test_what_a_motor_must_not_be_told_is_refused_by_its_number(values, message):
    """A kd below half a step is none."""
    commands = MitCommand(*np.array([[0, 0, 1, 1, 0], values], float).T)
    scaling = scaling_of("DM4310", "DM4340")
    if message is None:
        encode_mit(commands, scaling)
    else:
        assert f"the command of motor number 2 {message}" in refusal(commands, scaling)


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
