"""Pages of small arms, made once."""

from rigs.reports import link_run, page

__all__ = ["link_run", "page"]
