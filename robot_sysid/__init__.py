"""Identify a robot arm's terminal link: inertial parameters and friction from joint torques."""

from __future__ import annotations

__version__ = "0.1.0"
