"""Each option reaches the configuration, and what makes no sense is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_sysid.config import SysidConfig
from robot_sysid.errors import InputError
from robot_sysid.options import build_parser, config_from

LOG = ("--measurements", "log.csv")
PLANT = ("--plant-model", "truth.xml")


def config(*arguments):
    return config_from(build_parser().parse_args(["arm.xml", *arguments]))


def test_the_defaults_are_those_of_the_record():
    made = config()
    # The record leaves consistency and the design's worker processes to whoever makes it.
    plain = SysidConfig(model=Path("arm.xml"), estimator=made.estimator, design=made.design)
    assert made == plain
    assert config().estimator.consistency == "auto"
    assert config().estimation_method == "ols" and not config().is_measured


OPTIONS = [
    (LOG, lambda c: c.measurements, Path("log.csv")),
    ((*LOG, "--columns", "c.txt"), lambda c: c.columns, Path("c.txt")),
    ((*LOG, "--units", "deg,ms"), lambda c: c.units, "deg,ms"),
    ((*LOG, "--cutoff", "7.5"), lambda c: c.signals.cutoff, 7.5),
    ((*LOG, "--velocity-deadband", "0.1"), lambda c: c.signals.velocity_deadband, 0.1),
    ((*LOG, "--velocity-deadband", "0.1,0.2"), lambda c: c.signals.velocity_deadband, (0.1, 0.2)),
    ((*LOG, "--delay", "auto"), lambda c: c.estimate_delay, True),
    ((*LOG, "--tilt", "auto"), lambda c: c.estimate_tilt, True),
    ((*LOG, "--validate", "0.3"), lambda c: c.validate, 0.3),
    (
        (*LOG, "--validation-measurements", "b.csv"),
        lambda c: c.validation_measurements,
        Path("b.csv"),
    ),
    (PLANT, lambda c: c.plant_model, Path("truth.xml")),
    ((*PLANT, "--simulation", "forward"), lambda c: c.simulation, "forward"),
    ((*PLANT, "--noise-torque", "0.3"), lambda c: c.sensors.noise_torque, 0.3),
    ((*PLANT, "--noise-torque", "0.3,0.1"), lambda c: c.sensors.noise_torque, (0.3, 0.1)),
    ((*PLANT, "--noise-position", "1e-4"), lambda c: c.sensors.noise_position, 1e-4),
    ((*PLANT, "--encoder-resolution", "1e-4"), lambda c: c.sensors.encoder_resolution, 1e-4),
    ((*PLANT, "--torque-delay", "0.005"), lambda c: c.sensors.torque_delay, 0.005),
    ((*PLANT, "--save-measurements", "s.csv"), lambda c: c.save_measurements, Path("s.csv")),
    (("--method", "robust"), lambda c: c.estimation_method, "robust"),
    (LOG, lambda c: c.estimation_method, "wls"),
    (PLANT, lambda c: c.estimation_method, "wls"),
    (("--consistency", "off"), lambda c: c.estimator.consistency, "off"),
    (("--prior", "entropic", "--prior-weight", "3"), lambda c: c.estimator.entropic_weight, 3.0),
    ((*LOG, "--friction-model", "+sqrt"), lambda c: c.friction_model, "+sqrt"),
]


@pytest.mark.parametrize(("arguments", "where", "value"), OPTIONS)
def test_an_option_reaches_the_configuration(arguments, where, value):
    assert where(config(*arguments)) == value


REFUSED = [
    ((*LOG, *PLANT), "exclude each other"),
    (("--columns", "c.txt"), "--columns describes a log; add --measurements"),
    (("--units", "deg"), "--units describes a log; add --measurements"),
    (("--noise-torque", "0.1"), "belong to a simulated plant; add --plant-model"),
    (("--simulation", "forward"), "belong to a simulated plant; add --plant-model"),
    (("--delay", "auto"), "--delay auto needs --measurements or --plant-model"),
    (("--tilt", "auto"), "--tilt auto needs --measurements or --plant-model"),
    (("--cutoff", "8"), "--cutoff needs --measurements or --plant-model"),
    (("--velocity-deadband", "1"), "--velocity-deadband needs --measurements or --plant-model"),
    (("--friction-model", "auto"), "--friction-model needs --measurements or --plant-model"),
    (("--validation-measurements", "b.csv"), "--validation-measurements needs --measurements"),
    ((*LOG, "--validate", "1"), "--validate must be at least 0 and below 1"),
    ((*LOG, "--validate", "-0.1"), "--validate must be at least 0 and below 1"),
    ((*LOG, "--cutoff", "0"), "must be positive"),
    ((*LOG, "--velocity-deadband", "-1"), "must not be negative"),
    ((*LOG, "--friction-model", "glue"), "unknown friction term 'glue'"),
    ((*LOG, "--friction-model", "auto", "--no-friction"), "exclude each other"),
    ((*PLANT, "--noise-torque", "loud"), "--noise-torque"),
    ((*PLANT, "--encoder-resolution", "-1"), "--encoder-resolution"),
    ((*PLANT, "--torque-delay", "2"), "--torque-delay"),
    (("--method", "magic"), "invalid choice"),
    (("--consistency", "maybe"), "invalid choice"),
    (("--prior", "entropic", "--prior-weight", "0"), "--prior-weight must be a positive number"),
    ((*LOG, "--export-damiao", "--motor-type", "DM4340"), "--export-damiao"),
]


@pytest.mark.parametrize(("arguments", "words"), REFUSED, ids=lambda value: " ".join(value)[:40])
def test_what_makes_no_sense_is_refused_in_one_line(arguments, words):
    with pytest.raises(InputError) as caught:
        config(*arguments)
    message = str(caught.value)
    assert words in message and "\n" not in message
