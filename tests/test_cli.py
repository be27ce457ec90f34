"""The command line: output block, options, one line per error, exit codes, nothing left behind."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rigs.arms.small_arms import TWO_ARMS, Y, serial_arm
from rigs.files.command_line import OUT, files_in
from rigs.files.places import GUESS
from rigs.logs.log_files import motion
from robot_sysid.cli import main, on_one_line, record_interrupts
from robot_sysid.commands.remedies import remedies
from robot_sysid.errors import ColumnsError
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records.file_access import RECORD_NAME

ARM = serial_arm((Y, "1 .2 0"))
SHORT = ("--duration", "1", "--sample-rate", "100", "--seed", "1")
EXPORT = ("--export-damiao", *(("--motor-type", "DM4340") * 2))
RESULTS = [
    "damiao_trajectory.csv",
    "damiao_trajectory_weight.csv",
    "params.json",
    "updated_model.xml",
]
WITH_OPTIONS = sorted([*RESULTS, "run.toml"])


@pytest.fixture
def arm(arm_file):
    """A two-joint model; ``command`` makes its folder the working one."""
    return arm_file(ARM)


BAD_OPTIONS = [
    ("--output-dir ''", "--output-dir: the folder's name is empty"),
    ("--output-dir \udcff", "cannot be written as UTF-8"),
    (f"--output-dir {300 * 'n'}", "File name too long"),
    (f"--trajectory {300 * 'n'}", "File name too long"),
    ("--joint wrist", "the model has: joint0, joint1"),
    ("--output-dir arm.xml/results", "arm.xml is not a folder"),
    ("--export-damiao --motor-type DM1 --motor-type DM4340", "DM4340_48V"),
    ("--export-damiao --motor-type DM4340", "2, got 1"),
    ("--mesh-dir arm.xml", "arm.xml is no folder"),
]
"""Options and a phrase of the error message that each of them gets."""


def test_bad_options_exit_2_with_one_line_and_nothing_written(arm, command):
    for options, phrase in BAD_OPTIONS:
        assert phrase in command.refused(arm, *shlex.split(options)), options


def commands_in(text):
    """The commands that are printed alone on a line, as words without the program's name."""
    lines = [line for line in text.splitlines() if line.startswith("  robot-sysid ")]
    return [shlex.split(line)[1:] for line in lines]


def test_a_doubt_about_the_joint_ends_with_commands_that_run(arm, command):
    arm.write_text(TWO_ARMS)
    remedies = commands_in(command.run(arm, *SHORT, "--no-friction", code=2).err)
    assert [remedy[-1] for remedy in remedies] == ["left_joint3", "right_joint3"]
    printed = command.run(*remedies[1]).out
    assert "Identified terminal joint: right_joint3" in printed


