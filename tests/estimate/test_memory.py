"""What may still be taken of memory, as the system says it, and what is refused."""

from __future__ import annotations

import math
import sys

import pytest

from rigs.files.refusals import refused
from robot_sysid.estimate.equations.memory import free_memory, refuse_too_much

GIGA = 1e9
SYSTEM = {"proc/meminfo": "MemTotal: 32000000 kB\nMemAvailable:   16000000 kB\n"}
OWN_GROUP = {"proc/self/cgroup": "0::/a/b\n"}
GROUPS = {
    "sys/fs/cgroup/a/b/memory.max": "max\n",
    "sys/fs/cgroup/a/b/memory.current": "1000\n",
    "sys/fs/cgroup/a/memory.max": "4000000000\n",
    "sys/fs/cgroup/a/memory.current": "1000000000\n",
}
OLD_GROUP = {
    "sys/fs/cgroup/memory/memory.limit_in_bytes": "2000000000",
    "sys/fs/cgroup/memory/memory.usage_in_bytes": "500000000",
}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (SYSTEM, 16.384 * GIGA),
        ({**SYSTEM, **OWN_GROUP, **GROUPS}, 3.0 * GIGA),
        ({**SYSTEM, **OLD_GROUP}, 1.5 * GIGA),
    ],
)
def test_the_least_of_all_limits_counts(tmp_path, files, expected):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert free_memory(tmp_path) == expected


def test_where_nothing_is_said_it_is_that_of_the_machine(tmp_path):
    assert free_memory(tmp_path) > 0.0
    assert math.isfinite(free_memory()) or sys.platform == "win32"


def test_what_takes_too_much_is_refused_with_how_many_joints_can():
    refuse_too_much(8.0 * GIGA, 8.0 * GIGA, 56)
    with refused(
        "56 joints move: .* takes 8 GB of memory, and 1 GB are free, enough for 28; record "
        "with all joints but the last 28 standing still, .* with --first-joint"
    ):
        refuse_too_much(8.0 * GIGA, 1.0 * GIGA, 56)
