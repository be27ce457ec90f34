"""Model files with units as CAD programs write them are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigs.files import urdf
from rigs.files.refusals import refused
from robot_sysid.errors import ModelError
from robot_sysid.parser import load_robot_model

LINKS = {"l1": (3.0, 0.3), "l2": (2.0, 0.25), "l3": (1.2, 0.2), "l4": (0.4, 0.08)}
"""Mass [kg] and length [m] of boxes, one on the other."""


def arm(folder, mass=1.0, inertia=1.0, length=1.0, changed=LINKS, is_placeholder=False):
    """The path of a URDF whose numbers are multiplied, those of inertials in ``changed`` links."""
    bodies = {}
    for name, (link_mass, size) in LINKS.items():
        squares = np.array([0.08, 0.1, size]) ** 2
        moments = link_mass / 12.0 * (np.sum(squares) - squares)
        if is_placeholder:
            moments[:] = 1e-6
        mass_factor, inertia_factor = (mass, inertia) if name in changed else (1.0, 1.0)
        com = np.array([0.0, 0.0, 0.5 * length * size])
        bodies[name] = mass_factor * link_mass, com, inertia_factor * np.diag(moments)
    path = urdf.write_bodies(folder, bodies)
    path.write_text(path.read_text().replace("0 0 0.2", f"0 0 {0.2 * length!r}"))
    return path


@pytest.mark.parametrize(
    ("mass", "inertia"),
    [(1.0, 1e6), (1.0, 1e9), (1.0, 1e4), (1e3, 1.0), (1e3, 1e9), (1e-3, 1.0)],
)
def test_masses_and_inertias_in_other_units_are_refused(tmp_path, mass, inertia):
    with refused("which no arm has; state masses in kg", ModelError):
        load_robot_model(arm(tmp_path, mass, inertia))


def test_the_factor_that_is_advised_replaces_one_that_was_given(tmp_path):
    path = arm(tmp_path)
    with refused("which no arm has; state masses in kg", ModelError) as caught:
        load_robot_model(path, mass_scale=1e3)
    (remedy,) = caught.value.options
    assert remedy == ("--mass-scale", "1")
    assert load_robot_model(path, mass_scale=float(remedy[1])).n_joints == 4


def test_lengths_in_millimetres_are_refused(tmp_path):
    path = arm(tmp_path, length=1000.0)
    with refused("joints add up to 600 m, .*: these lengths fit", ModelError):
        load_robot_model(path)
    text = path.read_text().replace("0 0 200.0", "0 0 0.2")
    path.write_text(text)
    with refused(r"centres of mass lie 112 m .*: these lengths", ModelError):
        load_robot_model(path)


@given(st.sampled_from(list(LINKS)), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_single_link_may_be_ten_times_off(tmp_path_factory, name, mass, inertia):
    folder = tmp_path_factory.mktemp("single")
    path = arm(folder, 10.0**mass, 10.0**inertia, changed={name})
    assert load_robot_model(path).n_joints == 4


def test_equal_moments_of_all_links_stand_for_unknown_ones(tmp_path):
    assert load_robot_model(arm(tmp_path, is_placeholder=True)).n_joints == 4
