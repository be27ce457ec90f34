"""Recordings and fits of the tests of estimates."""

from tests.estimate.conftest import noisy as noisy
from tests.estimate.conftest import noisy_fit as noisy_fit
from tests.estimate.conftest import payload_fit as payload_fit
from tests.estimate.conftest import plant as plant
from tests.estimate.conftest import recordings as recordings
from tests.estimate.conftest import robot as robot
