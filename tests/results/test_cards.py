"""Cards for controllers, read back by the definition of each controller, give the body again."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from lxml import etree
from numpy.testing import assert_allclose
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
from robot_sysid.results.record import BodyEstimate, Payload
from tests.support.arms import SEEDS, random_rotation

FLANGE = Flange("site 'tool'", np.eye(3), np.array([0.0, 0.0, 0.107]), "link7")
COVARIANCE = np.diag(np.square([0.0153, *[2e-4] * 3, *[1e-4] * 6]))
SHAPES = [
    "any",
    "nearly round",
    "nearly a disc",
    "round",
    "rod",
    "point",
    "tiny",
    "heavy",
]


def random_body(rng, shape):
    """Mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2] of a possible body."""
    second_moments = {
        "any": rng.uniform(0.01, 1.0, 3),
        "nearly round": 0.3 + 10.0 ** rng.uniform(-14, -6) * rng.uniform(size=3),
        "nearly a disc": np.array([0.5, 0.5 + 10.0 ** rng.uniform(-14, -6), 0.01]),
        "round": np.full(3, 0.2),
        "rod": np.array([1.0, 0.0, 0.0]),
        "point": np.zeros(3),
        "tiny": 1e-3 * rng.uniform(0.1, 1.0, 3),
        "heavy": 50.0 * rng.uniform(0.1, 1.0, 3),
    }[shape]
    mass = {"tiny": 1e-3, "heavy": 40.0}.get(shape, rng.uniform(0.1, 5.0))
    axes = random_rotation(rng)
    spread = axes @ np.diag(0.01 * mass * second_moments) @ axes.T
    inertia = np.trace(spread) * np.eye(3) - spread
    return mass, 0.2 * rng.normal(size=3), inertia


def symmetric(xx, yy, zz, xy, xz, yz):
    """The symmetric matrix (3, 3) of its six elements."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def floats(text):
    """All numbers of a text."""
    return [
        float(number)
        for number in re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?", text)
    ]


def rotate_moments(rotation, moments):
    """The inertia (3, 3) of principal moments (3,) whose axes are turned by a rotation."""
    axes = rotation.as_matrix()
    return axes @ np.diag(moments) @ axes.T


# Readers return the mass [kg], centre of mass (3,) [m] and inertia about it (3, 3) [kg m^2].


def read_franka(text):
    """Read a body from setLoad: mass, centre of mass, inertia by columns."""
    mass, *numbers = floats(text)
    return mass, numbers[:3], np.reshape(numbers[3:], (3, 3), order="F")


def read_desk(text):
    """Read a body from an end effector of Franka Desk, in the flange frame."""
    content = json.loads(text)
    assert content["transformation"] == np.eye(4).ravel().tolist()
    inertia = np.reshape(content["inertia"], (3, 3), order="F")
    return content["mass"], content["centerOfMass"], inertia


def read_six(text):
    """Read a body from its mass, centre of mass and elements xx, yy, zz, xy, xz, yz."""
    mass, *numbers = floats(text)
    return mass, numbers[:3], symmetric(*numbers[3:])


def read_kuka(text):
    """Read a body from principal moments about axes turned by A, B, C [deg]; lengths in mm."""
    assert re.sub(r"-?[\d.]+", "#", text) == (
        "{M #, CM {X #, Y #, Z #, A #, B #, C #}, J {X #, Y #, Z #}}"
    )
    mass, x, y, z, a, b, c, *moments = floats(text)
    # Each angle turns about the axes that the ones before it have turned.
    rotation = Rotation.from_euler("ZYX", [a, b, c], degrees=True)
    return mass, 1e-3 * np.array([x, y, z]), rotate_moments(rotation, moments)


def read_abb(text):
    """Read a body from loaddata: principal moments, axes as a quaternion, lengths in mm."""
    mass, com, (w, x, y, z), *moments = json.loads(text)
    rotation = Rotation.from_quat([x, y, z, w])
    return mass, 1e-3 * np.array(com), rotate_moments(rotation, moments)


