"""Commands that positions follow as those of a servo are accepted, and others are refused."""

import numpy as np
import pytest
from scipy.signal import lfilter

from robot_sysid.errors import InputError
from robot_sysid.records import Recording
from robot_sysid.servo.command_check import check_commands
from robot_sysid.servo.loop import low_pass_motion

TIME = np.arange(500) / 50.0
SLOW_WAVES = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0]))
COMMAND = SLOW_WAVES + 0.1 * np.sin(np.outer(TIME, [7.0, 8.0]))
RNG = np.random.default_rng(0)
NOISE = 1e-4 * RNG.normal(size=COMMAND.shape)
NAMES = ("base", "tip")


def delay(values, samples):
    return np.vstack((np.repeat(values[:1], samples, axis=0), values))[: len(values)]


def log(q, command, time=TIME):
    return Recording(time, q, None, command - q, command=command, name="log.csv")


FOLLOWED = delay(COMMAND, 2) + NOISE


def test_commands_that_are_followed_are_accepted():
    """A joint that stands still is no fault."""
    followed = log(FOLLOWED, COMMAND)
    check_commands([followed], NAMES)
    _, qd, _ = low_pass_motion(followed)
    expected = np.gradient(FOLLOWED, 0.02, axis=0)
    assert qd[100] == pytest.approx(expected[100], abs=0.05)
    still = np.column_stack((FOLLOWED[:, 0], np.full(len(TIME), 0.3)))
    check_commands([log(still, np.round(still, 1))], NAMES)


ENCODER_STEPS = COMMAND * 4096 / (2 * np.pi) + 2048
FUTURE = np.vstack((FOLLOWED[1:], FOLLOWED[-1:]))
COPIED = ("repeat the measured", "were sent")


@pytest.mark.parametrize("rate", [25.0, 250.0, 1000.0])
def test_the_rate_of_a_log_decides_nothing(rate):
    """Positions of a soft servo follow about 0.14 s late (kd/kp); exchanged, they lead."""
    time = np.arange(0.0, 10.0, 1.0 / rate)
    command = 0.4 * np.sin(np.outer(time, [2.0, 3.0])) + np.sin(
        np.outer(time, [0.5, 0.4])
    )
    decay = np.exp(-1.0 / (0.14 * rate))
    late = lfilter([1.0 - decay], [1.0, -decay], command, axis=0)
    check_commands([log(late, command, time)], NAMES)
    with pytest.raises(InputError, match=r"commands come -0\.1"):
        check_commands([log(command, late, time)], NAMES)


@pytest.mark.parametrize(
    ("q", "command", "message_parts"),
    [
        (
            FOLLOWED,
            np.degrees(COMMAND),
            ("57.3 times as much (deg", "--units", "0.01745"),
        ),
        (
            FOLLOWED,
            ENCODER_STEPS,
            ("652 times as much (deg", "steps of 4096", "--columns"),
        ),
        (FOLLOWED, FOLLOWED, COPIED),
        (FOLLOWED, FUTURE, COPIED),
        (delay(COMMAND, 30), COMMAND, ("0.6 s before", "0.5 s")),
        (COMMAND + NOISE, delay(COMMAND, 3), ("-0.06 s before", "exchanged")),
        (FOLLOWED, RNG.normal(size=COMMAND.shape), ("correlation of -0.0",)),
        (FOLLOWED, -COMMAND, ("change -1", "sign")),
        (FOLLOWED, COMMAND + 1.0, ("differ by 1 ", "zeros")),
    ],
)
def test_implausible_commands_are_refused(q, command, message_parts):
    # The commands of the other joint are plausible.
    commands = np.column_stack((COMMAND[:, 0], command[:, 1]))
    positions = np.column_stack((FOLLOWED[:, 0], q[:, 1]))
    with pytest.raises(InputError) as error:
        check_commands([log(positions, commands)], NAMES)
    message = str(error.value)
    assert "log.csv" in message and "\n" not in message
    assert all(word in message for word in message_parts), message
