"""What to do after a result or a plan, and that the path of commands ends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robot_sysid.records.messages import NextStep
from robot_sysid.results.next_steps import (
    PAYLOAD_RECORDINGS,
    RunWords,
    last_lines,
    next_step,
    step_after_plan,
    use_lines,
    weighing_words,
)
from tests.support import results as made

RUN = RunWords(
    "an arm.xml",
    arm=("--joint", "j6"),
    log=("--units", "deg"),
    folder=Path("out"),
    empty=("a.csv",),
)
PLANNED = replace(RUN, plan=Path("out/trajectory.toml"), plan_purpose="link")
LINKS = replace(RUN, links=True)
FILES = [Path("out/updated_model.xml"), Path("out/params.json")]
PLAN = "robot-sysid plan out/updated_model.xml --joint j6"


def link_with(share, cause="links"):
    """A result whose mass is known to a share of it, limited by a cause."""
    result = made.found(made.with_value("m", 2.0, 2.0 * share))
    link = result.links[-1]
    noise = (0.6 if cause == "links" else 0.8) * link.errors
    other = {"links" if cause == "noise" else cause: 0.6 * link.errors}
    if cause != "noise":
        other = {cause: 0.8 * link.errors}
    return replace(result, links=(replace(link, noise_errors=noise, budget=other),))


def command_after(result, run, files=FILES):
    """The next command on one line; "" where nothing is left to do."""
    step = next_step(result, run, files)
    return "" if step is None else step.lines()[-1].strip()


def test_a_plan_with_the_mjcf_of_a_urdfs_arm_keeps_the_speed_limits_of_the_urdf():
    """An MJCF cannot state them; without the option, every joint could turn at 2 rad/s."""
    file = made.model_file()
    mjcf_file = replace(file, urdf_file=file)
    for speeds, option in {(1.5, 3.0): "--max-velocity 1.5,3 ", (2.0, 2.0): ""}.items():
        limits = replace(made.ARM.limits, velocity=np.array(speeds))
        robot = replace(made.ARM, kind="urdf", limits=limits)
        result = replace(link_with(3.37), robot=robot, file=mjcf_file)
        command = f"{PLAN} {option}--output-dir out/planned"
        assert command_after(result, RUN) == command
        assert "--max-velocity" not in command_after(replace(result, file=file), RUN)


@pytest.mark.parametrize(
    ("result", "run", "command"),
    [
        # A model that predicts torques is done.
        (link_with(0.001), RUN, ""),
        (link_with(0.3, "noise"), RUN, ""),
        # The links limit the mass: weigh by difference.
        (link_with(0.095), RUN, f"{PLAN} --for payload --output-dir out/weighing"),
        # The log leaves the mass open.
        (link_with(3.37), RUN, f"{PLAN} --output-dir out/planned"),
        (made.found(made.without_mass()), RUN, f"{PLAN} --output-dir out/planned"),
        # No motion determines the mass.
        (
            link_with(3.37),
            replace(RUN, is_out_of_reach=True),
            f"{PLAN} --for payload --output-dir out/weighing",
        ),
        # After a planned motion no other one is planned.
        (
            link_with(3.37, "noise"),
            PLANNED,
            f"{PLAN} --config out/trajectory.toml --for payload --output-dir out/weighing",
        ),
        # Every mass was asked for.
        (link_with(0.3, "noise"), LINKS, f"{PLAN} --for arm --output-dir out/planned"),
        (link_with(0.095), LINKS, f"{PLAN} --for payload --output-dir out/weighing"),
        (link_with(0.3, "noise"), replace(LINKS, plan_purpose="arm"), ""),
        # A slow first motion leads to the one that identifies.
        (
            link_with(0.001),
            replace(PLANNED, plan_purpose="weight"),
            f"{PLAN} --config out/trajectory.toml --for link --output-dir out/planned",
        ),
        (
            made.itself(),
            RUN,
            "robot-sysid plan 'an arm.xml' --joint j6 --output-dir out/planned",
        ),
    ],
)
def test_after_an_arm_comes_what_its_question_still_needs(result, run, command):
    assert command_after(result, run) == command


WEIGHT_COMMAND = (
    "robot-sysid payload 'an arm.xml' --joint j6 --units deg --empty a.csv --loaded out/weight.csv "
    "--known-mass 1 --save-torque-scale out/torque_scale/torque_scale.json --output-dir "
    "out/torque_scale"
)


def payload_with(cause, mass=0.3):
    """A payload whose mass error of 0.01 kg is mostly of one cause."""
    body = made.body(mass)
    return made.payload(replace(body, budget={cause: 0.8 * body.errors}))


@pytest.mark.parametrize(
    ("result", "run", "line"),
    [
        (payload_with("torque scale", 1.2), RUN, ""),
        (payload_with("torque scale"), RUN, WEIGHT_COMMAND),
        (payload_with("torque scale"), replace(RUN, scales="scale.json"), ""),
        (
            payload_with("delay"),
            RUN,
            "robot-sysid plan 'an arm.xml' --joint j6 --for payload --output-dir out/weighing",
        ),
        (payload_with("delay"), replace(RUN, plan_purpose="payload"), ""),
        (
            payload_with("gravity"),
            RUN,
            "Next, to know the mass better, level the base, and state with --gravity-uncertainty "
            "how well",
        ),
    ],
)
def test_after_a_payload_comes_what_limits_its_mass(result, run, line):
    assert command_after(result, run) == line


def test_scales_from_a_known_mass_repeat_the_run_or_identify_the_arm(tmp_path):
    calibration = made.payload(known_mass=1.0)
    scales = str(tmp_path / "scale" / "s.json")
    run = replace(RUN, folder=tmp_path / "scale", scales=scales)
    scale_words = f"--torque-scale {scales}"
    identify = "robot-sysid identify 'an arm.xml' a.csv --joint j6 --units deg"
    assert command_after(calibration, run) == f"{identify} {scale_words}"
    (tmp_path / "run.toml").write_text("")
    command = command_after(calibration, run, [])
    settings = f"--config {tmp_path}/run.toml {scale_words}"
    assert command == f"robot-sysid payload {settings}"
    assert next_step(calibration, replace(run, scales=None), []) is None


@pytest.mark.parametrize("columns", [(), ("--columns", "c.txt")])
def test_a_columns_file_asks_for_recordings_of_the_recorder_that_it_describes(columns):
    """Another recorder writes other columns, which the printed command would refuse."""
    run = replace(RUN, log=columns)
    weighing = payload_with("torque scale")
    steps = [step_after_plan(run, [], purpose) for purpose in ("link", "payload")]
    steps.append(next_step(weighing, run, []))
    for step in steps:
        remark = "with the recorder that the columns file describes as"
        assert (remark in step.sentence) == bool(columns)
        assert ("--columns" in step.command) == bool(columns)


def test_the_last_lines_name_the_files_that_were_written():
    step = NextStep("Next, plan", ("robot-sysid", "plan", "it's.xml"))
    verdict, *lines = last_lines(
        made.found(), [Path("o ut/updated_model.urdf")], step, None
    )
    assert verdict.startswith("Usable: ")
    assert lines == [
        "Use this file: o ut/updated_model.urdf",
        '  mujoco.MjModel.from_xml_path("o ut/updated_model.urdf")',
        "Next, plan:",
        "  robot-sysid plan 'it'\"'\"'s.xml'",
    ]
    card = last_lines(made.payload(), [Path("out/payload_card.txt")], None, None)[1]
    frame = "in the frame of site 'flange'"
    assert card == f"Copy into the controller, {frame}: out/payload_card.txt"
    refused = last_lines(made.found(), FILES, step, "the disk is gone")
    assert refused == ("Not usable: the disk is gone",)


def test_a_path_with_quotes_is_python_too():
    _, load = use_lines(Path('a "b".xml'))
    assert load == '  mujoco.MjModel.from_xml_path("a \\"b\\".xml")'


@pytest.mark.parametrize(
    ("purpose", "command"),
    [
        ("link", "identify 'an arm.xml' out/log.csv"),
        ("friction", "identify 'an arm.xml' out/log.csv"),
        ("weight", "identify 'an arm.xml' out/log.csv"),
        ("arm", "identify 'an arm.xml' out/log.csv --links"),
        (
            "payload",
            "payload 'an arm.xml' --empty out/empty.csv out/empty_again.csv "
            "--loaded out/loaded.csv out/loaded_again.csv --order ABBA",
        ),
    ],
)
def test_after_a_plan_its_recording_is_identified(purpose, command):
    sentence, line = step_after_plan(RUN, [], purpose).lines()
    options = "--joint j6 --units deg --output-dir out"
    assert line == f"  robot-sysid {command} {options}"
    names = (
        tuple(f"out/{name}" for name in PAYLOAD_RECORDINGS)
        if purpose == "payload"
        else ("out/log.csv",)
    )
    assert all(name in sentence for name in names)


def test_a_written_model_is_no_prior_of_the_next_identification():
    run = replace(RUN, model="out/updated_model.xml", origin=("arm.xml", "first.csv"))
    line = step_after_plan(run, []).lines()[1]
    assert line.startswith("  robot-sysid identify arm.xml first.csv out/log.csv ")
    weighing = step_after_plan(run, [], "payload").lines()[1]
    assert weighing.startswith("  robot-sysid payload out/updated_model.xml --empty ")


def test_a_motion_for_motors_is_rehearsed_first():
    file = Path("out/damiao_trajectory.csv")
    plane = ["--keep-out", "0", "0", "1", "0"]
    line = step_after_plan(RUN, [file], limits=plane).lines()[1]
    rehearsal = f"motors simulate {file} --model 'an arm.xml' --joint j6"
    assert line == f"  robot-sysid {rehearsal} --keep-out 0 0 1 0 --play"
    static = step_after_plan(replace(RUN, is_static=True), [], "payload").lines()[1]
    assert "--order ABBA --static " in static
    for is_static in (False, True):
        words = weighing_words(replace(RUN, is_static=is_static), Path("weight.csv"))
        assert ("--static" in words) == is_static