@pytest.mark.parametrize(
    ("prefixes", "joints"),
    [
        (["right_"], ["right_joint3"]),
        # Both, and neither.
        (["right_", "left_"], ["left_joint3", "right_joint3"]),
        ([""], ["left_joint3", "right_joint3"]),
    ],
)
@pytest.mark.parametrize("words", ["log log.csv {}", "identify {} log.csv"])
def test_of_two_arms_the_one_is_proposed_whose_joints_a_log_names(
    prefixes, joints, words, arm, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    arm.write_text(TWO_ARMS)
    names = [f"{prefix}joint{k}" for prefix in prefixes for k in range(4)]
    log = replace(motion(), joint_names=tuple(names))
    parts = [(log.q[:, k % 3], log.tau[:, k % 3]) for k in range(len(names))]
    q, tau = (np.column_stack(columns) for columns in zip(*parts))
    log = replace(log, q=q, qd=None, tau=tau)
    write_measurement_csv(tmp_path / "log.csv", names, [log])
    err = command.run(words.format(arm), code=2).err
    remedies = commands_in(err)
    assert [remedy[-2:] for remedy in remedies] == [["--joint", j] for j in joints]
    assert ("log.csv has the names of the joints up to" in err) == (len(joints) == 1)


def test_a_word_that_is_neither_model_nor_command_is_told_what_is_expected(command):
    assert "no command identfy: did you mean identify?" in command.refused(
        "identfy", "a.xml"
    )
    for name, expected in (("nosuch", True), ("robot.stl", True), ("arm2.xml", False)):
        message = command.refused(name)
        assert (
            f"model file {Path(name).absolute()} not found; check the path" in message
        )
        assert ("Expected an XML model file" in message) == expected


def test_of_a_long_name_beginning_and_end_are_shown(command):
    message = command.refused(f"begin{'n' * 100_000}end.xml")
    assert (
        "begin" in message
        and "[...]" in message
        and "end.xml" in message
        and len(message) < 2000
    )


def test_names_cannot_steer_the_terminal(tmp_path, command, arm_file):
    assert "\x1b" not in command.refused("a\x1b[31m.xml")
    path = arm_file(ARM.replace("joint1", "joi\u202ent1"), "a\u202e.xml")
    printed = command.run(path, *SHORT)
    assert "\u202e" not in printed.out + printed.err


def test_names_do_not_break_the_lines_of_what_is_written(arm, command):
    """Of joints, bodies, files and columns: every end of a line that Unicode knows."""
    ends = "\n\r\v\x1c\x85\u2028\u2029"
    odd = arm.with_name(f"a{ends}m.xml")
    references = "".join(f"&#{ord(end)};" for end in "\n\r\x85\u2028\u2029")
    odd.write_text(
        ARM.replace("joint1", f"jo{references}int1").replace(
            "link1", f"--{references}>"
        )
    )

    def count_lines(model, folder):
        """The number of lines of every printed and written text of a run."""
        texts = [*command.run(model, *SHORT, "--output-dir", folder)]
        params = arm.parent / folder / "params.json"
        texts.append(params.read_text(encoding="utf-8").strip())
        xml = params.with_name("updated_model.xml").read_text(encoding="utf-8")
        # XML keeps the ends that are no ends of lines to it.
        return [xml.count("\n"), *(len(text.splitlines()) for text in texts)]

    assert count_lines(odd, f"o{ends}ut") == count_lines(arm, "out")


def test_the_name_of_a_folder_states_no_option_and_no_command(arm, command):
    """Neither in the settings of a run, which are read again, nor in what is printed."""
    folder = "out\nsample_rate = 7\n  robot-sysid motors play\x1b[31m '\x7f"
    out = command.run(arm, *SHORT, "--output-dir", Path(folder)).out
    first, *lines = (Path(folder) / "run.toml").read_text().splitlines()
    assert first.startswith("# In ") and len(lines) == 5
    command.run("--config", Path(folder) / "run.toml")
    line = out.splitlines()[-1]
    assert line.startswith("  robot-sysid plan ") and " --output-dir $'" in line
    words = subprocess.run(
        ["bash", "-c", f'for word in {line.strip()}; do printf "%s\\0" "$word"; done'],
        capture_output=True,
        text=True,
    ).stdout.split("\0")
    assert words[-2] == f"{folder}/planned"
    assert not [c for c in out if ord(c) < 32 and c != "\n"]


def test_no_title_of_a_log_becomes_a_command_below_an_error(arm, command):
    Path("log.csv").write_text('"a\n  robot-sysid motors play --yes",b\n1,2\n3,4\n')
    error = command.run("log log.csv arm.xml", code=2).err
    assert "motors play" not in error.replace("?  robot-sysid motors play", "")


def test_what_is_not_sought_or_not_seen_is_said(arm, command):
    out = command.run(arm, *SHORT, "--no-friction").out
    assert "Mass:" in out and "friction:" not in out
    out = command.run(GUESS, *SHORT, "--torques", "terminal").out
    assert "Base parameters: 9" in out and "Mass: 0.789 kg" in out
    assert "says nothing of the real arm (not identifiable: mass" in out
    arm.write_text(
        ARM.replace('<joint name="joint1"', '<joint name="joint1" type="slide"')
    )
    out = command.run(arm, *SHORT).out
    assert "  Coulomb friction: 0.00 N\n  Viscous friction: 0.00 N·s/m\n" in out


def test_a_model_that_cannot_be_written_keeps_the_numbers(arm, command):
    """Exit code 1, params.json, no model; an older model goes, and is said to have gone.

    The compiler's settings multiply the mass that is written.
    """
    command.run(arm, *SHORT)
    arm.write_text(
        ARM.replace("<worldbody>", '<compiler settotalmass="4"/><worldbody>')
    )
    printed = command.run(arm, *SHORT, code=1)
    assert "Identified parameters:" in printed.out
    assert "settotalmass" in printed.err.splitlines()[-1]
    assert "updated_model.xml of an earlier run was removed" in printed.err
    assert set(files_in(OUT)) == {"params.json", "run.toml"}


def test_a_seed_repeats_a_run_to_the_last_bit_and_none_draws_another(arm, command):
    written = []
    for _ in range(2):
        command.run(arm, *SHORT, "--output-dir", "a")
        written.append(files_in(arm.parent / "a"))
    assert written[0] == written[1] and "params.json" in written[0]
    seeds = set()
    for _ in range(2):
        printed = command.run(arm, *SHORT[:4], "--json")
        seeds.add(json.loads(printed.out)["seed"])
    assert len(seeds) == 2
    params = OUT / "params.json"
    content = params.read_bytes()
    params.unlink()
    command.run("--config", OUT / "run.toml")
    assert params.read_bytes() == content


def test_debug_shows_the_traceback(arm, command):
    assert "Traceback" in command.run(arm, "--joint", "wrist", "--debug", code=2).err


@pytest.fixture
def old_files(command, arm):
    """Names and contents of the result files of a run in the output folder."""
    command.run(arm, *SHORT, *EXPORT)
    files = files_in(OUT)
    assert sorted(files) == WITH_OPTIONS
    return files


def test_a_signal_waits_until_the_new_set_is_there_with_the_model_last(
    old_files, command, arm, monkeypatch
):
    replace = os.replace
    order = []

    def replace_and_interrupt(source, target):
        replace(source, target)
        order.append(Path(target).name)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace_and_interrupt)
        printed = command.run(arm, *SHORT[:4], "--seed", "2", *EXPORT, code=130)
    end = "robot-sysid: error: interrupted; no unfinished file is left\n"
    assert printed.err.endswith(end)
    assert order[0] == RECORD_NAME and order[-1] == "updated_model.xml"
    assert sorted(order[1:]) == RESULTS
    new_files = files_in(OUT)
    assert sorted(new_files) == RESULTS
    assert all(new_files[name] != old_files[name] for name in RESULTS)


