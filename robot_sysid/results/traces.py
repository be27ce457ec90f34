"""What a report draws of a fit: measured and predicted torques over time."""

from __future__ import annotations

import numpy as np

from robot_sysid.dynamics.friction import OFFSET
from robot_sysid.estimate.fit import Fit
from robot_sysid.estimate.rows import row_chunks
from robot_sysid.estimate.terms import FRICTION, PAYLOAD_NAMES
from robot_sysid.records import Traces


def traces_of(fitted: Fit) -> Traces:
    """Return the measured torques, and the predictions of a fit and of the given model.

    Both predictions contain the estimated offsets of the torque sensors. With a payload, the second
    prediction is that of the fit without the payload.
    """
    arm = fitted.arm
    values = fitted.by_name
    model = dict(arm.model)
    if fitted.question.loaded:
        model = {**values, **dict.fromkeys(PAYLOAD_NAMES, 0.0)}
    model.update((name, values[name]) for name in arm.terms[OFFSET.name].names)
    friction = {
        name: values[name]
        for term in fitted.equations.terms
        if term.cause == FRICTION and term.key != "armature"
        for name in term.names
    }
    chunks = []
    for recording in fitted.recordings:
        for rows in row_chunks(recording, 36 * arm.robot.n_joints):
            signals = (
                rows.motion.time,
                rows.motion.qd[:, arm.indices],
                arm.measured_torque(rows),
                arm.torque(rows, fitted.point, values),
                arm.torque(rows, fitted.point, model),
                arm.torque(rows, fitted.point, friction) - arm.known(rows),
            )
            chunks.append(signals)
    is_slide = tuple(arm.robot.is_slide[arm.indices].tolist())
    return Traces(arm.joints, is_slide, *map(np.concatenate, zip(*chunks)))
