"""Which motor drives which joint of a model, and how it is mounted: a small table in a file.

::

    joint,bus,can_id,master_id,direction,offset,torque_ratio
    shoulder,can0,1,0x11,+1,0.0,1.0
    elbow,can0,2,0x12,-1,0.785,1.0

Only ``joint``, ``can_id`` and ``direction`` have to be there. See ``joint_space`` for what
direction, offset [rad] and torque ratio mean.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from robot_sysid.damiao.protocol.joints import MASTER_ID_OFFSET, DamiaoJoint, id_problems
from robot_sysid.errors import InputError
from robot_sysid.records.atomic_files import write_whole

_COLUMNS = ("joint", "bus", "can_id", "master_id", "direction", "offset", "torque_ratio")
_NEEDED = ("joint", "can_id", "direction")


@dataclass(frozen=True)
class MappedJoint:
    """One line of a joint map; see the module's text."""

    joint: str
    bus: str
    can_id: int
    master_id: int
    direction: int
    offset: float = 0.0
    torque_ratio: float = 1.0


def read_joint_map(path: str | os.PathLike[str]) -> tuple[MappedJoint, ...]:
    """Read a joint map.

    Raises:
        InputError: the file cannot be read or a line is not as it should be; names the line.
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            lines = [line for line in file if line.strip() and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    if any("\0" in line for line in lines):
        raise InputError(f"{path} is not text: it has zero bytes")
    table = csv.DictReader(lines, skipinitialspace=True)
    titles = [title.strip() for title in table.fieldnames or ()]
    if not set(_NEEDED) <= set(titles) <= set(_COLUMNS):
        raise InputError(
            f"{path}: expected the columns {', '.join(_COLUMNS)} (at least {', '.join(_NEEDED)})"
        )
    rows = tuple(_row(line, f"{path}, row {k}") for k, line in enumerate(table, start=1))
    _require_sound(rows, path)
    return rows


def write_joint_map(path: Path, rows: Iterable[MappedJoint]) -> None:
    """Write a joint map."""
    lines = [",".join(_COLUMNS)]
    for row in rows:
        numbers = f"{row.direction:+d},{row.offset:.4f},{row.torque_ratio:g}"
        lines.append(f"{row.joint},{row.bus},{row.can_id},{row.master_id:#x},{numbers}")
    write_whole(path, "\n".join(lines) + "\n")


def mapped(
    joints: Sequence[DamiaoJoint],
    rows: Sequence[MappedJoint],
    channels: Sequence[str],
    names: Sequence[str] = (),
) -> tuple[DamiaoJoint, ...]:
    """Return the joints of a trajectory as a map says that they are mounted.

    Args:
        joints: of the trajectory, base to terminal.
        rows: of the map; more than the trajectory has joints only where ``names`` are known.
        channels: names of the buses that are open.
        names: of the joints in the model, base to terminal; empty where there is no model.

    Raises:
        InputError: the map does not cover the joints, or names a bus that is not open.
    """
    by_name = {row.joint: row for row in rows}
    absent = [name for name in names if name not in by_name]
    if absent:
        raise InputError(f"the joint map has no line for {absent[0]}; it has {', '.join(by_name)}")
    chosen = [by_name[name] for name in names] if names else list(rows)
    if len(chosen) != len(joints):
        raise InputError(
            f"the joint map has {len(chosen)} joints but the trajectory {len(joints)}: give one "
            "line per joint, base to terminal, or --model to choose them by name"
        )
    # An adapter may have got another name; but never play one arm's motion on the other arm.
    several = len(channels) > 1 or len({row.bus for row in rows}) > 1
    for row in chosen:
        if several and row.bus and row.bus not in channels:
            raise InputError(
                f"the joint map puts {row.joint} on {row.bus}; open it with --channel {row.bus}"
            )
    return tuple(_mounted(*pair, channels) for pair in zip(joints, chosen))


def _mounted(joint: DamiaoJoint, row: MappedJoint, channels: Sequence[str]) -> DamiaoJoint:
    bus = channels.index(row.bus) if row.bus in channels else 0
    return replace(
        joint,
        can_id=row.can_id,
        master_id=row.master_id,
        name=row.joint,
        bus=bus,
        channel=channels[bus] if len(channels) > 1 else "",
        direction=row.direction,
        offset=row.offset,
        torque_ratio=row.torque_ratio,
    )


def _row(line: Mapping[str, str | None], where: str) -> MappedJoint:
    cells = {key.strip(): (value or "").strip() for key, value in line.items() if key}
    try:
        can_id = int(cells["can_id"], 0)
        row = MappedJoint(
            cells["joint"],
            cells.get("bus", ""),
            can_id,
            int(cells.get("master_id") or str(can_id + MASTER_ID_OFFSET), 0),
            int(cells["direction"]),
            float(cells.get("offset") or 0.0),
            float(cells.get("torque_ratio") or 1.0),
        )
    except ValueError:
        raise InputError(
            f"{where}: expected a name and numbers, as in elbow,can0,2,0x12,-1,0,1"
        ) from None
    if row.direction not in (1, -1):
        raise InputError(f"{where}: direction must be +1 or -1, got {row.direction}")
    if not math.isfinite(row.offset) or not 0.0 < row.torque_ratio < math.inf:
        raise InputError(f"{where}: offset must be a number and torque_ratio positive")
    return row


def _require_sound(rows: Sequence[MappedJoint], path: str | os.PathLike[str]) -> None:
    names = [row.joint for row in rows]
    twice = [name for name in names if names.count(name) > 1]
    if twice or not rows:
        raise InputError(f"{path} names {twice[0]} twice" if twice else f"{path} has no lines")
    for bus in {row.bus for row in rows}:
        on_it = [(row.can_id, row.master_id) for row in rows if row.bus == bus]
        problem = next(id_problems(*zip(*on_it)), None)
        if problem:
            raise InputError(f"{path}: {problem}")
