"""The command line: output block, options, one line per error, exit codes, nothing left behind."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from robot_sysid import __version__
from robot_sysid.cli import main
from robot_sysid.options import build_parser
from robot_sysid.self_analysis import ITSELF

EXAMPLE = Path(__file__).parents[1] / "examples/kinova/model/kinova_fullinertia_guess.xml"

ARM = """<mujoco model="two">
  <worldbody>
    <body name="upper" pos="0 0 0.3">
      <joint name="shoulder" axis="0 1 0" range="-90 90" limited="true"/>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.02 0.02"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" axis="1 0.2 0" range="-120 120" limited="true"/>
        <inertial pos="0.1 0.02 0" mass="0.5" diaginertia="0.003 0.004 0.005"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

BALL = ARM.replace(
    '<joint name="shoulder" axis="0 1 0" range="-90 90" limited="true"/>',
    '<joint name="shoulder" type="ball"/>',
)
NO_JOINTS = "<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>"
FRAGMENT = "<default><joint damping='1'/></default>"
MISSING_MESH = ARM.replace(
    "<worldbody>", "<asset><mesh name='cup' file='cup.stl'/></asset><worldbody>"
)
BOMB = """<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><mujoco model="&c;"/>"""


@pytest.fixture
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A two-joint model in an otherwise empty working folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    return path


