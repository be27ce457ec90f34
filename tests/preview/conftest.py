"""A run to draw."""

from tests.support.reports import link_run

__all__ = ["link_run"]
