"""The one figure of a result in a notebook; the report draws all others."""

from __future__ import annotations

from typing import Any

from robot_sysid.errors import InputError
from robot_sysid.records.traces import Traces


def torques(traces: Traces) -> Any:
    """Return a matplotlib Figure: measured and predicted torque of each joint over time.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("plot() needs matplotlib; pip install matplotlib") from None
    count = len(traces.joints)
    figure = Figure(figsize=(8.0, 1.6 * count + 0.6), layout="constrained")
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for k, (axis, joint) in enumerate(zip(axes, traces.joints)):
        # Blue and orange of Okabe and Ito, safe for colour-blind readers.
        axis.plot(traces.time, traces.measured[:, k], ".", ms=2, color="#0072B2", label="measured")
        axis.plot(traces.time, traces.predicted[:, k], lw=1, color="#D55E00", label="predicted")
        axis.set_ylabel(f"{joint}\n[{'N' if traces.is_slide[k] else 'N m'}]")
    axes[-1].set_xlabel("time [s]")
    axes[0].legend(loc="upper right", ncols=2)
    return figure
