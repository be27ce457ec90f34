"""The harnesses of ``trust``: signals end them, what they draw is repeated by its seed, and
the table of real files has what was printed."""

from __future__ import annotations

import signal

import numpy as np
import pytest

from benchmarks.accuracy import real_files
from benchmarks.trust.answers import Stopped, run_command
from benchmarks.trust.drawn_changes import Subject, draw_changes
from rigs.files.places import GUESS
from robot_sysid.records import Recording


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_a_command_ends_the_benchmark(number, tmp_path):
    """It is no answer to a log, though the command turns it into an exit code."""
    handlers = [signal.getsignal(each) for each in (signal.SIGALRM, number)]
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    try:
        with pytest.raises(Stopped) as stopped:
            run_command(GUESS, "--output-dir", tmp_path)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handlers[0])
    assert stopped.value.code == 128 + number
    assert signal.getsignal(number) is handlers[1]


@pytest.mark.slow
def test_drawn_changes_are_those_of_their_seed_and_change_the_log():
    """Each of them, of any log, keeps the number of joints and as many rows of each quantity."""
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(400)
    q = np.cumsum(rng.standard_normal((400, 6)), axis=0) / 20.0
    log = Recording(time, q, None, rng.standard_normal((400, 6)))
    names = tuple(f"joint{number}" for number in range(6))
    subject = Subject(names, log, np.ones(6))
    kinds = set()
    for seed in range(100):
        twice = [draw_changes(np.random.default_rng(seed), subject) for _ in range(2)]
        words = [[change.words for change in changes] for changes in twice]
        assert words[0] == words[1]
        spoiled = subject
        for change in twice[0]:
            spoiled = change.spoil(spoiled)
            kinds.add(change.kind)
            assert set(change.culprits) <= set(names)
        arrays = (spoiled.log.time, spoiled.log.q, spoiled.log.tau)
        assert len({len(array) for array in arrays}) == 1
        assert spoiled.log.q.shape[1] == spoiled.log.tau.shape[1] == 6
        assert any(
            not np.array_equal(new, old)
            for new, old in zip(arrays, (log.time, log.q, log.tau))
        )
    assert len(kinds) > 25


@pytest.mark.slow
def test_the_table_of_real_files_has_what_the_gate_prints():
    printed = [
        "kuka3 0-1 on kuka1 0-1: 5.59 (2.37) %, 9.8 imports; best 6.00 (2.36), 6.9",
        "tx40 0-0.7 on tx40 0.7-0.86: REFUSED (exit 2) error: too short",
        "0 worse or refused",
    ]
    assert [*real_files.table(printed)][2:] == [
        "| `kuka3` | `kuka1` | 5.59 % | 2.37 % |",
        "| `tx40`, 0 to 0.7 | `tx40`, 0.7 to 0.86 | refused |  |",
    ]
