"""Signals of a recording that contradict one another."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.checks.after_run import contradictions

PERIOD = 0.004
KP = 100.0
KD = 2.0
HEAD = "# kp={:g}\n# kd={:g}\n# registers_j0: MST_ID=17,PMAX=12.5,VMAX=10,TMAX=28\n"
TITLES = ["pos", "vel", "tau", "time", "cmd_pos", "cmd_vel", "cmd_tau", "cmd_mean"]
STEPS = {"pos": 25.0 / 65535, "vel": 20.0 / 4095, "tau": 56.0 / 4095}
AGES = [
    (0.075, 0.0, 0.0),
    (0.5, 0.0, 0.0),
    (1.0, 0.0, 0.0),
    (2.0, 0.0, 0.0),
    (0.0, 1.3, 0.0),
    (0.0, 0.0, 2.0),
    (0.3, 1.7, 0.6),
    (1.4, 0.2, 1.1),
    (2.0, 2.0, 2.0),
]
"""Ages of torque, position and velocity [cycles]; at kp 400 the first is 0.3 ms."""


def _path(time, size, slow, error):
    """Return commanded and true positions and velocities of a motion at times (N,)."""
    phase = time / slow
    command = size * np.sin(2.0 * phase)
    command_speed = 2.0 * size / slow * np.cos(2.0 * phase)
    position = command - size * error * np.sin(5.0 * phase + 0.3)
    speed = command_speed - 5.0 * size / slow * error * np.cos(5.0 * phase + 0.3)
    return command, command_speed, position, speed


def recording(
    folder,
    kp_share=1.0,
    kd_share=1.0,
    speed_share=1.0,
    reading=1.0,
    size=1.0,
    slow=1.0,
    error=0.02,
    fed=3.0,
    kp=KP,
    kd=KD,
    ages=(0.0, 0.0, 0.0),
    noise=0.0,
    lost=0.0,
):
    """Write the recording of a motor that follows a path, and return its path.

    Args:
        folder: in which it is written.
        kp_share, kd_share, speed_share: of stiffness, damping and velocity that there is.
        reading: reported torque over the motor's.
        size: of the motion [rad].
        slow: how many times as long as usual it takes.
        error: largest distance from the path, over the size of the motion.
        fed: largest feed-forward torque [N m].
        kp, kd: gains [N m/rad, N m s/rad].
        ages: of reported torque, position and velocity [cycles].
        noise: of the reported velocity [rad/s], and a tenth of it of the torque [N m].
        lost: share of commands that never arrive, after which none is sent for four cycles.
    """
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 6.0, PERIOD)
    n_rows = len(time)
    sent_row = np.arange(n_rows)
    heard_row = sent_row.copy()
    is_answered = np.ones(n_rows, bool)
    for row in np.flatnonzero(rng.random(n_rows) < lost):
        silent = slice(row, row + 5)
        is_answered[silent] = False
        # The recording knows of the lost command, the motor does not.
        sent_row[row + 1 : row + 6] = row + 1
        heard_row[row + 1 : row + 6] = row
    of_torque, of_position, of_velocity = (PERIOD * age for age in ages)
    # Commands are held from one row to the next.
    in_force = np.maximum(np.arange(n_rows) - int(ages[0]), 0)
    heard = time[heard_row[in_force]]
    command, command_speed, _, _ = _path(heard, size, slow, error)
    _, _, position, speed = _path(time - of_torque, size, slow, error)
    torque = fed * np.cos(1.3 * heard / slow) + kp_share * kp * (command - position)
    torque += kd_share * kd * (command_speed - speed)
    torque *= reading
    torque += (0.01 + 0.1 * noise) * rng.standard_normal(n_rows)
    sent = time[sent_row]
    command, command_speed, _, _ = _path(sent, size, slow, error)
    position = _path(time - of_position, size, slow, error)[2]
    speed = _path(time - of_velocity, size, slow, error)[3]
    speed = speed_share * speed + noise * rng.standard_normal(n_rows)
    torque_fed = fed * np.cos(1.3 * sent / slow)
    values = {
        "pos": STEPS["pos"] * np.rint(position / STEPS["pos"]),
        "vel": STEPS["vel"] * np.rint(speed / STEPS["vel"]),
        "tau": STEPS["tau"] * np.rint(torque / STEPS["tau"]),
        "time": time,
        "cmd_pos": command,
        "cmd_vel": STEPS["vel"] * np.rint(command_speed / STEPS["vel"]),
        "cmd_tau": STEPS["tau"] * np.rint(torque_fed / STEPS["tau"]),
        "cmd_mean": 0.0 * time,
    }
    for title in ("pos", "vel", "tau", "time"):
        values[title] = np.where(is_answered, values[title], np.nan)
    path = folder / "measured.csv"
    table = np.column_stack([time, *(values[title] for title in TITLES)])
    titles = ",".join(["time", *(f"j0_{title}" for title in TITLES)])
    rows = "\n".join(",".join(f"{cell:.6f}" for cell in row) for row in table)
    text = f"{HEAD.format(kp, kd)}{titles}\n{rows}\n".replace("nan", "")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("size", [1.0, 0.1, 0.01])
def test_a_sound_motor_contradicts_nothing_however_small_its_motion_is(tmp_path, size):
    assert contradictions(recording(tmp_path, size=size), ["joint1"]) == []


@pytest.mark.parametrize(
    ("size", "slow", "fed"),
    [
        (0.01, 8.0, 0.1),
        (0.02, 20.0, 0.15),
        (0.05, 8.0, 0.2),
        (0.05, 8.0, 3.0),
        (0.1, 30.0, 0.5),
        (0.2, 30.0, 0.5),
    ],
)
def test_a_slow_run_whose_values_stay_within_few_steps_contradicts_nothing(
    tmp_path, size, slow, fed
):
    log = recording(tmp_path, size=size, slow=slow, fed=fed)
    assert contradictions(log, ["joint1"]) == []


@pytest.mark.parametrize(
    ("shares", "words"),
    [
        ({"kd_share": 0.0}, "of its damping kd"),
        ({"kp_share": 0.67, "kd_share": 0.67}, "0.67 ± 0.00 of its stiffness kp"),
        ({"speed_share": 0.8}, "its positions move by 1.25 times"),
    ],
)
def test_what_a_motor_does_not_do_is_said_with_its_numbers(tmp_path, shares, words):
    texts = contradictions(recording(tmp_path, **shares), ["joint1"])
    assert texts and all(text.startswith("joint1: ") for text in texts)
    assert any(words in text for text in texts)


@pytest.mark.parametrize("ages", AGES)
@pytest.mark.parametrize("slow", [1.0, 5.0])
def test_signals_of_different_ages_contradict_nothing(tmp_path, ages, slow):
    for kp, kd, error in ((400.0, 5.0, 0.005), (20.0, 0.5, 0.02)):
        log = recording(tmp_path, slow=slow, kp=kp, kd=kd, ages=ages, error=error)
        assert contradictions(log, ["joint1"]) == []


@pytest.mark.parametrize(
    "shares", [{"kd_share": 0.0}, {"kp_share": 0.5}, {"reading": 1.3}]
)
@pytest.mark.parametrize("ages", AGES)
def test_a_wrong_gain_is_found_whatever_the_ages_are(tmp_path, ages, shares):
    log = recording(tmp_path, ages=ages, **shares)
    assert contradictions(log, ["joint1"]) != []


def test_noise_that_the_motor_does_not_see_is_no_missing_damping(tmp_path):
    noise = 0.2
    assert contradictions(recording(tmp_path, noise=noise), ["joint1"]) == []
    log = recording(tmp_path, noise=noise, kd_share=0.0)
    assert "of its damping kd" in contradictions(log, ["joint1"])[0]


@pytest.mark.parametrize("ages", [(0.0, 0.0, 0.0), (1.4, 0.2, 1.1)])
def test_lost_commands_contradict_nothing_and_hide_nothing(tmp_path, ages):
    log = recording(tmp_path, ages=ages, lost=0.02)
    assert contradictions(log, ["joint1"]) == []
    log = recording(tmp_path, ages=ages, lost=0.02, kd_share=0.0)
    assert "of its damping kd" in contradictions(log, ["joint1"])[0]
