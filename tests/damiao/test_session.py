"""Asking motors and commanding them, and which answer belongs to which command."""

from __future__ import annotations

import contextlib
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.motors.damiao_rig import Damage, MotorBus, mit_command
from rigs.motors.motor_causes import slow_adapter
from robot_sysid.damiao.bus import GuardedLink, RegisterClient
from robot_sysid.damiao.joints import damiao_joints
from robot_sysid.damiao.protocol import DISABLED, ENABLED, CanFrame, Register, is_motion
from robot_sysid.damiao.safety.health import BusHealth
from robot_sysid.damiao.session import PATIENCE, REPLY_SHARE, Outstanding
from robot_sysid.damiao.settings import PlaySettings
from robot_sysid.errors import HardwareAbort


class Bench(MotorBus):
    """Motors of one type with a session."""

    def __init__(self, n=2, echo=False):
        super().__init__(damiao_joints(["DM4340"] * n, n), echo=echo)
        self.session = self.open_session()

    @contextlib.contextmanager
    def enabled(self):
        """Enable the motors for a block."""
        with self.session:
            self.session.enable()
            yield

    def exchange(self, q=0.0, kp=20.0, seconds=0.004, joints=True):
        """Command joints, or all, to q [rad] and return their replies of so many seconds."""
        n = len(self.motors)
        command = mit_command(np.full(n, q), kp=kp)
        until = self.clock.now() + seconds
        return self.session.exchange(command, until, np.broadcast_to(joints, n), False)


def setup_client(bench):
    """What setting up a motor writes with: a run may not."""
    link = GuardedLink(bench.wire, bench.clock, refuses=is_motion)
    return RegisterClient(link)


def test_a_refused_write_is_noticed():
    bench = Bench()
    bench.motors[0].writable = ()
    with pytest.raises(HardwareAbort, match="motor 1 refused VMAX = 0.5 and keeps 10"):
        setup_client(bench).write(1, Register.VMAX, 0.5)


def test_a_motor_that_is_not_there_does_not_answer():
    bench = Bench()
    assert RegisterClient(bench.link).read(9, Register.PMAX) is None
    with pytest.raises(
        HardwareAbort, match="motor 9 did not answer to writing TIMEOUT"
    ):
        setup_client(bench).write(9, Register.TIMEOUT, 1.0)


def test_feedback_is_not_taken_for_a_register_reply():
    """A joint at -11.9 rad sends the bytes that begin some register's reply."""
    bench = Bench()
    ours = bench.arm.handle

    def with_feedback_first(frame, time):
        feedback = CanFrame(17, bytes([0x01, 0x00, 0x33, 0x07, 0x80, 0x00, 30, 30]))
        return [feedback, *ours(frame, time)]

    bench.arm.handle = with_feedback_first
    client = RegisterClient(bench.link)
    assert client.read(1, Register.PMAX) == 12.5
    other = CanFrame(18, bytes([1] * 8))
    bench.arm.handle = lambda frame, time: [other, *ours(frame, time)]
    assert client.refresh(2, 18).data[0] == 2


def test_leaving_without_having_enabled_sends_nothing():
    bench = Bench()
    with bench.session:
        pass
    assert bench.wire.sent == []


@pytest.mark.parametrize(
    "error", [None, RuntimeError("x"), KeyboardInterrupt(), SystemExit(1)]
)
def test_every_way_out_disables(error):
    bench = Bench()
    try:
        with bench.session as session:
            session.enable()
            assert bench.states() == [ENABLED] * 2
            bench.exchange()
            if error:
                raise error
    except BaseException as raised:
        assert raised is error
    assert bench.states() == [DISABLED] * 2


def test_a_reply_is_the_state_before_the_command_acted():
    bench = Bench()
    with bench.enabled():
        bench.clock.stall(0.004)
        first = bench.exchange(0.03, kp=500.0)
        bench.clock.stall(0.004)
        second = bench.exchange(0.03, kp=500.0)
    half = 0.5 * 28.0 * 2 / 4095
    assert np.all(np.abs(first.feedback.torque) <= half * 1.01)
    assert np.all(second.feedback.torque > 10.0)


def test_joints_that_were_not_asked_do_not_answer():
    bench = Bench(3)
    with bench.enabled():
        bench.exchange()
        only = np.array([True, False, True])
        replies = bench.exchange(0.005, joints=only)
    # Who was told nothing is under its old command.
    np.testing.assert_allclose(replies.command.position, [0.005, 0.0, 0.005], atol=1e-3)
    assert replies.answered.tolist() == [True, False, True]
    assert np.isnan(replies.feedback.position[1]) and np.isnan(replies.time[1])
    assert replies.feedback.status[1] == -1


@pytest.mark.parametrize("echo", [False, True])
def test_stamps_differ_from_joint_to_joint(echo):
    bench = Bench(3, echo)
    with bench.enabled():
        start = bench.clock.now()
        replies = bench.exchange()
    frame = 135e-6
    first = frame if echo else 4 * frame
    np.testing.assert_allclose(
        replies.time - start, first + frame * np.arange(3), atol=1e-9
    )


