"""A log of two arms is refused with a columns file that takes the one, and can take the other."""

from __future__ import annotations

import numpy as np
import pytest

from robot_sysid.errors import ColumnsError
from tests.support.log_files import motion, read_measurements, write

JOINTS = ("joint1", "joint2", "joint3")
DATA = motion()


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
