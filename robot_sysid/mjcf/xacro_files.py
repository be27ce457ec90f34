"""Xacro files, in which URDFs are written with macros, expanded to URDF by the package xacro.

Packages that ``$(find NAME)`` names are looked up as those of meshes are, in the user's folder, the
file's and every folder above it, by the folder's name or that of its package.xml; else as ROS does.
A xacro is a program by whoever wrote the model: ``xacro_process`` runs it, in a process of its own.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from robot_sysid.errors import ModelError
from robot_sysid.records.installation import missing_library


def is_xacro(root: Any) -> bool:
    """Return whether the tree of a URDF has something that xacro expands."""
    for node in root.iter("*") if root.tag == "robot" else ():
        text = " ".join(node.values())
        # Without its namespace, the prefix is a part of the tag.
        has_prefix = "xacro" in (node.prefix, node.tag.partition(":")[0])
        if has_prefix or "${" in text or "$(" in text:
            return True
    return False


# What expands a file, as a script.
_SCRIPT = Path(__file__).with_name("xacro_process.py")
# Seconds of a processor that an expansion may take; those of public arms take one or two.
_MOST_SECONDS = 10
# Seconds until it is ended where it waits, or the system knows no limit of the processor's time.
_LONGEST_WAIT = 60
# Bytes of memory that it may take, and characters that it may expand to.
_MOST_MEMORY = 10**9
_MOST_CHARACTERS = 10**7
# The only variables of the environment that it has: where ROS and Windows are.
_VARIABLES = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH", "SYSTEMROOT")


def expand_xacro(path: Path, mesh_dir: Path | None) -> bytes:
    """Return the URDF that a xacro file expands to, its arguments at their defaults.

    ModelError where xacro is not installed, or cannot expand the file within its limits.
    """
    if importlib.util.find_spec("xacro") is None:
        start = (
            f"{path} is a xacro file: pass the URDF that 'xacro {path.name} -o arm.urdf' writes, "
            "or have it expanded here, which"
        )
        raise missing_library(start, "xacro", "xacro", ModelError)
    request = {
        "sys_path": sys.path,
        "path": str(path),
        "folders": [*map(str, filter(None, (mesh_dir, *path.parents)))],
        "seconds": _MOST_SECONDS,
        "memory": _MOST_MEMORY,
        "bytes": _MOST_CHARACTERS,
    }
    answer = _answer_to(request)
    if "urdf" in answer:
        return bytes(answer["urdf"].encode("utf-8", "replace"))
    reason = (
        f"{answer['error']}; mend the file, or pass the URDF that xacro writes with other "
        "arguments"
    )
    missing = answer.get("missing")
    if missing:
        reason = f"no folder above it holds package {missing[-1]}; put it there"
    raise ModelError(
        f"xacro cannot expand {path}, its arguments at their defaults: {reason}"
    )


def _answer_to(request: dict[str, Any]) -> dict[str, Any]:
    """Return what the process that expands a file answers, or how it ended."""
    environment = {name: os.environ[name] for name in _VARIABLES if name in os.environ}
    try:
        done = subprocess.run(
            [sys.executable, "-I", str(_SCRIPT)],
            input=json.dumps(request).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            timeout=_LONGEST_WAIT,
            check=False,
        )
        answer: dict[str, Any] = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        return {
            "error": f"its expansion takes more than {_MOST_SECONDS} s, or more memory than "
            f"{_MOST_MEMORY:.0e} bytes"
        }
    except OSError as error:
        return {"error": f"Python cannot be started ({error.strerror})"}
    return answer
