"""A merge in parts gives what a merge in one process gives, and continues after an interruption."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import Disconnected, LimitExceeded
from rse_pf.extensions.batch.merge import BatchMerge, BatchMergeResult, strongest
from rse_pf.extensions.batch.part_kinds import strongest_rows
from rse_pf.extensions.batch.parts import PREFIX, Part
from rse_pf.geometry import Array
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.slam.map_merge import Atlas, MergedMap, MergeOptions, merge_versions, propose_loop_closures
from rse_pf.storage.object_store import MemoryStore
from tests.kit.in_process_engine import InProcessEngine
from tests.kit.synthetic_maps import make_world

pytest.importorskip("gtsam", reason="the extra maps is not installed")

SETTINGS = PlatformSettings().replace(batch={"pairs_per_part": 40})
NAMES = ("maps/a", "maps/b")


@functools.cache
def two_robots() -> tuple[MapVersion, MapVersion]:
    world = make_world(1)
    a, _ = world.walk("a", np.linspace(0.0, 0.5, 13), seed=1)
    b, _ = world.walk("b", np.linspace(0.3, 0.8, 13), seed=2)
    return a, b


@functools.cache
def in_one_process() -> MergedMap:
    return merge_versions(two_robots())


def a_store() -> MemoryStore:
    store = MemoryStore()
    for name, version in zip(NAMES, two_robots(), strict=True):
        store.put(name, encode_map(version))
    return store


class Interrupted:
    """An engine that is gone after some parts."""

    def __init__(self, store: MemoryStore, parts: int) -> None:
        self._engine = InProcessEngine(store)
        self._left = parts

    def run(self, parts: Sequence[Part], on_done: Callable[[int], None]) -> None:
        for number, part in enumerate(parts, start=1):
            if self._left == 0:
                raise Disconnected("the scheduler ended", hint="run it again")
            self._left -= 1
            self._engine.run([part], lambda _: None)
            on_done(number)


@functools.cache
def in_parts() -> BatchMergeResult:
    store = a_store()
    return BatchMerge(store, InProcessEngine(store), SETTINGS).run(NAMES)


def poses(merged: MergedMap) -> Array:
    return np.array([each.T_world_camera for each in merged.version.keyframes])


def test_the_links_are_those_of_one_process_to_the_bit() -> None:
    expected = propose_loop_closures(Atlas.of(two_robots()), MergeOptions()).loop_closures

    found = in_parts().links

    assert [(link.a, link.b, link.inliers) for link in found] == [
        (link.a, link.b, link.inliers) for link in expected
    ]
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.T_a_b, other.T_a_b)
        assert np.array_equal(one.information, other.information)


def test_the_map_is_that_of_one_process() -> None:
    one, parts = in_one_process(), in_parts().merged

    assert parts.joined == one.joined == (0, 1)
    assert parts.refused == one.refused
    assert (parts.loops, parts.merges) == (one.loops, one.merges)
    assert np.abs(poses(parts) - poses(one)).max() < 1e-4


def test_an_interrupted_merge_continues_with_the_parts_that_are_missing() -> None:
    store = a_store()
    with pytest.raises(Disconnected):
        BatchMerge(store, Interrupted(store, 7), SETTINGS).run(NAMES)

    again = BatchMerge(store, InProcessEngine(store), SETTINGS).run(NAMES)

    whole = in_parts()
    assert again.found == 7
    assert again.computed == whole.computed - 7
    assert encode_map(again.merged.version) == encode_map(whole.merged.version)


def test_a_finished_merge_leaves_nothing_in_the_store() -> None:
    store = a_store()
    merge = BatchMerge(store, InProcessEngine(store), SETTINGS)
    merge.run(NAMES)

    merge.forget()

    assert not list(store.list(f"{PREFIX}/"))


def test_progress_never_goes_back() -> None:
    store, shares = a_store(), []
    BatchMerge(store, InProcessEngine(store), SETTINGS).run(NAMES, lambda done, what: shares.append(done))

    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_too_many_keyframes_are_refused_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    store = a_store()
    monkeypatch.setattr("rse_pf.extensions.batch.merge.MAX_KEYFRAMES", 20)

    with pytest.raises(LimitExceeded, match="20 keyframes"):
        BatchMerge(store, InProcessEngine(store), SETTINGS).run(NAMES)


def test_of_too_many_links_each_pair_of_maps_keeps_its_strongest() -> None:
    atlas = Atlas.of(two_robots())
    links = in_parts().links
    within = [replace(each, a=0, b=1, inliers=row) for row, each in enumerate(links)]

    kept, refused = strongest(atlas, [*within, *links], 10)

    assert sum(refused.values()) == 2 * len(links) - 10
    own = sorted(each.inliers for each in kept if each.b == 1)
    assert own == sorted(each.inliers for each in within)[-5:]
    assert strongest(atlas, links, len(links)) == (list(links), {})


def test_the_strongest_links_are_spread_over_the_keyframes() -> None:
    one = in_parts().links[0]
    inliers = {0: (90, 80, 70), 1: (50,), 2: (60, 40)}
    links = [replace(one, a=a, inliers=count) for a, counts in inliers.items() for count in counts]

    assert [(links[row].a, links[row].inliers) for row in strongest_rows(links, 4)] == [
        (0, 90), (0, 80), (1, 50), (2, 60),
    ]  # fmt: skip


def test_links_that_are_not_compared_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    store = a_store()
    monkeypatch.setattr("rse_pf.extensions.batch.merge.MAX_LINKS_PER_PAIR", 10)

    found = BatchMerge(store, InProcessEngine(store), SETTINGS).run(NAMES)

    assert len(found.links) == len(in_parts().links)
    assert found.merged.refused[0, 1, "surplus"] == len(found.links) - 10
    assert found.merged.merges <= 10
