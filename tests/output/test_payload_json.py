"""params.json of a payload: strict, complete, and not to be taken for that of a link."""

from __future__ import annotations

import json

import pytest

from robot_sysid.output.cards import load_errors, payload_cards
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.records.payload import PayloadStatus
from tests.support.payload_results import body, result


def written(found, cards=()):
    return json.loads(payload_json_text(found, cards, ("said while writing",)))


def test_payload_link_and_sum_stand_beside_each_other():
    content = written(result())
    assert content["command"] == "payload" and "mass" not in content
    masses = [content[key]["mass"] for key in ("payload", "link", "link_with_payload")]
    assert masses == [1.2, 0.8, 2.0]
    assert content["flange"]["name"] == "site 'flange'"
    assert content["notes"] == ["a note", "said while writing"]
    assert content["valid"] == {"physically_consistent": True, "trustworthy": True}


def test_errors_are_whole_and_split_by_cause():
    payload = written(result())["payload"]
    assert payload["standard_errors"]["m"] == pytest.approx(0.01)
    assert payload["standard_errors_noise"]["m"] == pytest.approx(0.006)
    assert payload["error_budget"]["torque scale"]["m"] == pytest.approx(0.008)
    known = load_errors(body().inertial, body().covariance)
    assert payload["standard_errors"]["com_z"] == pytest.approx(known["com_z"])


def test_what_is_not_known_is_null():
    content = written(result(payload=body(shown=False)))
    assert content["payload"]["standard_errors"]["Ixx"] is None
    assert content["parameters"]["load[joint0]"] == {"value": 0.0, "standard_error": None}


def test_a_card_stands_in_it_and_a_refusal_gives_its_reason():
    found = result()
    cards = payload_cards(found.payload.inertial, found.flange)
    assert len(written(found, cards)["cards"]) == len(cards) > 5
    refused = written(result(PayloadStatus.SWAPPED))
    assert refused["status"] == "SWAPPED" and refused["reasons"] == ["because"]
    assert refused["cards"] == {} and not refused["valid"]["trustworthy"]


def test_scales_of_a_known_mass():
    content = written(result(known_mass=2.0, torque_scale={"joint0": (1.02, 0.003)}))
    assert content["torque_scale"] == {"joint0": {"scale": 1.02, "standard_error": 0.003}}
