"""The type of fuzz targets, and the error that a target raises when the product violates a rule."""

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
