"""Whether somebody still reads what a run prints."""

from __future__ import annotations

import io
import os

from robot_sysid.damiao.player import StopRequest
from robot_sysid.damiao.safety.outputs import watched_outputs


def test_a_pipe_counts_as_unread_when_its_reader_has_gone():
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream, watched_outputs([stream]) as is_unread:
        assert not is_unread()
        os.close(reader)
        assert is_unread()
        # What is printed now goes elsewhere; nobody reads the pipe any the more.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, writer)
        os.close(nowhere)
        assert is_unread()


def test_a_file_and_a_stream_without_one_count_as_read(tmp_path):
    file = (tmp_path / "log.txt").open("w")
    with file, watched_outputs([file, io.StringIO(), None]) as is_unread:
        assert not is_unread()


def test_a_run_that_nobody_reads_is_asked_to_stop():
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream:
        stop = StopRequest(outputs=[stream])
        with stop.on_signals():
            stop.look_at_outputs()
            assert not stop.reason
            os.close(reader)
            stop.look_at_outputs()
        assert "nobody reads its output" in stop.reason
