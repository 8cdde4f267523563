"""Which cases of a test run at every change, and which each night alone."""

import pytest


def by_night(cases, *, day):
    """
    Return the cases of a test for `parametrize`, all but some of them with the marker `nightly`.

    Args:
        cases: All of them: values, or tuples of values.
        day: Those that run at every change. They hold the test's claim; the others look for where it does not hold.
    """
    assert all(case in cases for case in day)
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=() if case in day else pytest.mark.nightly,
        )
        for case in cases
    ]
