"""What a run was asked to do is checked once, before any work, with the option in the message."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_sysid.config import PayloadConfig, SysidConfig
from robot_sysid.dynamics.friction import FrictionModel, friction_model
from robot_sysid.errors import InputError
from robot_sysid.estimation.question import CHOSEN, DEFAULT_TERMINAL, EstimationOptions
from robot_sysid.records.option_fields import MAX_SAMPLES, write_torque_scale
from tests.support import option_samples

MODEL = Path("arm.xml")
LOG = {"measurements": (Path("log.csv"),)}
PLANT = {"plant_model": Path("truth.xml")}
PLAN = {"plan_only": True}
OPTIMAL = {"excitation": "optimal"}
FILE = {"trajectory": Path("saved.json")}
STATIC = {**PLAN, "for_": "payload", "static": True}
SERVOS = {**LOG, "torque_from": "position-error"}
MOTORS = {"export_damiao": True, "motor_type": ("DM4340",)}
EMPTY_AND_LOADED = {"empty": (Path("a.csv"),), "loaded": (Path("b.csv"),)}


def refusal(make=SysidConfig.of, **values):
    """The one line with which options are refused."""
    with pytest.raises(InputError) as caught:
        make(MODEL, **values)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_every_option_is_accepted_in_some_run_and_kept():
    config = SysidConfig.of(MODEL)
    assert config == SysidConfig(config.model) and config.model.path == MODEL
    samples = list(option_samples.samples())
    assert len({sample.option.key for sample in samples}) == len(samples)
    for sample in samples:
        for context in ({}, OPTIMAL, STATIC, PLANT, LOG, SERVOS, MOTORS):
            values = (
                {"motor_type": ("DM4340",), **context} if context is MOTORS else context
            )
            try:
                config = SysidConfig.of(
                    MODEL, **{**values, sample.option.key: sample.value}
                )
            except InputError:
                continue
            assert getattr(getattr(config, sample.record), sample.field) == sample.value
            break
        else:
            assert sample.option.key == "export_damiao"  # Never without motor types.


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {**LOG, "duration": 3.0},
            "--duration is about a motion; a log brings its own",
        ),
        ({**LOG, **MOTORS}, "--export-damiao is about a motion"),
        ({"units": "deg"}, "--units describes a log; add --measurements LOG.csv"),
        ({**PLANT, "torque_from": "position-error"}, "--torque-from describes a log"),
        (
            {"noise_torque": 0.1},
            "--noise-torque belongs to a simulated plant; add --plant-model",
        ),
        (
            {"cutoff": 3.0},
            "--cutoff is about measured torques; add --measurements or --plant",
        ),
        (
            {**SERVOS, "torque_scale": 2.0},
            "--torque-scale is about measured torques; leave it off",
        ),
        ({"for_": "friction"}, "--for says what a plan is for; use robot-sysid plan"),
        (
            {**PLAN, "static": True},
            "--static is about resting poses; add --for payload",
        ),
        (
            {"excitation_time_budget": 3.0},
            "--excitation-time-budget is about a design; add",
        ),
        ({**FILE, "seed": 7}, "--seed has nothing to draw"),
        ({**FILE, **PLANT, "seed": 7}, "--seed has nothing to draw"),
        (
            {**FILE, **PLAN, "noise_torque": 0.1, "seed": 7},
            "--seed has nothing to draw",
        ),
        ({**PLAN, "for_": "friction", "seed": 7}, "--seed has nothing to draw"),
        (
            {**PLAN, "encoder_resolution": 0.1},
            "--encoder-resolution belongs to a simulated plant",
        ),
        (
            {**PLAN, **PLANT},
            "--plant-model is about an estimate; a plan stops before it",
        ),
        ({**PLAN, "no_friction": True}, "--no-friction is about an estimate"),
        ({**PLAN, "report": True}, "--report is about an estimate"),
        (
            {"can_id": (3,)},
            "--can-id is only used together with --export-damiao; add it",
        ),
        ({"export_damiao": True}, "--export-damiao requires at least one --motor-type"),
    ],
)
def test_an_option_that_does_not_count_is_refused(values, message):
    assert refusal(**values).startswith(message)


def test_scales_are_as_sure_as_their_file_says_unless_the_user_says(tmp_path):
    path = tmp_path / "scale.json"
    write_torque_scale(
        path, {"two": (2.0, 0.02), "other": (3.0, 1.0), "one": (1.1, 0.0055)}
    )

    def sure(**values):
        config = PayloadConfig.of(MODEL, **EMPTY_AND_LOADED, **values)
        return config.with_scale_uncertainty(
            ("one", "two")
        ).estimation.scale_uncertainty

    assert sure(torque_scale=path) == pytest.approx((0.5, 1.0))
    assert sure(torque_scale=path, scale_uncertainty=2.0) == 2.0
    path.write_text('{"version": 1, "torque_scale": {"one": 1.1, "two": 2}}')
    assert sure(torque_scale=path) is sure(torque_scale=1.1) is sure() is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "--empty LOG... is missing"),
        ({"empty": (Path("a.csv"),)}, "--loaded LOG... is missing"),
        ({**EMPTY_AND_LOADED, "order": "AAB"}, "--order AAB"),
        (
            {**EMPTY_AND_LOADED, "known_mass": 1.0, "keep": "links"},
            "--keep is about a written",
        ),
        (
            {**EMPTY_AND_LOADED, "known_mass": 1.0, "as_body": "load"},
            "--known-mass writes no",
        ),
        (
            {**EMPTY_AND_LOADED, "known_mass": 1.0, "scale_uncertainty": 0.0},
            "--known-mass and --scale-uncertainty 0 exclude",
        ),
        (
            {**EMPTY_AND_LOADED, "save_torque_scale": Path("s")},
            "--save-torque-scale is about",
        ),
        (
            {**EMPTY_AND_LOADED, "static": True, "cutoff": 3.0},
            "--cutoff is about motion; --static",
        ),
        (
            {**EMPTY_AND_LOADED, "empty": Path("sysid_output/params.json")},
            "--output-dir would ov",
        ),
    ],
)
def test_of_a_payload_as_well(values, message):
    assert refusal(PayloadConfig.of, **values).startswith(message)


@pytest.mark.parametrize(
    "values",
    [
        {**LOG, **PLANT},
        {**FILE, **OPTIMAL},
        {**FILE, "duration": 3.0},
        {**STATIC, **OPTIMAL},
        {
            "measurements": (Path("a.csv"), Path("b.csv")),
            "save_measurements": Path("c.csv"),
        },
        {**LOG, "verify_rollout": True, "torques": "terminal"},
        {**LOG, "no_friction": True, "keep": "friction"},
    ],
    ids=str,
)
def test_options_that_exclude_each_other_are_refused(values):
    assert "exclude each other" in refusal(**values)


def test_what_goes_together_is_accepted():
    for values in (
        {**PLANT, **OPTIMAL},
        {**PLANT, **FILE},
        {**PLAN, **OPTIMAL},
        {**PLAN, **FILE},
    ):
        SysidConfig.of(MODEL, **values)
    for values, measured in (({}, False), (OPTIMAL, False), (LOG, True), (PLANT, True)):
        assert SysidConfig.of(MODEL, **values).is_measured == measured
    SysidConfig.of(
        MODEL, save_trajectory=Path("a.json"), save_measurements=Path("b.csv")
    )
    SysidConfig.of(MODEL, **LOG, save_measurements=Path("other/log.csv"))
    PayloadConfig.of(MODEL, **EMPTY_AND_LOADED, order="AB")


@pytest.mark.parametrize(
    "values",
    [
        {**LOG, "save_measurements": Path("./log.csv")},
        {"save_trajectory": MODEL},
        {**FILE, "save_trajectory": Path("saved.json")},
        {"save_trajectory": Path("plan.csv")},
        {"save_trajectory": Path("run.json"), "save_measurements": Path("run.csv")},
    ],
    ids=str,
)
def test_no_file_is_written_over_another_one(values):
    assert "would overwrite" in refusal(**values)


def test_an_unknown_key_names_the_nearest_or_lists_the_known_ones():
    assert refusal(cutof=0.5) == "unknown option 'cutof'; did you mean 'cutoff'?"
    assert refusal(zzz=0.5).startswith(
        "unknown option 'zzz'; valid: accept, below_base, bundle, "
    )


@given(st.floats(0.01, 1e5), st.floats(0.01, 1e5))
def test_any_duration_and_rate_with_two_samples_or_more_and_not_too_many_is_accepted(
    duration, rate
):
    values = {"duration": duration, "sample_rate": rate}
    if duration * rate > MAX_SAMPLES:
        assert "more than the 1e+09 a run can take" in refusal(**values)
    elif duration * rate >= 1.0:
        assert SysidConfig.of(MODEL, **values).trajectory.duration == duration
    else:
        assert "less than two samples" in refusal(**values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"duration": 0.0}, "--duration must be positive"),
        ({"max_velocity": float("inf")}, "--max-velocity must be positive"),
        ({"speed": 1e-12}, "a trajectory of 1.5e+13 s with --sample-rate"),
        ({**LOG, "cutoff": 0.0}, "--cutoff must be positive (got 0)"),
        ({**LOG, "friction_model": "glue"}, "unknown friction term 'glue'"),
        (
            {**PLANT, "encoder_resolution": -1.0},
            "--encoder-resolution must be a number",
        ),
        (
            {**PLANT, "torque_delay": 2.0},
            "--torque-delay is given in seconds and may be at most 1",
        ),
        ({"torques": "all"}, "--torques 'all': choose one of chain, terminal"),
        ({"speed": 1.5}, "--speed must be above 0 and at most 1 (got 1.5)"),
        ({"seed": -1}, "--seed must be a number that is not negative"),
    ],
)
def test_values_that_mean_nothing_are_refused(values, message):
    assert refusal(**values).startswith(message)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, None),
        ({"friction_model": CHOSEN}, None),
        ({"no_friction": True}, FrictionModel(())),
        ({"friction_model": "coulomb-load"}, friction_model("coulomb-load")),
        # One row tells too little to choose by.
        ({"torques": "terminal"}, friction_model(DEFAULT_TERMINAL)),
    ],
)
def test_friction_is_chosen_by_the_data_unless_it_is_said(options, expected):
    assert EstimationOptions(**options).friction == expected