def test_a_damaged_answer_while_enabling_is_asked_again():
    """Where the arm is held would be where it never was."""
    bench = Bench()
    bench.bus.damage = Damage("position", 0.4, 1)
    with bench.session as session:
        position = session.enable()
    assert bench.bus.damage is None
    np.testing.assert_allclose(position, 0.0, atol=1e-3)


def test_an_adapter_that_turns_slow_stops_a_run_before_many_answers_are_paired_wrongly():
    """From the 200th cycle on answers come 5 to 16 ms late."""
    bench = Bench(1)
    (hit,) = bench.motors
    hit.counts_commands = True
    health = BusHealth(bench.session.joints, PlaySettings())
    behind = []
    period = 0.004
    with bench.enabled(), pytest.raises(HardwareAbort, match="again and again"):
        begin = bench.clock.now()
        for k in range(1, 260):
            if k == 200:
                slow_adapter(5e-3, 16e-3)(bench)
            bench.clock.sleep_until(begin + period * k)
            replies = bench.exchange(seconds=REPLY_SHARE * period)
            if replies.answered[0]:
                count = replies.feedback.temperature_rotor[0]
                behind.append((hit.n_commands - count) % 60)
            health.update(replies)
            health.check(replies)
    assert k > 200
    assert not any(behind[:195])
    assert np.count_nonzero(behind) <= 10
    assert max(behind) < PATIENCE


ONE = np.ones(1, bool)
# Of an answer, how many cycles after its command it comes at the earliest; None is lost.
AT_ONCE_OR_LOST = st.lists(st.just(0) | st.none(), min_size=1, max_size=60)
UP_TO_A_CYCLE_LATE = st.lists(st.integers(0, 1), min_size=1, max_size=60)
HICCUPS = st.lists(st.just(0) | st.integers(2, PATIENCE), min_size=1, max_size=60)


def taken_answers(delays):
    """Yield, of each cycle with an answer that is used, this cycle and that of the answer.

    Adapters keep the order of answers, so that one which is late delays those behind it.
    """
    delays = [*delays]
    books = Outstanding(1)
    # The cycles of commands whose answers come in a cycle, in their order.
    coming = defaultdict(list)
    earliest = 0
    for cycle in range(4 * len(delays) + 8):
        if books.may_be_commanded(ONE)[0]:
            delay = delays.pop(0) if delays else 0
            if delay is not None:
                earliest = max(earliest, cycle + delay)
                coming[earliest].append(cycle)
        used = [command for command in coming[cycle] if books.take_answer(0)]
        if used:
            yield cycle, used[-1]
        books.end_cycle()


@given(AT_ONCE_OR_LOST | UP_TO_A_CYCLE_LATE)
def test_no_answer_is_taken_for_that_to_another_command(delays):
    for cycle, command in taken_answers(delays):
        assert command == cycle


@given(HICCUPS)
def test_after_a_hiccup_answers_belong_to_their_commands_again(delays):
    """Meanwhile one may be taken for a later one, by no more cycles than the hiccup has."""
    for cycle, command in taken_answers(delays):
        assert cycle - command <= PATIENCE
    assert cycle == command


@pytest.mark.parametrize("late", range(1, 9))
def test_of_answers_that_are_late_for_good_few_are_taken_for_timely_ones(late):
    """The others are missing, again and again."""
    taken = [cycle for cycle, _ in taken_answers(200 * [late]) if cycle < 100]
    assert len(taken) <= 40


@pytest.mark.parametrize(
    ("lost", "commanded"),
    [
        (5, [True, False, True, True, True, True, True]),
        (1, [True, False, True, False, False, True, True]),
        (0, [True, True, True, True, True, True, True]),
    ],
)
def test_a_motor_whose_answer_is_missing_is_commanded_again_after_a_cycle(
    lost, commanded
):
    books = Outstanding(1)
    seen = []
    for _ in commanded:
        seen.append(bool(books.may_be_commanded(ONE)[0]))
        if seen[-1] and sum(seen) > lost:
            books.take_answer(0)
        books.end_cycle()
    assert seen == commanded


def test_an_answer_that_comes_between_two_cycles_is_late():
    books = Outstanding(1)
    assert books.may_be_commanded(ONE)[0]
    books.end_cycle()
    assert not books.take_answer(0)
    assert (books.late[0], books.surplus[0]) == (1, 0)


def test_a_late_cycle_and_a_timely_one_after_it_are_within_the_bounds():
    """Their commands are farther apart than the times at which they were sent."""
    bench = Bench()
    with bench.enabled():
        speed = 10.0
        begin = bench.clock.now()
        for k, late in enumerate((0.0, 0.0, 0.008, 0.0, 0.005, 0.001)):
            bench.clock.sleep_until(begin + 0.01 * k + late)
            q = 0.9 * speed * 0.01 * k
            bench.exchange(q, kp=0.0, seconds=1e-3)
