"""Signals of a recording that contradict one another."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.damiao.checks.after_run import contradictions

KP = 100.0
KD = 2.0
HEAD = "# kp=100\n# kd=2\n# registers_j0: MST_ID=17,PMAX=12.5,VMAX=10,TMAX=28\n"
TITLES = ["pos", "vel", "tau", "time", "cmd_pos", "cmd_vel", "cmd_tau", "cmd_mean"]
STEPS = {"pos": 25.0 / 65535, "vel": 20.0 / 4095, "tau": 56.0 / 4095}


def recording(
    folder, kp_share=1.0, kd_share=1.0, speed_share=1.0, size=1.0, slow=1.0, fed=3.0
):
    """Write the recording of a motor that follows a path, and return its path.

    Args:
        folder: in which it is written.
        kp_share, kd_share, speed_share: of stiffness, damping and velocity that there is.
        size: of the motion [rad].
        slow: how many times as long as usual it takes.
        fed: largest feed-forward torque [N m].
    """
    time = np.arange(0.0, 6.0, 0.004)
    phase = time / slow
    rng = np.random.default_rng(0)
    command = size * np.sin(2.0 * phase)
    command_speed = 2.0 * size / slow * np.cos(2.0 * phase)
    position = command - size * 0.02 * np.sin(5.0 * phase + 0.3)
    speed = command_speed - size / slow * 0.1 * np.cos(5.0 * phase + 0.3)
    torque_fed = fed * np.cos(1.3 * phase)
    torque = torque_fed + kp_share * KP * (command - position)
    torque += kd_share * KD * (command_speed - speed)
    torque += 0.01 * rng.standard_normal(len(time))
    values = {
        "pos": STEPS["pos"] * np.rint(position / STEPS["pos"]),
        "vel": STEPS["vel"] * np.rint(speed_share * speed / STEPS["vel"]),
        "tau": STEPS["tau"] * np.rint(torque / STEPS["tau"]),
        "time": time,
        "cmd_pos": command,
        "cmd_vel": STEPS["vel"] * np.rint(command_speed / STEPS["vel"]),
        "cmd_tau": STEPS["tau"] * np.rint(torque_fed / STEPS["tau"]),
        "cmd_mean": 0.0 * time,
    }
    path = folder / "measured.csv"
    table = np.column_stack([time, *(values[title] for title in TITLES)])
    titles = ",".join(["time", *(f"j0_{title}" for title in TITLES)])
    rows = "\n".join(",".join(f"{cell:.6f}" for cell in row) for row in table)
    path.write_text(f"{HEAD}{titles}\n{rows}\n", encoding="utf-8")
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
