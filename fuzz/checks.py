"""The type of fuzz targets, and the error that a target raises when the product violates a rule."""

from __future__ import annotations

from collections.abc import Callable

from fuzz.meter import Meter

__all__ = ["Target", "TargetFailure", "expect"]

Target = Callable[[bytes, Meter], None]


class TargetFailure(AssertionError):
    """A fuzz target found that the product violates one of its rules."""


def expect(holds: bool, otherwise: str) -> None:
    """Raise `TargetFailure` with the message *otherwise* unless the condition *holds*."""
    if not holds:
        raise TargetFailure(otherwise)
