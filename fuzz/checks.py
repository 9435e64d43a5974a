"""What all fuzz targets share: their type, and the error of a rule that the product violates."""

from __future__ import annotations

from collections.abc import Callable

from fuzz.meter import Meter

__all__ = ["Target", "TargetFailure", "expect"]

Target = Callable[[bytes, Meter], None]


class TargetFailure(AssertionError):
    """The product violates one of its rules."""


def expect(holds: bool, otherwise: str) -> None:
    """Raise `TargetFailure` with *otherwise* unless *holds*."""
    if not holds:
        raise TargetFailure(otherwise)
