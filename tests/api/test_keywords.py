"""Keywords are those of the option records, for readers, checkers and programs alike."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

import robot_sysid as rs
from robot_sysid.api.keywords import RECORDS, python_words, refused_by
from robot_sysid.records.option_fields import keys_of
from tests.support import keyword_types
from tests.support.places import ROOT


def test_the_types_are_what_the_generator_writes():
    """``python -m tests.support.keyword_types`` brings them up to date."""
    assert keyword_types.PATH.read_text(encoding="utf-8") == keyword_types.text()


@pytest.mark.parametrize("function", RECORDS)
def test_a_signature_shows_every_keyword_with_its_default(function):
    face = rs if hasattr(rs, function) else rs.motors
    parameters = inspect.signature(getattr(face, function)).parameters
    keys = keys_of(*RECORDS[function]) - set(refused_by(function))
    assert keys <= set(parameters) and "options" not in parameters
    if "cutoff" in parameters:
        assert (
            parameters["cutoff"].default is None
            and parameters["delay"].default == "off"
        )
    if function == "plan":
        assert parameters["excitation"].default == "optimal"
    if function == "play":
        assert (
            parameters["max_velocity"].default is None
            and "below_base" not in parameters
        )


@pytest.mark.parametrize("function", RECORDS)
def test_help_says_what_every_keyword_means(function):
    """In the words of the options, as keywords, with type, unit and default."""
    face = rs if hasattr(rs, function) else rs.motors
    text = getattr(face, function).__doc__
    assert "options:" not in text and max(map(len, text.splitlines())) <= 100
    for key in inspect.signature(getattr(face, function)).parameters:
        assert f"\n    {key}:" in text or f"\n    {key} (" in text, key
    words = " ".join(text.split())
    assert "may be repeated" not in words
    if function == "identify":
        assert "cutoff (a number [Hz]; default: from the data): cut-off of" in words
        assert (
            'keep ("friction", "rotors", "gravity" or "links", or a list of th' in words
        )
        assert 'torques ("chain" or "terminal"; default "chain"): use' in words
        assert words.endswith("or a log cannot be used; says why.")
    if function == "plan":
        assert '"optimal"; default "optimal"): random' in words
        assert 'with for_="payload": resting poses' in words


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: rs.identify("m", cutof=8.0),
            "unknown option 'cutof'; did you mean 'cutoff'?",
        ),
        (
            lambda: rs.identify("m", "l", cutoff="abc"),
            "cutoff must be a number (got 'abc')",
        ),
        (
            lambda: rs.identify(5, "l"),
            "a model is the path of an MJCF or URDF file, a mujoco",
        ),
        (
            lambda: rs.identify("m", measurements="l"),
            "measurements is the argument log",
        ),
        (
            lambda: rs.identify("m", "l", output_dir="x"),
            "output_dir is for the command; the res",
        ),
        (
            lambda: rs.identify("m", units="deg"),
            "units describes a log; add log=LOG.csv",
        ),
        (
            lambda: rs.payload("m", [], "b"),
            "empty=LOG... is missing: a payload is found from",
        ),
        (lambda: rs.plan("m", for_="friction", seed=7), "seed has nothing to draw"),
        (
            lambda: rs.plan("m", static=True),
            'static=True is about resting poses; add for_="pay',
        ),
        (
            lambda: rs.plan("m", cutoff=5.0),
            "cutoff is about an estimate; a plan stops before it",
        ),
        (
            lambda: rs.payload("m", "a", "b", links=True),
            "links means nothing for a payload; lea",
        ),
        (
            lambda: rs.read_log("l", "m", accept="gravity"),
            "accept is about an estimate; reading ",
        ),
        (
            lambda: rs.read_log("l", 5),
            "a model is the path of an MJCF or URDF file, a mujoco",
        ),
        (
            lambda: rs.identify("<mujoco>\n</mujoco>", "l"),
            "the model is XML text, not the path of a file; write it to a file, or",
        ),
        (
            lambda: rs.identify("m", "l", validation=["a", "b"]),
            "validation is one log, not a list",
        ),
        (
            lambda: rs.identify("m", "l", torque_from="position-error"),
            "torque_from is for logs without torque; it needs the command robot-sysid identify "
            "MODEL LOG --torque-from position-error",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_the_words_of_python(call, message):
    with pytest.raises(rs.InputError) as caught:
        call()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("command", "python"),
    [
        ("name them with --columns FILE", "name them with columns=FILE"),
        ("pass --units deg, or --units rad if", 'pass units="deg", or units="rad" if'),
        ("give --torque-constants to use them", "give torque_constants to use them"),
        ("--known-mass and --scale-uncertainty 0", "known_mass and scale_uncertainty=0"),
        ("none; identify --torque-from position-error needs none",
         "none; the command robot-sysid identify MODEL LOG --torque-from position-error needs "
         "none"),
        ("with robot-sysid payload --known-mass KG", "with robot_sysid.payload and known_mass=KG"),
        ("--empty and --loaded look swapped", "empty and loaded look swapped"),
        ("leave it off with --no-friction", "leave it off with no_friction=True"),
        ("weigh (--known-mass KG --save-torque-scale FILE)",
         "weigh (known_mass=KG save_torque_scale=FILE)"),
        ("see robot-sysid motors map --model", "see robot-sysid motors map --model"),
        ("an --option of another tool", "an --option of another tool"),
        ("weigh it:\n  robot-sysid plan --config out/run.toml --for payload --output-dir out/two",
         'weigh it:\n  rs.plan(model, for_="payload")'),
        ("  robot-sysid identify a.xml 'b c.csv' --links --cutoff 8 --keep links --keep rotors",
         '  rs.identify(model, log, links=True, cutoff=8, keep=["links", "rotors"])'),
        ("  robot-sysid motors map --model a.xml", "  robot-sysid motors map --model a.xml"),
    ],
)  # fmt: skip
def test_options_are_said_as_keywords(command, python):
    assert python_words(command) == python


USER = """
import robot_sysid as rs



