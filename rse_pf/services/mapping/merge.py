"""The service ``merge``: merge the maps of several robots into one map.

A map that shows no place of the other maps is left out, and the reply names it with the reason.  Equal
requests have equal results.
"""

from __future__ import annotations

import msgspec

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.maps.format import MapVersion, decode_map, encode_map
from rse_pf.service import Registry, Report
from rse_pf.services.mapping.place import MAP_LIMITS, MAX_KEYFRAMES
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
"""Most maps of one request, which is refused with more; all maps together have at most 2,000 keyframes."""
_MAX_PROJECTIONS = 20_000_000_000
"""Largest product of the numbers of keyframes and of cloud points of all maps of a request, which is refused
with LimitExceeded beyond it: this number of projections takes an hour, the time limit of a job."""


class MergeRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Encoded map versions; the world frame of the first map becomes that of the result."""

    maps: list[bytes]
    options: MergeOptions | None = None


class Refusal(msgspec.Struct, frozen=True, kw_only=True):
    """Rejected loop closures between two maps.

    Attributes:
        maps: Indices of the two maps in the request, from 0; equal for loop closures within one map.
        reason: Why the loop closures were rejected.
        count: Number of loop closures that were rejected for this reason.
    """

    maps: tuple[int, int]
    reason: str
    count: int


class NotJoined(msgspec.Struct, frozen=True, kw_only=True):
    """A map of the request that is not in the result.

    Attributes:
        map: Index of the map in the request, from 0.
        reason: Why the map was not joined.
    """

    map: int
    reason: str


class MergeReply(msgspec.Struct, frozen=True, kw_only=True):
    """The merged map.

    Attributes:
        map: Encoded map version.
        joined: Indices, from 0, of the maps of the request that are in the result.
        not_joined: The other maps.
        refused: Rejected loop closures.
        loops: Number of accepted loop closures within a map, summed over the joined maps.
        merges: Number of accepted loop closures between two joined maps.
        cost_before: Cost of the merged pose graph, with the robust loss, before its optimisation; no unit.
        cost_after: The same cost after the optimisation, at most *cost_before*.
    """

    map: bytes
    joined: list[int]
    not_joined: list[NotJoined]
    refused: list[Refusal]
    loops: int
    merges: int
    cost_before: float
    cost_after: float


def merge_maps(request: MergeRequest, *, report: Report = ignore_progress) -> MergeReply:
    """Merge the maps of several robots into one map, or close the loops of a single map.

    Args:
        request: The maps.
        report: Function that receives the progress, and may raise Cancelled to stop the work.

    Raises:
        BadRequest: There are no or too many maps, the bytes are not maps, a map has no keyframes, the maps
            have descriptors of different kinds, or the information of an edge is not positive definite.
        LimitExceeded: The maps are too large, or the product of the numbers of keyframes, maps and candidates
            is above `MAX_PAIRS`.
        MissingExtra: GTSAM or the native core is not installed.
        Cancelled: *report* raised it.
    """
    if not 1 <= len(request.maps) <= MAX_MAPS:
        raise BadRequest(f"{len(request.maps)} maps are not within 1..{MAX_MAPS}", hint="send one or more")
    versions: list[MapVersion] = []
    for encoded in request.maps:
        versions.append(decode_map(encoded, limits=MAP_LIMITS))
        count = sum(len(version.keyframes) for version in versions)
        points = sum(len(version.points) for version in versions)
        if count > MAX_KEYFRAMES or count * points > _MAX_PROJECTIONS:
            raise LimitExceeded(
                f"the maps have {count} keyframes and {points} points, but may have up to {MAX_KEYFRAMES} "
                f"keyframes, and up to {_MAX_PROJECTIONS} as the product of keyframes and points",
                hint="merge fewer maps at once, or thin their clouds",
            )
    if not all(version.keyframes for version in versions):
        raise BadRequest("a map has no keyframes", hint="leave it out")
    return reply_of(merge_versions(versions, request.options, report=report))


def register(registry: Registry) -> None:
    """Add the service ``merge``, a long job, to *registry*."""

    @registry.service("merge", kind="long")
    def merge(request: MergeRequest, *, report: Report = ignore_progress) -> MergeReply:
        """Make one map of several robots' maps, or close the loops of one."""
        return merge_maps(request, report=report)


def reply_of(merged: MergedMap) -> MergeReply:
    """Return the reply of the service for *merged*, with the encoded map."""
    return MergeReply(
        map=encode_map(merged.version),
        joined=list(merged.joined),
        not_joined=[NotJoined(map=number, reason=reason) for number, reason in merged.not_joined],
        refused=[
            Refusal(maps=(first, second), reason=reason, count=count)
            for (first, second, reason), count in sorted(merged.refused.items())
        ],
        loops=merged.loops,
        merges=merged.merges,
        cost_before=merged.cost_before,
        cost_after=merged.cost_after,
    )
