"""A draft is a columns file: short where columns follow each other, with a reason on each line."""

from __future__ import annotations

from robot_sysid.errors import ColumnsError
from robot_sysid.logs.column_draft import DraftLine, draft, join_ranges


def test_columns_one_after_the_other_are_a_range():
    assert join_ranges(["#2", "#3", "#4", "#7", "#8", "?", "-#9"]) == [
        "#2-4", "#7", "#8", "?", "-#9",
    ]  # fmt: skip


def test_a_draft_is_complete_without_a_question_mark():
    time = DraftLine("time", ("#1",), "is it the time? yes")
    text = draft(("when?", "q"), ("elbow",), [time])
    assert "time = #1  # is it the time? yes\n" in text and "when?" in text
    assert ColumnsError("", text).is_complete
    text = draft(("when?", "q"), ("elbow",), [time, DraftLine("torque", ("?",), "")])
    assert "Complete the lines with ?" in text
    assert not ColumnsError("", text).is_complete