def test_a_signal_at_work_leaves_the_old_results_and_no_drafts(
    old_files, command, arm, monkeypatch
):
    """While the model's draft is written, and when all drafts are."""

    def call_before_a_signal(call):
        """A call that a signal follows."""

        def call_and_stop(*arguments):
            call(*arguments)
            signal.raise_signal(signal.SIGTERM)

        return call_and_stop

    for module, name in ((Path, "write_bytes"), (os, "fsync")):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, call_before_a_signal(getattr(module, name)))
            command.run(arm, *SHORT[:4], "--seed", "2", *EXPORT, code=130)
        assert files_in(OUT) == old_files


def run_process(*arguments, cwd, **streams):
    """The completed process of a command line, with its standard error."""
    call = [sys.executable, "-m", "robot_sysid", *map(str, arguments)]
    return subprocess.run(call, cwd=cwd, **{"stderr": subprocess.PIPE, **streams})


def test_a_process_leaves_nothing_but_results_though_its_reader_goes_away(arm):
    """No MUJOCO_LOG.TXT, nothing raw on standard error."""
    reader, writer = os.pipe()
    os.close(reader)
    completed = run_process(arm, *SHORT, cwd=arm.parent, stdout=writer)
    os.close(writer)
    assert (completed.returncode, completed.stderr) == (0, b"")
    assert {p.name for p in arm.parent.iterdir()} == {"arm.xml", "sysid_output"}
    assert (arm.parent / "sysid_output" / "params.json").is_file()


def test_a_mujoco_that_does_not_load_is_no_defect_of_ours(arm):
    """As pip leaves it after `pip install -U mujoco` from release 3 to 4."""
    damaged = arm.parent / "site" / "mujoco" / "__init__.py"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("raise ImportError('core bindings are missing')", "utf-8")
    paths = [str(damaged.parents[1]), os.environ.get("PYTHONPATH", "")]
    completed = subprocess.run(
        [sys.executable, "-m", "robot_sysid", str(arm)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        stderr=subprocess.PIPE,
        text=True,
    )
    first, *commands = completed.stderr.splitlines()
    assert completed.returncode == 2
    assert first.startswith("robot-sysid: error: MuJoCo does not load")
    assert commands == [
        "  pip uninstall -y mujoco mujoco-core mujoco-studio",
        "  pip install mujoco",
    ]


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_a_signal_that_nohup_makes_the_process_ignore_stays_ignored():
    old_handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with record_interrupts():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        assert main(["--version"]) == 0
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, old_handler)


def test_an_error_is_one_line_whatever_ends_of_lines_and_commands_are_in_it():
    message = f"arm.xml:\n bad {3000 * 'x'};\nrun\n  robot-sysid log a b\nor\n  this"
    line = on_one_line(message)
    assert line.startswith("arm.xml: bad xxx")
    assert line.endswith("x; run robot-sysid log a b or this")
    assert "[...]" in line and len(line) < 2000


def test_corrected_columns_take_the_place_of_those_in_use():
    error = ColumnsError("wrong", "a = b", "new.txt", [("--columns", "new.txt")])
    words = ["arm.xml", "log.csv", "--columns", "old.txt", "--links"]
    command = "robot-sysid identify arm.xml log.csv --links --columns new.txt"
    assert [*remedies(error, "identify", words, {})] == [command]
