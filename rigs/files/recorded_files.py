"""Files in a folder of results, as runs write them."""

from __future__ import annotations

from robot_sysid.records.file_access import FOLDER_OPTION, PARAMS_NAME, claim


def as_run(folder):
    """Hold a folder of results while a block writes to it: what it writes is recorded there."""
    return claim([(FOLDER_OPTION, folder / PARAMS_NAME)], print)
