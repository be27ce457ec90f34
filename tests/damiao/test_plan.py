"""What can go wrong with an arm, and how each run ends.

Every scenario asserts the state of all motors afterwards, and that no sample that arrived while the
trajectory played is missing from the recording.
"""

from __future__ import annotations

import signal

import numpy as np
import pytest

from robot_sysid.damiao.bus import LinkError
from robot_sysid.damiao.preflight import Permissions
from robot_sysid.damiao.protocol import frames
from robot_sysid.damiao.protocol.codec import Scaling
from robot_sysid.damiao.protocol.frames import (
    DISABLED,
    ENABLED,
    LOST_COMMUNICATION,
    REGISTER_ID,
    BusTiming,
    Frame,
    is_special,
)
from robot_sysid.damiao.protocol.joints import DamiaoJoint
from robot_sysid.damiao.protocol.motors import MOTORS
from robot_sysid.damiao.simulated import Fault, simulated_motor
from robot_sysid.damiao.supervision import VelocityScalingCheck
from robot_sysid.errors import HardwareAbort, InputError
from tests.support.damiao_rig import Rig, swing
from tests.support.motor_bench import answering_writes_with

MID_PLAY = 1.0  # seconds after enabling: 0.3 s ramp, 0.3 s approach, 0.1 s rest, then playing
SIGNALS = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@pytest.fixture
def rig(tmp_path):
    def build(n_joints=2, **options):
        options.setdefault("motion", swing(n_joints, duration=1.0))
        built = Rig(tmp_path, n_joints, **options)
        built.states_before = built.states()
        return built

    return build


def refused(rig, words):
    """Run it: a check has to forbid it with these words, and nothing may happen."""
    rig.states_before = rig.states()
    rig.run()
    assert isinstance(rig.error, HardwareAbort) and words in str(rig.error), rig.error
    assert str(rig.error).startswith("not played: ")
    rig.assert_never_moved()
    assert not rig.record_path.exists()


# --- runs that end well -------------------------------------------------------------------------


def test_an_undisturbed_run_plays_everything_and_disables(rig):
    run = rig(3).run()
    assert run.error is None
    assert run.states() == [DISABLED] * 3
    recording = run.assert_nothing_lost()
    assert recording.ending == "completed"
    assert len(recording.columns["time"]) == run.report.cycles == 251
    assert np.all(np.isfinite(recording.joint_values("pos")))
    check = VelocityScalingCheck(Scaling([MOTORS["DM4340"].limits] * 3).steps[1])
    for sample in zip(*(recording.joint_values(what) for what in ("time", "pos", "vel"))):
        check.add(*sample)
    np.testing.assert_allclose(check.slopes()[0], 1.0, atol=0.01)


def test_a_stop_that_was_asked_for_before_enables_nothing(rig):
    run = rig()
    run.states_before = run.states()
    run.stop("stopped by SIGINT")
    run.run()
    assert run.error.exit_code == 3 and str(run.error) == "stopped by SIGINT"
    assert run.phases == []
    run.assert_never_moved()


def test_a_few_lost_replies_leave_gaps_but_do_not_stop(rig):
    faults = [Fault("lost-replies", 1, 1, MID_PLAY), Fault("lost-replies", 1, 0, MID_PLAY + 0.008)]
    run = rig(faults=faults).run()
    assert run.error is None and run.states() == [DISABLED] * 2
    q = run.assert_nothing_lost().joint_values("pos")
    assert np.isfinite(q[:, 0]).all() and np.isnan(q[:, 1]).sum() == 5
    # One command is not answered; the motor is not asked again for four cycles.
    assert run.report.missed.tolist() == [0, 1]


def test_a_short_stall_skips_cycles_and_never_replays_them(rig):
    run = rig().during("playing", 0.5, lambda r: r.clock.stall(0.015)).run()
    assert run.error is None and run.states() == [DISABLED] * 2
    time = run.assert_nothing_lost().columns["time"]
    assert run.report.skipped in (2, 3) and len(time) == 251 - run.report.skipped
    assert np.max(np.diff(time)) == pytest.approx(0.004 * (1 + run.report.skipped), abs=1e-9)
    commanded = run.recording.columns["j0_cmd_pos"]
    assert np.all(np.diff(commanded[:120]) >= 0.0)


