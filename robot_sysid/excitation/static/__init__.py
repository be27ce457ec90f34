"""Motions that are slow, or at rest: starts, resting poses for payloads, sweeps for friction."""
