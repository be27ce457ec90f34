"""Cards for controllers, read back by the definition of each controller, give the body again."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rigs.arms.bodies import SHAPES, body_estimate, card_of, random_body
from rigs.arms.small_arms import SEEDS
from rigs.files import results as made
from robot_sysid import spatial
from robot_sysid.errors import ExportError
from robot_sysid.records.quantities import load_errors
from robot_sysid.results.cards import card_text, number_groups

EXACT = np.eye(10) * 1e-40
"""Covariance of a body that is known to the last digit."""


def symmetric(xx, yy, zz, xy, xz, yz):
    """The symmetric matrix (3, 3) of its six elements."""
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def floats(text):
    """All numbers of a text."""
    numbers = re.findall(r"(?<![\w.])-?\d+\.?\d*(?:e[+-]?\d+)?", text)
    return [*map(float, numbers)]


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


def read_kinova(text):
    """Read a mass and a centre of mass in m; the card has no inertia."""
    assert re.sub(r"-?[\d.]+", "#", text) == (
        "PayloadInformation(payload_mass=#, payload_mass_center=Position(x=#, y=#, z=#))"
    )
    mass, *com = floats(text)
    return mass, com, None


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


READERS = (
    *(read_franka, read_desk, read_six, read_six, read_kuka, read_kinova),
    *(read_point, read_abb, read_point, read_urdf, read_mjcf),
)
"""A reader for each card, in their order."""
WITH_AXES = (read_kuka, read_abb)
"""Readers of cards that state principal moments and the turn of their axes."""


def bodies_in(body):
    """Yield each card's reader and what it reads: mass, centre of mass and inertia."""
    _, *cards = card_of(body, "all").split("\n== ")
    numbers = [card.strip().splitlines()[-1] for card in cards]
    # Not all controllers read a number with an exponent.
    assert not re.search(r"\d[eE][-+\d]", "".join(numbers))
    assert len(cards) == len(READERS)
    for read, number in zip(READERS, numbers):
        yield read, read(number)


@given(SEEDS, st.sampled_from(SHAPES))
def test_every_card_of_an_exact_body_read_back_is_the_body(seed, shape):
    mass, com, inertia = random_body(np.random.default_rng(seed), shape)
    # An inertia about a distant origin knows the one about the centre of mass to its own rounding.
    rounding = 1e-14 * mass * (com @ com)
    size = np.max(np.abs(inertia))
    for read, found in bodies_in(body_estimate(mass, com, inertia, EXACT)):
        card_mass, card_com, card_inertia = found
        name = read.__name__
        assert card_mass == pytest.approx(mass, rel=1e-6, abs=0.0), name
        assert_allclose(card_com, com, rtol=1e-6, atol=1e-9, err_msg=name)
        if card_inertia is None:
            continue
        # Angles have their own digits; a quaternion has six decimals.
        share = {read_abb: 4e-6, read_kuka: 1e-6}.get(read, 1e-8)
        assert_allclose(card_inertia, inertia, 0.0, share * size + rounding, name)


@given(SEEDS, st.sampled_from(SHAPES), st.floats(1e-4, 0.5))
def test_cards_are_rounded_by_less_than_their_errors_to_a_possible_body(
    seed, shape, share
):
    mass, com, inertia = random_body(np.random.default_rng(seed), shape)
    moment = max(np.max(np.abs(inertia)), 1e-9)
    scale = np.array([mass, *[0.1 * mass] * 3, *[moment] * 6])
    body = body_estimate(mass, com, inertia, np.diag(np.square(share * scale)))
    errors = load_errors(body)
    for read, (card_mass, card_com, card_inertia) in bodies_in(body):
        assert abs(card_mass - mass) <= 0.051 * errors[0]
        assert np.all(np.abs(np.subtract(card_com, com)) <= 0.051 * errors[1:4] + 1e-9)
        if card_inertia is None or read in WITH_AXES:
            continue
        off = spatial.six_from_symmetric(np.asarray(card_inertia) - inertia)
        assert np.all(np.abs(off) <= 0.051 * errors[4:] + 1e-12)
        moments = np.linalg.eigvalsh(card_inertia)
        least = np.linalg.eigvalsh(inertia)[0]
        assert 2.0 * moments[-1] - np.sum(moments) <= 2e-6 * np.sum(moments) + 1e-15
        assert moments[0] >= 0.49 * least - 1e-15


@pytest.mark.parametrize(
    ("error", "n_identified", "source"),
    [
        (1e-4, 10, "# Inertia identified: principal moments 0.00200 ± 0.00010"),
        (8e-4, 10, "# Inertia identified in part: principal moments 0.00200 ± 0.00080"),
        (1e-4, 4, "# Inertia not known: a ball of aluminium"),
    ],
)
def test_every_card_with_an_inertia_says_how_it_was_made(error, n_identified, source):
    covariance = np.diag([1e-4] * 4 + [error**2] * 6)
    inertia = np.diag([2e-3, 2.5e-3, 1e-3])
    body = body_estimate(1.5, np.zeros(3), inertia, covariance, n_identified)
    plain, *cards = card_of(body, "all").split("\n== ")
    assert source in plain
    for read, card in zip(READERS, cards):
        assert (source in card) == (read not in (read_kinova, read_point)), card


def test_an_inertia_that_is_not_known_has_one_digit():
    moments = np.diag([2.347e-3, 2.347e-3, 2.347e-3])
    body = body_estimate(1.5, np.zeros(3), moments, n_identified=4)
    assert number_groups(body)["inertia_xx_yy_zz_xy_xz_yz"][0] == 0.002


@pytest.mark.parametrize(
    ("mass", "moments"),
    [(0.0, (1, 1, 1)), (-1.0, (1, 1, 1)), (1.0, (1, 1, 2.1)), (1.0, (1, 1, -0.1))],
)
def test_an_impossible_body_has_no_card(mass, moments):
    inertia = np.diag(np.array(moments, dtype=float))
    with pytest.raises(
        ExportError, match="not a possible rigid body, so there is no card"
    ):
        number_groups(body_estimate(mass, [0.1, 0.0, 0.0], inertia))


def test_the_name_of_a_frame_begins_no_line_of_a_card():
    own = made.payload().payload
    flange = replace(own.flange, name="site 'a\nmass 9 kg'", note="b\nmass 9 kg")
    payload = replace(own, flange=flange)
    text = card_text(payload, number_groups(payload), made.ARM)
    assert "?mass 9 kg" in text and "\nmass 9 kg" not in text