def test_the_example_prints_the_documented_block(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([str(EXAMPLE)]) == 0
    lines = capsys.readouterr().out.splitlines()
    seed_line = lines.pop(3)
    assert re.fullmatch(r"Random seed: \d+ \(--seed \d+ repeats this run\)", seed_line)
    assert lines[:6] == [
        f"Loading robot model from {EXAMPLE}...",
        "Identified terminal joint: joint6",
        "Generating excitation trajectory (15.0s, 1000 Hz)...",
        "Running MuJoCo simulation...",
        "Collecting regressor data: 100%",
        "Solving for parameters...",
    ]
    assert lines[6:13] == [
        "Identified parameters:",
        "  Mass: 0.789 kg",
        "  CoM moment: [-0.000, 0.009, 0.120] kg·m",
        "  Inertia: [0.024, 0.000, 0.000, 0.024, -0.002, 0.001] kg·m²",
        "  Coulomb friction: 0.40 N·m",
        "  Viscous friction: 0.10 N·m·s/rad",
        "  RMSE: 0.0000 N·m",
    ]
    assert re.fullmatch(r"  Condition number: \d+\.\d", lines[13])
    assert lines[14] == "  Base parameters: 12"
    assert lines[-1] == "Results saved to ./sysid_output/"
    written = sorted(p.name for p in (tmp_path / "sysid_output").iterdir())
    assert written == ["params.json", "updated_model.xml"]


BAD_FILES = {
    "no such file": (None, "not found"),
    "not XML": ("hello", "Expected an XML model file"),
    "empty": ("", "Expected an XML model file"),
    "truncated": (ARM[: len(ARM) // 2], "XML"),
    "entity bomb": (BOMB, "entit"),
    "fragment": (FRAGMENT, "fragment"),
    "no joints": (NO_JOINTS, "no hinge or slide joints"),
    "ball joint in the chain": (BALL, "ball joint shoulder"),
    "missing mesh": (MISSING_MESH, "cup.stl"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_exit_2_with_one_line_and_nothing_written(case, arm, capsys):
    text, word = BAD_FILES[case]
    path = arm.with_name("bad.xml")
    if text is not None:
        path.write_text(text)
    _expect_usage_error([str(path)], word, arm.parent, capsys)


BAD_OPTIONS = {
    "zero duration": (["--duration", "0"], "--duration must be positive"),
    "negative duration": (["--duration", "-3"], "--duration must be positive"),
    "duration not a number": (["--duration", "nan"], "--duration must be positive"),
    "endless duration": (["--duration", "inf"], "--duration must be positive"),
    "duration in words": (["--duration", "long"], "--duration"),
    "zero rate": (["--sample-rate", "0"], "--sample-rate must be positive"),
    "rate not a number": (["--sample-rate", "nan"], "--sample-rate must be positive"),
    "too few samples": (["--duration", "0.1", "--sample-rate", "1"], "two samples"),
    "negative seed": (["--seed", "-1"], "--seed"),
    "zero speed": (["--max-velocity", "0"], "--max-velocity must be positive"),
    "unknown joint": (["--joint", "wrist"], "the model has: shoulder, elbow"),
    "unknown torques": (["--torques", "some"], "chain"),
    "unknown option": (["--frobnicate"], "--frobnicate"),
    "no motor type": (["--export-damiao"], "--export-damiao requires at least one --motor-type"),
    "unknown motor type": (
        ["--export-damiao", "--motor-type", "DM1", "--motor-type", "DM4340"],
        "DM4340_48V",
    ),
    "too few motor types": (["--export-damiao", "--motor-type", "DM4340"], "2 joints"),
    "no mesh folder": (["--mesh-dir", "nowhere"], "nowhere"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options_exit_2_with_one_line_and_nothing_written(case, arm, capsys):
    options, word = BAD_OPTIONS[case]
    _expect_usage_error([str(arm), *options], word, arm.parent, capsys)


def test_a_directory_is_not_a_model(arm, capsys):
    _expect_usage_error([str(arm.parent)], "is a folder", arm.parent, capsys)


def test_an_output_folder_that_is_a_file_is_refused(arm, capsys):
    (arm.parent / "taken").write_text("")
    options = [str(arm), "--output-dir", "taken/results"]
    _expect_usage_error(options, "taken", arm.parent, capsys, {"arm.xml", "taken"})


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_output_folder_is_refused(arm, capsys):
    locked = arm.parent / "locked"
    locked.mkdir(mode=0o555)
    options = [str(arm), "--output-dir", "locked/results"]
    _expect_usage_error(options, "locked", arm.parent, capsys, {"arm.xml", "locked"})


def _expect_usage_error(arguments, word, folder, capsys, expected=None):
    code = main(arguments)
    printed = capsys.readouterr()
    errors = printed.err.splitlines()
    assert code == 2
    assert len([line for line in errors if line.startswith("robot-sysid: error: ")]) == 1
    assert len(errors) == 1, errors
    assert word in errors[0]
    left = {path.name for path in folder.iterdir()}
    assert left <= (expected or {"arm.xml", "bad.xml"})


def test_no_friction_drops_the_two_friction_lines(arm, capsys):
    assert main([str(arm), "--no-friction", "--seed", "1"]) == 0
    printed = capsys.readouterr().out
    assert "Mass:" in printed and "friction:" not in printed


def test_terminal_torques_say_what_they_cannot_see(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([str(EXAMPLE), "--torques", "terminal", "--seed", "1"]) == 0
    printed = capsys.readouterr().out
    assert "Base parameters: 9" in printed
    assert "Mass: 0.789 kg" in printed
    assert "Not visible in these torques, kept from the model: mass" in printed


def test_quiet_prints_nothing(arm, capsys):
    assert main([str(arm), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_seed_repeats_a_run_to_the_last_bit(arm, capsys):
    for folder in ("a", "b"):
        assert main([str(arm), "--seed", "42", "--output-dir", folder]) == 0
    first, second = ((arm.parent / f / "updated_model.xml").read_bytes() for f in ("a", "b"))
    assert first == second


def test_a_fresh_seed_is_drawn_each_time(arm, capsys):
    printed = []
    for _ in range(2):
        main([str(arm)])
        printed.append(re.search(r"Random seed: (\d+)", capsys.readouterr().out).group(1))
    assert printed[0] != printed[1]


def test_debug_shows_the_traceback(arm, capsys):
    assert main([str(arm), "--joint", "wrist", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_an_interrupt_leaves_no_file(arm, capsys, monkeypatch):
    import robot_sysid.results as results

    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "require_reproduction", interrupt)
    assert main([str(arm)]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert {p.name for p in arm.parent.rglob("*") if p.is_file()} == {"arm.xml"}


def test_version(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out.strip() == f"robot-sysid {__version__}"


def test_every_option_has_help():
    for action in build_parser()._actions:
        assert action.help, action.option_strings


def test_the_installed_command_leaves_nothing_but_results(arm):
    """A whole process: no MUJOCO_LOG.TXT, nothing raw on standard error."""
    process = subprocess.run(
        [sys.executable, "-m", "robot_sysid.cli", str(arm), "--seed", "3"],
        capture_output=True,
        text=True,
        cwd=arm.parent,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert process.stderr == f"note: {ITSELF}\n"
    assert {p.name for p in arm.parent.iterdir()} == {"arm.xml", "sysid_output"}
