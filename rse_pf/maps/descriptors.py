"""Describe the kinds of feature descriptors, so that descriptors of different kinds are never compared."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest

__all__ = [
    "MAX_DESCRIPTOR_SIZE",
    "ORB",
    "DescriptorKind",
    "Descriptors",
    "check_same_kind",
    "common_kind",
    "decode_descriptors",
]

Descriptors = npt.NDArray[Any]
"""Descriptors of n features, ``(n, d)``: uint8 if they are binary (d bytes), int8 if they are vectors."""

MAX_DESCRIPTOR_SIZE = 512
"""Largest size of a descriptor, in bytes if it is binary, else in dimensions.  Of two int8 vectors with this
number of dimensions, twice the scalar product and the sum of the squared lengths are at most 2**24, up to
which float32 holds whole numbers exactly, so that a distance does not depend on the order of summation."""
_MIN_DESCRIPTOR_SIZE = 4
"""Smallest size of a descriptor, in bytes if it is binary, else in dimensions: smaller ones do not
distinguish features, and are refused."""
_KIND_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,31}")


@dataclass(frozen=True, slots=True)
class DescriptorKind:
    """A kind of descriptors; descriptors are compared only with descriptors of an equal kind.

    Attributes:
        name: Name of the feature, such as ``orb``: up to 32 lower-case letters, digits, dots, hyphens and
            underscores.
        dtype: ``uint8`` for binary descriptors, which are compared by their Hamming distance; ``int8`` for
            vectors, which are compared by their Euclidean distance.
        size: Bytes of a binary descriptor, or dimensions of a vector; 4 to 512.

    Raises:
        BadRequest: An attribute is out of its range.
    """

    name: str
    dtype: str
    size: int

    def __post_init__(self) -> None:
        if not _KIND_NAME.fullmatch(self.name):
            raise BadRequest(
                f"{self.name[:40]!r} is no name of features",
                hint="use up to 32 small letters, digits, dots, hyphens and underscores",
            )
        if (
            self.dtype not in ("uint8", "int8")
            or not _MIN_DESCRIPTOR_SIZE <= self.size <= MAX_DESCRIPTOR_SIZE
        ):
            raise BadRequest(
                f"descriptors of {self.size} numbers of {str(self.dtype)[:20]} are not known",
                hint=f"use {_MIN_DESCRIPTOR_SIZE} to {MAX_DESCRIPTOR_SIZE} numbers of uint8 (binary) or int8 "
                "(a vector)",
            )

    def __str__(self) -> str:
        unit = "bytes" if self.dtype == "uint8" else "dimensions"
        return f"{self.name} ({self.size} {unit})"

    def is_kind_of(self, descriptors: npt.NDArray[Any]) -> bool:
        """Return whether an array has the shape ``(n, size)`` and the dtype of this kind."""
        return descriptors.dtype == self.dtype and descriptors.shape[1:] == (self.size,)

    def empty(self) -> Descriptors:
        """Return descriptors of no features, shape ``(0, size)``."""
        return np.empty((0, self.size), dtype=self.dtype)


ORB = DescriptorKind("orb", "uint8", 32)
"""The default kind of descriptors, which the native core matches; other kinds are matched by numpy."""


def common_kind(kinds: Iterable[DescriptorKind], subject: str) -> DescriptorKind:
    """Return the kind that all of *kinds* are equal to, or ORB if there are none.

    Raises:
        BadRequest: *kinds* differ; the message begins with *subject*, such as "the map".
    """
    distinct = dict.fromkeys(kinds)
    if len(distinct) > 1:
        first, second, *_ = distinct
        raise _different_kinds(first, second, subject)
    return next(iter(distinct), ORB)


def check_same_kind(expected: DescriptorKind, actual: DescriptorKind, subject: str) -> None:
    """Raise BadRequest if *actual* is not the *expected* kind of *subject*, such as "the map"."""
    if actual != expected:
        raise _different_kinds(expected, actual, subject)


def _different_kinds(expected: DescriptorKind, actual: DescriptorKind, subject: str) -> BadRequest:
    return BadRequest(
        f"{subject} has features of kind {expected}, and cannot take {actual}",
        hint="use one kind of features for a map, or another map",
    )


def decode_descriptors(data: bytes, count: int, kind: DescriptorKind = ORB) -> Descriptors:
    """Return *data* as a read-only array ``(count, kind.size)`` of descriptors, without copying it.

    Raises:
        BadRequest: *data* has another length than *count* descriptors.
    """
    if len(data) != kind.size * count:
        raise BadRequest(
            f"{len(data)} bytes are not {count} descriptors of {kind.size} bytes",
            hint="send one descriptor for each pixel",
        )
    return np.frombuffer(data, dtype=kind.dtype).reshape(count, kind.size)
