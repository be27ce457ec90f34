"""Xacro files, in which URDFs are written with macros, expanded to URDF by the package xacro.

Packages that ``$(find NAME)`` names are looked up as those of meshes are, in the user's folder, the
file's and every folder above it, by the folder's name or that of its package.xml; else as ROS does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robot_sysid.errors import ModelError, error_text
from robot_sysid.records.installation import install_hint


def is_xacro(root: Any) -> bool:
    """Return whether the tree of a URDF has something that xacro expands."""
    for node in root.iter("*") if root.tag == "robot" else ():
        text = " ".join(node.values())
        # Without its namespace, the prefix is a part of the tag.
        has_prefix = "xacro" in (node.prefix, node.tag.partition(":")[0])
        if has_prefix or "${" in text or "$(" in text:
            return True
    return False


def expand_xacro(path: Path, mesh_dir: Path | None) -> bytes:
    """Return the URDF that a xacro file expands to, its arguments at their defaults.

    ModelError where xacro is not installed, or cannot expand the file.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise ModelError(
            f"{path} is a xacro file: pass the URDF that 'xacro {path.name} -o arm.urdf' writes, "
            f"or have it expanded here, which {install_hint('xacro', 'xacro')}"
        ) from None
    find_as_ros = substitution_args._eval_find
    missing = []

    def find(name: str) -> str:
        """Return the folder of a package."""
        for folder in filter(None, (mesh_dir, *path.parents)):
            # A clone may be called otherwise than the package.
            manifest = folder / "package.xml"
            text = manifest.read_text("utf-8", "replace") if manifest.is_file() else ""
            if folder.name == name or f"<name>{name}</name>" in text:
                return str(folder)
            if (folder / name).is_dir():
                return str(folder / name)
        missing.append(name)
        return str(find_as_ros(name))

    # The package asks ROS alone where packages are.
    substitution_args._eval_find = find
    try:
        document = xacro.process_file(str(path), verbosity=0)
    except Exception as error:
        reason = (
            f"{error_text(error)}; mend the file, or pass the URDF that xacro writes with other "
            "arguments"
        )
        if missing:
            reason = f"no folder above it holds package {missing[-1]}; put it there"
        raise ModelError(
            f"xacro cannot expand {path}, its arguments at their defaults: {reason}"
        ) from None
    finally:
        substitution_args._eval_find = find_as_ros
    return bytes(document.documentElement.toprettyxml(indent="  ").encode())
