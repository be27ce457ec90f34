"""The command line: output block, options, one line per error, exit codes, nothing left behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from robot_sysid import __version__
from robot_sysid.cli import main
from robot_sysid.errors import SysidError
from robot_sysid.estimation.identify import ITSELF
from robot_sysid.records.atomic_files import only_run_in
from tests.support.command_line import files_in
from tests.support.places import GUESS

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


def test_an_error_is_a_line_that_can_be_read(capsys):
    """However long a name in it: its beginning and its end."""
    assert main(["b" + "a" * 5000 + ".xml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert len(line) < 2000 and " [...] " in line and "cannot read model file" in line


@pytest.mark.parametrize("mark", ["\x1b[31m", "\u202e"])
def test_names_cannot_steer_the_terminal(tmp_path, capsys, mark):
    path = tmp_path / f"a{mark}.xml"
    assert main([str(path)]) == 2
    if mark != "\x1b[31m":  # XML itself has none of these.
        path.write_text(ARM.replace("elbow", f"el{mark}bow"), encoding="utf-8")
        assert main([str(path), "--duration", "1", "--output-dir", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert mark[0] not in printed.out + printed.err


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
    assert main([str(GUESS)]) == 0
    lines = capsys.readouterr().out.splitlines()
    seed_line = lines.pop(3)
    assert re.fullmatch(r"Random seed: \d+ \(--seed \d+ repeats this run\)", seed_line)
    assert lines[:6] == [
        f"Loading robot model from {GUESS}...",
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
    assert lines[15:17] == ["Results saved to ./sysid_output/", "Before -> after:"]
    assert lines.pop() == "Result: all requested parameters are identified from the data"
    table = [re.split(r"  +", line.strip()) for line in lines[18:]]
    assert table[0] == ["mass", "0.7892", "0.7892", "kg", "none"]
    assert {row[-1] for row in table} == {"none"}
    written = {p.name for p in (tmp_path / "sysid_output").iterdir()}
    assert written >= {"params.json", "updated_model.xml"}
    assert not any(name.startswith(".") for name in written)


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
    "duration in words": (["--duration", "long"], "--duration"),
    "no output folder": (["--output-dir", ""], "--output-dir: the folder's name is empty"),
    "output folder without a name": (["--output-dir", "\udcff"], "cannot be written as UTF-8"),
    "output folder with too long a name": (["--output-dir", 300 * "n"], "File name too long"),
    "log with too long a name": (["--measurements", 300 * "n"], "File name too long"),
    "unknown joint": (["--joint", "wrist"], "the model has: shoulder, elbow"),
    "unknown option": (["--measurement", "a"], "--measurement: did you mean --measurements?"),
    "no motor type": (["--export-damiao"], "--export-damiao requires at least one --motor-type"),
    "unknown motor type": (
        ["--export-damiao", "--motor-type", "DM1", "--motor-type", "DM4340"],
        "DM4340_48V",
    ),
    "too few motor types": (["--export-damiao", "--motor-type", "DM4340"], "2 joints"),
    "no mesh folder": (["--mesh-dir", "nowhere"], "nowhere does not exist"),
    "mesh folder is a file": (["--mesh-dir", "arm.xml"], "arm.xml is not a folder"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options_exit_2_with_one_line_and_nothing_written(case, arm, capsys):
    options, word = BAD_OPTIONS[case]
    _expect_usage_error([str(arm), *options], word, arm.parent, capsys)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("nosuch", True),
        ("robot.stl", True),
        ("arm2.xml", False),
        ("a.MJCF", False),
        ("b.urdf", False),
    ],
)
def test_a_path_that_is_no_model_by_its_name_is_told_what_is_expected(name, expected, command):
    message = command.refused(name)
    assert f"model file {Path(name).absolute()} not found; check the path" in message
    assert ("Expected an XML model file" in message) == expected


def test_a_command_that_is_misspelt_is_told_what_is_near(command):
    assert "no command identfy: did you mean identify?" in command.refused("identfy", "a.xml")


def test_a_directory_is_not_a_model(arm, capsys):
    _expect_usage_error([str(arm.parent)], "is a folder", arm.parent, capsys)


def test_an_output_folder_that_is_a_file_is_refused(arm, capsys):
    (arm.parent / "taken").write_text("")
    options = [str(arm), "--output-dir", "taken/results"]
    _expect_usage_error(options, "taken", arm.parent, capsys, {"arm.xml", "taken"})


@pytest.mark.parametrize(
    "words", ["{}", "plan {}", "payload {} --empty-model {} --loaded-model {}"]
)
def test_a_working_folder_that_is_gone_is_one_line(words, arm, monkeypatch, capsys):
    gone = arm.parent / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    words = [word.format(arm) for word in words.split()]
    _expect_usage_error(words, "current folder no longer", arm.parent, capsys)


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
    assert main([str(GUESS), "--torques", "terminal", "--seed", "1"]) == 0
    printed = capsys.readouterr().out
    assert "Base parameters: 9" in printed
    assert "Mass: 0.789 kg" in printed
    assert "Not visible in these torques, kept from the model: mass" in printed


def test_friction_of_a_slide_is_a_force(arm, capsys):
    arm.write_text(ARM.replace('<joint name="elbow"', '<joint name="elbow" type="slide"'))
    assert main([str(arm), "--seed", "1"]) == 0
    printed = capsys.readouterr().out
    assert "  Coulomb friction: 0.00 N\n  Viscous friction: 0.00 N·s/m\n" in printed


def test_a_model_that_cannot_be_written_keeps_the_numbers(arm, capsys):
    """Exit code 1, params.json, no model; an older model goes, and is said to have gone."""
    assert main([str(arm), "--seed", "1", "--quiet"]) == 0
    arm.write_text(ARM.replace("<worldbody>", '<compiler settotalmass="2"/><worldbody>'))
    (arm.parent / "sysid_output/params.json").unlink()
    capsys.readouterr()
    assert main([str(arm), "--seed", "1"]) == 1
    printed = capsys.readouterr()
    assert "Identified parameters:" in printed.out
    assert "settotalmass" in printed.err.splitlines()[-1]
    assert "updated_model.xml of an earlier run was removed" in printed.err
    assert [path.name for path in (arm.parent / "sysid_output").iterdir()] == ["params.json"]


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
    import robot_sysid.results.model as results

    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "require_reproduction", interrupt)
    assert main([str(arm)]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert {p.name for p in arm.parent.rglob("*") if p.is_file()} == {"arm.xml"}


FIRST, SECOND = ("--seed", "1"), ("--seed", "2")
EXPORT = ("--quiet", "--export-damiao", *(("--motor-type", "DM4340") * 2))
RESULTS = ("damiao_trajectory.csv", "params.json", "updated_model.xml")
SHORT = ("--duration", "1", "--sample-rate", "100")


@pytest.fixture
def first(command, arm):
    """The files of a run, which are in the output folder."""
    command.run(arm, *SHORT, *EXPORT, *FIRST)
    found = files_in(arm.parent / "sysid_output")
    assert sorted(found) == list(RESULTS)
    return found


def test_a_signal_waits_until_the_new_set_is_there_with_the_model_last(
    first, command, arm, monkeypatch
):
    replace, order = os.replace, []

    def interrupted(source, target):
        replace(source, target)
        order.append(Path(target).name)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        printed = command.run(arm, *SHORT, *EXPORT, *SECOND, code=130)
    assert printed.err == "robot-sysid: error: interrupted; no unfinished file is left\n"
    assert sorted(order) == list(RESULTS) and order[-1] == "updated_model.xml"
    second = files_in(arm.parent / "sysid_output")
    assert sorted(second) == list(RESULTS)
    assert all(second[name] != first[name] for name in RESULTS)


def test_a_signal_at_work_leaves_the_old_results_and_no_drafts(first, command, arm, monkeypatch):
    def stop(*_, **__):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("robot_sysid.results.model.require_reproduction", stop)
    command.run(arm, *SHORT, *EXPORT, *SECOND, code=130)
    assert files_in(arm.parent / "sysid_output") == first


def test_two_runs_do_not_write_into_one_folder(command, arm):
    with only_run_in(arm.parent / "sysid_output"):
        message = command.refused(arm, *SHORT)
        assert message.endswith(
            "another run is writing to sysid_output; wait until it ends, or choose another "
            "--output-dir"
        )
        command.run(arm, *SHORT, "--output-dir", "elsewhere")
    command.run(arm, *SHORT)


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


def test_the_command_runs_as_a_module(arm):
    process = _run_command("--version", cwd=arm.parent, module="robot_sysid")
    assert (process.returncode, process.stdout) == (0, f"robot-sysid {__version__}\n".encode())


def test_a_reader_that_goes_away_does_not_cost_the_results(arm):
    reader, writer = os.pipe()
    os.close(reader)
    process = _run_command(str(arm), "--seed", "3", cwd=arm.parent, stdout=writer)
    os.close(writer)
    assert (process.returncode, process.stderr) == (0, f"note: {ITSELF}\n".encode())
    assert (arm.parent / "sysid_output" / "params.json").is_file()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_output_that_cannot_be_printed_is_one_line(arm):
    with open("/dev/full", "wb") as full:
        process = _run_command(str(arm), cwd=arm.parent, stdout=full)
    assert process.returncode == 2
    assert process.stderr.startswith(b"robot-sysid: error: cannot print: ")
    assert process.stderr.count(b"\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="streams cannot be closed by a shell")
def test_closed_streams_do_not_matter(arm):
    command = f"exec '{sys.executable}' -m robot_sysid '{arm}' --seed 3 >&- 2>&-"
    assert subprocess.run(["sh", "-c", command], cwd=arm.parent, check=False).returncode == 0
    assert (arm.parent / "sysid_output" / "params.json").is_file()


def test_an_interrupt_that_a_module_turns_into_another_error_is_still_one(arm, capsys, monkeypatch):
    def interrupted_import(*_args):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    monkeypatch.setattr("robot_sysid.pipeline.run", interrupted_import)
    assert main([str(arm)]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(os.name == "nt", reason="signals cannot be sent to oneself")
def test_an_interrupt_on_the_way_out_of_the_process_is_not_heard(arm):
    code = (
        "import atexit, signal, sys; from robot_sysid.cli import main; "
        "atexit.register(lambda: signal.raise_signal(signal.SIGINT)); "
        f"sys.argv = ['robot-sysid', {str(arm)!r}, '--quiet']; sys.exit(main())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=arm.parent, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")


def test_an_interrupt_while_the_command_is_loaded_is_one_line(arm, capsys, monkeypatch):
    def interrupt(name):
        raise KeyboardInterrupt

    monkeypatch.setattr("robot_sysid.cli.importlib.import_module", interrupt)
    assert main([str(arm)]) == 130
    assert capsys.readouterr().err == "robot-sysid: error: interrupted\n"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_a_signal_that_nohup_makes_the_process_ignore_stays_ignored(arm, monkeypatch):
    def run(*_):
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        raise SysidError("stop here")

    monkeypatch.setattr("robot_sysid.pipeline.run", run)
    usual = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert main([str(arm)]) == 1
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, usual)


def test_warnings_of_libraries_come_out_as_notes(arm, capsys, monkeypatch):
    def warn(*_args):
        warnings.warn("overflow encountered", RuntimeWarning, stacklevel=1)
        raise SysidError("stop here")

    monkeypatch.setattr("robot_sysid.pipeline.run", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main([str(arm)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["note", "robot-sysid"]


def _run_command(*arguments, cwd, module="robot_sysid.cli", stdout=subprocess.PIPE):
    return subprocess.run(
        [sys.executable, "-m", module, *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        cwd=cwd,
        check=False,
    )
