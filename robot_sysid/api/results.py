"""What the functions of the face return: named values, and what can be made of them."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from robot_sysid.api.threads import one_thread
from robot_sysid.config import OutputOptions, SysidConfig
from robot_sysid.dynamics.spatial import PARAMETER_NAMES
from robot_sysid.errors import SysidError
from robot_sysid.export import alone_in
from robot_sysid.identify.arm.run import write_arm, write_model
from robot_sysid.identify.simulated import Analysis
from robot_sysid.output.arm_json import arm_json_text
from robot_sysid.output.bundle import model_in_memory, write_bundle
from robot_sysid.output.params_json import friction_entries, params_json_text
from robot_sysid.output.payload_json import payload_json_text
from robot_sysid.output.printed.arm import arm_lines, link_rows_of
from robot_sysid.output.printed.before_after import HEADINGS, BeforeAfter, link_rows
from robot_sysid.output.printed.link import more_lines, result_lines
from robot_sysid.output.printed.payload import payload_lines, payload_rows
from robot_sysid.payload import written as payload_written
from robot_sysid.payload_config import PayloadConfig
from robot_sysid.pipeline import written
from robot_sysid.records import Array, Identification, InertialParameters, Motion, RobotModel
from robot_sysid.records.atomic_files import temporary_folder
from robot_sysid.records.payload import PayloadIdentification
from robot_sysid.records.progress import Progress
from robot_sysid.records.results import MODEL_NAMES
from robot_sysid.records.traces import Traces
from robot_sysid.records.whole_arm import ArmIdentification


class Result(ABC):
    """What all results have in common.

    Attributes:
        robot: the arm as its model describes it.
        notes: one sentence each: what the commands would have printed as notes.
        failure: why the result must not be used, or None.
    """

    robot: RobotModel
    notes: tuple[str, ...]
    failure: str | None

    @property
    @abstractmethod
    def rows(self) -> Sequence[BeforeAfter]:
        """The table before -> after."""

    @abstractmethod
    def lines(self) -> list[str]:
        """Return what the command would have printed."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return what the JSON file of the result holds (see docs/formats.md)."""

    @abstractmethod
    def _write(self, output: OutputOptions) -> tuple[Sequence[Path], str | None]:
        """Write all files; returns (paths, why there is no model or None)."""

    @abstractmethod
    def _traces(self) -> Traces:
        """Return measured and predicted torques."""

    def save(
        self, folder: str | Path, *, bundle: bool = False, keep_friction: bool = False
    ) -> tuple[Path, ...]:
        """Write what the command writes: the JSON file and, where trusted, the updated model.

        Args:
            folder: where to; made where it is missing.
            bundle: also copy model, meshes and textures into ``folder/bundle``.
            keep_friction: leave the friction of the model's joints as it is.

        Returns:
            The written files.

        Raises:
            InputError: the folder cannot be written to.
        """
        output = OutputOptions(Path(folder), keep_friction, bundle)
        with one_thread(), alone_in(output.output_dir, Progress()):
            files, _ = self._write(output)
        models = [path for path in files if path.name in MODEL_NAMES.values()]
        copies = [write_bundle(model, output.output_dir) for model in models if bundle]
        return (*files, *copies)

    def spec(self, *, keep_friction: bool = False) -> Any:
        """Return a ``mujoco.MjSpec`` with the result applied; meshes and textures are in memory.

        Raises:
            SysidError: the result must not be used, or the model cannot hold it; says why.
        """
        with one_thread(), temporary_folder() as folder:
            files, failure = self._write(OutputOptions(folder, keep_friction))
            models = [path for path in files if path.name in MODEL_NAMES.values()]
            if not models:
                raise SysidError(failure or self.failure or "this result is written into no model")
            return model_in_memory(models[0])

    def plot(self) -> Any:
        """Return a matplotlib Figure: measured and predicted torque of each joint over time [N m].

        Raises:
            InputError: matplotlib is not installed.
        """
        from robot_sysid.api.drawing import torques

        return torques(self._traces())

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def _repr_html_(self) -> str:
        """Return the table before -> after for a notebook, with the verdict above it."""
        head = "".join(f"<th>{escape(name)}</th>" for name in HEADINGS)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row.cells) + "</tr>"
            for row in self.rows
        )
        verdict = f"<p><b>Not to be used:</b> {escape(self.failure)}</p>" if self.failure else ""
        return f"{verdict}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def named_errors(names: Sequence[str], errors: Array | None) -> dict[str, float]:
    """Return parameter name to whole standard error; infinite where the data does not show it."""
    return {} if errors is None else dict(zip(names, np.asarray(errors, dtype=float).tolist()))


