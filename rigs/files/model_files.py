"""Small model files for the tests that read and write them, and where the large ones are."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from robot_sysid.mjcf.documents import ModelDocument, read_document
from robot_sysid.mjcf.updated_model import ModelChange, changed_model_text
from robot_sysid.model.compilation import compile_model
from robot_sysid.results.verification import compiled_file, require_change

TETRAHEDRON = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1
f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""

INERTIAL = "<inertial pos='0.01 0.02 0.03' mass='0.5' diaginertia='2e-3 3e-3 4e-3'/>"

ARM = f"""<mujoco model="two links">
  <!-- a comment -- with dashes -->
  <worldbody>
    <body name="base">
      <geom size="0.1"/>
      <body name="link1" pos="0 0 0.2">
        <joint name="j1" axis="0 1 0"/>
        {INERTIAL}
        <body name="link2"   pos="0 0 0.3"
              quat="1 0.1 0 0">
          <joint name="j2" axis="1 0 0"/>
          <inertial pos="0 0 0.1" quat="0.9 0.1 0.2 0.3" mass="1.5"
                    diaginertia="2e-3 3e-3 4e-3"/>
          <geom type="capsule" size="0.02 0.1"/>
          <body name="tool" pos="0 0 0.1" euler="10 20 30">
            <inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/>
          </body>
          <body name="finger" pos="0 0.05 0.1">
            <joint name="grip" type="slide"/>
            <inertial pos="0 0 0" mass="0.1" diaginertia="1e-5 1e-5 1e-5"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


LFS_POINTER = (
    f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 9\n"
)
"""What Git leaves in the place of a large file that was not fetched."""


def write_files(folder: Path, files: dict[str, str]) -> Path:
    """Write files given by relative name; return the first one's path."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode())
    return folder / next(iter(files))


def make_pipe(path: Path) -> Path:
    """Make a named pipe and return its path; skip the test where there is none."""
    if sys.platform == "win32":
        pytest.skip("needs named pipes")
    os.mkfifo(path)
    return path


def write_and_verify(source: Path, change: ModelChange, target: Path) -> None:
    """Write a changed model file as results are written, and verify it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(changed_model_text(source, change, target.parent.absolute()))
    require_change(compile_model(source).mj_model, compiled_file(target), change)


def document_of(folder: Path, text: str, name: str = "m.xml") -> ModelDocument:
    """Write a model file, and return it as it is read."""
    return read_document(write_files(folder, {name: text}))
