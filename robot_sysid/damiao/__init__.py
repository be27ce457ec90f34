"""Damiao motors: export, check, play and record trajectories over CAN.

What needs no bus (motors, codec, bus_load, trajectory_csv, ...) works without python-can; the
modules that open a bus import it inside the function that does.
"""

from __future__ import annotations
