"""Linear algebra stays in one thread while a function works, and goes back to what was set."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - brings threads of its own, which are counted from here on
from threadpoolctl import threadpool_info, threadpool_limits

import robot_sysid as rs
from rigs.arms import small_arms
from robot_sysid.api.results import one_thread

LIBRARIES = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
pytestmark = pytest.mark.skipif(
    not LIBRARIES, reason="a linear algebra that has no threads to set"
)


def counts():
    """Threads of each library of linear algebra."""
    return {
        pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"
    }


@pytest.fixture(autouse=True)
def two():
    """What the caller has set."""
    with threadpool_limits(2, user_api="blas"):
        yield


def test_there_is_one_inside_and_afterwards_what_was_there():
    assert counts() == {2}
    with pytest.raises(ZeroDivisionError), one_thread():
        with one_thread():
            assert counts() == {1}
        assert counts() == {1}
        raise ZeroDivisionError
    assert counts() == {2}


def test_a_function_works_in_one(monkeypatch, arm_file):
    """All linear algebra that it asks for."""
    thread_counts = []

    def counted(function):
        """The function, which keeps the threads that it had."""

        def count_and_call(*arguments, **options):
            thread_counts.append(counts())
            return function(*arguments, **options)

        return count_and_call

    for name in ("cholesky", "eigvalsh", "qr", "svd"):
        monkeypatch.setattr(np.linalg, name, counted(getattr(np.linalg, name)))
    rs.self_test(arm_file(small_arms.THREE), duration=1.0, seed=1)
    assert thread_counts and thread_counts == [{1}] * len(thread_counts)
    assert counts() == {2}
