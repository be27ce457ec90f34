"""What whole commands print, to the letter, and how they end.

``python -m rigs.files.recorded_results`` records it anew; read the difference before it is
committed.
"""

from __future__ import annotations

import pytest

from rigs.files import releases, transcripts
from robot_sysid.errors import EXIT_CODES

pytest.importorskip("can")

# Last digits and the words on what a file can hold are those of newer releases.
pytestmark = releases.since(3, 14)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """Folder of the files that commands need."""
    return tmp_path_factory.mktemp("workshop")


@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("name", transcripts.TRANSCRIPTS)
def test_a_command_prints_what_is_recorded(name, workshop):
    transcript = transcripts.TRANSCRIPTS[name]
    printed = transcripts.console_of(transcript, workshop)
    assert printed.splitlines() == transcripts.recorded_text(name).splitlines()
    assert printed.endswith(f"[exit code {transcript.code}]\n")


def test_every_way_to_end_is_recorded_and_nothing_else():
    recorded = {path.stem for path in transcripts.FOLDER.iterdir()}
    assert recorded == {*transcripts.TRANSCRIPTS}
    codes = {transcript.code for transcript in transcripts.TRANSCRIPTS.values()}
    assert codes == {*EXIT_CODES}


def test_what_differs_from_run_to_run_is_masked(tmp_path):
    text = (
        f"in {tmp_path}/x, MuJoCo 4.0.1\nSearching: 5 %, 10 s\n/tmp/.robot-sysid-a1/y"
    )
    masked = transcripts.mask(text, tmp_path)
    assert masked == "in FOLDER/x, MuJoCo #\nSCRATCH/y"
