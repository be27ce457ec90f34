"""Which gain leaves less dead band and sag, found by playing the model of each servo.

Each joint gets a step of its command and is then held, in the poses in which it carries most and in
which the links that it turns have the largest and the smallest inertia, up and down, with so many
times its gain and with numbers drawn from what the fit knows: a gain is advised where nearly all of
them come to rest without much overshoot. What is then left follows from the formulas of the printed
dead band and sag. The model has no delay within its loop: gains are not raised far beyond the
recording's, from which the model is.

n is the number of joints, p that of poses of each, c that of gains, d that of draws.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.records import Array, Recording, RobotModel
from robot_sysid.records.messages import number_text, with_error
from robot_sysid.records.servo_setting import ServoSetting
from robot_sysid.servo.derived import derived_numbers, drawn_poses, torque_at_rest
from robot_sysid.servo.fit import LARGEST_ERROR, ServoFit
from robot_sysid.servo.play import Tracks, inertia_columns, make_tracks, play
from robot_sysid.servo.unknowns import LEAST, MOST, column, numbers_at
from robot_sysid.servo.windows import HIDDEN

TIMES = (1.0, 1.5, 2.0, 3.0, 4.0)
"""Gains that are played, over the recording's."""
ENOUGH = np.radians(0.5)
"""Dead band, or sag, that needs no advice [rad]: the play that the makers of an SO-101 state, 3 mm
at the hand of a small arm."""
LEAST_SHARE = 0.8
"""Share of the larger one of both above which what is left is not worth a higher gain."""
STEP = 0.1
"""Step of the command [rad]: a brisk motion at 30 Hz."""
HOLD = 2.0
"""Time for which a command is held behind its step [s]."""
RATE = 100.0
"""Played positions that are judged in a second [Hz]."""
AT_REST = 0.5
"""Time at the end in which a joint has to be at rest [s]."""
MUCH = 0.2
"""Share of a step that is much overshoot, or swing: a damping ratio below 0.45."""
DRAWS = 20
"""Sets of numbers that are played beside those of the fit."""
SURE_SHARE = 0.95
"""Share of them that has to come to rest: what a printed ± of two errors holds."""
NUMBERS = ("dead_band", "sag")
"""Numbers that a gain makes smaller."""


@dataclass(frozen=True)
class Left:
    """What a gain leaves.

    Attributes:
        times: the gain over the recording's.
        at_rest: share of the played sets of numbers that come to rest without much overshoot.
        numbers: name to dead band and sag [rad]; those that are known.
    """

    times: float
    at_rest: float
    numbers: dict[str, float]


@dataclass(frozen=True)
class Advice:
    """What makes the dead band and sag of a joint smaller.

    Attributes:
        joint: its name.
        errors: name to standard error [rad] of dead band and sag, those that are known.
        left: what each gain leaves, the recording's first.
        chosen: number in ``left`` of the gain that is advised; zero for none.
        swings: whether the next gain swings.
        register: of the gain in the recording; None where it is not known.
    """

    joint: str
    errors: dict[str, float]
    left: tuple[Left, ...]
    chosen: int
    swings: bool
    register: float | None

    @property
    def line(self) -> str:
        """The advice as a sentence, without an end mark."""
        numbers = []
        for name, value in self.left[0].numbers.items():
            angle = with_error(_degrees(value), _degrees(self.errors[name]))
            numbers.append(f"{name.replace('_', ' ')} {angle}")
        if self.chosen:
            chosen = self.left[self.chosen]
            outcome = f"{self._gain(chosen.times)} would leave {self._numbers(chosen)}"
        elif self.swings:
            outcome = "more gain swings"
        elif self.left[1].at_rest < SURE_SHARE:
            outcome = "whether more gain swings is not known"
        else:
            outcome = "more gain leaves nearly as much"
        return f"{self.joint}: {', '.join(numbers)} degrees; {outcome}"

    def register_at(self, times: float) -> float | None:
        """Return the register of so many times the gain; None where it is not known."""
        return None if self.register is None else float(round(self.register * times))

    def _gain(self, times: float) -> str:
        """Return a gain in words."""
        register = self.register_at(times)
        if register is None:
            return f"{times:g} times the gain"
        return f"P = {register:g} ({times:g} times)"

    def _numbers(self, left: Left) -> str:
        """Return what a gain leaves, with the digits that its errors deserve."""
        texts = []
        for name, value in left.numbers.items():
            error = self.errors[name] * value / self.left[0].numbers[name]
            texts.append(number_text(_degrees(value), _degrees(error)))
        return " and ".join(texts)

    def json_content(self) -> dict[str, Any]:
        """Return the record of servo.json."""
        chosen = self.left[self.chosen].times if self.chosen else None
        return {
            "of": self.joint,
            "errors": self.errors,
            "gains": [
                {
                    "times": left.times,
                    "register": self.register_at(left.times),
                    "at_rest": left.at_rest,
                    **left.numbers,
                }
                for left in self.left
            ],
            "advised": chosen,
            "swings": self.swings,
        }


