"""Logs on many machines: what each says is sent, added, and gives what one process finds."""

from __future__ import annotations

import pickle
import re

import numpy as np
import pytest

import robot_sysid as rs
from robot_sysid.errors import InputError
from robot_sysid.records.option_fields import write_torque_scale
from tests.support import pages
from tests.support.places import ROOT

CUTOFF = 8.0
TERMS = "coulomb-viscous-offset-armature"


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A folder with arm.xml and logs of different lengths of one arm."""
    folder = tmp_path_factory.mktemp("adding")
    pages.make_models(folder)
    for number, duration in enumerate((6.0, 8.0, 12.0)):
        pages.record(folder, "truth.xml", f"log{number}.csv", number, duration)
    return folder


@pytest.fixture(scope="module")
def model(workshop):
    return str(workshop / "arm.xml")


@pytest.fixture(scope="module")
def logs(workshop):
    return sorted(map(str, workshop.glob("log*.csv")))


def add_logs(model, logs, rounds=2):
    total = None
    for _ in range(rounds):
        total = sum(
            rs.information(model, log, around=total, cutoff=CUTOFF) for log in logs
        )
    return total


@pytest.mark.slow
def test_the_sum_is_what_identify_finds(model, logs, tmp_path):
    """To rounding in three rounds, and nearly so in two."""
    direct = rs.identify(
        model, logs, cutoff=CUTOFF, friction_model=TERMS, keep="gravity"
    )
    for rounds, value_tolerance, error_tolerance in ((2, 1e-4, 0.15), (3, 1e-9, 0.02)):
        summed = rs.identify_from(
            model, pickle.loads(pickle.dumps(add_logs(model, logs, rounds)))
        )
        assert summed.theta == pytest.approx(direct.theta, rel=value_tolerance)
        assert summed.failure == direct.failure
        errors = direct.standard_errors.items()
        assert summed.standard_errors == {
            k: pytest.approx(v, rel=error_tolerance) for k, v in errors
        }
    assert "3 logs, added" in str(summed.to_dict())
    assert {path.name for path in summed.save(tmp_path)} == {
        "params.json",
        "updated_model.xml",
    }
    with pytest.raises(InputError, match="holds no samples"):
        summed.plot()


@pytest.mark.slow
def test_a_cluster_finds_the_numbers_of_one_process(model, logs):
    """By the code of the page."""
    distributed = pytest.importorskip("distributed")
    blocks = [text for _, text in pages.blocks(ROOT / "docs" / "python.md")]
    page = {"__name__": "page"}
    exec(next(text for text in blocks if "dask" in text), page)
    local = rs.identify_from(model, add_logs(model, logs))
    cluster_options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "dashboard_address": None,
    }
    with (
        distributed.LocalCluster(**cluster_options) as cluster,
        distributed.Client(cluster),
    ):
        clustered = rs.identify_from(model, page["total"](model, logs, CUTOFF))
    np.testing.assert_allclose(clustered.theta, local.theta, rtol=1e-9)
    errors = {
        name: pytest.approx(error, rel=1e-6)
        for name, error in local.standard_errors.items()
    }
    assert clustered.standard_errors == errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "give cutoff=HZ"),
        ({"cutoff": 8.0, "sped": 1}, "unknown option 'sped'; valid: "),
        ({"cutoff": 8.0, "delay": "auto"}, "delay='auto' depends on all logs"),
        ({"cutoff": 8.0, "joint": "elbow"}, "elbow"),
    ],
)
def test_what_cannot_be_used_is_one_clear_error(model, logs, options, message):
    with pytest.raises(InputError, match=message):
        rs.information(model, logs[0], **options)


def test_a_first_round_is_no_result(model, logs):
    first = rs.information(model, logs[0], cutoff=CUTOFF)
    assert re.fullmatch(
        r"<LogInformation of 1 log: \d+ samples of joints up to \w+ in [\d.]+ s>",
        repr(first),
    )
    with pytest.raises(InputError, match="does not know its errors"):
        rs.identify_from(model, first)
    with pytest.raises(InputError, match="unknown option 'cutoff'"):
        rs.identify_from(model, first, cutoff=CUTOFF)


def test_scales_that_are_known_are_as_sure_as_their_file_says(model, logs, tmp_path):
    joints = [f"joint{k}" for k in range(len(pages.AXES))]
    write_torque_scale(tmp_path / "scale.json", dict.fromkeys(joints, (1.0, 0.004)))
    first = rs.information(
        model, logs[0], cutoff=CUTOFF, torque_scale=tmp_path / "scale.json"
    )
    assert first.settled.estimation.scale_uncertainty == pytest.approx(
        (0.4,) * len(joints)
    )
