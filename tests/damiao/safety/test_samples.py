"""Which answers are believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.damiao.protocol import Feedback, MitCommand
from robot_sysid.damiao.safety.guards import Replies, SampleFilter

PEAK = 27.0
STEP = 0.005
CYCLE = 0.004
KP = 180.0


def swing(k):
    """Position and velocity of a joint that swings, at a cycle."""
    time = k * CYCLE
    return 0.5 * np.sin(2.0 * time), np.cos(2.0 * time)


def answer(k, q=None, qd=None, tau=None, status=1, heat=30):
    """What one joint answers in a cycle in which it follows its command, or says something else."""
    p, v = swing(k)
    command = MitCommand(*(np.array([x]) for x in (p, v, KP, 4.5, 3.0)))
    q = p if q is None else q
    qd = v if qd is None else qd
    commanded = command.motor_torque(np.array([q]), np.array([qd]))[0]
    fields = (np.array([float(x)]) for x in (q, qd, commanded if tau is None else tau))
    codes = (np.array([x]) for x in (heat, 30))
    feedback = Feedback(np.array([1]), np.array([status]), *fields, *codes)
    answered = np.ones(1, bool)
    return Replies(answered, np.array([k * CYCLE]), feedback, answered), command


def believed(*changes):
    """Return for each of some answers, after ten good ones, whether it is believed."""
    judge = SampleFilter(np.array([PEAK]), np.array([STEP]))
    judge.start(0.0, np.zeros(1))
    verdicts = []
    for k in range(1, 11 + len(changes)):
        change = changes[k - 11] if k > 10 else {}
        replies = judge.believe(*answer(k, **change))
        verdicts.append(bool(replies.answered[0]))
        assert replies.doubted[0] == (not replies.answered[0])
        assert np.isfinite(replies.feedback.position[0]) == replies.answered[0]
    assert all(verdicts[:10])
    return verdicts[10:]


OFF = {
    "position": lambda k: {"q": swing(k)[0] + 0.78, "tau": 3.0},
    "position, near": lambda k: {"q": swing(k)[0] - 0.06, "tau": 3.0},
    "velocity": lambda k: {"qd": swing(k)[1] - 2.5, "tau": 3.0},
    "torque": lambda k: {"tau": 3.0 + 9.0},
    "status": lambda k: {"status": 9},
    "disabled": lambda k: {"status": 0},
    "heat": lambda k: {"heat": 94},
}


@pytest.mark.parametrize("offset", OFF)
def test_one_damaged_answer_is_set_aside_and_the_next_good_one_believed(offset):
    assert believed(OFF[offset](11), {}, {}) == [False, True, True]


@pytest.mark.parametrize("offset", ["velocity", "torque", "status", "disabled", "heat"])
def test_two_that_agree_are_believed(offset):
    assert believed(OFF[offset](11), OFF[offset](12), OFF[offset](13)) == [
        False,
        True,
        True,
    ]


def test_a_position_that_the_torque_contradicts_is_never_believed():
    """Its motor holds the joint where it was: what reports is wrong, and not where it is."""
    offset = OFF["position"]
    assert believed(*(offset(k) for k in range(11, 17))) == [False] * 6


def test_an_encoder_that_jumps_with_its_motor_is_a_finding():
    """A motor whose encoder jumps pulls its joint after it, and its torque shows that."""
    judge = SampleFilter(np.array([PEAK]), np.array([STEP]))
    judge.start(0.0, np.zeros(1))
    jumps = []
    for k in range(1, 14):
        shift = 0.15 if k > 10 else 0.0
        jumps.append(float(judge.believe(*answer(k, q=swing(k)[0] + shift)).jump[0]))
    assert jumps[:11] == [0.0] * 11 and jumps[12] == 0.0
    assert jumps[11] == pytest.approx(0.15, abs=0.01)


def test_a_motor_that_goes_off_does_not_jump():
    """A second motor of the same id that is disabled says so from where it stands itself."""
    other = {"status": 0, "q": 1.3, "qd": 0.0, "tau": 0.0}
    assert believed(*[other] * 4) == [False] * 4


def test_missing_answers_change_nothing():
    judge = SampleFilter(np.array([PEAK]), np.array([STEP]))
    judge.start(0.0, np.zeros(1))
    replies, command = answer(1)
    judge.believe(replies, command)
    missing = replace(replies, answered=np.zeros(1, bool), time=np.full(1, np.nan))
    for _ in range(3):
        assert not judge.believe(missing, command).doubted[0]
    assert judge.believe(*answer(5)).answered[0]


SAMPLES = st.lists(
    st.tuples(
        st.floats(-12.5, 12.5),
        st.floats(-10.0, 10.0),
        st.floats(-28.0, 28.0),
        st.booleans(),
    ),
    max_size=30,
)


@given(SAMPLES)
def test_no_history_moves_what_is_believed_farther_than_a_joint_can_go(samples):
    """Unless its own torque says that it was there."""
    judge = SampleFilter(np.array([PEAK]), np.array([STEP]))
    judge.start(0.0, np.zeros(1))
    last = 0.0
    for k, (q, qd, tau, is_enabled) in enumerate(samples, 1):
        replies = judge.believe(*answer(k, q, qd, tau, int(is_enabled)))
        if replies.answered[0] and replies.jump[0] == 0.0:
            assert (
                abs(q - last) < 0.05 + 1.5 * 10.0 * CYCLE * k + 100.0 * (CYCLE * k) ** 2
            )
            last = q
        elif replies.answered[0]:
            last = q