def _degrees(angle: float) -> float:
    """Return an angle in degrees."""
    return float(np.degrees(angle))


def advice_of(robot: RobotModel, fit: ServoFit, setting: ServoSetting) -> list[Advice]:
    """Return advice on the hinges of an arm that have more dead band or sag than ``ENOUGH``.

    Nothing is said of joints of which neither is known.

    Args:
        robot: the arm as in the model file.
        fit: of its servos.
        setting: of the recording whose gains the fit has.
    """
    at_times = [derived_numbers(robot, fit, times) for times in TIMES]
    now = at_times[0]
    is_known = {
        name: fit.is_known
        & (now[name].values > HIDDEN)
        & (now[name].errors <= LARGEST_ERROR * now[name].values)
        for name in NUMBERS
    }
    # What the servo's largest torque does not carry falls, whatever its gain.
    is_known["sag"] &= now["torque_over_weight"].values > 1.0
    needs = np.any([is_known[k] & (now[k].values > ENOUGH) for k in NUMBERS], axis=0)
    joints = np.flatnonzero(needs & ~robot.is_slide).tolist()
    if not joints:
        return []
    at_rest, is_best_at_rest = comes_to_rest(robot, fit, joints)
    advice = []
    for k, joint in enumerate(joints):
        names = [name for name in NUMBERS if is_known[name][joint]]
        left = tuple(
            Left(
                times,
                float(share),
                {name: float(numbers[name].values[joint]) for name in names},
            )
            for times, numbers, share in zip(TIMES, at_times, at_rest[:, k])
        )
        chosen = _chosen(left)
        advice.append(
            Advice(
                joint=robot.joint_names[joint],
                errors={name: float(now[name].errors[joint]) for name in names},
                left=left,
                chosen=chosen,
                swings=not chosen and not is_best_at_rest[1, k],
                register=setting.register,
            )
        )
    return advice


def _chosen(left: tuple[Left, ...]) -> int:
    """Return the number of the least gain that leaves enough, else of the highest that comes to
    rest; zero where none does, or the highest is not worth it.
    """
    count = next(
        (k for k, each in enumerate(left) if each.at_rest < SURE_SHARE), len(left)
    )
    for k in range(count):
        if max(left[k].numbers.values()) <= ENOUGH:
            return k
    last = max(count - 1, 0)
    largest = max(left[0].numbers.values())
    return last if max(left[last].numbers.values()) <= LEAST_SHARE * largest else 0