@pytest.mark.parametrize("echo_opcode", [0x33, 0x55])
def test_a_missing_watchdog_is_set_for_the_run_and_put_back(rig, echo_opcode):
    run = rig(watchdog=0.0, allowed=Permissions(watchdog=0.1))
    for motor in run.motors:
        answering_writes_with(echo_opcode, motor)
    seen = []
    run.during("playing", 0.1, lambda r: seen.append(r.motors[1].registers[frames.TIMEOUT])).run()
    assert run.error is None and run.states() == [DISABLED] * 2
    assert seen == [2000.0]
    assert [m.registers[frames.TIMEOUT] for m in run.motors] == [0.0, 0.0]


def test_register_limits_can_be_accepted_by_name_and_are_what_the_codec_uses(rig):
    plain = rig(name="plain").run().recording.joint_values("tau")
    run = rig(faults=[Fault("tmax", 0, 20.0)], allowed=Permissions(register_limits=True)).run()
    assert run.error is None and run.states() == [DISABLED] * 2
    recording = run.assert_nothing_lost()
    assert any("TMAX=20," in line for line in recording.head)
    np.testing.assert_allclose(recording.joint_values("tau"), plain, rtol=0, atol=0.05)


def test_can_fd_motors_play_on_an_fd_host(rig):
    run = rig(timing=BusTiming(fd=True), rate=500.0)
    run.motors[0].registers[frames.CAN_BR] = 9.0  # the other one answers in classic frames
    run.run()
    assert run.error is None and run.states() == [DISABLED] * 2
    assert {frame.fd for frame in run.play_frames} == {True, False}
    run.assert_nothing_lost()


def test_time_stamps_come_from_the_bus_where_it_reports_sent_frames(tmp_path):
    motion = swing(3, duration=0.5, amplitude=0.05)
    late = Rig(tmp_path, motion=motion, name="late").run().recording.joint_values("time")
    run = Rig(tmp_path, motion=motion, echo=True).run()
    early = run.assert_nothing_lost().joint_values("time")
    cycle = run.recording.columns["time"]
    frame = 135e-6
    np.testing.assert_allclose(
        early - cycle[:, None], [[frame, 2 * frame, 3 * frame]] * 126, atol=2e-6
    )
    assert np.all(late > early)


# --- refused before anything moves ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault("tmax", 1, 40.0), "has PMAX, VMAX, TMAX 12.5, 10, 40 but a DM4340 has 12.5, 10, 28"),
        (Fault("vmax", 0, 8.0), "give --accept-register-limits"),
        (Fault("mode", 1, 2), "is in mode 2 (POS_VEL)"),
        (Fault("watchdog", 0, 0.0), "no watchdog"),
        (Fault("watchdog", 0, 0.005), "watchdog of 5 ms is too short"),
        (Fault("status", 1, 0x8), "reports status 8: over-voltage"),
        (Fault("status", 0, 0xD), "status D: communication lost"),
        (Fault("temperature-mos", 0, 70), "is at 70 deg C, above 60"),
        (Fault("temperature-rotor", 1, 61), "is at 61 deg C, above 60"),
        (Fault("silent", 1), "motor 2 does not answer"),
        (Fault("lost-replies", 0), "motor 1 does not answer"),
    ],
)
def test_a_motor_that_is_not_as_expected_is_refused(rig, fault, words):
    refused(rig(faults=[fault]), words)


def test_a_motor_with_another_reply_id_is_refused(rig):
    run = rig()
    run.motors[0].registers[frames.MST_ID] = 0x21
    refused(run, "answers on 0x21 (MST_ID 0x21) but the trajectory expects 0x11")


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (("DM4340", 2, 0x12), "2 motors answer to the id of motor 2"),
        (("DM4310", 9, 0x102), "would be taken as commands by the motor with CAN id 2"),
        (("DM4310", 9, 0x12), "master id 0x12 is used by more than one motor"),
    ],
)
def test_an_extra_motor_that_cannot_share_the_bus_is_refused(rig, extra, words):
    refused(rig(extra_motors=[simulated_motor(DamiaoJoint(*extra))]), words)


