"""Which MuJoCo is installed, for tests of what older releases cannot read."""

import mujoco
import pytest

MUJOCO = tuple(int(part) for part in mujoco.__version__.split(".")[:3])

IS_PRINCIPAL = MUJOCO < (3, 14)
"""Whether models are written with principal moments of inertia."""


def since(*release):
    """Mark a test that needs a release of MuJoCo, ``since(3, 1, 6)``."""
    needed = ".".join(map(str, release))
    return pytest.mark.skipif(release > MUJOCO, reason=f"needs MuJoCo {needed}")
