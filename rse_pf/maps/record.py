"""Define the record that the registry stores for each version of a map."""

from __future__ import annotations

import msgspec

from rse_pf.storage.object_store import digest_of

__all__ = ["MapRecord"]


class MapRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The record of a version of a map, stored as JSON; its sha256 is the id of the version.

    Attributes:
        digest: The sha256 of the encoded map, in hexadecimal digits.
        size: Bytes of the encoded map.
        parent: Id of the version that was the head when this version was committed; None for the first
            version.
        number: 1 for the first version, else the number of the parent plus 1.  After a rollback, two versions
            may have the same number.
        author: Who committed the version.
        created_s: When it was committed, Unix seconds.
        note: What the author says about it.
        keyframes: Number of keyframes.
        edges: Number of edges of the pose graph.
        points: Number of points of the cloud.
        robots: Names of the robots of the keyframes.
    """

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
        """The id of the version: the sha256 of this record, in hexadecimal digits."""
        return digest_of(msgspec.json.encode(self))