def test_a_motor_that_somebody_else_enabled_is_refused_and_left_alone(rig):
    run = rig()
    run.motors[1].status = ENABLED
    run.motors[1].registers[frames.TIMEOUT] = 6e4
    refused(run, "motor 2 is enabled already")


def test_a_bus_on_which_others_talk_is_refused(rig):
    run = rig()
    for k in range(10):
        run.bus._replies.append((0.004 * k, 0x11, -k, Frame(0x11, bytes(8))))
    refused(run, "another program is talking to these motors")


def test_an_arm_far_from_the_first_point_is_refused(rig):
    refused(rig(start=[0.0, 0.7]), "rad but the trajectory starts at 0.000, more than 0.5 away")


def test_a_lost_turn_is_recognised(rig):
    refused(rig(start=[-2 * np.pi, 0.0]), "lost its turn count")


def test_a_motor_that_answers_in_fd_to_a_classic_host_is_refused(rig):
    run = rig()
    run.motors[0].registers[frames.CAN_BR] = 9.0
    refused(run, "motor 1 does not answer")
    assert any("use --fd" in check.text for check in run.checks)


def test_a_bus_load_above_seventy_percent_is_refused_unless_forced(rig):
    refused(rig(4, rate=1000.0), "load classic CAN to 108 %, limit 70 %; use --rate 500")
    forced = rig(4, rate=700.0, allowed=Permissions(bus_load=True)).run()
    assert forced.error is None and forced.states() == [DISABLED] * 4


def test_a_trajectory_that_starts_moving_is_refused(rig):
    time, q, qd, tau = swing(2, duration=1.0)
    refused(rig(motion=(time[:200], q[20:220], qd[20:220], tau[20:220])), "at rest")


def test_a_trajectory_that_jumps_is_refused(rig):
    time, q, qd, tau = (x.copy() for x in swing(2, duration=1.0))
    q[100:] += 0.3
    refused(rig(motion=(time, q, qd, tau)), "of motor 1, but the positions change by 4 rad/s")


def test_a_trajectory_beyond_the_peak_torque_is_refused(rig):
    time, q, qd, tau = (x.copy() for x in swing(2, duration=1.0))
    tau[50:60, 1] = 27.5
    refused(rig(motion=(time, q, qd, tau)), "exceeds the peak torque")


@pytest.mark.parametrize("suffix", [".csv", ".log"])
def test_an_existing_recording_is_not_overwritten(rig, suffix):
    run = rig()
    there = run.record_path.with_suffix(suffix)
    there.write_text("precious")
    files = sorted(there.parent.iterdir())
    run.run()
    assert isinstance(run.error, InputError) and f"{there} exists" in str(run.error)
    assert there.read_text() == "precious" and sorted(there.parent.iterdir()) == files
    run.assert_never_moved()


# --- faults while moving --------------------------------------------------------------------------


@pytest.mark.parametrize("code", [0x0, 0x2, 0x5, 0x8, 0x9, 0xA, 0xB, 0xC, 0xE, 0xF])
def test_any_status_but_enabled_stops_the_run(rig, code):
    run = rig(3, faults=[Fault("status", 1, code, MID_PLAY)]).run()
    run.assert_stopped(f"motor 2 reports status {code:X}", {1: code})
    recording = run.assert_nothing_lost()
    assert recording.ending.startswith("stopped: motor 2")
    assert recording.columns["j1_status"][-1] == code
    assert "stopping" in run.phases


def test_the_other_motors_come_to_rest_before_they_are_disabled(rig):
    run = rig(3, faults=[Fault("status", 1, 0xA, MID_PLAY)], rest_time=0.5)
    speeds = []
    original = run.bus.send

    def send(frame):
        if frame.data == b"\xff" * 7 + b"\xfd" and not speeds:
            speeds.extend(abs(run.arm.mechanism.qd[[0, 2]]))
        original(frame)

    run.bus.send = send
    run.run()
    run.assert_stopped("status A", {1: 0xA})
    assert max(speeds) < 0.05


