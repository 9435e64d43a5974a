"""The computation of each kind of part: it reads objects of the store and returns one result.

A computation gives the same result in every process.  Maps are decoded within the limits of the platform's
services.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from typing import Any, cast

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.extensions.batch.icp_tiles import align_tiles
from rse_pf.extensions.batch.parts import Part, PartResult, encode_result, is_done, read_result
from rse_pf.maps.format import MapVersion, decode_map
from rse_pf.services.mapping.place import MAP_LIMITS
from rse_pf.slam.cloud_deform import deform_cloud
from rse_pf.slam.consistency import LoopClosure
from rse_pf.slam.loop_closures import (
    Atlas,
    MergeOptions,
    RejectionCounts,
    choose_candidate_pairs,
    measure_pairs,
    select_consistent,
)
from rse_pf.slam.place_recognition import PLACE_VECTOR_SIZE, PlaceIndex, place_vector
from rse_pf.storage.object_store import ObjectStore

__all__ = [
    "compute_part",
    "link_arrays",
    "links_of",
    "strongest_rows",
]

# Number of decoded maps that a process keeps in memory for the next parts.
_CACHED_MAPS = 4


def compute_part(store: ObjectStore, part: Part) -> None:
    """Compute *part* and store its result, unless it is stored already.

    Raises:
        BadRequest: The kind of part is unknown, or an input is malformed.
        StoreError: The store failed.
    """
    if part.kind not in _KINDS:
        raise BadRequest(f"there is no kind of part {part.kind!r}", hint="run the same version everywhere")
    if not is_done(store, part):
        store.put(part.name, encode_result(_KINDS[part.kind](store, part)))


def link_arrays(links: Sequence[LoopClosure]) -> dict[str, npt.NDArray[Any]]:
    """Return loop closures as arrays that have a row for each of them."""
    return {
        "a": np.array([link.a for link in links], dtype=np.int64),
        "b": np.array([link.b for link in links], dtype=np.int64),
        "T_a_b": np.array([link.T_a_b for link in links], dtype=np.float64).reshape(-1, 4, 4),
        "information": np.array([link.information for link in links], dtype=np.float64).reshape(-1, 6, 6),
        "inliers": np.array([link.inliers for link in links], dtype=np.int64),
        "matches": np.array([link.matches for link in links], dtype=np.int64),
    }


def links_of(result: PartResult) -> list[LoopClosure]:
    """Return the loop closures in the arrays of *result*, which `link_arrays` made."""
    of = result.arrays
    return [
        LoopClosure(a=a, b=b, T_a_b=T, information=information, inliers=inliers, matches=matches)
        for a, b, T, information, inliers, matches in zip(
            of["a"].tolist(), of["b"].tolist(), of["T_a_b"], of["information"],
            of["inliers"].tolist(), of["matches"].tolist(), strict=True,
        )
    ]  # fmt: skip


def strongest_rows(links: Sequence[LoopClosure], most: int) -> list[int]:
    """Return the row numbers of at most *most* of the loop closures *links*, sorted.

    The loop closure with the most inliers of each keyframe comes before every keyframe's second best, so that
    the chosen loop closures are spread over the map.
    """
    by_inliers = sorted(range(len(links)), key=lambda row: (-links[row].inliers, row))
    seen: Counter[int] = Counter()
    ranked = []
    for row in by_inliers:
        ranked.append((seen[links[row].a], -links[row].inliers, row))
        seen[links[row].a] += 1
    return sorted(row for _, _, row in sorted(ranked)[:most])


def _vectors(store: ObjectStore, part: Part) -> PartResult:
    """Compute the place-recognition vector of each keyframe of a map: array ``vectors``."""
    atlas = _atlas(store, part, 1)
    vectors = [place_vector(keyframe.descriptors) for keyframe in atlas.keyframes]
    return PartResult(arrays={"vectors": np.array(vectors, dtype=np.float32).reshape(-1, PLACE_VECTOR_SIZE)})


def _pairs(store: ObjectStore, part: Part) -> PartResult:
    """Choose pairs of similar keyframes of two maps, or of one: array ``pairs`` ``(n, 2)`` of rows."""
    vectors = [read_result(store, name).arrays["vectors"] for name in part.inputs]
    of_map = np.concatenate([np.full(len(each), which) for which, each in enumerate(vectors)])
    stacked = np.concatenate(vectors)
    pairs = choose_candidate_pairs(
        PlaceIndex.from_pairs(enumerate(stacked)),
        of_map,
        _options(part),
        between=(0, len(vectors) - 1),
    )
    return PartResult(arrays={"pairs": np.array(pairs, dtype=np.int64).reshape(-1, 2)})


def _links(store: ObjectStore, part: Part) -> PartResult:
    """Measure some of the candidate pairs with PnP: arrays of loop closures, and failures by reason."""
    first, last = part.arguments["rows"]
    pairs = read_result(store, part.inputs[-1]).arrays["pairs"][first:last]
    atlas = _atlas(store, part, len(part.inputs) - 1)
    links, failed = measure_pairs(atlas, [(a, b) for a, b in pairs.tolist()], _options(part))
    return PartResult(arrays=link_arrays(links), counts=_by_reason(failed))


def _agree(store: ObjectStore, part: Part) -> PartResult:
    """Select the pairwise consistent loop closures between two maps, or within one.

    The array ``rows`` has the row numbers of the accepted loop closures; rejected ones are counted by reason.
    """
    maps = part.arguments["maps"]
    atlas = _atlas(store, part, maps)
    links = [link for name in part.inputs[maps:] for link in links_of(read_result(store, name))]
    tried = strongest_rows(links, part.arguments["most"])
    rows, refused = select_consistent(
        (0, maps - 1), [links[row] for row in tried], atlas.T_world_camera, _options(part)
    )
    counts = {**_by_reason(refused), "surplus": len(links) - len(tried)}
    return PartResult(arrays={"rows": np.array([tried[row] for row in rows], dtype=np.int64)}, counts=counts)


def _tiles(store: ObjectStore, part: Part) -> PartResult:
    """Align the clouds of two maps tile by tile: arrays of loop closures, and other tiles by reason."""
    versions = [_map(store, name) for name in part.inputs[:2]]
    pose = read_result(store, part.inputs[2]).arrays["T_one_other"]
    links, refused = align_tiles(Atlas.of(versions), (versions[0].points, versions[1].points), pose)
    return PartResult(arrays=link_arrays(links), counts=dict(refused))


def _cloud(store: ObjectStore, part: Part) -> PartResult:
    """Move the points of a map's cloud with its keyframes to the optimised poses: array ``points``."""
    atlas = _atlas(store, part, 1)
    points = _map(store, part.inputs[0]).points
    poses = read_result(store, part.inputs[1]).arrays["poses"]
    return PartResult(arrays={"points": deform_cloud(points, atlas.keyframes, poses)})


# The computation of each kind of part.
_KINDS: dict[str, Callable[[ObjectStore, Part], PartResult]] = {
    "vectors": _vectors,
    "pairs": _pairs,
    "links": _links,
    "agree": _agree,
    "tiles": _tiles,
    "cloud": _cloud,
}


def _atlas(store: ObjectStore, part: Part, maps: int) -> Atlas:
    return Atlas.of([_map(store, name) for name in part.inputs[:maps]])


def _map(store: ObjectStore, name: str) -> MapVersion:
    version: MapVersion = _cached_map(cast("Hashable", store), name)
    return version


@functools.lru_cache(maxsize=_CACHED_MAPS)
def _cached_map(store: Any, name: str) -> MapVersion:
    """Return the decoded map in the object *name*; the object never changes, since *name* has its digest."""
    return _decoded(store.get(name))


def _decoded(data: bytes) -> MapVersion:
    return decode_map(data, limits=MAP_LIMITS)


def _options(part: Part) -> MergeOptions:
    return msgspec.convert(part.arguments["options"], MergeOptions)


def _by_reason(refused: RejectionCounts) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for (_, _, reason), count in refused.items():
        counts[reason] += count
    return {reason: count for reason, count in sorted(counts.items()) if count}
