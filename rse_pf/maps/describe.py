"""Count what an encoded map contains.

The bytes of a robot are untrusted: a data server decodes them in a child process with limits, see
`rse_pf.processes.limited`.
"""

from __future__ import annotations

import msgspec

__all__ = ["MapSummary", "describe_map"]


class MapSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers of keyframes, edges and points of a map, and the names of the robots of its keyframes."""

    keyframes: int
    edges: int
    points: int
    robots: tuple[str, ...]


def describe_map(data: bytes, max_bytes: int) -> MapSummary:
    """Return the summary of an encoded map.

    Args:
        data: The bytes that `rse_pf.maps.format.encode_map` returned; they may come from an untrusted robot.
        max_bytes: The largest size of the decompressed map.

    Raises:
        BadRequest: The bytes are not a map.
        LimitExceeded: The map has too many keyframes, features or edges.
    """
    from rse_pf.maps.format import decode_map  # Imports numpy, which a data server does without.

    version = decode_map(data, max_bytes)
    return MapSummary(
        keyframes=len(version.keyframes),
        edges=len(version.edges),
        points=len(version.points),
        robots=tuple(sorted({keyframe.robot for keyframe in version.keyframes})),
    )
