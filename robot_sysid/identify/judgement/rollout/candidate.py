"""The new model as it would be written, loaded again."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from robot_sysid.errors import ExportError, InputError
from robot_sysid.output.model_writing import ModelTarget
from robot_sysid.parser import load_robot_model
from robot_sysid.records import Motion, RobotModel
from robot_sysid.records.atomic_files import temporary_folder, whole_files
from robot_sysid.records.results import MODEL_NAMES, RolloutTest


def as_written(
    robot: RobotModel,
    write: Callable[[ModelTarget], object],
    checkpoints: Motion,
    mesh_dir: Path | None,
) -> RobotModel:
    """Return the model that ``write`` writes, read back from a folder that is gone afterwards.

    Raises:
        ExportError: the model cannot hold what is to be written.
    """
    with temporary_folder() as folder:
        path = folder / MODEL_NAMES[robot.kind]
        with whole_files() as files:
            write(ModelTarget(files, path, checkpoints, 0.0, mesh_dir))
        return load_robot_model(path, joint=robot.terminal_joint)


def refusal(test: RolloutTest | None, accepted: Collection[str]) -> str | None:
    """Return why a model that was played must not be written, or None."""
    refused = None if test is None or "rollout" in accepted else test.refusal
    return (
        refused and f"no model was written: {refused}; to write it all the same: --accept rollout"
    )


def played_or_reason(robot: RobotModel, test: Callable[[], RolloutTest]) -> RolloutTest:
    """Return a test, or one without figures that says why there are none."""
    try:
        return test()
    except (ExportError, InputError) as error:
        return RolloutTest(robot.joint_names, "held-out pieces", "", (), (str(error),))
