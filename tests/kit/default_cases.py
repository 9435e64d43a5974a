"""Cases of a test: the first ones run by default, the others with the slow tests.

For tests that repeat one claim over many random worlds: some worlds show each day that the claim holds,
and the others show it where time does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["first_by_default"]


def first_by_default(count: int, cases: Iterable[Any]) -> list[Any]:
    """Return *cases* for ``parametrize``: those after the first *count* are slow."""
    return [
        case if number < count else pytest.param(case, marks=pytest.mark.slow)
        for number, case in enumerate(cases)
    ]
