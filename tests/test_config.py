"""What a run was asked to do is checked once, before any work, with the option in the message."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.config import NEEDS, SysidConfig, config_from
from robot_sysid.errors import InputError
from robot_sysid.records.options import default_of
from robot_sysid.trajectory import MOST_SAMPLES
from tests.support import option_samples
from tests.support.option_samples import FILE, LOG, MET, MOTORS, OPTIMAL, PLAN, PLANT, UNMET

MODEL = Path("arm.xml")
SAMPLES = list(option_samples.samples())
NEEDY = [sample for sample in SAMPLES if sample.option.needs]
SOURCES = {"log": LOG, "plant": PLANT, "plan": PLAN, "file": FILE, "design": OPTIMAL}
TOGETHER = ({"plant", "design"}, {"plant", "file"}, {"plan", "design"}, {"plan", "file"})
NOT_POSITIVE = st.one_of(
    st.floats(max_value=0.0), st.sampled_from([float("nan"), float("inf"), -float("inf")])
)


def refused(**values):
    """The one line with which options are refused."""
    with pytest.raises(InputError) as caught:
        config_from(MODEL, **values)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def flag(key):
    return next(sample.option.flag for sample in SAMPLES if sample.option.key == key)


def test_without_options_every_record_has_its_defaults():
    config = config_from(MODEL)
    assert config == SysidConfig(config.model)
    assert config.model.path == MODEL
    for sample in SAMPLES:
        record = getattr(config, sample.record)
        assert getattr(record, sample.field) == default_of(record, sample.field)


def test_every_need_is_explained_met_somewhere_and_used():
    used = {sample.option.needs for sample in SAMPLES}
    assert used == {"", *NEEDS} == set(MET) == {"", *UNMET}


def test_keys_are_different():
    keys = [sample.option.key for sample in SAMPLES]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("sample", SAMPLES, ids=str)
def test_an_option_is_accepted_and_kept_where_what_it_needs_is_there(sample):
    companions = MOTORS if sample.option.key == "export_damiao" else {}
    # Where the motion comes from is a choice of its own, see below.
    is_source = any(sample.option.key in source for source in SOURCES.values())
    for there in ({},) if is_source else MET[sample.option.needs]:
        config = config_from(MODEL, **{**there, **companions, sample.option.key: sample.value})
        assert getattr(getattr(config, sample.record), sample.field) == sample.value


@pytest.mark.parametrize("sample", NEEDY, ids=str)
def test_an_option_is_refused_where_what_it_needs_is_not_there(sample):
    """In the name of that option, or of the one that stands against it."""
    companions = MOTORS if sample.option.key == "export_damiao" else {}
    for there in UNMET[sample.option.needs]:
        message = refused(**{**companions, **there, sample.option.key: sample.value})
        named = {sample.option.flag, *map(flag, there)}
        assert message.split()[0] in named, message


@pytest.mark.parametrize("sample", NEEDY, ids=str)
def test_the_refusal_says_what_is_missing(sample):
    for there in UNMET[sample.option.needs]:
        if not there and sample.option.key != "export_damiao":
            message = refused(**{sample.option.key: sample.value})
            assert message == f"{sample.option.flag} {NEEDS[sample.option.needs]}"


PAIRS = {
    "a log and a plant": {**LOG, **PLANT},
    "a file and a design": {**FILE, **OPTIMAL},
    "one copy of several logs": {
        "measurements": (Path("a.csv"), Path("b.csv")),
        "save_measurements": Path("c.csv"),
    },
    "no friction and some": {**LOG, "no_friction": True, "friction_model": "coulomb"},
    "a model of one joint and all": {**LOG, "verify_rollout": True, "torques": "terminal"},
    "a possible body and perhaps not": {"consistency": "off", "prior": "entropic"},
}


@pytest.mark.parametrize("case", PAIRS)
def test_options_that_exclude_each_other_are_refused(case):
    message = refused(**PAIRS[case])
    assert "exclude each other" in message
    assert all(flag(key) in message for key in PAIRS[case] if key != "measurements")


@pytest.mark.parametrize("there", [{}, OPTIMAL])
def test_the_robust_method_needs_measured_data(there):
    assert refused(**there, method="robust") == f"--method robust {NEEDS['measured']}"
    for measured in (LOG, PLANT):
        assert config_from(MODEL, **measured, method="robust").estimation.method == "robust"


@pytest.mark.parametrize("pair", [*combinations(SOURCES, 2)], ids=" and ".join)
def test_where_the_motion_comes_from_is_settled_or_refused(pair):
    values = {**SOURCES[pair[0]], **SOURCES[pair[1]]}
    if set(pair) in TOGETHER:
        config_from(MODEL, **values)
    else:
        refused(**values)


FILES = {
    "the log": {**LOG, "save_measurements": Path("./log.csv")},
    "the model": {"save_trajectory": MODEL},
    "the trajectory": {**FILE, "save_trajectory": Path("saved.json")},
    "the samples over the trajectory": {"save_trajectory": Path("plan.csv")},
    "the samples over the measurements": {
        "save_trajectory": Path("run.json"),
        "save_measurements": Path("run.csv"),
    },
    "by its whole path": {**LOG, "save_measurements": Path.cwd() / "log.csv"},
}


@pytest.mark.parametrize("case", FILES)
def test_no_file_is_written_over_another_one(case):
    assert "would overwrite" in refused(**FILES[case])


def test_different_files_are_accepted():
    config_from(MODEL, save_trajectory=Path("a.json"), save_measurements=Path("b.csv"))
    config_from(MODEL, **LOG, save_measurements=Path("other/log.csv"))


def test_an_unknown_key_lists_the_known_ones():
    message = refused(sped=0.5)
    assert message.startswith("unknown option 'sped'; valid: accept, append, base_frequency, ")
    assert all(sample.option.key in message for sample in SAMPLES)


@pytest.mark.parametrize("key", ["duration", "sample_rate", "max_velocity", "damiao_rate"])
@given(value=NOT_POSITIVE)
def test_numbers_that_must_be_positive_are_refused_otherwise(key, value):
    motors = MOTORS if key == "damiao_rate" else {}
    assert refused(**motors, **{key: value}).startswith(f"{flag(key)} must be positive")


@given(st.floats(0.01, 1e5), st.floats(0.01, 1e5))
def test_any_duration_and_rate_with_two_samples_or_more_and_not_too_many_is_accepted(
    duration, rate
):
    values = {"duration": duration, "sample_rate": rate}
    if duration * rate > MOST_SAMPLES:
        assert "more than the 1e+09 a run can take" in refused(**values)
    elif duration * rate >= 1.0:
        assert config_from(MODEL, **values).trajectory.duration == duration
    else:
        assert "less than two samples" in refused(**values)


@pytest.mark.parametrize(
    ("values", "option"),
    [
        ({"speed": 1e-12}, "--sample-rate"),
        ({"sample_rate": 1e12}, "--sample-rate"),
        ({"duration": 1e12}, "--sample-rate"),
        ({**MOTORS, "damiao_rate": 1e9}, "--damiao-rate"),
        ({**MOTORS, "damiao_rate": 1e5, "sample_rate": 1.0, "speed": 1e-3}, "--damiao-rate"),
    ],
)
def test_more_samples_than_a_run_can_take_are_refused(values, option):
    message = refused(**values)
    assert option in message and "more than the 1e+09 a run can take" in message


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({**LOG, "cutoff": 0.0}, "--cutoff must be positive (got 0)"),
        ({**LOG, "velocity_deadband": -1.0}, "--velocity-deadband must be a number"),
        ({**LOG, "velocity_deadband": (0.1, -1.0)}, "--velocity-deadband must be a number"),
        ({**LOG, "friction_model": "glue"}, "unknown friction term 'glue'"),
        ({**PLANT, "encoder_resolution": -1.0}, "--encoder-resolution must be a number"),
        ({**PLANT, "noise_torque": (0.1, -0.1)}, "--noise-torque must be a number"),
        ({**PLANT, "noise_position": float("inf")}, "--noise-position must be a number"),
        ({**PLANT, "torque_delay": 2.0}, "--torque-delay is given in seconds and may be at most 1"),
        ({"prior": "entropic", "prior_weight": 0.0}, "--prior-weight must be positive (got 0)"),
        ({"torques": "all"}, "--torques 'all': choose one of chain, terminal"),
        ({"method": "magic"}, "--method 'magic': choose one of ols, wls, robust"),
        ({"speed": 0.0}, "--speed must be above 0 and at most 1 (got 0)"),
        ({"speed": 1.5}, "--speed must be above 0 and at most 1 (got 1.5)"),
    ],
)
def test_values_that_mean_nothing_are_refused(values, message):
    assert refused(**values).startswith(message)


def test_measured_data_is_a_log_or_a_plant():
    for values, measured in (({}, False), (OPTIMAL, False), (LOG, True), (PLANT, True)):
        assert config_from(MODEL, **values).is_measured == measured


def test_a_negative_seed_is_refused():
    assert "--seed must be a number that is not negative" in refused(seed=-1)
    assert config_from(MODEL, seed=0).trajectory.seed == 0


def test_the_damiao_export_needs_motor_types():
    message = refused(export_damiao=True)
    assert message.startswith("--export-damiao requires at least one --motor-type")


def test_a_design_that_has_no_basis_is_refused():
    assert "--harmonics 0 is too few" in refused(**OPTIMAL, harmonics=0)


def test_a_config_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        config_from(MODEL).trajectory.duration = 3.0
