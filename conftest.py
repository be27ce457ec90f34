"""Shared by all tests: the hypothesis profile and fixtures for arms of ``rigs.arms.small_arms``."""

from __future__ import annotations

import gc
import os
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import Phase, settings

from rigs.arms import small_arms
from rigs.files.command_line import CommandLine
from robot_sysid.model.compilation import captured_warnings

settings.register_profile("deep", max_examples=200, deadline=None)
# The same examples each time, so that a tree's verdict does not depend on luck.
settings.register_profile("repeatable", settings.get_profile("deep"), derandomize=True)
settings.register_profile("few", settings.get_profile("repeatable"), max_examples=10)
# A mutant is dead with the first example against it; looking for the smallest one takes minutes.
settings.register_profile(
    "mutants",
    settings.get_profile("repeatable"),
    phases=(Phase.explicit, Phase.generate),
    database=None,
    report_multiple_bugs=False,
)
settings.load_profile("few")


SECONDS = "processor_seconds"
"""Key of the processor time that a test took, in the properties of its report."""


def pytest_addoption(parser):
    """Take --slowest N: the processor time of single tests, which a busy machine hardly changes."""
    parser.addoption(
        "--slowest", type=int, default=0, help="N tests with most processor time"
    )


def processor_seconds():
    """Return the processor time of this process and of those that it has run [s]."""
    return sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Note when a test begins, its fixtures included."""
    item.began = processor_seconds()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item, call):
    """Put the processor time of a test into its last report."""
    if call.when == "teardown":
        item.user_properties.append((SECONDS, processor_seconds() - item.began))


def pytest_terminal_summary(terminalreporter, config):
    """Print the slowest tests, where they are asked for."""
    seconds = Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            properties = dict(getattr(report, "user_properties", ()))
            if SECONDS in properties:
                seconds[report.nodeid] = properties[SECONDS]
    for name, value in seconds.most_common(config.getoption("slowest")):
        terminalreporter.write_line(f"{value:6.2f} s of processor time: {name}")


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config):
    """Let --benchmark-enable and --benchmark-only count, though benchmarks are off by default."""
    wanted = config.getoption("benchmark_enable") or config.getoption("benchmark_only")
    config.option.benchmark_skip = config.getoption("benchmark_skip") and not wanted


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Let all cases of a test but its first ones be slow, as its mark ``fast_cases`` says."""
    collected = Counter()
    for item in items:
        mark = item.get_closest_marker("fast_cases")
        if mark is None or item.get_closest_marker("slow") is not None:
            continue
        test = item.nodeid.partition("[")[0]
        collected[test] += 1
        if collected[test] > mark.args[0]:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish(session):
    """Let the garbage collector pass over what stays: players of motions collect before each."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def arm_file(tmp_path):
    """Factory: write an XML string to a file and return its path."""

    def write(xml: str, name: str = "arm.xml") -> Path:
        path = tmp_path / name
        path.write_text(xml)
        return path

    return write


@pytest.fixture(scope="session", autouse=True)
def quiet_mujoco():
    """Keep MuJoCo from writing about needle-shaped links: a line each and a log file."""
    with captured_warnings():
        yield


@pytest.fixture
def three_joint_arm():
    """A small arm whose three joints turn about z, y and x."""
    return small_arms.robot_of(small_arms.THREE)


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """The command line, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    return CommandLine(tmp_path, capsys)
