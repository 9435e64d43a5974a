"""Merge maps in parts: the expensive steps of `merge_versions` are cut into parts that an engine computes.

All other steps are those of `merge_versions`, so that both give the same loop closures and the same map.  A
run that was killed is continued by the same call: parts whose results are stored are not computed again.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.extensions.batch.dask_engine import DaskEngine
from rse_pf.extensions.batch.part_kinds import links_of, strongest_rows
from rse_pf.extensions.batch.parts import Part, PartResult, delete_parts, is_done, put_input, read_result
from rse_pf.geometry import Array, inverse
from rse_pf.maps.format import MapLimits, MapVersion, decode_map
from rse_pf.service import Report
from rse_pf.services.mapping.place import MAP_LIMITS
from rse_pf.slam.cloud_deform import merge_clouds
from rse_pf.slam.consistency import LoopClosure
from rse_pf.slam.loop_closures import Atlas, LoopProposals, MergeOptions, RejectionCounts, map_pair_of
from rse_pf.slam.map_merge import MergedMap, MergeSteps, merge_versions
from rse_pf.slam.optimise import (
    ignore_progress,
)
from rse_pf.slam.ply import Colours, Points
from rse_pf.storage.object_store import ObjectStore

__all__ = ["BatchMerge", "BatchMergeResult", "strongest"]

# Progress, as a fraction of the whole merge, at which each kind of part begins.
_PROGRESS_AT_BEGIN = {
    "vectors": 0.0, "pairs": 0.08, "links": 0.12, "agree": 0.70, "tiles": 0.76,
    "cloud": 0.95,
}  # fmt: skip
# Name of each kind of part in the text of the progress.
_PROGRESS_TEXTS = {
    "vectors": "views of maps", "pairs": "proposals", "links": "parts of links",
    "agree": "pairs of maps", "tiles": "pairs of clouds", "cloud": "clouds",
}  # fmt: skip
MAX_MAPS = 256
"""Largest number of maps of one merge."""
MAX_KEYFRAMES = 20_000
"""Largest number of keyframes of all maps of one merge, as many as the largest stored map holds."""
MAX_LINKS_PER_PAIR = 300
"""Largest number of loop closures of two maps, or of one map, that are checked for pairwise consistency.
The best loop closures of each keyframe are taken first.  The time grows with the cube of the number: 215
take 0.4 s."""
MAX_LINKS = 30_000
"""Largest number of loop closures in a merged map.

Of more, the strongest of each pair of maps are used.  A map may
hold 100,000 edges, and 24,701 take 16.5 s to optimise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchMergeResult:
    """The merged map, its loop closures, and the numbers and times of its parts."""

    merged: MergedMap
    links: tuple[LoopClosure, ...]
    """All loop closures that PnP measured, accepted or not."""
    tiles: tuple[LoopClosure, ...]
    """Loop closures from the alignment of clouds."""
    computed: int
    """Number of parts that this run computed."""
    found: int
    """Number of parts whose results were stored already."""
    seconds: Mapping[str, float]
    """Wall-clock time of each kind of part, in seconds."""


