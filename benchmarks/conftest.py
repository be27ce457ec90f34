"""The tests' profiles and fixtures, for what is measured with pytest."""

from tests.conftest import *  # noqa: F403
