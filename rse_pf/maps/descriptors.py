"""What kind the descriptors of features are, so that those of two kinds are never compared."""

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
    "check_alike",
    "descriptors_of",
    "one_kind",
]

Descriptors = npt.NDArray[Any]
"""``(n, d)``, uint8 for binary ones, int8 for vectors."""

MAX_DESCRIPTOR_SIZE = 512
"""Bytes of a descriptor, or dimensions: squared distances of so many stay below 2**24, exact in float32."""
_MIN_SIZE = 4
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,31}")


@dataclass(frozen=True, slots=True)
class DescriptorKind:
    """What descriptors are: those of two kinds are never compared.

    Attributes:
        name: Of the features, such as ``orb``: small letters, digits, dots, hyphens and underscores, 32 at
            most.
        dtype: ``uint8`` for binary ones, ``int8`` for vectors.
        size: Bytes of a binary one, dimensions of a vector; 4 to 512.

    Raises:
        BadRequest: A part is out of its range.
    """

    name: str
    dtype: str
    size: int

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise BadRequest(
                f"{self.name[:40]!r} is no name of features",
                hint="use up to 32 small letters, digits, dots, hyphens and underscores",
            )
        if self.dtype not in ("uint8", "int8") or not _MIN_SIZE <= self.size <= MAX_DESCRIPTOR_SIZE:
            raise BadRequest(
                f"descriptors of {self.size} numbers of {str(self.dtype)[:20]} are not known",
                hint=f"use {_MIN_SIZE} to {MAX_DESCRIPTOR_SIZE} of uint8 (binary) or int8 (a vector)",
            )

    def __str__(self) -> str:
        unit = "bytes" if self.dtype == "uint8" else "dimensions"
        return f"{self.name} ({self.size} {unit})"

    def describes(self, descriptors: npt.NDArray[Any]) -> bool:
        """Return whether an array holds ``(n, size)`` descriptors of this kind."""
        return descriptors.dtype == self.dtype and descriptors.shape[1:] == (self.size,)

    def none(self) -> Descriptors:
        """Return an array of no descriptors."""
        return np.empty((0, self.size), dtype=self.dtype)


ORB = DescriptorKind("orb", "uint8", 32)
"""The default, and all that the native core matches; numpy matches the others."""


def one_kind(kinds: Iterable[DescriptorKind], what: str) -> DescriptorKind:
    """Return the kind that all are of, ORB if there are none.

    Raises:
        BadRequest: There are two kinds.
    """
    found = dict.fromkeys(kinds)
    if len(found) > 1:
        first, second, *_ = found
        raise _two_kinds(first, second, what)
    return next(iter(found), ORB)


def check_alike(kind: DescriptorKind, other: DescriptorKind, what: str) -> None:
    """Raise BadRequest if *other* is not the *kind* that *what* holds."""
    if other != kind:
        raise _two_kinds(kind, other, what)


def _two_kinds(first: DescriptorKind, second: DescriptorKind, what: str) -> BadRequest:
    """Return the refusal of features of another kind."""
    return BadRequest(
        f"{what} has features of kind {first}, and cannot take {second}",
        hint="use one kind of features for a map, or another map",
    )


def descriptors_of(data: bytes, rows: int, kind: DescriptorKind = ORB) -> Descriptors:
    """Return raw bytes as ``(rows, size)`` descriptors; raises BadRequest."""
    if len(data) != kind.size * rows:
        raise BadRequest(
            f"{len(data)} bytes are not {rows} descriptors of {kind.size} bytes",
            hint="send one for each pixel",
        )
    return np.frombuffer(data, dtype=kind.dtype).reshape(rows, kind.size)
