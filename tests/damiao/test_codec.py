"""Laws of the Damiao frame codec."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol.codec import (
    KD_MAX,
    KP_MAX,
    Feedback,
    MitCommand,
    Scaling,
    decode_feedback,
    decode_mit,
    encode_feedback,
    encode_mit,
)
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.errors import InputError

UNIT = st.floats(-1.0, 1.0)
SHARE = st.floats(0.0, 1.0)
TYPES = sorted(MOTORS)
KP_STEP, KD_STEP = KP_MAX / 4095, KD_MAX / 4095


def scaling_of(*names: str) -> Scaling:
    return Scaling(MOTORS[name].limits for name in names)


def command(position, velocity, kp, kd, torque) -> MitCommand:
    return MitCommand(*(np.array([float(x)]) for x in (position, velocity, kp, kd, torque)))


def hexed(frame: np.ndarray) -> str:
    return " ".join(f"{byte:02X}" for byte in frame)


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
    assert hexed(encode_mit(command(*values), Scaling([limits]))[0]) == expected


@pytest.mark.parametrize(
    ("limits", "p", "v", "t"),
    [
        ((12.5, 10, 28), 1.08701, -0.21734, 1.40171),
        ((12.5, 8, 28), 1.08701, -0.17387, 1.40171),
        ((12.5, 30, 10), 1.08701, -0.65201, 0.50061),
    ],
)
def test_known_feedback_has_known_values(limits, p, v, t):
    frame = np.frombuffer(bytes.fromhex("138B217D3866231F"), dtype=np.uint8)[None]
    feedback = decode_feedback(frame, Scaling([limits]))
    assert (feedback.can_id[0], feedback.status[0]) == (3, 1)
    assert feedback.position[0] == pytest.approx(p, abs=5e-6)
    assert feedback.velocity[0] == pytest.approx(v, abs=5e-6)
    assert feedback.torque[0] == pytest.approx(t, abs=5e-6)
    assert (feedback.temperature_mos[0], feedback.temperature_rotor[0]) == (35, 31)


@pytest.mark.parametrize("name", TYPES)
@given(p=UNIT, v=UNIT, kp=SHARE, kd=st.floats(0.001, 1.0), t=UNIT)
def test_command_survives_within_half_a_step(name, p, v, kp, kd, t):
    spec, scaling = MOTORS[name], scaling_of(name)
    sent = command(
        p * spec.limits[0], v * spec.limits[1], kp * KP_MAX, kd * KD_MAX,
        min(t, 0.8) * spec.limits[2],
    )  # fmt: skip
    back = decode_mit(encode_mit(sent, scaling), scaling)
    steps = dict(zip(("position", "velocity", "torque"), scaling.steps), kp=KP_STEP, kd=KD_STEP)
    for field, step in steps.items():
        error = abs(getattr(back, field)[0] - getattr(sent, field)[0])
        assert error <= 0.5 * float(np.squeeze(step)) * (1 + 1e-9), field


@pytest.mark.parametrize("name", TYPES)
@given(raw=st.binary(min_size=8, max_size=8))
def test_decoding_and_encoding_a_command_gives_its_bytes_back(name, raw):
    scaling = scaling_of(name)
    frame = np.frombuffer(raw, dtype=np.uint8)[None]
    meant = decode_mit(frame, scaling)
    if raw[:7] == b"\xff" * 7 or (meant.kp[0] > 0 and meant.kd[0] == 0):
        with pytest.raises(InputError):
            encode_mit(meant, scaling)
    else:
        assert encode_mit(meant, scaling).tobytes() == raw


@pytest.mark.parametrize("name", TYPES)
@given(p=UNIT, v=UNIT, t=UNIT, status=st.integers(0, 15), can_id=st.integers(1, 15))
def test_feedback_survives_within_a_step_and_half_a_step_centred(name, p, v, t, status, can_id):
    spec, scaling = MOTORS[name], scaling_of(name)
    truth = np.array([p, v, t]) * spec.limits
    one = np.ones(1)
    sent = Feedback(
        one * can_id, one * status, *(one * x for x in truth), one * 40, one * 50
    )  # fmt: skip
    sent = Feedback(*(np.asarray(x, dtype=int) if k in (0, 1, 5, 6) else x
                      for k, x in enumerate(vars(sent).values())))  # fmt: skip
    frame = encode_feedback(sent, scaling)
    plain, centred = decode_feedback(frame, scaling), decode_feedback(frame, scaling, True)
    for field, value, step in zip(("position", "velocity", "torque"), truth, scaling.steps):
        late = value - getattr(plain, field)[0]
        assert -1e-9 * step[0] <= late <= step[0] * (1 + 1e-9)
        assert abs(value - getattr(centred, field)[0]) <= 0.5 * step[0] * (1 + 1e-9)
    assert (plain.status[0], plain.can_id[0]) == (status, can_id)
    assert (plain.temperature_mos[0], plain.temperature_rotor[0]) == (40, 50)


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("field", ["position", "velocity", "torque", "kp", "kd"])
@pytest.mark.parametrize("sign", [-1, 1])
def test_out_of_range_is_refused_and_the_limit_itself_is_not(name, field, sign):
    spec, scaling = MOTORS[name], scaling_of(name)
    tops = (*spec.limits, KP_MAX, KD_MAX)
    high = dict(zip(("position", "velocity", "torque", "kp", "kd"), tops))[field]
    low = 0.0 if field in ("kp", "kd") else -high
    values = {"position": 0.0, "velocity": 0.0, "kp": 0.0, "kd": 1.0, "torque": 0.0}
    values[field] = low if sign < 0 else high
    encode_mit(command(*values.values()), scaling)
    values[field] += sign * 1e-5 * high
    with pytest.raises(InputError, match=rf"{field} .* of motor number 1 is outside its range"):
        encode_mit(command(*values.values()), scaling)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    with pytest.raises(InputError, match="velocity"):
        encode_mit(command(0.0, bad, 1.0, 1.0, 0.0), scaling_of("DM4340"))


def test_a_limit_that_went_through_a_float32_register_is_still_inside():
    scaling = Scaling([tuple(map(float, np.float32(MOTORS["DM3507"].limits)))])
    assert hexed(encode_mit(command(12.566, 0, 0, 0, 0), scaling)[0]).startswith("FF FF 80 00")


@pytest.mark.parametrize("field", ["position", "velocity", "torque", "kp", "kd"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_limit_may_be_off_by_a_millionth(field, sign):
    """Of itself, whether it is 5 or 500; what is sent is the limit."""
    limits = {"position": 12.5, "velocity": 0.3, "torque": 28.0, "kp": KP_MAX, "kd": KD_MAX}
    scaling = Scaling([(12.5, 0.3, 28.0)])
    values = {"position": 0.0, "velocity": 0.0, "kp": 0.0, "kd": 1.0, "torque": 0.0}
    low = 0.0 if field in ("kp", "kd") else -limits[field]
    exact = values | {field: limits[field] if sign > 0 else low}
    for share, refused in ((0.9e-6, False), (1.1e-6, True)):
        beyond = values | {field: exact[field] + sign * share * limits[field]}
        if refused:
            assert "outside its range" in refusal(command(**beyond), scaling)
        else:
            frames = [encode_mit(command(**v), scaling).tobytes() for v in (exact, beyond)]
            assert frames[0] == frames[1]


@pytest.mark.parametrize("torque_share", [0.876, 0.9, 1.0])
def test_a_command_that_looks_like_a_special_frame_is_refused(torque_share):
    with pytest.raises(InputError, match="special frame"):
        encode_mit(command(12.5, 10, 500, 5, 28 * torque_share), scaling_of("DM4340"))


def test_stiffness_without_damping_is_refused():
    damping = np.array([[1.0, 1.0], [1.0, 0.0]])
    shaky = MitCommand(0.0 * damping, 0.0 * damping, 10.0 + 0.0 * damping, damping, 0.0 * damping)
    assert refusal(shaky, scaling_of("DM4340", "DM4310")) == (
        "kp > 0 needs kd of at least 0.0012 of motor number 2: less is sent as 0"
    )
    # The least that a frame carries will do; the nearest code to anything below half of it is 0.
    encode_mit(command(0, 0, 10, 0.51 * KD_STEP, 0), scaling_of("DM4340"))
    refusal(command(0, 0, 10, 0.49 * KD_STEP, 0), scaling_of("DM4340"))
    refusal(command(0, 0, 1e-9, 0, 0), scaling_of("DM4340"))
    encode_mit(command(0, 0, 0, 0, 0), scaling_of("DM4340"))


def test_a_special_frame_is_refused_by_the_motors_number():
    limits = np.array([MOTORS[name].limits for name in ("DM4310", "DM4340")]).T
    p, v, t = np.stack((0.0 * limits, limits), axis=1)
    gains = np.array([[1.0, 1.0], [KP_MAX, KP_MAX]]), np.array([[1.0, 1.0], [KD_MAX, KD_MAX]])
    p[1, 0] = 0.0
    assert refusal(MitCommand(p, v, *gains, t), scaling_of("DM4310", "DM4340")) == (
        "the command of motor number 2 has every field at its maximum and would read as a special "
        "frame; lower its gains or torque"
    )


@given(data=st.data())
def test_all_joints_at_once_equal_one_joint_at_a_time(data):
    names = data.draw(st.lists(st.sampled_from(TYPES), min_size=1, max_size=8))
    limits = np.array([MOTORS[name].limits for name in names]).T
    draw = lambda: np.array([data.draw(st.floats(-0.8, 0.8)) for _ in names])  # noqa: E731
    p, v, t = (draw() * limit for limit in limits)
    many = MitCommand(p, v, np.full(len(names), 20.0), np.full(len(names), 1.0), t)
    frames = encode_mit(many, scaling_of(*names))
    for j, name in enumerate(names):
        single = encode_mit(command(p[j], v[j], 20.0, 1.0, t[j]), scaling_of(name))
        assert frames[j].tobytes() == single[0].tobytes()
    back = decode_mit(frames, scaling_of(*names))
    assert back.position.shape == (len(names),)


def test_encoding_a_whole_trajectory_at_once_keeps_its_shape():
    scaling = scaling_of("DM4340", "DM4310")
    flat = np.zeros((50, 2))
    frames = encode_mit(MitCommand(flat, flat, flat + 20, flat + 1, flat), scaling)
    assert frames.shape == (50, 2, 8)
    assert np.all(frames == frames[:1])


@pytest.mark.parametrize(
    ("field", "value", "limit"),
    [("position", -13, "12.5"), ("velocity", 31, "30"), ("torque", 28.5, "10")],
)
def test_the_message_names_the_joint_that_is_out_of_range(field, value, limit):
    """The first sample is fine; motor 2 has limits of its own."""
    values = dict.fromkeys(("position", "velocity", "kp", "kd", "torque"), np.ones((2, 3)))
    values[field] = values[field].copy()
    values[field][1, 1] = value
    scaling = Scaling([(13.0, 40.0, 29.0), (12.5, 30.0, 10.0), (13.0, 40.0, 29.0)])
    expected = f"{field} {value} of motor number 2 is outside its range, limit {limit}"
    assert refusal(MitCommand(**values), scaling) == expected


@pytest.mark.parametrize("name", TYPES)
def test_a_step_is_what_one_code_more_stands_for(name):
    scaling = scaling_of(name)
    codes = np.array([[0x10] + [0] * 7, [0x10, 0, 1, 0, 0x10, 1, 0, 0]], dtype=np.uint8)[:, None]
    told = decode_feedback(codes, scaling)
    for field, step in zip(("position", "velocity", "torque"), scaling.steps):
        low, high = getattr(told, field)
        np.testing.assert_allclose(step, high - low, rtol=1e-9)


@pytest.mark.parametrize("bad", [0.0, -12.5, np.nan, np.inf])
@pytest.mark.parametrize("place", range(3))
def test_scaling_has_to_be_positive(bad, place):
    limits = [12.5, 10.0, 28.0]
    limits[place] = bad
    name = ("position", "velocity", "torque")[place]
    with pytest.raises(InputError) as refused:
        Scaling([(1.0, 2.0, 3.0), limits])
    good = float(place + 1)
    words = f"{name} scaling must be positive numbers, got [{good}, {bad}]"
    assert str(refused.value) == words


def test_what_was_checked_cannot_be_changed():
    one = np.ones(1)
    for record in (scaling_of("DM4340"), command(0, 0, 0, 0, 0), Feedback(*[one] * 7)):
        with pytest.raises(AttributeError):
            record.position = one


# --- shapes -------------------------------------------------------------------------------------

SHAPES = st.lists(st.integers(0, 3), max_size=2)


@given(seed=st.integers(0, 2**32 - 1), shape=SHAPES, n=st.integers(1, 4))
def test_a_trajectory_at_once_equals_its_samples_one_by_one(seed, shape, n):
    rng = np.random.default_rng(seed)
    names = rng.choice(TYPES, n)
    scaling = scaling_of(*names)
    p, v, t = (rng.uniform(-0.9, 0.9, (*shape, n)) * x for x in scaling.limits.T)
    kp, kd = rng.uniform(0.0, KP_MAX, (*shape, n)), rng.uniform(0.01, KD_MAX, (*shape, n))
    frames = encode_mit(MitCommand(p, v, kp, kd, t), scaling)
    code = np.ones((*shape, n), dtype=int)
    answers = encode_feedback(Feedback(code, code, p, v, t, code, code), scaling)
    assert frames.shape == answers.shape == (*shape, n, 8)
    meant, told = decode_mit(frames, scaling), decode_feedback(answers, scaling)
    for index in np.ndindex(*shape):
        for j in range(n):
            at, own = (*index, j), scaling_of(names[j])
            single = command(p[at], v[at], kp[at], kd[at], t[at])
            assert encode_mit(single, own)[0].tobytes() == frames[at].tobytes()
            one = Feedback(*(np.array([x]) for x in (1, 1, p[at], v[at], t[at], 1, 1)))
            assert encode_feedback(one, own)[0].tobytes() == answers[at].tobytes()
            for field in ("position", "velocity", "torque"):
                for back, (decode, sent) in (
                    (meant, (decode_mit, frames)), (told, (decode_feedback, answers)),
                ):  # fmt: skip
                    alone = getattr(decode(sent[at][None], own), field)[0]
                    assert getattr(back, field)[at] == alone


@pytest.mark.parametrize("beyond", [1.01, 1e3, np.inf])
def test_a_motor_says_its_limit_where_the_truth_is_beyond_it(beyond):
    scaling, code = scaling_of("DM4340"), np.ones(1, dtype=int)
    for sign in (-1.0, 1.0):
        values = [sign * beyond * x for x in scaling.limits.T]
        frame = encode_feedback(Feedback(code, code, *values, code, code), scaling)
        told = decode_feedback(frame, scaling)
        assert told.position[0] == sign * scaling.limits[0, 0]
        assert told.velocity[0] == sign * scaling.limits[0, 1]
        assert told.torque[0] == pytest.approx(sign * scaling.limits[0, 2], rel=1e-15)


# --- what a command asks for --------------------------------------------------------------------

VALUES = st.floats(-10.0, 10.0)


@given(p=VALUES, v=VALUES, kp=SHARE, kd=SHARE, t=VALUES, q=VALUES, qd=VALUES)
def test_a_motor_is_pulled_towards_where_and_how_fast_it_should_be(p, v, kp, kd, t, q, qd):
    """Of a spring and a damper between the joint and its reference, beside the torque asked for."""
    asked = command(p, v, kp, kd, t)
    there = asked.motor_torque(np.array([p]), np.array([v]))[0]
    away = asked.motor_torque(np.array([p + q]), np.array([v + qd]))[0]
    assert there == pytest.approx(t, abs=1e-12)
    assert away - there == pytest.approx(-kp * q - kd * qd, abs=1e-12)
