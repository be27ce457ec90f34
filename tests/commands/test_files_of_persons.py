"""Nothing of a person's is lost: every command beside every file that it writes.

A table of commands; the files of each come from its options. A person's file is there by the name,
or another run is writing, or the run is killed between two of its changes of the folder.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import robot_sysid as rs
from rigs.arms import small_arms
from rigs.files.command_line import files_in
from rigs.files.other_process import running
from rigs.files.places import ROOT
from rigs.logs.measured_logs import XML, log_of, true_arm
from rigs.motors.damiao_rig import swing, trajectory_file
from robot_sysid.cli import main
from robot_sysid.config import (
    Config,
    IdentifyConfig,
    PayloadConfig,
    PlanConfig,
    SelfTestConfig,
)
from robot_sysid.logs.text import write_measurement_csv
from robot_sysid.records.drafts import HIDDEN_PREFIX, locked
from robot_sysid.records.file_access import RECORD_NAME, is_marked, is_replaceable

SHORT = "--duration 3 --sample-rate 100 --seed 1 --output-dir out"
MOTORS = "--export-damiao --motor-type DM8009 --motor-type DM8009"
RUNS = {
    "self-test": (
        f"arm.xml {SHORT} --save-trajectory p.json --save-measurements m.csv --plant-model arm.xml "
        "--report",
        SelfTestConfig.of(
            Path("arm.xml"),
            output_dir="out",
            save_trajectory=Path("p.json"),
            save_measurements=Path("m.csv"),
            plant_model=Path("arm.xml"),
            report=True,
        ),
    ),
    "self-test for motors": (
        f"two.xml {SHORT} {MOTORS}",
        SelfTestConfig.of(
            Path("two.xml"), output_dir="out", motor_type=("DM8009", "DM8009")
        ),
    ),
    "plan": (
        f"plan two.xml --excitation sines {SHORT} {MOTORS}",
        PlanConfig.of(
            Path("two.xml"), output_dir="out", motor_type=("DM8009", "DM8009")
        ),
    ),
    "plan for servos": (
        f"plan arm.xml --excitation sines {SHORT} --save-trajectory p.json --for servos",
        PlanConfig.of(
            Path("arm.xml"),
            output_dir="out",
            save_trajectory=Path("p.json"),
            for_="servos",
        ),
    ),
    "identify": (
        "identify arm.xml log.csv --output-dir out --cards all --report",
        IdentifyConfig.of(
            Path("arm.xml"),
            measurements=(Path("log.csv"),),
            output_dir="out",
            cards="all",
            report=True,
        ),
    ),
    "payload": (
        "payload arm.xml --empty log.csv --loaded other.csv --output-dir out",
        PayloadConfig.of(
            Path("arm.xml"),
            empty=(Path("log.csv"),),
            loaded=(Path("other.csv"),),
            output_dir="out",
        ),
    ),
    "payload of a known mass": (
        "payload arm.xml --empty log.csv --loaded other.csv --output-dir out --known-mass 1 "
        "--save-torque-scale scale.json",
        PayloadConfig.of(
            Path("arm.xml"),
            empty=(Path("log.csv"),),
            loaded=(Path("other.csv"),),
            output_dir="out",
            known_mass=1.0,
            save_torque_scale=Path("scale.json"),
        ),
    ),
}
"""Run to its words, and the options by which its files are known."""
OTHER_FILES = {
    "motors simulate": ("motion.csv --model two.xml --record rec.csv", "rec.csv"),
    "motors map": ("--channel can0 --model two.xml --output map.csv", "map.csv"),
    "example": ("kinova --output-dir copy", "copy"),
}
"""Command to its words and the one path that it writes; it refuses whatever is there."""


def files_of(config: Config) -> list[Path]:
    return list(dict.fromkeys(path for _, path in config.written_files()))


CASES = [
    pytest.param(words, path, id=f"{name}-{path}")
    for name, (words, config) in RUNS.items()
    for path in files_of(config)
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Name to content of what the commands read."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "arm.xml").write_text(XML)
    (folder / "two.xml").write_text(small_arms.serial_arm((small_arms.Z, small_arms.Y)))
    arm = true_arm()
    for seed, name in enumerate(("log.csv", "other.csv")):
        log = log_of(arm, noise_torque=0.1, seed=seed)
        write_measurement_csv(folder / name, arm.joint_names, [log])
    text = (folder / "log.csv").read_text()
    (folder / "bad.csv").write_text("\n".join(text.splitlines()[:3]))
    path = trajectory_file(folder, swing(2, duration=0.5, amplitude=0.05)).path
    path.rename(folder / "motion.csv")
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def place(inputs, tmp_path, monkeypatch):
    """The working folder, with what the commands read and a person's notes."""
    for name, content in inputs.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(words, capsys):
    """The error of a command line that does nothing else."""
    capsys.readouterr()
    assert main(words.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    return printed.err


def hidden_files(folder):
    """Drafts and locks anywhere in a folder."""
    paths = folder.rglob(f"{HIDDEN_PREFIX}*")
    return [path for path in paths if path.name != RECORD_NAME]


@pytest.mark.parametrize(("words", "path"), CASES)
def test_a_persons_file_is_refused_before_any_work(place, capsys, words, path):
    for other_words in (words, words.replace("log.csv", "bad.csv")):
        path.write_text("mine")
        before = files_in(place)
        error = refusal(other_words, capsys)
        assert f"would replace {path}, which no run wrote" in error
        assert "choose another, or move that file away" in error
        assert files_in(place) == before and not hidden_files(place)


def test_a_link_is_a_persons_file(place, capsys):
    target = place / "mine.xml"
    target.write_text("mine")
    Path("out/updated_model.xml").symlink_to(target)
    refusal(RUNS["identify"][0], capsys)
    assert Path("out/updated_model.xml").is_symlink() and target.read_text() == "mine"


@pytest.mark.parametrize("command", OTHER_FILES)
def test_commands_that_replace_nothing_say_so(place, capsys, command):
    words, path = OTHER_FILES[command]
    Path(path).write_text("mine")
    before = files_in(place)
    assert f"{path} exists" in refusal(f"{command} {words}", capsys)
    assert files_in(place) == before


OCCUPYING = """
import sys, time
from pathlib import Path
from robot_sysid.records.file_access import claim
with claim([("--output-dir", Path(path)) for path in sys.argv[1:]], print):
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def other_run(place):
    """Another process that is writing to out/."""
    with running(OCCUPYING, "out/x", folder=place) as process:
        yield process


def test_a_second_run_is_refused_and_a_killed_one_taken_over(place, other_run, capsys):
    before = files_in(place)
    for name, (words, config) in RUNS.items():
        if config.settings_file.parent == Path("out"):
            error = refusal(words, capsys)
            occupied = (
                f"to out, and another run, process {other_run.pid}, is writing there;"
            )
            assert occupied in error, name
    assert files_in(place) == before
    other_run.send_signal(signal.SIGKILL)
    other_run.wait()
    words = RUNS["identify"][0].replace(" --report", "").split()
    assert main(words) == 0
    assert main(words) == 0
    assert not hidden_files(place)
    Path("out/report.html").write_text("mine")
    assert "would replace out/report.html" in refusal("report out", capsys)
    # What a run without a page would only remove stays where it is a person's.
    assert main(words) == 0
    assert Path("out/report.html").read_text() == "mine"


def test_two_runs_do_not_write_one_recording(place, capsys):
    words = "motors simulate motion.csv --model two.xml --record rec.csv --overwrite"
    with locked(Path("rec.csv")):
        error = refusal(words, capsys)
        assert f"rec.csv, and another run, process {os.getpid()}, is writing" in error
    assert not hidden_files(place)


@pytest.mark.slow
def test_a_recording_is_replaced_by_another_where_that_is_asked_for(place, capsys):
    words = "motors simulate motion.csv --model two.xml --record rec.csv"
    assert main(words.split()) == 0
    assert "rec.csv exists" in refusal(words, capsys)
    assert main([*words.split(), "--overwrite"]) == 0
    assert not hidden_files(place)


def test_calls_of_python_obey_the_same_rules(place, inputs):
    result = rs.identify("arm.xml", "log.csv")
    plan = rs.plan("arm.xml", duration=3.0, seed=1, excitation="sines")
    for save, path in (
        (lambda: result.save("out"), Path("out/updated_model.xml")),
        (lambda: plan.save("p.json"), Path("p.csv")),
        (
            lambda: rs.self_test("arm.xml", save_measurements=Path("m.csv")),
            Path("m.csv"),
        ),
    ):
        path.write_text("mine")
        before = files_in(place)
        with pytest.raises(rs.InputError, match="which no run wrote"):
            save()
        assert files_in(place) == before
        path.unlink()
        save()
        save()
        assert is_replaceable(path)
    with pytest.warns(UserWarning, match=r"kept as p\.json\.old"):
        Path("p.json").write_text(Path("p.json").read_text() + " ")
        plan.save("p.json")


def test_columns_put_right_leave_a_persons_columns_file(place, capsys):
    titles, *rows = Path("log.csv").read_text().splitlines()
    torques = [k for k, title in enumerate(titles.split(",")) if "torque" in title]
    turned = []
    for row in rows:
        cells = row.split(",")
        cells[torques[0]] = str(-float(cells[torques[0]]))
        turned.append(",".join(cells))
    Path("bad.csv").write_text("\n".join([titles, *turned]))
    Path("bad_columns.txt").write_text("mine")
    for _ in range(2):
        assert main(["log", "bad.csv", "arm.xml"]) == 2
        assert "bad_columns_2.txt has the columns put right" in capsys.readouterr().err
    assert Path("bad_columns.txt").read_text() == "mine"
    assert not Path(RECORD_NAME).exists()


def test_results_without_a_record_are_known_by_their_marks_and_kept(place, capsys):
    """Those of versions before 1.0, for instance: a person may have changed them since."""
    words = RUNS["identify"][0].replace(" --report", "").split()
    assert main(words) == 0
    Path("out", RECORD_NAME).unlink()
    Path("out/report.html").write_text("Written by robot-sysid 0.1.0.")
    before = files_in(Path("out"))
    model = Path("out/updated_model.xml")
    model.write_text(model.read_text() + "<!-- mine -->")
    assert main(words) == 0
    said = capsys.readouterr().err
    assert "what was in out has the marks of this program" in said
    assert Path(f"{model}.old").read_text().endswith("<!-- mine -->")
    # A page of what was there before does not stay beside other results.
    assert "report.html.old" in said and "updated_model.xml.old" in said
    assert set(files_in(Path("out"))) > set(before) - {"report.html"}
    # From now on there is a record.
    assert main(words) == 0 and not list(Path("out").glob("*.old2"))


@pytest.mark.slow
def test_each_kind_of_result_has_marks(place):
    for name in ("identify", "payload", "plan", "self-test for motors"):
        assert main(RUNS[name][0].split()) in (0, 1)
        Path("out", RECORD_NAME).unlink()
        for path in Path("out").iterdir():
            assert is_marked(path) or path.name == "notes.txt", path


def test_a_single_file_leaves_nothing_beside_it_and_is_replaced(place, capsys):
    words, config = RUNS["plan for servos"]
    before = set(files_in(place))
    for _ in range(2):
        assert main(words.split()) == 0
        written = set(files_in(place)) - before
        assert written == {*map(str, files_of(config))}
    plan = Path("p.json")
    plan.write_text(plan.read_text() + "\n")
    assert main(words.split()) == 0
    assert "it was kept as p.json.old\n" in capsys.readouterr().err
    assert Path("p.json.old").read_text() == plan.read_text() + "\n"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_all_that_is_written_is_known_and_nothing_that_was_changed_is_replaced(
    place, capsys, name
):
    words, config = RUNS[name]
    before = set(files_in(place))
    for _ in range(2):
        assert main(words.split()) in (0, 1), capsys.readouterr().err
    written = {Path(path) for path in set(files_in(place)) - before}
    assert written and written <= set(files_of(config))
    for path in written:
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        kept = path
        if path.parent == Path("out"):
            assert f"would replace {path}" in refusal(words, capsys)
        else:
            assert main(words.split()) in (0, 1)
            kept = Path(f"{path}.old")
        assert kept.read_bytes() == content + b"\n"
        path.write_bytes(content)
    assert main(words.split()) in (0, 1)


KILLED = """
import os, signal, sys
left = int(sys.argv[1])
def count_down(step):
    def counted(*arguments, **options):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(*arguments, **options)
    return counted
for name in ("replace", "unlink", "mkdir", "rmdir"):
    setattr(os, name, count_down(getattr(os, name)))
from robot_sysid.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no SIGKILL here")
@pytest.mark.parametrize(
    ("name", "is_again"), [*((name, True) for name in RUNS), ("identify", False)]
)
def test_a_run_killed_at_any_change_loses_nothing_and_the_next_one_works(
    place, name, is_again
):
    words = RUNS[name][0].replace(" --report", "").split()
    if is_again:
        assert main(words) in (0, 1)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for count in range(1, 100):
        call = [sys.executable, "-c", KILLED, str(count), *words]
        code = subprocess.run(call, env=environment, capture_output=True).returncode
        assert Path("out/notes.txt").read_text() == "mine"
        for path in files_of(RUNS[name][1]):
            assert is_replaceable(path), (count, path)
        if code != -signal.SIGKILL:
            break
    assert code in (0, 1) and count > 4
    assert main(words) in (0, 1)
    assert not hidden_files(place)