@dataclass(frozen=True, repr=False)
class LinkResult(Result):
    """A terminal link, from ``identify``.

    Attributes:
        config: what was asked for.
        robot, notes: see ``Result``.
        analysis: what the pipeline returned.
    """

    config: SysidConfig
    robot: RobotModel
    analysis: Analysis
    notes: tuple[str, ...] = ()

    @property
    def identification(self) -> Identification:
        """Everything that was found."""
        return self.analysis.identification

    @property
    def inertial(self) -> InertialParameters:
        """The ten parameters with what follows from them."""
        return self.identification.estimate.inertial

    @property
    def theta(self) -> Array:
        """[m, hx, hy, hz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] (10,), inertia about the body ORIGIN
        [kg, kg m, kg m^2]."""
        return self.inertial.theta

    @property
    def mass(self) -> float:
        """Mass of the terminal body with all that hangs on it [kg]."""
        return self.inertial.mass

    @property
    def center_of_mass(self) -> Array:
        """Centre of mass (3,) in the body frame [m]."""
        return self.inertial.com

    @property
    def inertia(self) -> Array:
        """Inertia (3, 3) about the centre of mass, axes of the body frame [kg m^2]."""
        return self.inertial.inertia_com

    @property
    def standard_errors(self) -> Mapping[str, float]:
        """Parameter name ("m", "hx", ..., "coulomb[joint6]") to whole standard error; infinite
        where the data does not show it. Empty for a simulation of the model itself."""
        found, estimate = self.identification, self.identification.estimate
        errors = estimate.standard_errors if found.data.source.is_measured else None
        return named_errors(estimate.names[: estimate.n_interest], errors)

    @property
    def friction(self) -> Mapping[str, Mapping[str, float]]:
        """Joint name to friction term ("coulomb", "viscous", ...) to its coefficient."""
        return friction_entries(self.identification)

    @property
    def failure(self) -> str | None:  # type: ignore[override]
        """Why the result must not be used, or None."""
        status, reasons = self.identification.estimate.status, self.identification.reasons
        return None if status.is_trustworthy else "; ".join((*reasons, status.value))

    @property
    def rows(self) -> Sequence[BeforeAfter]:
        """The table before -> after."""
        return link_rows(self.identification)

    def lines(self) -> list[str]:
        """Return what the command would have printed."""
        return [*result_lines(self.identification), *more_lines(self.identification)]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of params.json."""
        return dict(json.loads(params_json_text(self.identification)))

    def _write(self, output: OutputOptions) -> tuple[Sequence[Path], str | None]:
        config = replace(self.config, output=output) if output.keep_friction else self.config
        config = replace(config, output=replace(output, bundle=False))
        outcome = written(config, self.robot, self.analysis, None, Progress())
        return outcome.files, outcome.failure

    def _traces(self) -> Traces:
        return self.analysis.traces()


@dataclass(frozen=True, repr=False)
class PayloadResult(Result):
    """A payload, from ``payload``; all in the frame of the flange.

    Attributes:
        config: what was asked for.
        robot, notes: see ``Result``.
        found: everything that was found, the link without and with the payload among it.
        motion, traces: some of the motion; makes measured and predicted torques.
    """

    config: PayloadConfig
    robot: RobotModel
    found: PayloadIdentification
    motion: Motion
    traces: Callable[[], Traces]
    notes: tuple[str, ...] = ()

    @property
    def theta(self) -> Array:
        """The ten parameters (10,), inertia about the flange's ORIGIN [kg, kg m, kg m^2]."""
        return self.found.payload.inertial.theta

    @property
    def mass(self) -> float:
        """Mass of the payload [kg]."""
        return self.found.payload.inertial.mass

    @property
    def center_of_mass(self) -> Array:
        """Centre of mass (3,) in the flange frame [m]."""
        return self.found.payload.inertial.com

    @property
    def inertia(self) -> Array:
        """Inertia (3, 3) about the centre of mass, axes of the flange [kg m^2]."""
        return self.found.payload.inertial.inertia_com

    @property
    def standard_errors(self) -> Mapping[str, float]:
        """Parameter name ("m", "hx", ...) to whole standard error; infinite where not seen."""
        return named_errors(PARAMETER_NAMES, self.found.payload.errors)

    @property
    def failure(self) -> str | None:  # type: ignore[override]
        """Why the result must not be used, or None."""
        status = self.found.status
        return None if status.is_trustworthy else "; ".join((status.value, *self.found.reasons))

    @property
    def rows(self) -> Sequence[BeforeAfter]:
        """The table of the payload's numbers."""
        return payload_rows(self.found.payload)

    def lines(self) -> list[str]:
        """Return what the command would have printed."""
        return payload_lines(self.found)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the payload's params.json, without cards."""
        return dict(json.loads(payload_json_text(self.found, (), ())))

    def _write(self, output: OutputOptions) -> tuple[Sequence[Path], str | None]:
        config = replace(self.config, output=replace(output, bundle=False))
        outcome = payload_written(config, self.robot, self.found, self.motion, Progress())
        return outcome.files, outcome.failure

    def _traces(self) -> Traces:
        return self.traces()