def read_point(text):
    """Read a mass and a centre of mass in mm; the card has no inertia."""
    mass, *com = floats(text)
    return mass, 1e-3 * np.array(com), None


def read_urdf(text):
    """Read a body from an inertial element of a URDF without rotation."""
    element = etree.fromstring(text)
    origin = element.find("origin")
    tensor = element.find("inertia")
    assert origin.get("rpy") == "0 0 0"
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    inertia = symmetric(*(float(tensor.get(name)) for name in names))
    return float(element.find("mass").get("value")), floats(origin.get("xyz")), inertia


def read_mjcf(text):
    """Read a body from an inertial element of an MJCF."""
    element = etree.fromstring(text)
    tensor = floats(element.get("fullinertia") or element.get("diaginertia") + " 0 0 0")
    return float(element.get("mass")), floats(element.get("pos")), symmetric(*tensor)


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


WITH_AXES = ("kuka_load", "abb_loaddata")
"""Cards that state principal moments and the turn of their axes."""

EXAMPLE = (1.517, [0.001, -0.02, 0.0453], np.diag([2e-3, 2.5e-3, 1e-3]))
"""Mass, centre of mass and inertia about it of the body whose cards are read line by line."""


def body_estimate(mass, com, inertia, covariance=COVARIANCE, n_identified=10):
    """A body of whose ten parameters the first n_identified are identified."""
    theta = InertialParameters(spatial.theta_from_com(mass, np.array(com), inertia))
    return BodyEstimate(
        "it", theta, covariance, np.arange(10) < n_identified, np.zeros(10)
    )


def cards_by_name(mass, com, inertia, flange=FLANGE, n_identified=10):
    """The cards of a body (kg, m, kg m^2) by name."""
    body = body_estimate(mass, com, inertia, n_identified=n_identified)
    return {card.name: card for card in payload_cards(body, flange)}


@given(SEEDS, st.sampled_from(SHAPES))
def test_every_card_read_back_is_the_body(seed, shape):
    mass, com, inertia = random_body(np.random.default_rng(seed), shape)
    cards = cards_by_name(mass, com, inertia)
    assert list(cards) == ["payload", *READERS]
    assert [form.name for form in FORMS] == list(READERS)
    # An inertia about a distant origin knows the one about the centre of mass to its own rounding.
    rounding = 1e-14 * mass * (com @ com)
    size = np.max(np.abs(inertia))
    for name, read in READERS.items():
        card_mass, card_com, card_inertia = read(cards[name].text)
        assert card_mass == pytest.approx(mass, rel=1e-6, abs=0.0), name
        assert_allclose(card_com, com, rtol=1e-6, atol=1e-9, err_msg=name)
        if card_inertia is None:
            continue
        # Angles have their own digits; single elements keep theirs.
        rtol, share = (0.0, 1e-6) if name in WITH_AXES else (1e-8, 1e-11)
        atol = share * size + rounding
        assert_allclose(card_inertia, inertia, rtol, atol, err_msg=name)


def leaves(value):
    """All values of nested lists and dictionaries."""
    if isinstance(value, (dict, list)):
        children = value.values() if isinstance(value, dict) else value
        return [leaf for child in children for leaf in leaves(child)]
    return [value]


@given(SEEDS, st.sampled_from(SHAPES))
def test_values_of_a_card_are_the_numbers_of_its_text_without_exponents(seed, shape):
    cards = cards_by_name(*random_body(np.random.default_rng(seed), shape))
    for name in READERS:
        values = json.loads(json.dumps(cards[name].values, allow_nan=False))
        assert set(leaves(values)) <= set(floats(cards[name].text)), name
        if "inertial" not in name:  # controllers do not all read them
            assert not re.search(r"\d[eE]", cards[name].text), cards[name].text


