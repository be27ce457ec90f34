"""Cards for controllers, read back by each target's own definition: the same body every time."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from lxml import etree
from scipy.spatial.transform import Rotation

from robot_sysid.dynamics import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records import Flange, InertialParameters
from robot_sysid.results.cards import (
    ERROR_NAMES,
    FORMS,
    NOT_KNOWN,
    card_text,
    is_inertia_known,
    load_errors,
    payload_cards,
    principal_moments,
)
from robot_sysid.results.record import BodyEstimate
from tests.support.arms import SEEDS, random_rotation

FLANGE = Flange("site 'tool'", np.eye(3), np.array([0.0, 0.0, 0.107]), "link7")
COVARIANCE = np.diag(np.square([0.0153, *[2e-4] * 3, *[1e-4] * 6]))
KINDS = (
    "any",
    "nearly round",
    "nearly a disc",
    "round",
    "rod",
    "point",
    "tiny",
    "heavy",
)


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


def symmetric(xx, yy, zz, xy, xz, yz):
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def floats(text):
    return [
        float(word) for word in re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?", text)
    ]


def turned(rotation, moments):
    axes = rotation.as_matrix()
    return axes @ np.diag(moments) @ axes.T


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
    turn = Rotation.from_euler(
        "ZYX", [a, b, c], degrees=True
    )  # each about the axes so far
    return mass, 1e-3 * np.array([x, y, z]), turned(turn, moments)


def read_abb(text):
    mass, com, (w, x, y, z), *moments = json.loads(text)
    return mass, 1e-3 * np.array(com), turned(Rotation.from_quat([x, y, z, w]), moments)


def read_point(text):
    mass, *com = floats(text)
    return mass, 1e-3 * np.array(com), None


def read_urdf(text):
    element = etree.fromstring(text)
    origin = element.find("origin")
    six = element.find("inertia")
    assert origin.get("rpy") == "0 0 0"
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    inertia = symmetric(*(float(six.get(name)) for name in names))
    return float(element.find("mass").get("value")), floats(origin.get("xyz")), inertia


def read_mjcf(text):
    element = etree.fromstring(text)
    six = floats(element.get("fullinertia") or element.get("diaginertia") + " 0 0 0")
    return float(element.get("mass")), floats(element.get("pos")), symmetric(*six)


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
}


def body_of(mass, com, inertia, covariance=COVARIANCE, seen=10):
    """A body of whose parameters the first are shown."""
    theta = InertialParameters(spatial.theta_from_com(mass, np.array(com), inertia))
    return BodyEstimate("it", theta, covariance, np.arange(10) < seen, np.zeros(10))


def cards_of(mass, com, inertia, flange=FLANGE, seen=10):
    body = body_of(mass, com, inertia, seen=seen)
    return {card.name: card for card in payload_cards(body, flange)}


@given(SEEDS, st.sampled_from(KINDS))
def test_every_card_gives_the_body_back(seed, kind):
    mass, com, inertia = random_body(np.random.default_rng(seed), kind)
    cards = cards_of(mass, com, inertia)
    assert (
        list(cards)
        == ["payload", *(form.name for form in FORMS)]
        == ["payload", *READERS]
    )
    # An inertia about a distant origin knows the one about the centre of mass to its own rounding.
    rounding = 1e-14 * mass * (com @ com)
    for name, read in READERS.items():
        found_mass, found_com, found_inertia = read(cards[name].text)
        assert found_mass == pytest.approx(mass, rel=1e-6, abs=0.0), name
        np.testing.assert_allclose(found_com, com, rtol=1e-6, atol=1e-9, err_msg=name)
        if found_inertia is not None:
            # Angles have their own digits; single elements keep theirs.
            exact = name not in ("kuka_load", "abb_loaddata")
            slack = (1e-11 if exact else 1e-6) * np.max(np.abs(inertia)) + rounding
            limits = {"rtol": 1e-8 if exact else 0.0, "atol": slack}
            np.testing.assert_allclose(found_inertia, inertia, err_msg=name, **limits)


def leaves(value):
    if isinstance(value, (dict, list)):
        parts = value.values() if isinstance(value, dict) else value
        return [leaf for part in parts for leaf in leaves(part)]
    return [value]


@given(SEEDS, st.sampled_from(KINDS))
def test_the_values_are_the_numbers_of_the_text_which_has_no_exponents(seed, kind):
    cards = cards_of(*random_body(np.random.default_rng(seed), kind))
    for name in READERS:
        values = json.loads(json.dumps(cards[name].values, allow_nan=False))
        assert set(leaves(values)) <= set(floats(cards[name].text)), name
        if "inertial" not in name:  # controllers do not all read them
            assert not re.search(r"\d[eE]", cards[name].text), cards[name].text


def test_a_whole_card_says_what_it_has_to():
    flange = Flange(
        "site 'tool'", np.eye(3), FLANGE.translation, "link7", note="found by name"
    )
    cards = cards_of(
        1.517, [0.001, -0.02, 0.0453], np.diag([2e-3, 2.5e-3, 1e-3]), flange
    )
    text = card_text(list(cards.values()), "A heading.")
    assert text.startswith("A heading.\n\n== Payload ==\n") and text.endswith("\n")
    for said in (
        *(
            "site 'tool': origin at 0.0, 0.0, 0.107 m",
            "of body 'link7'",
            "# found by name",
        ),
        "mass            1.517 kg",
        "Standard errors: mass 0.015 kg; centre of mass 0.13, 0.24, 0.48 mm.",
        "set_target_payload(1.517, [0.001, -0.02, 0.0453], [0.002, 0.0025, 0.001, 0.0, 0.0, 0.0])",
        *(
            "SetPayload(1.517, 1.0, -20.0, 45.3)",
            "arm.set_tcp_load(1.517, [1.0, -20.0, 45.3])",
        ),
    ):
        assert said in text, said
    assert max(len(line) for line in text.splitlines() if line.startswith("#")) <= 100
    errors = cards["payload"].values["standard_errors"]
    assert errors["com_z"] == pytest.approx(4.8e-4, rel=0.01) and len(errors) == 10


def test_a_round_body_is_not_turned():
    body = spatial.aluminium_ball(0.3, np.array([-0.0011, -0.0033, 0.1445]))
    card = cards_of(*spatial.com_from_theta(body))["kuka_load"]
    assert [card.values["CM"][name] for name in "ABC"] == [0.0, 0.0, 0.0]


def test_every_card_states_how_far_each_of_its_numbers_may_be_off():
    """... or that it is not known; two take no inertia."""
    body = 1.517, [0.001, -0.02, 0.0453], np.diag([2e-3, 2.5e-3, 1e-3])
    for seen, inertia in (
        (10, "xx 0.00011, xy 0.0001, xz 0.0001, yy 0.00011, yz"),
        (4, NOT_KNOWN),
    ):
        for name, card in cards_of(*body, seen=seen).items():
            note = " ".join(card.notes)
            assert note.startswith("Standard errors: mass 0.015 kg; centre of mass "), (
                name
            )
            takes_none = name in ("xarm_set_tcp_load", "mecademic_set_payload")
            turned = name in ("kuka_load", "abb_loaddata") and seen == 10
            axes = "turn about the axes X, Y, Z 3.9, 5.8, 11 degrees; moments 0.00011, 0.00011, 0"
            assert ((axes if turned else inertia) in note) != takes_none, name
    known = cards_of(*body, seen=4)["payload"].values["standard_errors"]
    assert [name for name, each in known.items() if each is None] == list(known)[4:]


@pytest.mark.parametrize(("largest", "is_refused"), [(133.0, False), (133.001, True)])
def test_what_a_ur_controller_refuses_is_said(largest, is_refused):
    inertia = np.diag([100.0, 120.0, largest])
    cards = cards_of(50.0, np.zeros(3), inertia)
    for name, card in cards.items():
        refused = [note for note in card.notes if "may exceed 133." in note]
        assert bool(refused) == (is_refused and name.startswith("ur_")), name


@pytest.mark.parametrize(
    ("mass", "moments"),
    [(0.0, (1, 1, 1)), (-1.0, (1, 1, 1)), (1.0, (1, 1, 2.1)), (1.0, (1, 1, -0.1))],
)
def test_no_controller_gets_an_impossible_body(mass, moments):
    with pytest.raises(
        ExportError, match="not a possible rigid body, so there is no card"
    ):
        cards_of(mass, [0.1, 0.0, 0.0], np.diag(np.array(moments, dtype=float)))


def random_estimate(seed):
    """(a body, a factor of its covariance, which is small)."""
    rng = np.random.default_rng(seed)
    factor = 1e-7 * rng.normal(size=(10, 10))
    return body_of(*random_body(rng, "any"), factor @ factor.T), factor


def spread_of(outcome, theta, factor):
    """Standard errors of what follows from theta, by finite differences along the factor."""
    both = [(outcome(theta + each), outcome(theta - each)) for each in factor.T]
    return np.linalg.norm([0.5 * (a - b) for a, b in both], axis=0)


@given(SEEDS)
def test_errors_of_place_and_inertia_follow_from_those_of_theta(seed):
    body, factor = random_estimate(seed)

    def outcome(theta):
        mass, com, inertia = spatial.com_from_theta(theta)
        return np.array([mass, *com, *spatial.six_from_symmetric(inertia)])

    found = load_errors(body)
    expected = spread_of(outcome, body.inertial.theta, factor)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert ERROR_NAMES[:5] == ("mass", "com_x", "com_y", "com_z", "Ixx_about_com")


@pytest.mark.parametrize("mass_error", [0.1, 0.3, 0.5])
def test_intervals_of_a_centre_of_mass_hold_where_the_mass_is_hardly_known(mass_error):
    rng = np.random.default_rng(0)
    inertia = np.eye(3)
    com = np.array([0.1, -0.05, 0.2])
    errors = np.concatenate(([mass_error], np.full(3, 0.005), np.full(6, 1e-6)))
    is_held = []
    for mass in 1.0 + mass_error * rng.standard_normal(2000):
        # Torques show the first moment, whatever the mass is.
        first_moment = com + errors[1:4] * rng.standard_normal(3)
        if mass > 0.0:
            body = body_of(mass, first_moment / mass, inertia, np.diag(errors**2))
            is_held.append(
                np.abs(body.inertial.com - com) < 1.96 * load_errors(body)[1:4]
            )
    assert 0.93 <= np.mean(is_held) <= 0.98


@given(SEEDS)
def test_errors_of_moments_and_axes_are_those_of_the_turned_matrix(seed):
    body, factor = random_estimate(seed)
    moments, errors, turns = principal_moments(body)
    values, axes = np.linalg.eigh(body.inertial.inertia_com)
    order = [int(np.argmin(np.abs(values - each))) for each in moments]
    assume(np.min(np.diff(values)) > 1e-3 * values[-1])

    def outcome(theta):
        """Moments, and by how much each axis leans to the next one."""
        own, now = np.linalg.eigh(spatial.com_from_theta(theta)[2])
        lean = np.cross(
            axes[:, order].T, (now * np.sign(np.sum(now * axes, axis=0)))[:, order].T
        )
        about = np.stack([lean[(k + 1) % 3] @ axes[:, order[k]] for k in range(3)])
        return np.array([*own[order], *np.degrees(about)])

    expected = spread_of(outcome, body.inertial.theta, factor)
    np.testing.assert_allclose([*errors, *turns], expected, rtol=1e-2)


@pytest.mark.parametrize(
    ("moments", "error", "seen", "is_known"),
    [
        ((1e-3, 1e-3, 1e-3), 0.39e-3, 10, True),
        ((1e-3, 1e-3, 1e-3), 0.41e-3, 10, False),
        ((1e-9, 1e-3, 1e-3), 0.39e-3, 10, True),  # a rod
        (
            (1e-9, 1e-3, 1e-3),
            1.2e-3,
            10,
            False,
        ),  # what only the bound of a possible body holds up
        ((1e-3, 1e-3, 1e-3), 1e-9, 4, False),
    ],
)
def test_inertia_is_known_where_one_moment_is_told_from_zero(
    moments, error, seen, is_known
):
    covariance = np.diag([0.0] * 4 + [error**2] * 6)
    body = body_of(1.0, np.zeros(3), np.diag(moments), covariance, seen)
    assert is_inertia_known(body) == is_known