def mass(result: rs.Identified, log: rs.Log, arm: rs.RobotModel) -> rs.Quantity | None:
    check: rs.MeasurementLog = rs.read_log(log, arm)
    verdict: rs.Verdict = result.result.verdict
    print(check.notes, verdict.value, result.result.sensors)
    return result.result.sensors.get("delay")


try:
    result = rs.identify("arm.xml", ["log.csv"], cutoff=8.0, keep="gravity", tilt="auto")
except rs.InputError as error:
    print(error)
else:
    print(result.mass, result.center_of_mass[0])
motion = rs.plan("arm.xml", for_="friction")
matrix, torque = rs.joint_torque_regressor("arm.xml", [0.0], [0.0], [0.0], joint="elbow")
report = rs.motors.play("motion.csv", model="arm.xml", channel="can0", speed=0.3)
print(report.cycles, rs.motors.hold("arm.xml", 2.0, others="hold").worst_tracking)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("replacement", "complaint"),
    [
        (("", ""), ""),
        (("cutoff", "cutof"), 'Unexpected keyword argument "cutof" for "identify"'),
        (("8.0", '"8"'), 'Argument "cutoff" to "identify" has incompatible type "str"'),
        (('"friction"', '"speed"'), 'Argument "for_" to "plan" has incompatible type'),
        (("speed=", "sped="), 'Unexpected keyword argument "sped" for "play"'),
        (("others=", "other="), 'Unexpected keyword argument "other" for "hold"'),
        (("rs.Quantity", "rs.Quantities"), 'Name "rs.Quantities" is not defined'),
    ],
)
def test_a_checker_knows_the_keywords_of_a_users_script(
    tmp_path, monkeypatch, replacement, complaint
):
    pytest.importorskip("mypy")
    monkeypatch.setenv("MYPYPATH", str(ROOT))
    (tmp_path / "mine.py").write_text(USER.replace(*replacement) if complaint else USER)
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--follow-imports=silent",
        "mine.py",
    ]
    checked = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert checked.returncode == bool(complaint) and complaint in checked.stdout, (
        checked.stdout
    )
