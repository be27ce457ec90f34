"""What touches the arm for a moment is left out of the fit, and nothing else is."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from rigs.arms.core_fits import fit_recordings
from rigs.logs.payload_logs import (
    TrueArm,
    add_noise,
    add_torque,
    four_joint_arm,
    wide_motion,
)

ROBOT = four_joint_arm()


@pytest.mark.parametrize(
    "spans", [[], [(4.0, 4.5), (9.0, 12.0)], [(k, k + 0.3) for k in range(1, 7)]]
)
def test_rows_of_contacts_are_left_out_unless_they_come_back(spans):
    """As the last ones do: no log goes on without what comes back."""
    arm = TrueArm(ROBOT, 0, model_error=0.02)
    recording = arm.recording(wide_motion(0, duration=20.0), False)
    time = recording.motion.time
    push = np.zeros_like(recording.torque)
    for first, last in spans:
        push[(time >= first) & (time <= last)] = 0.0, 8.0, 0.0, 4.0
    touched = add_noise(add_torque(recording, push), 0.05, 0)
    fitted = fit_recordings(ROBOT, [touched])
    found = fitted.recordings[0]
    kept = np.ones(len(time), dtype=bool)
    for (start, stop, joints, _), (first, last) in zip(found.touched, spans):
        assert start <= first <= last <= stop < last + 1.0 < start + 1.5 + last - first
        assert joints[1] and not joints[0]
        kept[(time >= start) & (time <= stop)] = len(spans) > 5
    assert len(found.touched) == len(spans)
    assert_array_equal(found.is_used, touched.only(kept).is_used)
    off = (fitted.values - arm.values(fitted.names)) / fitted.errors
    assert np.max(np.abs(off)) < 4.0 or len(spans) > 5
