"""The merge service: from the maps of several robots to one map, with what was joined or refused and why.

A map that shares no view with the others is left out and named.  The same maps give the same result.
"""

from __future__ import annotations

import msgspec

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.maps.format import MapVersion, decode_map, encode_map
from rse_pf.service import Registry, Report
from rse_pf.services.mapping.place import MAX_KEYFRAMES, map_limits
from rse_pf.slam.map_merge import MergedMap, MergeOptions, merge_versions
from rse_pf.slam.optimise import ignore_progress

__all__ = [
    "MAX_MAPS",
    "MergeReply",
    "MergeRequest",
    "NotJoined",
    "Refusal",
    "merge_maps",
    "register",
    "reply_of",
]


MAX_MAPS = 64
_MAX_PROJECTIONS = 20_000_000_000
"""Of one point of a cloud into one keyframe: an hour of work, which is all that a job has."""


class MergeRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Encoded map versions; the world of the first one becomes the world of the result."""

    maps: list[bytes]
    options: MergeOptions | None = None


class Refusal(msgspec.Struct, frozen=True, kw_only=True):
    """How many proposed loops between two maps (row numbers) were refused, for one *reason*."""

    maps: tuple[int, int]
    reason: str
    count: int


class NotJoined(msgspec.Struct, frozen=True, kw_only=True):
    """A map that could not be placed, and why."""

    map: int
    reason: str


class MergeReply(msgspec.Struct, frozen=True, kw_only=True):
    """One encoded map of all that was joined, and the account of it."""

    map: bytes
    joined: list[int]
    not_joined: list[NotJoined]
    refused: list[Refusal]
    loops: int
    merges: int
    cost_before: float
    cost_after: float


def merge_maps(request: MergeRequest, *, report: Report = ignore_progress) -> MergeReply:
    """Make one map of several robots' maps, or close the loops of one.

    *report* gets the progress, and may raise Cancelled to end the work.
    """
    if not 1 <= len(request.maps) <= MAX_MAPS:
        raise BadRequest(f"{len(request.maps)} maps are not within 1..{MAX_MAPS}", hint="send one or more")
    versions: list[MapVersion] = []
    for encoded in request.maps:
        versions.append(decode_map(encoded, limits=map_limits()))
        count = sum(len(version.keyframes) for version in versions)
        points = sum(len(version.points) for version in versions)
        if count > MAX_KEYFRAMES or count * points > _MAX_PROJECTIONS:
            raise LimitExceeded(
                f"{count} keyframes are above {MAX_KEYFRAMES}, or with {points} points of clouds above "
                f"{_MAX_PROJECTIONS} projections",
                hint="merge fewer maps at once, or thin their clouds",
            )
    if not all(version.keyframes for version in versions):
        raise BadRequest("a map has no keyframes", hint="leave it out")
    return reply_of(merge_versions(versions, request.options, report=report))


def register(registry: Registry) -> None:
    """Add ``merge`` to *registry*; *data* has the limit of a keyframe's features."""

    @registry.service("merge", kind="long")
    def merge(request: MergeRequest, *, report: Report = ignore_progress) -> MergeReply:
        """Make one map of several robots' maps, or close the loops of one."""
        return merge_maps(request, report=report)


def reply_of(merged: MergedMap) -> MergeReply:
    """Return the reply of the service: the merged map encoded, and the account of it."""
    return MergeReply(
        map=encode_map(merged.version),
        joined=list(merged.joined),
        not_joined=[NotJoined(map=which, reason=reason) for which, reason in merged.not_joined],
        refused=[
            Refusal(maps=(one, other), reason=reason, count=count)
            for (one, other, reason), count in sorted(merged.refused.items())
        ],
        loops=merged.loops,
        merges=merged.merges,
        cost_before=merged.cost_before,
        cost_after=merged.cost_after,
    )
