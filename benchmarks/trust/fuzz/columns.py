"""Small files that say what is what: column files, torque factors, joint maps of motors."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from random import Random

from benchmarks.trust.fuzz.harness import Case, write_case
from benchmarks.trust.fuzz.mutations import (
    damage_bytes,
    damaged_json,
    damaged_table,
    odd,
)
from rigs.logs import log_files
from robot_sysid.damiao.joints import damiao_joints, map_joints, read_joint_map
from robot_sysid.logs import LogOptions
from robot_sysid.logs.table import LogTable, make_table
from robot_sysid.records.option_fields import CONSTANTS, SCALE, joint_factors

_ARM = log_files.arm_of(log_files.JOINTS, log_files.limits())
LINES = """# which column is what
time = Zeit
units = rad, s
position = A1, A2, A3
torque.base = M1
torque.elbow = -M2
torque.wrist = 0.95 * M3
velocity = none
rate = 200
acceleration = #1, #2, #3
"""
FACTORS = {
    "version": 1,
    SCALE: {"base": 1.3, "elbow": 1.2, "wrist": 1.1},
    CONSTANTS: {"base": 0.1},
}
MAP = """joint,can_id,master_id,direction,offset,verified
base,1,0x11,+1,0.0,hand
elbow,2,0x12,-1,0.785,
wrist,3,19,1,0.0,
"""


@functools.cache
def _log() -> LogTable:
    """Return a log whose titles cannot be recognised."""
    titles = ("Zeit", "A1", "A2", "A3", "M1", "M2", "M3")
    cells = log_files.table(log_files.motion(30, 40.0))
    return make_table(Path("log"), "arrays", zip(titles, cells.T))


def case(random: Random) -> Case:
    """Return one columns file."""
    draw = random.random()
    if draw < 0.6:
        lines = LINES.splitlines()
        for _ in range(random.randint(1, 3)):
            line_index = random.randrange(len(lines))
            key, _, value = lines[line_index].partition("=")
            lines[line_index] = random.choice(
                (f"{key}={odd(random)}", f"{odd(random)}={value}", key)
            )
        data = "\n".join(lines).encode()
        return {
            "lines.txt": damage_bytes(random, data) if random.random() < 0.3 else data
        }
    if draw < 0.8:
        return {"factors.json": damaged_json(random, FACTORS)}
    return {"map.csv": damaged_table(random, MAP)}


def use(case: Case, folder: Path) -> None:
    """Read the file and apply it to a log."""
    (name,) = case
    path = write_case(case, folder) / name
    if name == "factors.json":
        for table in (SCALE, CONSTANTS):
            joint_factors(path, log_files.JOINTS[:1], table)
    elif name == "map.csv":
        joints = damiao_joints(["DM4340"] * 3, 3)
        map_joints(joints, read_joint_map(path), log_files.JOINTS)
    else:
        titles = (
            ("", "<script>", *_log().titles[2:]) if len(case[name]) % 50 == 0 else None
        )
        table = dataclasses.replace(_log(), titles=titles) if titles else _log()
        log_files.open_log(_ARM, table, LogOptions(columns=path))