class BatchMerge:
    """One merge of maps in parts; `run` merges, `forget` deletes the parts afterwards."""

    def __init__(
        self,
        store: ObjectStore,
        engine: DaskEngine,
        settings: PlatformSettings,
        *,
        options: MergeOptions | None = None,
        align_clouds: bool = True,
    ) -> None:
        """Describe the merge; nothing is computed.

        Args:
            store: The object store with the maps and the results of parts; every worker must have access to
                it.
            engine: Computes the parts.
            settings: Settings of the platform, with the size of parts (``batch.pairs_per_part``).
            options: Options of the merge; None means the defaults.
            align_clouds: Whether overlapping clouds are aligned, which gives more loop closures.
        """
        self._store = store
        self._engine = engine
        self._settings = settings
        self._options = options or MergeOptions()
        self._align_clouds = align_clouds
        self._report: Report = ignore_progress
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._maps: tuple[str, ...] = ()
        self._own: list[str] = []
        self._tiles: list[LoopClosure] = []
        self._links: tuple[LoopClosure, ...] = ()
        self._agreeing: list[Part] = []
        self._pairs: list[tuple[int, int]] = []
        self._computed = self._found = 0

    def run(self, maps: Sequence[str], report: Report = ignore_progress) -> BatchMergeResult:
        """Merge the maps in the objects *maps* and return the result.

        Args:
            maps: Names of objects with encoded map versions; a name contains the digest of the object.
            report: Called with the completed fraction and a text; may raise Cancelled.

        Raises:
            BadRequest: The number of maps is out of range, or an object is no map or has no keyframes.
            LimitExceeded: The maps have too many keyframes or features.
            RsePfError: The workers cannot be reached, or a part failed; the same call continues the merge.
        """
        self._maps = tuple(maps)
        self._report = report
        versions = self._versions()
        steps = MergeSteps(propose=self._propose, select=self._select, align=self._align, deform=self._deform)
        merged = merge_versions(versions, self._options, report=self._whole_report, steps=steps)
        return BatchMergeResult(
            merged=merged, links=self._links, tiles=tuple(self._tiles), computed=self._computed,
            found=self._found, seconds=dict(self._seconds),
        )  # fmt: skip

    def forget(self) -> None:
        """Delete the results and inputs of all parts of this merge from the store."""
        delete_parts(self._store, self._own)

    def _versions(self) -> list[MapVersion]:
        if not 1 <= len(self._maps) <= MAX_MAPS:
            raise BadRequest(f"{len(self._maps)} maps are not within 1..{MAX_MAPS}", hint="name one or more")
        most = MapLimits()
        versions: list[MapVersion] = []
        keyframes = features = 0
        for name in self._maps:
            versions.append(decode_map(self._store.get(name), limits=MAP_LIMITS))
            keyframes += len(versions[-1].keyframes)
            if keyframes > MAX_KEYFRAMES:
                raise LimitExceeded(f"more than {MAX_KEYFRAMES} keyframes", hint="merge fewer maps at once")
            features += sum(len(each.pixels) for each in versions[-1].keyframes)
            if features > most.features:
                raise LimitExceeded(
                    f"more than {most.features} features, which no map may hold",
                    hint="merge fewer maps at once, or maps with fewer keyframes",
                )
        if not all(version.keyframes for version in versions):
            raise BadRequest("a map has no keyframes", hint="leave it out")
        return versions

    def _whole_report(self, done: float, what: str) -> None:
        """Pass on only the last report of `merge_versions`: during its steps, `_run` reports the progress."""
        if done >= 1.0:
            self._report(done, what)

    def _run(self, parts: Sequence[Part]) -> list[PartResult]:
        """Compute those of *parts* whose results are not stored; return the results of all, in their order.

        All parts must be of the same kind.
        """
        if not parts:
            return []
        kind = parts[0].kind
        begin = _PROGRESS_AT_BEGIN[kind]
        end = min((share for share in _PROGRESS_AT_BEGIN.values() if share > begin), default=1.0)
        missing = list({part.name: part for part in parts if not is_done(self._store, part)}.values())
        known = len(parts) - len(missing)

        def on_done(count: int) -> None:
            share = (known + count) / len(parts)
            self._report(
                begin + share * (end - begin), f"{known + count} of {len(parts)} {_PROGRESS_TEXTS[kind]}"
            )

        on_done(0)
        self._own += [part.name for part in parts]
        began = time.monotonic()
        self._engine.run(missing, on_done)
        self._seconds[kind] += time.monotonic() - began
        self._computed += len(missing)
        self._found += known
        return [read_result(self._store, part.name) for part in parts]

    def _put(self, **arrays: Array) -> str:
        name = put_input(self._store, PartResult(arrays=arrays))
        self._own.append(name)
        return name

    @property
    def _merge_options(self) -> dict[str, float | int | bool]:
        names = self._options.__struct_fields__
        return {name: getattr(self._options, name) for name in names}

    def _propose(self, atlas: Atlas, options: MergeOptions, report: Report) -> LoopProposals:
        vectors = [Part(kind="vectors", inputs=(name,)) for name in self._maps]
        self._run(vectors)
        count = len(self._maps)
        self._pairs = [
            (one, other)
            for one in range(count)
            for other in range(one, count)
            if one != other or options.close_loops
        ]
        proposing = [
            Part(
                kind="pairs",
                inputs=tuple(vectors[which].name for which in dict.fromkeys((one, other))),
                arguments={"options": self._merge_options},
            )
            for one, other in self._pairs
        ]
        proposed = [len(each.arrays["pairs"]) for each in self._run(proposing)]
        step = self._settings.batch.pairs_per_part
        parts, owner = [], []
        for number, (each, pairs) in enumerate(zip(proposing, proposed, strict=True)):
            for first in range(0, pairs, step):
                arguments = {
                    "options": self._merge_options, "rows": (first, min(first + step, pairs))
                }  # fmt: skip
                inputs = (*self._names_of(self._pairs[number]), each.name)
                parts.append(Part(kind="links", inputs=inputs, arguments=arguments))
                owner.append(number)
        results = self._run(parts)
        self._plan_agreement(parts, owner)
        return self._proposals(atlas, results, owner)

    def _names_of(self, pair: tuple[int, int]) -> tuple[str, ...]:
        return tuple(self._maps[which] for which in dict.fromkeys(pair))

    def _plan_agreement(self, parts: Sequence[Part], owner: Sequence[int]) -> None:
        self._agreeing = []
        for number, pair in enumerate(self._pairs):
            maps = self._names_of(pair)
            own = tuple(part.name for part, which in zip(parts, owner, strict=True) if which == number)
            arguments = {
                "options": self._merge_options, "maps": len(maps), "most": MAX_LINKS_PER_PAIR,
            }  # fmt: skip
            self._agreeing.append(Part(kind="agree", inputs=(*maps, *own), arguments=arguments))

    def _proposals(self, atlas: Atlas, results: Sequence[PartResult], owner: Sequence[int]) -> LoopProposals:
        starts = np.searchsorted(atlas.of_map, np.arange(len(self._maps) + 1))
        links: list[LoopClosure] = []
        failed: RejectionCounts = Counter()
        for result, number in zip(results, owner, strict=True):
            pair = self._pairs[number]
            links += [_moved(link, pair, starts) for link in links_of(result)]
            failed.update({(*pair, reason): count for reason, count in result.counts.items()})
        self._links = tuple(sorted(links, key=lambda link: (link.a, link.b)))
        return LoopProposals(loop_closures=self._links, failed=failed)

    def _select(
        self, atlas: Atlas, proposals: LoopProposals, options: MergeOptions
    ) -> tuple[list[LoopClosure], RejectionCounts]:
        groups: dict[tuple[int, int], list[LoopClosure]] = {pair: [] for pair in self._pairs}
        for link in proposals.loop_closures:
            groups[map_pair_of(atlas, link.a, link.b)].append(link)
        wanted = [number for number, pair in enumerate(self._pairs) if groups[pair]]
        results = self._run([self._agreeing[number] for number in wanted])
        accepted: list[LoopClosure] = []
        refused = Counter(proposals.failed)
        for number, result in zip(wanted, results, strict=True):
            pair = self._pairs[number]
            accepted += [groups[pair][row] for row in result.arrays["rows"].tolist()]
            refused.update({(*pair, reason): count for reason, count in result.counts.items()})
        accepted, surplus = strongest(atlas, accepted, MAX_LINKS)
        refused.update(surplus)
        return accepted, Counter({key: count for key, count in refused.items() if count})

    def _align(self, atlas: Atlas, placed: Array, links: Sequence[LoopClosure]) -> list[LoopClosure]:
        if not self._align_clouds:
            return []
        linked = sorted({map_pair_of(atlas, link.a, link.b) for link in links})
        starts = np.searchsorted(atlas.of_map, np.arange(len(self._maps) + 1))
        T_world_map = [placed[row] @ inverse(atlas.T_world_camera[row]) for row in starts[:-1]]
        parts, pairs = [], []
        for one, other in linked:
            if one == other:
                continue
            guess = self._put(T_one_other=inverse(T_world_map[one]) @ T_world_map[other])
            inputs = (self._maps[one], self._maps[other], guess)
            parts.append(Part(kind="tiles", inputs=inputs))
            pairs.append((one, other))
        results = self._run(parts)
        self._tiles = [
            _moved(link, pair, starts)
            for pair, result in zip(pairs, results, strict=True)
            for link in links_of(result)
        ]
        return list(self._tiles)

    def _deform(
        self, versions: Sequence[MapVersion], atlas: Atlas, poses: Array, rows: npt.NDArray[np.int64]
    ) -> tuple[Points, Colours]:
        joined = [
            which
            for which in np.unique(atlas.of_map[rows]).tolist()
            if len(versions[which].points)
        ]  # fmt: skip
        parts = [
            Part(
                kind="cloud",
                inputs=(self._maps[which], self._put(poses=poses[atlas.of_map == which])),
            )
            for which in joined
        ]
        clouds = [result.arrays["points"] for result in self._run(parts)]
        return merge_clouds(clouds, [versions[which].colours for which in joined])


