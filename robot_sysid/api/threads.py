"""Linear algebra in one thread while a function of the face works, whatever the program has set.

With several, sums are rounded in another order: the same log would give other bytes.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

from threadpoolctl import threadpool_limits


def one_thread() -> AbstractContextManager[Any]:
    """Return a block with one thread; after it there are as many as before."""
    # It has a linear algebra of its own, and only what is loaded is limited.
    import scipy.linalg  # noqa: F401

    return threadpool_limits(1, user_api="blas")