@pytest.mark.parametrize("phase", ["raising the gains", "moving to the first point"])
def test_a_fault_before_the_trajectory_stops_too(rig, phase):
    run = rig(start=[0.3, -0.3]).during(phase, 0.15, lambda r: r.motors[0].fail(0xA)).run()
    run.assert_stopped("motor 1 reports status A", {0: 0xA})
    assert len(run.assert_nothing_lost().columns["time"]) == 0


def test_a_second_fault_while_stopping_still_disables_the_rest(rig):
    run = rig(
        3, faults=[Fault("status", 0, 0xA, MID_PLAY), Fault("status", 2, 0xB, MID_PLAY + 0.03)]
    )
    run.run().assert_stopped("motor 1 reports status A", {0: 0xA, 2: 0xB})
    run.assert_nothing_lost()


def test_all_motors_failing_at_once_ends_in_a_hard_stop(rig):
    run = rig(faults=[Fault("status", j, 0x9, MID_PLAY) for j in (0, 1)]).run()
    run.assert_stopped("reports status 9", {0: 0x9, 1: 0x9})
    run.assert_nothing_lost()


@pytest.mark.parametrize(
    ("fault", "states"), [("silent", {1: LOST_COMMUNICATION}), ("lost-replies", {})]
)
def test_a_motor_that_is_not_heard_stops_the_run_and_is_disabled_or_stopped_by_its_watchdog(
    rig, fault, states
):
    run = rig(3, faults=[Fault(fault, 1, 1, MID_PLAY)]).run()
    run.assert_stopped("motor 2 did not answer in time for ", states)
    assert "disabled: motor 2. Cut their power" in str(run.error)
    run.assert_nothing_lost()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault("temperature-mos", 1, 81, MID_PLAY), "motor 2 is at 81 deg C, limit 80"),
        (Fault("temperature-rotor", 1, 81, MID_PLAY), "motor 2 is at 81 deg C, limit 80"),
        (Fault("jammed", 1, 1, 0.8), "off its speed, limit 1.0"),
        (Fault("peak-torque", 1, 0.05, 0.8), "off its speed, limit 1.0"),
    ],
)
def test_heat_and_a_joint_that_leaves_its_path_stop_the_run(rig, fault, words):
    run = rig(faults=[fault]).run()
    run.assert_stopped(words)
    run.assert_nothing_lost()


def test_velocities_that_do_not_add_up_to_positions_stop_the_run(rig):
    run = rig(3, motion=swing(3, 4.0), faults=[Fault("velocity-factor", 1, 0.8)]).run()
    run.assert_stopped("motor 2 moves 1.2")
    run.assert_nothing_lost()


@pytest.mark.parametrize(
    ("seconds", "states"), [(0.2, {0: LOST_COMMUNICATION, 1: LOST_COMMUNICATION}), (0.05, {})]
)
def test_a_stall_stops_the_run_gently_or_after_the_watchdogs_have(rig, seconds, states):
    run = rig().during("playing", 0.4, lambda r: r.clock.stall(seconds)).run()
    run.assert_stopped("ms late for a control cycle, limit 20 ms", states)
    run.assert_nothing_lost()


def test_ctrl_c_comes_to_rest_and_disables(rig):
    run = rig().during("playing", 0.4, lambda r: r.stop("stopped by SIGINT")).run()
    run.assert_stopped("stopped by SIGINT")
    assert "stopping" in run.phases
    assert run.assert_nothing_lost().ending == "stopped: stopped by SIGINT"


@pytest.mark.parametrize("name", SIGNALS)
def test_signals_stop_the_run(rig, name):
    number = getattr(signal, name)
    run = rig().during("playing", 0.4, lambda r: signal.raise_signal(number))
    before = signal.getsignal(number)
    with run.stop.on_signals():
        run.run()
    assert signal.getsignal(number) is before
    run.assert_stopped(f"stopped by {name}")
    run.assert_nothing_lost()


def test_asking_twice_disables_at_once(rig):
    run = rig().during("playing", 0.4, lambda r: r.stop("stopped by SIGINT"))
    run.during("stopping", 0.02, lambda r: r.stop("again", insist=True)).run()
    run.assert_stopped("stopped by SIGINT")
    moment = dict(run.phase_times)
    assert run.disabled_at - moment["stopping"] < 0.05
    run.assert_nothing_lost()


