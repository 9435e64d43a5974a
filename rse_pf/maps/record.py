"""The record of one version of a map."""

from __future__ import annotations

import msgspec

from rse_pf.object_store import digest_of

__all__ = ["MapRecord"]


class MapRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What is stored about a version beside the map; the sha256 of the record is the version's id."""

    digest: str
    size: int
    parent: str | None
    number: int
    author: str
    created_s: float
    note: str
    keyframes: int
    edges: int
    points: int
    robots: tuple[str, ...]

    @property
    def id(self) -> str:
        """The id of this version."""
        return digest_of(msgspec.json.encode(self))
