"""Rigid-body dynamics of the arm: conversions, motion of the terminal link, joint equations."""
