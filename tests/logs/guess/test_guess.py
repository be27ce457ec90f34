"""Columns without telling titles are guessed, or left open with their candidates: never wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from robot_sysid.dynamics.inverse_dynamics import LinkDynamics
from robot_sysid.logs.column_map import ColumnChoices, read_columns_file
from robot_sysid.logs.guess import guess_columns
from robot_sysid.logs.table import Block, LogTable
from tests.support import arms

N_JOINTS = 4
ROBOT = arms.robot_of(arms.serial_arm(arms.SEVEN_AXES[:N_JOINTS]))
# Axes in another order: the same number of joints, another arm.
OTHER_ROBOT = arms.robot_of(arms.serial_arm((arms.X, arms.X, arms.Z, arms.X)))
DEGREES = 180.0 / np.pi
RATE = 100.0
GERMAN = {
    "time": "Zeit [s]",
    "position": "Gelenk {} Winkel [Grad]",
    "torque": "Gelenk {} Drehmoment [Nm]",
    "velocity": "Gelenk {} Geschwindigkeit [Grad/s]",
    "current": "Motorstrom {} [A]",
    "temperature": "Temperatur {} [°C]",
    "command": "Sollwinkel {} [Grad]",
}


def blocks(seed=1, degrees=False, ms=False):
    """Quantity to its columns (N, n or 1), as a sensor with noise reads them."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 8.0, 1.0 / RATE)
    omega = 2.0 * np.pi * np.array([0.23, 0.31, 0.41, 0.53])
    phase = np.outer(time, omega) + rng.uniform(0.0, 6.0, N_JOINTS)
    q = 0.9 * np.sin(phase)
    qd = 0.9 * omega * np.cos(phase)
    qdd = -(omega**2) * q
    # The model's masses are a guess: the arm's own are heavier.
    thetas = 1.2 * ROBOT.thetas
    tau = LinkDynamics(ROBOT).motion(q, qd, qdd).torque(thetas)
    size = np.std(tau, axis=0)
    tau = tau + 0.3 * size * np.sign(qd) + 0.02 * size * rng.normal(size=q.shape)
    angle = DEGREES if degrees else 1.0
    command = 0.9 * np.sin(phase + 0.03 * omega)
    return {
        "time": time[:, None] * (1e3 if ms else 1.0),
        "position": angle * (q + 1e-5 * rng.normal(size=q.shape)),
        "torque": tau,
        "velocity": angle * qd,
        "current": tau / rng.uniform(8.0, 15.0, N_JOINTS),
        "temperature": 30.0
        + np.outer(time, rng.uniform(0.1, 0.2, N_JOINTS))
        + 0.05 * rng.normal(size=q.shape),
        "command": angle * command,
    }


def table_of(columns, order, titles=None, in_turn=False):
    """(log, quantity to the numbers of its columns); ``in_turn`` lists joint after joint."""
    places = [(name, k) for name in order for k in range(columns[name].shape[1])]
    if in_turn:
        places.sort(key=lambda place: (place[0] != "time", place[1]))
    values = np.column_stack([columns[name][:, k] for name, k in places])
    texts = tuple(f"#{k}" for k in range(1, len(places) + 1))
    if titles:
        texts = tuple(titles[name].format(k + 1) for name, k in places)
    numbers = {}
    for number, (name, _) in enumerate(places, 1):
        numbers.setdefault(name, []).append(f"#{number}")

    def read(indices):
        yield Block(np.arange(1, len(values) + 1), values[:, list(indices)])

    return LogTable(Path("log.csv"), "table", texts, read), numbers


def guess(tmp_path, table, robot=ROBOT, choices=None, **options):
    """(text of the draft, its declarations; None where it holds a ?)."""
    text = guess_columns(table, robot, choices or ColumnChoices(), **options)
    lines = [line for line in text.split("\n") if not line.startswith("#")]
    if any("?" in line.partition("  # ")[0] for line in lines):
        return text, None
    path = tmp_path / "columns.txt"
    path.write_text(text, encoding="utf-8")
    return text, read_columns_file(path, robot.joint_names)


def test_a_numbered_t_may_be_a_torque(tmp_path):
    titles = {"time": "t", "position": "p{}", "torque": "t{}"}
    table, numbers = table_of(blocks(), tuple(titles), titles)
    _, declared = guess(tmp_path, table)
    assert declared == guess(tmp_path, table_of(blocks(), tuple(titles))[0])[1]
    assert numbers["torque"] == ["#6", "#7", "#8", "#9"]


EXTRAS = ("velocity", "current", "temperature", "command")


