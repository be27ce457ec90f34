"""Damiao motors: export, check, play and record trajectories over CAN.

What needs no bus (protocol, trajectory, the simulated arm) works without python-can; the modules
that open a bus or log its frames import it inside the function that does.
"""
