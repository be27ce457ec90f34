"""Commands that cannot be what they seem are refused in one line that says why."""

from types import SimpleNamespace

import numpy as np
import pytest

from robot_sysid.errors import InputError
from robot_sysid.records import Measurement
from robot_sysid.servo.run import commanded_pieces, moving
from robot_sysid.servo.search import smoothed

TIME = np.arange(500) / 50.0
COMMAND = 0.5 * np.sin(np.outer(TIME, [2.0, 3.0])) + 0.1 * np.sin(np.outer(TIME, [7.0, 8.0]))
RNG = np.random.default_rng(0)


def late(values, samples):
    return np.vstack((np.repeat(values[:1], samples, axis=0), values))[: len(values)]


def log(q, command):
    part = Measurement(TIME, q, None, command - q, command=command)
    return SimpleNamespace(path="log.csv", pieces=(part,))


def followed(samples=2):
    return late(COMMAND, samples) + 1e-4 * RNG.normal(size=COMMAND.shape)


MEASURED = followed()


def test_commands_that_are_followed_are_taken():
    pieces = commanded_pieces([log(followed(), COMMAND)], ("base", "tip"))
    assert len(pieces) == 1 and moving(pieces).all()
    _, qd = smoothed(pieces[0])
    assert qd[100] == pytest.approx(np.gradient(followed(), 0.02, axis=0)[100], abs=0.05)


@pytest.mark.parametrize(
    ("q", "command", "words"),
    [
        (followed(), np.degrees(COMMAND), ("degrees", "--units", "0.01745")),
        (followed(), COMMAND * 4096 / (2 * np.pi) + 2048, ("steps of 4096", "--columns")),
        (MEASURED, MEASURED, ("repeat the measured", "no real commands")),
        (MEASURED, np.vstack((MEASURED[1:], MEASURED[-1:])), ("repeat", "no real commands")),
        (late(COMMAND, 14), COMMAND, ("14 samples before", "10")),
        (COMMAND + 1e-4 * RNG.normal(size=COMMAND.shape), late(COMMAND, 3), ("exchanged",)),
        (followed(), RNG.normal(size=COMMAND.shape), ("not followed",)),
        (followed(), -COMMAND, ("sign",)),
        (followed(), COMMAND + 1.0, ("same zero",)),
    ],
)
def test_what_is_wrong_with_commands_is_said(q, command, words):
    # The other joint is as it should be.
    given, measured = COMMAND.copy(), followed()
    given[:, 1], measured[:, 1] = command[:, 1], q[:, 1]
    with pytest.raises(InputError) as caught:
        commanded_pieces([log(measured, given)], ("base", "tip"))
    message = str(caught.value)
    assert "log.csv" in message and "\n" not in message
    assert all(word in message for word in words), message


def test_a_joint_that_stands_still_is_no_fault():
    q, command = followed(), COMMAND.copy()
    q[:, 1] = command[:, 1] = 0.3
    assert moving(commanded_pieces([log(q, command)], ("base", "tip"))).tolist() == [True, False]
