"""The simulation of one joint that judges what only cards hold, and the recordings it plays."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rigs.files.places import DATA
from rigs.logs.pendulum_logs import (
    GRAVITY,
    STEP,
    Card,
    Pendulum,
    Recording,
    card_plays,
    model_plays,
    read,
    recordings_of,
)

LEVEL = Pendulum(0.5, 0.0)
"""A weight on its axis, which gravity does not turn."""
ARM = Pendulum(0.49, 0.1)
REAL = DATA / "bam_xl330"


def commands(command, seconds=1.0, start=None, pendulum=LEVEL):
    """Return a recording of a command (a number, or a function of times) from a start at rest."""
    time = np.arange(0.0, seconds + 0.01, 0.01)
    goals = command(time) if callable(command) else np.full(len(time), float(command))
    q = np.full(len(time), goals[0] if start is None else start)
    return Recording(Path("log"), pendulum, 400.0, time, q, goals)


@pytest.mark.parametrize("armature", [0.0, 0.002])
def test_without_friction_and_limit_it_is_an_oscillator(armature):
    card = Card(gain=2.0, armature=armature)
    times, q = card_plays(card, commands(0.3, start=0.1))
    rate = np.sqrt(card.gain / (LEVEL.inertia + armature))
    assert q == pytest.approx(0.3 - 0.2 * np.cos(rate * times), abs=0.3 * rate * STEP)


def test_dry_friction_takes_as_much_of_each_swing():
    card = Card(gain=2.0, coulomb=0.05, armature=0.002)
    _, q = card_plays(card, commands(0.0, seconds=1.5, start=0.5))
    moving = q[np.append(True, np.diff(q) != 0.0)]
    turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(moving))))
    ends = np.abs(moving[turns])
    lost = 2.0 * card.coulomb / card.gain
    expected = np.arange(0.5 - lost, 0.5 * lost, -lost)
    assert ends == pytest.approx(expected, abs=1e-3)
    assert q[-1] == pytest.approx(0.0, abs=1e-3)


def test_energy_of_a_swing_falls():
    card = Card(gain=1.0, damping=0.002, coulomb=0.01, armature=0.001, load_share=0.1)
    _, q = card_plays(card, commands(0.4, seconds=2.0, start=-1.0, pendulum=ARM))
    speed = np.diff(q) / STEP
    middle = 0.5 * (q[1:] + q[:-1])
    weight = ARM.mass * GRAVITY * ARM.length
    energy = 0.5 * (ARM.inertia + card.armature) * speed**2
    energy += 0.5 * card.gain * (0.4 - middle) ** 2 - weight * np.cos(middle)
    fastest = np.max(np.abs(speed)) * STEP
    assert np.max(np.diff(energy)) < fastest * (card.coulomb + card.damping) / 10
    assert energy[-1] < energy[0] - 0.1


@pytest.mark.parametrize("share", [0.98, -0.98])
def test_it_sticks_where_friction_can_hold_it(share):
    card = Card(gain=2.0, coulomb=0.02, stribeck=0.03, load_share=0.1)
    away = (card.coulomb + card.stribeck) / (card.gain * (1.0 - card.load_share))
    _, q = card_plays(card, commands(share * away, start=0.0))
    assert np.all(q == 0.0)
    _, q = card_plays(card, commands(share * away * 1.05, start=0.0))
    assert q[-1] != 0.0


def test_a_limit_leaves_a_constant_acceleration():
    card = Card(gain=50.0, limit=0.2, armature=0.01)
    times, q = card_plays(card, commands(1000.0, start=0.0))
    expected = 0.5 * card.limit / (LEVEL.inertia + card.armature) * times**2
    assert q == pytest.approx(expected, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("losses", [{"damping": 0.05}, {"back_emf": 0.05}])
def test_losses_at_the_limit_leave_a_speed(losses):
    card = Card(gain=50.0, limit=0.2, **losses)
    _, q = card_plays(card, commands(1000.0, start=0.0))
    assert (q[-1] - q[-2]) / STEP == pytest.approx(0.2 / 0.05, rel=1e-6)


def test_friction_that_grows_with_load_makes_lifting_harder_than_lowering():
    """Lifting begins at (W + F + s W) / (1 - s), lowering at (W - F - s W) / (1 + s)."""
    card = Card(gain=5.0, coulomb=0.02, load_share=0.2)
    level = np.pi / 2
    weight = ARM.mass * GRAVITY * ARM.length
    holding = level + weight / card.gain
    for sign in (1.0, -1.0):
        slope = sign * 0.5
        recording = commands(
            lambda time, slope=slope: holding + slope * time, start=level, pendulum=ARM
        )
        times, q = card_plays(card, recording)
        moved = times[np.argmax(q != level)]
        motor = card.gain * (holding + slope * moved - level)
        rubs = card.coulomb + card.load_share * weight
        expected = (weight + sign * rubs) / (1.0 - sign * card.load_share)
        assert motor == pytest.approx(expected, abs=2.0 * card.gain * 0.5 * STEP)


def test_friction_falls_from_rest_to_motion():
    card = Card(
        gain=1.0,
        coulomb=0.1,
        load_share=0.01,
        stribeck=0.2,
        load_stribeck=0.02,
        stribeck_speed=0.5,
        stribeck_curve=2.0,
    )
    moves, rests = 0.1 + 0.01 * 3.0, 0.2 + 0.02 * 3.0
    assert card.dry_friction(0.0, -3.0) == pytest.approx(moves + rests)
    assert card.dry_friction(-0.5, 3.0) == pytest.approx(moves + rests / np.e)
    assert card.dry_friction(1.0, 3.0) == pytest.approx(moves + rests / np.e**4)
    assert card.dry_friction(10.0, 3.0) == pytest.approx(moves)


def test_a_delay_moves_the_answer():
    recording = commands(lambda time: np.where(time > 0.2, 0.3, 0.0))
    card = Card(gain=2.0, damping=0.05, coulomb=0.01)
    _, soon = card_plays(card, recording)
    _, late = card_plays(Card(2.0, damping=0.05, coulomb=0.01, delay=0.1), recording)
    shift = round(0.1 / STEP)
    assert late[shift:] == pytest.approx(soon[:-shift], abs=1e-9)
    assert np.max(soon) > 0.25


def test_a_gain_that_is_doubled_is_that_of_another_register():
    recording = commands(lambda time: 0.3 * np.sin(5.0 * time), pendulum=ARM)
    _, twice = card_plays(Card(1.0, damping=0.05), recording, times=2.0)
    _, other = card_plays(Card(2.0, damping=0.05), recording)
    assert np.array_equal(twice, other)


@pytest.mark.parametrize(("coulomb", "steps"), [(0.0, 1.0), (0.03, 5.0)])
def test_it_plays_what_mujoco_plays(coulomb, steps):
    """Of what a model file holds, within steps at top speed; dry friction of MuJoCo is soft."""
    recording = commands(
        lambda time: 1.2 * np.sin(3.0 * time) * time, seconds=3.0, pendulum=ARM
    )
    card = Card(
        gain=0.9, limit=0.4, damping=0.03, coulomb=coulomb, armature=0.002, delay=0.02
    )
    spec = mujoco.MjSpec.from_string(ARM.model(card.gain))
    (joint,) = spec.joints
    (servo,) = spec.actuators
    old = joint.damping
    joint.damping = card.damping if np.isscalar(old) else [card.damping, *old[1:]]
    joint.frictionloss = card.coulomb
    joint.armature = card.armature
    servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    servo.forcerange = [-card.limit, card.limit]
    model = spec.compile()
    for times in (1.0, 0.5):
        clock, ours = card_plays(card, recording, times=times)
        same, theirs = model_plays(model, recording, times=times, delay=card.delay)
        assert np.array_equal(clock, same)
        off = steps * np.max(np.abs(np.diff(theirs)))
        assert ours == pytest.approx(theirs, abs=off)
    assert np.ptp(ours) > 1.0
    assert model.actuator_gainprm[0, 0] == card.gain


def test_it_plays_what_bam_plays():
    """Its model M4 with the numbers that it ships for an XL330, in steps of this simulation."""
    model = pytest.importorskip("bam.model").load_model(motor_name="xl330", model="m4")
    simulator = pytest.importorskip("bam.simulate").Simulator(model)
    volts, kp = 7.4, 400.0
    motor = model.actuator
    motor.max_current = None
    model.q_offset.value = 0.0
    per_volt = model.kt.value / model.R.value
    card = Card(
        gain=kp * motor.error_gain * volts * per_volt,
        limit=motor.max_pwm * volts * per_volt,
        back_emf=model.kt.value * per_volt,
        damping=model.friction_viscous.value,
        coulomb=model.friction_base.value,
        armature=model.armature.value - ARM.own_inertia,
        load_share=model.load_friction_base.value,
        stribeck=model.friction_stribeck.value,
        load_stribeck=model.load_friction_stribeck.value,
        stribeck_speed=model.dtheta_stribeck.value,
        stribeck_curve=model.alpha.value,
    )
    recording = commands(
        lambda time: 2.0 * np.sin(3.0 * time) * time, seconds=2.0, pendulum=ARM
    )
    clock, ours = card_plays(card, recording)
    goals = np.interp(clock, recording.time, recording.command).tolist()
    entries = [
        {"position": 0.0, "goal_position": goal, "torque_enable": True}
        for goal in goals
    ]
    log = {"mass": ARM.mass, "arm_mass": 0.0, "length": ARM.length, "kp": kp}
    log.update(vin=volts, dt=STEP, entries=entries)
    theirs, _, _ = simulator.rollout_log(log, simulate_control=True)
    assert ours == pytest.approx(np.array(theirs), abs=np.max(np.abs(np.diff(ours))))
    assert np.max(np.abs(np.array(goals) - ours)) > card.limit / card.gain


def recording_text(held):
    """Return a recording of BAM's of 3 samples, the last without torque."""
    keys = ("timestamp", "position", "goal_position", "torque_enable", "load")
    rows = [
        (0.1, 0.2, 0.3, True, 7),
        (0.2, 0.4, 0.6, True, 8),
        (0.3, 9.0, 9.0, held, 9),
    ]
    entries = [dict(zip(keys, row)) for row in rows]
    return json.dumps({"mass": 0.5, "length": 0.1, "kp": 400, "entries": entries})