def test_an_exception_in_the_middle_stops_the_run(rig):
    def explode(run):
        raise RuntimeError("something unforeseen")

    run = rig().during("playing", 0.4, explode).run()
    run.assert_stopped("RuntimeError: something unforeseen")
    run.assert_nothing_lost()


def test_a_full_disk_stops_the_run(rig, monkeypatch):
    from robot_sysid.damiao import recorder

    written = recorder.MeasurementRecorder.end_cycle
    calls = []

    def fails_later(self):
        calls.append(None)
        if len(calls) == 100:
            raise OSError(28, "No space left on device")
        written(self)

    monkeypatch.setattr(recorder.MeasurementRecorder, "end_cycle", fails_later)
    run = rig().run()
    run.assert_stopped("No space left on device")
    run.assert_nothing_lost()


def test_a_dead_bus_ends_in_a_hard_stop_and_the_watchdogs_take_over(rig):
    def unplug(run):
        def dead(*_):
            raise LinkError("the bus is gone")

        run.bus.send = run.bus.receive = dead

    run = rig().during("playing", 0.4, unplug).run()
    run.assert_stopped("the bus is gone", {0: LOST_COMMUNICATION, 1: LOST_COMMUNICATION})
    assert "Cut their power" in str(run.error)
    run.assert_nothing_lost()


def test_a_bus_that_comes_back_lets_the_motors_be_disabled(rig):
    def interrupt(run):
        alive, back_at = run.bus.send, run.clock.now() + 0.05

        def send(frame):
            run.clock.sleep_until(run.clock.now() + 1e-4)
            if run.clock.now() < back_at:
                raise LinkError("transmit buffer full")
            alive(frame)

        run.bus.send = send

    run = rig().during("playing", 0.4, interrupt).run()
    run.assert_stopped("transmit buffer full")
    run.assert_nothing_lost()


def test_a_motor_that_does_not_enable_stops_the_run(rig):
    run = rig(3).during("enabling", 0.0, lambda r: r.motors[1].fail(0x9)).run()
    run.assert_stopped("motor 2 did not enable: status 9: under-voltage", {1: 0x9})
    commands = [f for f in run.wire.sent if f.id != REGISTER_ID and not is_special(f.data)]
    assert commands == []


def test_a_trajectory_file_that_breaks_off_stops_the_run(rig):
    run = rig()
    lines = run.plan.trajectory.path.read_text().splitlines()
    run.plan.trajectory.path.write_text("\n".join([*lines[:150], "broken", *lines[150:]]))
    run.run()
    run.assert_stopped("expected 7 finite numbers")
    run.assert_nothing_lost()


def test_a_torque_the_frame_cannot_carry_is_never_sent(rig):
    run = rig()
    text = run.plan.trajectory.path.read_text()
    lines = text.splitlines()
    cells = lines[150].split(",")
    cells[3] = "30.0000"
    run.plan.trajectory.path.write_text("\n".join([*lines[:150], ",".join(cells), *lines[151:]]))
    run.run()
    run.assert_stopped("torque 30 of motor number 1 is outside its range")
    run.assert_nothing_lost()


def test_a_watchdog_trip_is_never_cleared_and_the_motor_never_enabled_again(rig):
    run = rig(faults=[Fault("status", 0, LOST_COMMUNICATION, MID_PLAY)]).run()
    run.assert_stopped("status D: communication lost", {0: LOST_COMMUNICATION})
    special = [f.data[7] for f in run.wire.sent if is_special(f.data)]
    assert special.count(0xFC) == 2
    assert set(special) == {0xFC, 0xFD}


def test_disable_is_sent_five_times_two_milliseconds_apart_and_then_confirmed(rig):
    run = rig().run()
    times = [f.time for f in run.wire.sent if f.data[7:] == b"\xfd" and f.id == 1]
    assert len(times) == 6
    np.testing.assert_allclose(np.diff(times[:5]), 2e-3, atol=1e-9)