def strongest(
    atlas: Atlas, links: Sequence[LoopClosure], most: int
) -> tuple[list[LoopClosure], RejectionCounts]:
    """Return about *most* of the loop closures *links*, in their order, and dropped ones by pair of maps.

    Each pair of maps keeps the same number of loop closures, at least one, or all if the pair has fewer, so
    that no map loses its connection.  Of a pair, the best loop closures of each keyframe are kept first.
    """
    refused: RejectionCounts = Counter()
    if len(links) <= most:
        return list(links), refused
    groups: dict[tuple[int, int], list[int]] = {}
    for row, link in enumerate(links):
        groups.setdefault(map_pair_of(atlas, link.a, link.b), []).append(row)
    share = max(1, most // len(groups))
    kept: list[int] = []
    for pair, rows in groups.items():
        best = strongest_rows([links[row] for row in rows], share)
        refused[pair[0], pair[1], "surplus"] += len(rows) - len(best)
        kept += [rows[place] for place in best]
    return [links[row] for row in sorted(kept)], refused


def _moved(link: LoopClosure, pair: tuple[int, int], starts: npt.NDArray[np.int64]) -> LoopClosure:
    """Convert the keyframe rows of the loop closure *link* from the atlas of *pair* to the atlas of all maps.

    *starts* holds the first row of each map in the atlas of all maps, and the number of rows at the end.
    """
    one, other = pair
    count = int(starts[one + 1] - starts[one])

    def row(local: int) -> int:
        if local < count:
            return int(starts[one]) + local
        return int(starts[other]) + local - count

    return LoopClosure(
        a=row(link.a), b=row(link.b), T_a_b=link.T_a_b, information=link.information,
        inliers=link.inliers, matches=link.matches,
    )  # fmt: skip