@dataclass(frozen=True, repr=False)
class ArmResult(Result):
    """Every link of an arm, from ``identify_arm``.

    Attributes:
        robot, notes: see ``Result``.
        found: everything that was found.
        motion, traces: some of the motion; makes measured and predicted torques.
        mesh_dir: the user's mesh folder, if any.
    """

    robot: RobotModel
    found: ArmIdentification
    motion: Motion
    traces: Callable[[], Traces]
    mesh_dir: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def links(self) -> Mapping[str, InertialParameters]:
        """Body name to its ten parameters, base to terminal; links without mass are left out."""
        pairs = zip(self.found.link_names, self.found.estimate.thetas)
        return {name: InertialParameters(theta) for name, theta in pairs if np.any(theta)}

    @property
    def theta(self) -> Array:
        """The links (n, 10), inertia about their bodies' ORIGINS [kg, kg m, kg m^2]."""
        return self.found.estimate.thetas

    @property
    def standard_errors(self) -> Mapping[str, Mapping[str, float]]:
        """Body name to parameter name to whole standard error."""
        pairs = zip(self.found.link_names, self.found.estimate.theta_errors)
        return {name: named_errors(PARAMETER_NAMES, errors) for name, errors in pairs}

    @property
    def friction(self) -> Mapping[str, Mapping[str, float]]:
        """Joint name to what a model can hold: coulomb, viscous, armature and more."""
        return {joint: held.values for joint, held in self.found.model_friction.items()}

    @property
    def failure(self) -> str | None:  # type: ignore[override]
        """Why the result must not be used, or None."""
        status = self.found.status
        return None if status.is_trustworthy else "; ".join((*self.found.reasons, status.value))

    @property
    def rows(self) -> Sequence[BeforeAfter]:
        """The table before -> after."""
        return list(link_rows_of(self.found))

    def lines(self) -> list[str]:
        """Return what the command would have printed."""
        return arm_lines(self.found)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of arm.json."""
        return dict(json.loads(arm_json_text(self.found)))

    def _write(self, output: OutputOptions) -> tuple[Sequence[Path], str | None]:
        write = partial(write_model, self.robot, output.keep_friction)
        place = self.motion, output.output_dir, self.mesh_dir
        outcome = write_arm(self.robot, self.found, *place, write, None)
        return outcome.files, outcome.failure

    def _traces(self) -> Traces:
        return self.traces()
