"""Pages of small arms, made once."""

from tests.support.reports import link_run, page

__all__ = ["link_run", "page"]