def comes_to_rest(
    robot: RobotModel, fit: ServoFit, joints: list[int]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return how surely joints come to rest behind a step of their command, by gain.

    They are the shares (c, j) of the sets of numbers with which joints do so in all of their poses,
    and whether they do with those of the fit (c, j).
    """
    tracks = step_tracks(robot, joints)
    count = len(tracks)
    tracks = tracks.at(np.tile(np.arange(count), len(TIMES)))
    tracks = replace(tracks, scale=np.repeat(TIMES, count))
    numbers = _drawn_numbers(fit)[:, tracks.joint]
    direction = np.sign(tracks.command[-1] - tracks.command[0])
    # Each begins at rest, where it holds its weight.
    gain = numbers[..., column("gain")] * tracks.scale
    limit = numbers[..., column("torque_limit")] * numbers[..., column("gain")]
    sag = np.clip(tracks.torque[0], -limit, limit) / gain
    start = np.zeros((len(numbers), 2, len(tracks)))
    start[:, 0] = -STEP * direction - sag
    errors = np.zeros((len(numbers), len(tracks), len(tracks.errors)))
    missed = play(tracks, numbers, errors, start) * direction[:, None]
    end = missed[..., -round(AT_REST * RATE) :]
    overshoot = np.max(missed, axis=2) - np.mean(end, axis=2)
    swing = np.ptp(end, axis=2)
    is_at_rest = np.maximum(overshoot, swing) <= MUCH * STEP
    by_joint = [tracks.joint.reshape(len(TIMES), -1)[0] == joint for joint in joints]
    by_gain = is_at_rest.reshape(len(numbers), len(TIMES), -1)
    together = np.stack([np.all(by_gain[..., own], axis=2) for own in by_joint], axis=2)
    return np.mean(together, axis=0), together[0]


def _drawn_numbers(fit: ServoFit) -> Array:
    """Return numbers (d + 1, n, u) of a fit, and those drawn from what it knows if the links are
    those of the file; without delays and zeros, which do not change how a step ends.
    """
    normal = np.random.default_rng(0).normal(size=(DRAWS, *fit.x.shape))
    values, axes = np.linalg.eigh(fit.given_links)
    root = axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    drawn = fit.x_given_links + np.einsum("nuk,dnk->dnu", root, normal)
    x = np.concatenate((fit.x_given_links[None], np.clip(drawn, LEAST, MOST)))
    numbers = numbers_at(x)
    numbers[..., column("gain")] *= fit.likely_gain
    for name in ("command_delay", "zero"):
        numbers[..., column(name)] = 0.0
    return numbers


def step_tracks(robot: RobotModel, joints: list[int]) -> Tracks:
    """Return tracks of joints that are commanded by a step up, or down, to each of their poses."""
    q = drawn_poses(robot)
    poses = _extreme_poses(robot, q)
    time = np.arange(0.0, HOLD, 1.0 / RATE)
    pieces = []
    owners = []
    for joint in joints:
        for pose in poses[:, joint]:
            for direction in (1.0, -1.0):
                still = np.tile(q[pose], (len(time), 1))
                command = still.copy()
                command[0] -= direction * STEP
                pieces.append(
                    Recording(time, still, None, command - still, command=command)
                )
                owners.append(joint)
    tracks = make_tracks(robot, pieces, HOLD, len(pieces))
    piece = np.repeat(np.arange(len(pieces)), robot.n_joints)
    return tracks.at(np.flatnonzero(tracks.joint == np.array(owners)[piece]))


def _extreme_poses(robot: RobotModel, q: Array) -> NDArray[np.int64]:
    """Return the numbers (p, n) of those poses q (m, n) in which each joint carries most, and has
    the largest and the smallest inertia.
    """
    weight = np.abs(torque_at_rest(robot, q, robot.thetas))
    inertia = inertia_columns(LinkDynamics(robot), q) @ robot.thetas.ravel()
    return np.stack(
        (weight.argmax(axis=0), inertia.argmax(axis=0), inertia.argmin(axis=0))
    )


def advice_lines(advice: list[Advice]) -> Iterator[str]:
    """Yield the printed lines of advice."""
    if not advice:
        return
    yield "Advice (what is left in the worst poses, simulated with more gain):"
    for each in advice:
        yield f"  {each.line}"
    if any(each.left[0].numbers.get("sag", 0.0) > ENOUGH for each in advice):
        yield (
            "  Adding the links' torque over the gain to the commands (feed-forward of the weight) "
            "takes off the sag and leaves the dead band"
        )
