"""Cards for controllers, read back by each target's own definition: the same body every time."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Flange, InertialParameters
from robot_sysid.results.cards import FORMS, card_entries, card_text, load_errors, payload_cards
from robot_sysid.results.record import BodyEstimate
from tests.support.arms import SEEDS, random_rotation

FLANGE = Flange("site 'tool'", np.eye(3), np.array([0.0, 0.0, 0.107]), "link7")
KINDS = ("any", "nearly round", "nearly a disc", "round", "rod", "point", "tiny", "heavy")


def random_body(rng, kind):
    """(mass, centre of mass, inertia about it) of a body that can exist."""
    second = {
        "any": rng.uniform(0.01, 1.0, 3),
        "nearly round": 0.3 + 10.0 ** rng.uniform(-14, -6) * rng.uniform(size=3),
        "nearly a disc": np.array([0.5, 0.5 + 10.0 ** rng.uniform(-14, -6), 0.01]),
        "round": np.full(3, 0.2),
        "rod": np.array([1.0, 0.0, 0.0]),
        "point": np.zeros(3),
        "tiny": 1e-3 * rng.uniform(0.1, 1.0, 3),
        "heavy": 50.0 * rng.uniform(0.1, 1.0, 3),
    }[kind]
    mass = {"tiny": 1e-3, "heavy": 40.0}.get(kind, rng.uniform(0.1, 5.0))
    axes = random_rotation(rng)
    spread = axes @ np.diag(0.01 * mass * second) @ axes.T
    return mass, 0.2 * rng.normal(size=3), np.trace(spread) * np.eye(3) - spread


def theta_of(mass, com, inertia):
    """theta by the definition of the parallel-axis theorem, written out."""
    x, y, z = com
    shift = mass * np.array(
        [
            [y * y + z * z, -x * y, -x * z],
            [-x * y, x * x + z * z, -y * z],
            [-x * z, -y * z, x * x + y * y],
        ]
    )
    full = inertia + shift
    return np.array([mass, *(mass * com), *full[np.triu_indices(3)]])


def symmetric(xx, yy, zz, xy, xz, yz):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def floats(text):
    return [float(word) for word in re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?", text)]


def about(axis, degrees):
    """Turn about a coordinate axis."""
    i, j = [(1, 2), (2, 0), (0, 1)]["XYZ".index(axis)]
    matrix = np.eye(3)
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix[i, i] = matrix[j, j] = cosine
    matrix[i, j], matrix[j, i] = -sine, sine
    return matrix


def of_quaternion(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_franka(text):
    mass, *rest = floats(text)
    return mass, rest[:3], np.reshape(rest[3:], (3, 3), order="F")


def read_desk(text):
    content = json.loads(text)
    assert content["transformation"] == np.eye(4).ravel().tolist()
    inertia = np.reshape(content["inertia"], (3, 3), order="F")
    return content["mass"], content["centerOfMass"], inertia


def read_six(text):
    mass, *rest = floats(text)
    return mass, rest[:3], symmetric(*rest[3:])


def read_kuka(text):
    assert re.sub(r"-?[\d.]+", "#", text) == (
        "{M #, CM {X #, Y #, Z #, A #, B #, C #}, J {X #, Y #, Z #}}"
    )
    mass, x, y, z, a, b, c, *moments = floats(text)
    axes = about("Z", a) @ about("Y", b) @ about("X", c)
    return mass, 1e-3 * np.array([x, y, z]), axes @ np.diag(moments) @ axes.T


def read_abb(text):
    mass, com, turn, *moments = json.loads(text)
    axes = of_quaternion(*turn)
    return mass, 1e-3 * np.array(com), axes @ np.diag(moments) @ axes.T


def read_point(text):
    mass, *com = floats(text)
    return mass, 1e-3 * np.array(com), None


def read_urdf(text):
    element = etree.fromstring(text)
    origin, six = element.find("origin"), element.find("inertia")
    assert origin.get("rpy") == "0 0 0"
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    inertia = symmetric(*(float(six.get(name)) for name in names))
    return float(element.find("mass").get("value")), floats(origin.get("xyz")), inertia


def read_mjcf(text):
    element = etree.fromstring(text)
    six = floats(element.get("fullinertia") or element.get("diaginertia") + " 0 0 0")
    return float(element.get("mass")), floats(element.get("pos")), symmetric(*six)


def read_pinocchio(text):
    first, second = text.splitlines()
    mass, *rest = floats(first)
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = floats(second)
    com = np.array([mx, my, mz]) / m
    again = symmetric(xx, yy, zz, xy, xz, yz) - m * (com @ com * np.eye(3) - np.outer(com, com))
    inertia = np.reshape(rest[3:], (3, 3))
    np.testing.assert_allclose(again, inertia, rtol=0.0, atol=1e-13 * (1.0 + m))
    np.testing.assert_allclose([m, *com], [mass, *rest[:3]], rtol=1e-12)
    return mass, rest[:3], inertia


READERS = {
    "franka_set_load": read_franka,
    "franka_end_effector": read_desk,
    "ur_set_target_payload": read_six,
    "ur_msgs_set_payload": read_six,
    "kuka_load": read_kuka,
    "abb_loaddata": read_abb,
    "xarm_set_tcp_load": read_point,
    "mecademic_set_payload": read_point,
    "urdf_inertial": read_urdf,
    "mjcf_inertial": read_mjcf,
    "pinocchio_inertia": read_pinocchio,
    "drake_spatial_inertia": read_six,
}


def cards_of(theta, errors=None, flange=FLANGE):
    return {card.name: card for card in payload_cards(InertialParameters(theta), flange, errors)}


def test_every_form_has_a_reader():
    assert [form.name for form in FORMS] == list(READERS)


@given(SEEDS, st.sampled_from(KINDS))
def test_every_card_gives_the_body_back(seed, kind):
    mass, com, inertia = random_body(np.random.default_rng(seed), kind)
    cards = cards_of(theta_of(mass, com, inertia))
    # An inertia about a distant origin knows the one about the centre of mass to its own rounding.
    rounding = 1e-14 * mass * (com @ com)
    for name, read in READERS.items():
        found_mass, found_com, found_inertia = read(cards[name].text)
        assert found_mass == pytest.approx(mass, rel=1e-6, abs=0.0), name
        np.testing.assert_allclose(found_com, com, rtol=1e-6, atol=1e-9, err_msg=name)
        if found_inertia is not None:
            slack = 1e-6 * np.max(np.abs(inertia)) + rounding
            np.testing.assert_allclose(found_inertia, inertia, rtol=0.0, atol=slack, err_msg=name)


@given(SEEDS, st.sampled_from(KINDS))
def test_single_elements_keep_their_digits_too(seed, kind):
    mass, com, inertia = random_body(np.random.default_rng(seed), kind)
    cards = cards_of(theta_of(mass, com, inertia))
    atol = 1e-11 * np.max(np.abs(inertia)) + 1e-14 * mass * (com @ com)
    for name in set(READERS) - {"kuka_load", "abb_loaddata", "xarm_set_tcp_load"}:
        found = READERS[name](cards[name].text)[2]
        if found is not None:
            np.testing.assert_allclose(found, inertia, rtol=1e-8, atol=atol, err_msg=name)


def leaves(value):
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    if isinstance(value, list):
        return [leaf for part in value for leaf in leaves(part)]
    return [value]


@given(SEEDS, st.sampled_from(KINDS))
def test_the_entries_hold_the_numbers_of_the_text(seed, kind):
    cards = payload_cards(
        InertialParameters(theta_of(*random_body(np.random.default_rng(seed), kind))), FLANGE
    )
    entries = json.loads(json.dumps(card_entries(cards), allow_nan=False))
    assert list(entries) == ["payload", *READERS]
    for card in cards[1:]:
        entry = entries[card.name]
        assert entry["text"] == card.text
        assert set(leaves(entry["values"])) <= set(floats(card.text)), card.name


@given(SEEDS, st.sampled_from(KINDS))
def test_what_goes_to_a_controller_has_no_exponents(seed, kind):
    cards = cards_of(theta_of(*random_body(np.random.default_rng(seed), kind)))
    for name in list(READERS)[2:8]:
        assert not re.search(r"\d[eE]", cards[name].text), cards[name].text


@given(SEEDS)
def test_principal_axes_stay_near_the_flanges(seed):
    """A body that is aligned with the flange turns nothing, whatever the order of its moments."""
    second = np.random.default_rng(seed).uniform(0.01, 1.0, 3)
    inertia = np.diag(np.sum(second) - second)
    cards = cards_of(theta_of(1.0, np.zeros(3), inertia))
    assert [cards["kuka_load"].values["CM"][name] for name in "ABC"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(list(cards["kuka_load"].values["J"].values()), np.diag(inertia))
    assert cards["abb_loaddata"].values["aom"] == [1.0, 0.0, 0.0, 0.0]


def test_franka_is_column_by_column_and_ur_is_xx_yy_zz_first():
    """Six different elements, so that no other order gives the same numbers."""
    inertia = symmetric(0.5, 0.6, 0.7, 0.01, 0.02, 0.03)
    cards = cards_of(theta_of(1.0, np.array([0.1, 0.2, 0.3]), inertia))
    assert cards["ur_set_target_payload"].values["inertia"] == [0.5, 0.6, 0.7, 0.01, 0.02, 0.03]
    names = ["ixx", "iyy", "izz", "ixy", "ixz", "iyz"]
    assert [cards["ur_msgs_set_payload"].values[n] for n in names] == [
        *(0.5, 0.6, 0.7, 0.01, 0.02, 0.03)
    ]
    assert cards["franka_set_load"].values["load_inertia"] == [
        *(0.5, 0.01, 0.02, 0.01, 0.6, 0.03, 0.02, 0.03, 0.7)
    ]
    assert cards["urdf_inertial"].text.index("ixz") < cards["urdf_inertial"].text.index("iyy")
    assert 'fullinertia="0.5' in cards["mjcf_inertial"].text


def test_a_whole_card_says_what_it_has_to():
    theta = theta_of(1.517, np.array([0.001, -0.02, 0.0453]), np.diag([2e-3, 2.5e-3, 1e-3]))
    errors = {"mass": 0.0153, "com_x": 1e-4, "com_y": 2e-4, "com_z": np.inf}
    cards = payload_cards(InertialParameters(theta), FLANGE, errors)
    text = card_text(cards, ["A heading."])
    assert text.startswith("A heading.\n\n== Payload ==\n") and text.endswith("\n")
    assert "site 'tool': origin at 0.0, 0.0, 0.107 m" in text and "of body 'link7'" in text
    assert "mass            1.517 kg" in text
    assert "Standard errors: mass 0.015 kg; centre of mass 0.0001, 0.0002, not known m." in text
    assert "Standard errors: mass 0.015 kg; centre of mass 0.1, 0.2, not known mm." in text
    assert "set_target_payload(1.517, [0.001, -0.02, 0.0453], [0.002, 0.0025, 0.001, 0" in text
    assert "SetPayload(1.517, 1.0, -20.0, 45.3)" in text
    assert "arm.set_tcp_load(1.517, [1.0, -20.0, 45.3])" in text
    assert "never as both" in text
    assert max(len(line) for line in text.splitlines() if line.startswith("#")) <= 100
    assert text == card_text(
        payload_cards(InertialParameters(theta), FLANGE, errors), ["A heading."]
    )


def test_errors_that_nobody_gave_are_not_made_up():
    cards = cards_of(theta_of(1.0, np.zeros(3), np.eye(3)))
    assert "Standard errors" not in card_text(list(cards.values()))
    assert cards["payload"].values["standard_errors"] is None


def test_how_the_flange_was_chosen_stands_in_the_card():
    flange = Flange("body 'link7'", np.eye(3), np.zeros(3), "link7", note="nothing looks like one")
    cards = cards_of(theta_of(1.0, np.zeros(3), np.eye(3)), flange=flange)
    assert "nothing looks like one" in cards["payload"].notes


@given(SEEDS)
def test_a_point_mass_has_clean_zeros_and_says_so(seed):
    theta = theta_of(*random_body(np.random.default_rng(seed), "point"))
    cards = cards_of(theta)
    assert cards["ur_set_target_payload"].values["inertia"] == [0.0] * 6
    assert 'diaginertia="0 0 0"' in cards["mjcf_inertial"].text
    assert "every card states a point mass" in cards["payload"].notes[-1]


def test_what_a_ur_controller_refuses_is_said():
    light, heavy = (cards_of(theta_of(50.0, np.zeros(3), k * np.eye(3))) for k in (132.9, 133.1))
    for name in ("ur_set_target_payload", "ur_msgs_set_payload"):
        assert light[name].notes == ()
        assert "no element of the inertia may exceed 133" in heavy[name].notes[0]
    assert heavy["kuka_load"].notes == ()


@pytest.mark.parametrize(
    ("mass", "moments"),
    [(0.0, (1, 1, 1)), (-1.0, (1, 1, 1)), (1.0, (1, 1, 2.1)), (1.0, (1, 1, -0.1))],
)
def test_no_controller_gets_an_impossible_body(mass, moments):
    theta = theta_of(mass, np.array([0.1, 0.0, 0.0]), np.diag(np.array(moments, dtype=float)))
    with pytest.raises(ExportError, match="not a possible rigid body, so there is no card"):
        cards_of(theta)


@given(SEEDS)
def test_errors_of_the_centre_of_mass_follow_from_those_of_theta(seed):
    rng = np.random.default_rng(seed)
    theta = theta_of(*random_body(rng, "any"))
    factor = rng.normal(size=(10, 10))
    shown = np.ones(10, dtype=bool)
    body = BodyEstimate("it", InertialParameters(theta), factor @ factor.T, shown, np.zeros(10))
    found = load_errors(body)
    step = 1e-6

    def outcome(values):
        return np.array([values[0], *(values[1:4] / values[0])])

    slopes = [
        (outcome(theta + step * unit) - outcome(theta - step * unit)) / (2.0 * step)
        for unit in np.eye(10)
    ]
    expected = np.linalg.norm(np.transpose(slopes) @ factor, axis=1)
    np.testing.assert_allclose(list(found.values()), expected, rtol=1e-6)
    assert list(found) == ["mass", "com_x", "com_y", "com_z"]


def test_the_readers_of_these_tests_agree_with_scipy():
    rotation = Rotation.from_euler("ZYX", [20.0, -40.0, 70.0], degrees=True)
    ours = about("Z", 20.0) @ about("Y", -40.0) @ about("X", 70.0)
    np.testing.assert_allclose(ours, rotation.as_matrix(), rtol=0.0, atol=1e-15)
    x, y, z, w = rotation.as_quat()
    np.testing.assert_allclose(of_quaternion(w, x, y, z), ours, rtol=0.0, atol=1e-15)
    theta = theta_of(2.0, np.array([0.1, 0.2, 0.3]), np.eye(3))
    expected = spatial.theta_from_com(2.0, np.array([0.1, 0.2, 0.3]), np.eye(3))
    np.testing.assert_allclose(theta, expected, rtol=0.0, atol=1e-15)
