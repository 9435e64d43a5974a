"""Say what a map holds without keeping it: bytes in, counts out.

A stranger's map is described in a process with limits only (`rse_pf.child.limited`).
"""

from __future__ import annotations

import msgspec

__all__ = ["MapSummary", "describe_map"]


class MapSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What a map holds: numbers of keyframes, edges and points, and whose keyframes they are."""

    keyframes: int
    edges: int
    points: int
    robots: tuple[str, ...]


def describe_map(data: bytes, max_bytes: int) -> MapSummary:
    """Return the counts of an encoded map.

    Args:
        data: What `encode_map` returned, or a stranger's bytes.
        max_bytes: Size of the inflated map.

    Raises:
        BadRequest: The bytes are not a map.
        LimitExceeded: The map holds more than a map may.
    """
    from rse_pf.maps.format import decode_map  # numpy, which a data server never needs

    decoded = decode_map(data, max_bytes)
    return MapSummary(
        keyframes=len(decoded.keyframes),
        edges=len(decoded.edges),
        points=len(decoded.points),
        robots=tuple(sorted({keyframe.robot for keyframe in decoded.keyframes})),
    )