def test_a_card_states_flange_mass_errors_and_commands():
    flange = replace(FLANGE, note="found by name")
    cards = cards_by_name(*EXAMPLE, flange)
    body = body_estimate(*EXAMPLE)
    recordings = {"empty": ("a",), "loaded": ("b", "c")}
    payload = Payload(flange, body, body, body, recordings)
    heading, text = card_text(list(cards.values()), payload, "m.xml").split("\n\n", 1)
    assert heading == (
        "Payload of 1.517 ± 0.015 kg, identified with m.xml from 1 empty and 2 loaded "
        "recordings."
    )
    assert text.startswith("== Payload ==\n") and text.endswith("\n")
    for phrase in (
        "site 'tool': origin at 0.0, 0.0, 0.107 m",
        "of body 'link7'",
        "# found by name",
        "mass            1.517 kg",
        "Standard errors: mass 0.015 kg; centre of mass 0.13, 0.24, 0.48 mm.",
        "set_target_payload(1.517, [0.001, -0.02, 0.0453], [0.002, 0.0025, 0.001, 0.0, 0.0, 0.0])",
        "SetPayload(1.517, 1.0, -20.0, 45.3)",
        "arm.set_tcp_load(1.517, [1.0, -20.0, 45.3])",
    ):
        assert phrase in text, phrase
    assert max(len(line) for line in text.splitlines() if line.startswith("#")) <= 100
    errors = cards["payload"].values["standard_errors"]
    assert errors["com_z"] == pytest.approx(4.8e-4, rel=0.01) and len(errors) == 10


def test_a_round_body_is_not_turned():
    body = spatial.aluminium_ball(0.3, np.array([-0.0011, -0.0033, 0.1445]))
    card = cards_by_name(*spatial.com_from_theta(body))["kuka_load"]
    assert [card.values["CM"][name] for name in "ABC"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("n_identified", "inertia_note"),
    [(10, "xx 0.00011, xy 0.0001, xz 0.0001, yy 0.00011, yz"), (4, NOT_KNOWN)],
)
def test_every_card_states_the_standard_errors_of_its_numbers(
    n_identified, inertia_note
):
    """An inertia that is not identified is said to be not known; two cards take no inertia."""
    cards = cards_by_name(*EXAMPLE, n_identified=n_identified)
    axes_note = (
        "turn about the axes X, Y, Z 3.9, 5.8, 11 degrees; moments 0.00011, 0.00011, 0"
    )
    for name, card in cards.items():
        note = " ".join(card.notes)
        assert note.startswith("Standard errors: mass 0.015 kg; centre of mass "), name
        has_axes = name in WITH_AXES and n_identified == 10
        expected_note = axes_note if has_axes else inertia_note
        assert (expected_note in note) != (READERS.get(name) is read_point), name
    errors = cards["payload"].values["standard_errors"].values()
    assert [error is None for error in errors] == [k >= n_identified for k in range(10)]


@pytest.mark.parametrize(("largest", "is_refused"), [(133.0, False), (133.001, True)])
def test_an_inertia_that_a_ur_controller_refuses_is_noted(largest, is_refused):
    inertia = np.diag([100.0, 120.0, largest])
    cards = cards_by_name(50.0, np.zeros(3), inertia)
    for name, card in cards.items():
        refused = [note for note in card.notes if "may exceed 133." in note]
        assert bool(refused) == (is_refused and name.startswith("ur_")), name


@pytest.mark.parametrize(
    ("mass", "moments"),
    [(0.0, (1, 1, 1)), (-1.0, (1, 1, 1)), (1.0, (1, 1, 2.1)), (1.0, (1, 1, -0.1))],
)
def test_an_impossible_body_has_no_card(mass, moments):
    with pytest.raises(
        ExportError, match="not a possible rigid body, so there is no card"
    ):
        cards_by_name(mass, [0.1, 0.0, 0.0], np.diag(np.array(moments, dtype=float)))


def random_body_estimate(seed):
    """A random body with a small covariance (10, 10), and a factor of the covariance."""
    rng = np.random.default_rng(seed)
    factor = 1e-7 * rng.normal(size=(10, 10))
    return body_estimate(*random_body(rng, "any"), factor @ factor.T), factor


