"""LeRobot data sets: a folder with meta/info.json and Parquet files, one piece per episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.errors import InputError
from robot_sysid.json_files import read_json
from robot_sysid.logs.formats.table import (
    Asked,
    LogTable,
    as_input_errors,
    library,
    pieces_table,
    renamed,
)
from robot_sysid.records import Array

WHAT = "a LeRobot data set"
STATE = "observation.state"
# What a name in a feature ends in, and the title that says quantity and unit.
_ENDINGS = {"pos": "position [deg]", "vel": "velocity [deg/s]", "current": "current"}
_ENDINGS.update(torque="torque [Nm]", effort="torque [Nm]")
# Features of their own, whose names are joints.
_FEATURES = {"observation.velocity": "velocity", "observation.effort": "torque"}
ACTION = "action"


def lerobot_table(asked: Asked) -> LogTable | None:
    """Return the episodes of a data set that are asked for, or all."""
    path, joint_names, commanded = asked.path, asked.joint_names, asked.options.commanded
    described = path / "meta" / "info.json"
    if not described.is_file():
        return None
    info = _mapping(read_json(described, "download the data set whole"))
    features = _mapping(info.get("features"))
    read = (STATE, ACTION) if commanded else (STATE, *_FEATURES)
    titles = {name: _titles(features, name, joint_names) for name in read}
    said = " ".join(title for names in titles.values() for title in names)
    if not commanded and "torque" not in said and "current" not in said:
        raise InputError(
            f"{path} holds no torque ({STATE}: {', '.join(titles[STATE]) or 'nothing'}); record it "
            "too: for OpenArm use_velocity_and_torque=true of the robot's configuration, for other "
            "robots an observation whose names end in .torque"
        )
    present = [name for name in titles if titles[name]]
    columns = ["timestamp", "episode_index", *present]
    frames = _frames(path, columns)
    wanted = _wanted(path, asked.options.episode, frames["episode_index"])
    cells = np.column_stack([frames["timestamp"], *(frames[name] for name in present)])
    pieces = tuple(cells[frames["episode_index"] == episode] for episode in wanted)
    version, fps = info.get("codebase_version", "?"), info.get("fps", "unknown")
    layout = f"LeRobot data set {version} at {fps} Hz, {len(pieces)} episodes"
    flat = tuple(title for name in present for title in titles[name])
    if cells.shape[1] != 1 + len(flat):
        raise InputError(
            f"{path} names {len(flat)} numbers of a frame in meta/info.json and holds "
            f"{cells.shape[1] - 1}; download the data set whole"
        )
    return pieces_table(path, layout, ("timestamp [s]", *flat), pieces)


def _wanted(path: Path, episodes: Sequence[int], index: Array) -> list[int]:
    """Return which episodes are read: those that were asked for, or all."""
    found = sorted(set(index.astype(int).tolist()))
    if not found:
        raise InputError(f"{path} holds no frames; download the data set whole")
    missing = sorted(set(episodes) - set(found))
    if missing:
        raise InputError(f"{path} has no episode {missing[0]}; it has {found[0]} to {found[-1]}")
    return list(episodes) or found


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _titles(features: Mapping[str, Any], name: str, joint_names: Sequence[str]) -> list[str]:
    """Return the titles of a feature's columns; nothing where it is not there."""
    names = _mapping(features.get(name)).get("names")
    if isinstance(names, dict):
        names = [each for group in names.values() if isinstance(group, list) for each in group]
    names = names if isinstance(names, list) else []
    pairs = [str(each).rpartition(".") for each in names]
    stems = [stem if ending in _ENDINGS else str(n) for (stem, _, ending), n in zip(pairs, names)]
    plain = _FEATURES.get(name, "position")
    ends = [_ENDINGS.get(ending, plain) for _, _, ending in pairs]
    known = dict(zip(dict.fromkeys(stems), renamed(list(dict.fromkeys(stems)), joint_names)))
    if name == ACTION:
        ends = [end.replace("position", "command") for end in ends]
    return [f"{known[stem]} {end}" for stem, end in zip(stems, ends)]


def _frames(path: Path, columns: Sequence[str]) -> Mapping[str, Array]:
    """Return the columns of all files, lists as (N, k)."""
    parquet = library("pyarrow.parquet", "lerobot", WHAT)
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(f"{path} has no Parquet files in data/; download the data set whole")
    parts: list[dict[str, Array]] = []
    for file in files:
        with as_input_errors(file, WHAT):
            read = parquet.read_table(file, columns=list(columns))
            parts.append({name: _array(read.column(name)) for name in columns})
    with as_input_errors(path, WHAT):
        return {name: np.concatenate([part[name] for part in parts]) for name in columns}


def _array(column: Any) -> Array:
    """Return a column (N,), or (N, k) of one with lists."""
    combined = column.combine_chunks()
    is_list = "list" in str(combined.type)
    flat = combined.flatten() if is_list else combined
    values = np.asarray(flat.to_numpy(zero_copy_only=False), float)
    return values.reshape(len(combined), -1) if is_list else values
