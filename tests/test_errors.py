"""Messages of errors stay readable."""

from __future__ import annotations

from robot_sysid.errors import AmbiguousJointError


def test_of_very_many_candidates_the_first_are_named_and_the_others_counted():
    error = AmbiguousJointError("two arms", [(f"j{k}", f"b{k}") for k in range(1601)])
    assert str(error).endswith("j19 (body b19), and 1581 more")
    assert len(error.candidates) == 1601


def test_few_candidates_are_all_named():
    error = AmbiguousJointError("two arms", [("a", "b"), ("c", "d")])
    assert str(error).endswith("Candidates: a (body b), c (body d)")