def propagated_errors(outcome, theta, factor):
    """Standard errors of outcome(theta), by central differences along columns of the factor."""
    changes = [outcome(theta + step) - outcome(theta - step) for step in factor.T]
    return 0.5 * np.linalg.norm(changes, axis=0)


@given(SEEDS)
def test_errors_of_centre_of_mass_and_inertia_follow_from_those_of_theta(seed):
    body, factor = random_body_estimate(seed)

    def outcome(theta):
        mass, com, inertia = spatial.com_from_theta(theta)
        return np.array([mass, *com, *spatial.six_from_symmetric(inertia)])

    errors = load_errors(body)
    expected = propagated_errors(outcome, body.inertial.theta, factor)
    assert_allclose(errors, expected, rtol=1e-4)
    assert ERROR_NAMES[:5] == ("mass", "com_x", "com_y", "com_z", "Ixx_about_com")


@pytest.mark.parametrize("mass_error", [0.1, 0.3, 0.5])
def test_intervals_of_a_centre_of_mass_cover_it_where_the_mass_is_uncertain(mass_error):
    rng = np.random.default_rng(0)
    inertia = np.eye(3)
    com = np.array([0.1, -0.05, 0.2])
    errors = np.concatenate(([mass_error], np.full(3, 0.005), np.full(6, 1e-6)))
    is_held = []
    for mass in 1.0 + mass_error * rng.standard_normal(2000):
        # Torques show the first moment, whatever the mass is.
        first_moment = com + errors[1:4] * rng.standard_normal(3)
        if mass > 0.0:
            body = body_estimate(mass, first_moment / mass, inertia, np.diag(errors**2))
            is_held.append(
                np.abs(body.inertial.com - com) < 1.96 * load_errors(body)[1:4]
            )
    assert 0.93 <= np.mean(is_held) <= 0.98


@given(SEEDS)
def test_errors_of_principal_moments_and_axes_follow_from_those_of_theta(seed):
    body, factor = random_body_estimate(seed)
    moments, errors, angle_errors = principal_moments(body)
    eigenvalues, axes = np.linalg.eigh(body.inertial.inertia_com)
    order = [int(np.argmin(np.abs(eigenvalues - moment))) for moment in moments]
    assume(np.min(np.diff(eigenvalues)) > 1e-3 * eigenvalues[-1])

    axes = axes[:, order]

    def outcome(theta):
        """Principal moments, and the small angles [deg] by which their axes have turned."""
        eigenvalues, vectors = np.linalg.eigh(spatial.com_from_theta(theta)[2])
        cosines = axes.T @ vectors[:, order]
        x, y, z = cosines * np.sign(np.diag(cosines))
        return np.array([*eigenvalues[order], *np.degrees([z[1], x[2], y[0]])])

    expected = propagated_errors(outcome, body.inertial.theta, factor)
    assert_allclose([*errors, *angle_errors], expected, rtol=1e-2)


@pytest.mark.parametrize(
    ("moments", "error", "n_identified", "is_known"),
    [
        ((1e-3, 1e-3, 1e-3), 0.39e-3, 10, True),
        ((1e-3, 1e-3, 1e-3), 0.41e-3, 10, False),
        ((1e-9, 1e-3, 1e-3), 0.39e-3, 10, True),  # a rod
        # A rod whose moments are smaller than their standard errors.
        ((1e-9, 1e-3, 1e-3), 1.2e-3, 10, False),
        ((1e-3, 1e-3, 1e-3), 1e-9, 4, False),
    ],
)
def test_inertia_is_known_where_one_moment_differs_significantly_from_zero(
    moments, error, n_identified, is_known
):
    covariance = np.diag([0.0] * 4 + [error**2] * 6)
    body = body_estimate(1.0, np.zeros(3), np.diag(moments), covariance, n_identified)
    assert is_inertia_known(body) == is_known
