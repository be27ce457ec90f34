"""A draft is a columns file: short where columns follow each other, with a reason on each line."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import ColumnsError
from robot_sysid.logs.column_draft import DraftLine, draft, join_ranges
from tests.support.log_files import motion, read_measurements, write

JOINTS = ("joint1", "joint2", "joint3")
DATA = motion()


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


def two_arms(folder):
    """Return a table of two arms, the right one of which has the torques of the left one turned."""
    titles = ["time"]
    columns = [DATA.time]
    for quantity, values in (("position", DATA.q), ("effort", DATA.tau)):
        for side, sign in (("left", 1.0), ("right", -1.0)):
            titles += [f"{side}_{joint} {quantity}" for joint in JOINTS]
            columns += [*(sign * values.T)]
    return write(folder / "log.csv", np.column_stack(columns), titles)


def test_the_draft_takes_the_first_arm_and_its_comments_the_second(tmp_path):
    path = two_arms(tmp_path)
    fault = "2 sets .* joint1..3: left_joint1..3 and right_joint1..3"
    with pytest.raises(ColumnsError, match=fault) as caught:
        read_measurements(path, JOINTS)
    draft = caught.value.draft
    swapped = []
    for line in draft.splitlines():
        is_key = line.split(" =")[0].strip("# ") in ("position", "torque")
        is_comment = line.startswith("# ")
        other = line[2:] if is_comment else f"# {line}"
        swapped.append(other if is_key else line)
    columns = tmp_path / "columns.txt"
    for text, sign in ((draft, 1.0), ("\n".join(swapped), -1.0)):
        columns.write_text(text)
        samples = read_measurements(path, JOINTS, columns=columns).samples
        np.testing.assert_array_equal(samples.q, sign * DATA.q)
        np.testing.assert_array_equal(samples.tau, sign * DATA.tau)


def test_the_arm_that_the_model_names_needs_no_choice(tmp_path):
    names = [f"openarm_right_{joint}" for joint in JOINTS]
    samples = read_measurements(two_arms(tmp_path), names).samples
    np.testing.assert_array_equal(samples.q, -DATA.q)