@settings(max_examples=8, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(
    st.integers(0, 1000),
    st.permutations(("time", "position", "torque")),
    st.sets(st.sampled_from(EXTRAS)),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
def test_shuffled_blocks_without_titles_are_never_guessed_wrong(
    tmp_path_factory, seed, order, extras, degrees, ms, in_turn
):
    order = [*order, *sorted(extras)]
    np.random.default_rng(seed).shuffle(order)
    columns = blocks(seed, degrees, ms)
    table, numbers = table_of(columns, order, in_turn=in_turn)
    text, choices = guess(tmp_path_factory.getbasetemp(), table)
    torque = ", ".join(numbers["torque"])
    if "command" in extras:  # Equal positions: which one is measured is for the user.
        assert choices is None
        assert "comes after" in text and "position = ?, ?, ?, ?" in text
        return
    assert choices is not None, text
    assert choices.time == numbers["time"][0]
    for quantity in ("position", "torque", *({"velocity"} & extras)):
        assert list(choices.columns[quantity].values()) == numbers[quantity], torque
    assert choices.angle_unit == ("deg" if degrees else None)
    assert choices.time_unit == ("ms" if ms else None)


def test_titles_in_another_language_are_enough_and_odd_units_are_factors(tmp_path):
    columns = blocks(degrees=True)
    table, numbers = table_of(columns, list(GERMAN), GERMAN)
    # The numbers are of another arm, and the titles outrank them.
    robot = replace(OTHER_ROBOT, joint_names=("base", "shoulder", "elbow", "wrist"))
    text, choices = guess(tmp_path, table, robot)
    assert choices is not None and choices.time == "#1"
    assert list(choices.columns["torque"].values()) == numbers["torque"]
    scaled = [f"0.0174532925 * {number}" for number in numbers["position"]]
    assert list(choices.columns["position"].values()) == scaled
    assert "# by the titles" in text


@pytest.mark.parametrize("name", ["Achse {}", "{}"])
def test_joints_with_letters_are_taken_from_a_to_d(tmp_path, name):
    columns = blocks()
    titles = {
        "time": "Zeit",
        "position": f"Winkel {name}",
        "torque": f"Moment [Nm] {name}",
    }
    table, numbers = table_of(columns, list(titles), titles)
    letters = dict(zip("1234", "ABCD"))
    texts = [text[:-1] + letters.get(text[-1], text[-1]) for text in table.titles]
    _, choices = guess(tmp_path, replace(table, titles=tuple(texts)))
    assert choices is not None
    for quantity in ("position", "torque"):
        assert list(choices.columns[quantity].values()) == numbers[quantity]


def test_a_commanded_position_is_taken_by_its_title(tmp_path):
    columns = blocks()
    titles = {"time": "t", "position": "q{}", "command": "Vorgabe {} Rest"}
    table, numbers = table_of(columns, list(titles), titles)
    _, choices = guess(tmp_path, table, commanded=True)
    assert choices is not None
    assert list(choices.columns["command"].values()) == numbers["command"]


def changed(name, change):
    columns = blocks()
    columns[name] = change(columns[name])
    return columns


def flip_second(tau):
    return tau * [1.0, -1.0, 1.0, 1.0]


def test_a_log_without_a_complete_row_is_guessed_by_its_titles(tmp_path):
    table, _ = table_of(blocks(), ("time", "position", "torque"))
    text, choices = guess(tmp_path, replace(table, blocks=lambda indices: iter(())))
    assert choices is None
    assert "position = ?, ?, ?, ?" in text


@pytest.mark.parametrize(
    ("columns", "order", "robot", "reasons"),
    [
        (blocks(), "time position torque", OTHER_ROBOT, ["no columns follow"]),
        (
            changed("torque", lambda tau: 1e3 * tau),
            "time torque position",
            ROBOT,
            ["times the model's torque", "0.001 *", "--torque-constants"],
        ),
        (
            changed("position", lambda q: 0.0 * q),
            "time position torque",
            ROBOT,
            ["position = ?, ?, ?, ?"],
        ),
        (
            changed("torque", flip_second),
            "time position torque",
            ROBOT,
            ["joint1: #7 or -#7, whose sign is the model's", "torque = #6, ?, #8, #9"],
        ),
        (
            changed("time", lambda time: np.arange(len(time))[:, None]),
            "time position torque",
            ROBOT,
            ["time = ?", "#1 counts rows or ms"],
        ),
        (blocks(), "position torque", ROBOT, ["rate = ?", "torque = #5-8"]),
        (blocks(), "time position current", ROBOT, ["motor current"]),
        (blocks(), "time position temperature", ROBOT, ["torque = ?"]),
    ],
    ids=[
        "another arm",
        "mN m",
        "standing",
        "sign",
        "row number",
        "no time",
        "current",
        "no torque",
    ],
)
def test_what_is_not_certain_is_left_open_with_its_candidates(
    tmp_path, columns, order, robot, reasons
):
    table, _ = table_of(columns, order.split())
    text, choices = guess(tmp_path, table, robot)
    assert choices is None
    for reason in reasons:
        assert reason in text