def test_a_recording_is_read_while_the_servo_holds(tmp_path):
    for name in ("xl330_kp400_sin_sin", "xl330_kp400_lift_and_drop", "sts_kp8_sin"):
        (tmp_path / f"{name}.json").write_text(recording_text(False), encoding="utf-8")
    assert list(recordings_of(tmp_path, "xl330")) == ["kp400_sin_sin"]
    (recording,) = recordings_of(tmp_path, "sts").values()
    assert recording.pendulum == Pendulum(0.5, 0.1)
    assert recording.kp == 400
    assert recording.time.tolist() == [0.1, 0.2]
    assert recording.q.tolist() == [0.2, 0.4]
    assert recording.command.tolist() == [0.3, 0.6]


def test_an_error_is_that_of_the_recorded_samples():
    recording = commands(0.0)
    times = np.array([-1.0, 2.0])
    assert recording.error(times, np.array([0.01, 0.01])) == pytest.approx(0.01)
    assert recording.error(times, times) == pytest.approx(np.sqrt(1.0 / 3.0), rel=1e-2)


@pytest.mark.skipif(not REAL.is_dir(), reason="recordings of BAM are not here")
def test_real_recordings_are_read_whole():
    recordings = recordings_of(REAL, "xl330")
    assert {recording.kp for recording in recordings.values()} == {100, 400}
    for recording in recordings.values():
        assert recording.pendulum == ARM
        assert 5.9 < np.ptp(recording.time) < 6.1
        assert np.all(np.diff(recording.time) > 0.0)
        assert np.max(np.abs(recording.q)) < np.pi
        assert read(recording.path).q.tolist() == recording.q.tolist()
