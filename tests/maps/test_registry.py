"""The map registry: versions never change, one of two commits succeeds, a crash leaves a complete head."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rse_pf.errors import Conflict, NotFound, StoreError
from rse_pf.geometry import exp_se3
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry, compare_versions
from rse_pf.storage.object_store import DirectoryStore, MemoryStore
from tests.kit.sample_maps import make_map


def commit(maps: MapRegistry, seed: int, parent: str | None) -> str:
    data = encode_map(make_map(seed))
    return maps.commit("kitchen", data, parent=parent, author="robot-1", created_s=1e9 + seed, note="n").id


@pytest.fixture
def maps() -> MapRegistry:
    return MapRegistry(MemoryStore())


def test_each_version_has_a_parent_and_old_versions_stay(maps: MapRegistry) -> None:
    first = commit(maps, 1, None)
    second = commit(maps, 2, first)

    assert maps.names() == ["kitchen"]
    assert maps.head("kitchen").id == second
    assert [record.number for record in maps.versions("kitchen")] == [1, 2]
    assert [record.parent for record in maps.versions("kitchen")] == [None, first]
    assert maps.data("kitchen", first) == encode_map(make_map(1))
    assert maps.record("kitchen", first[:8]).id == first
    assert maps.head("kitchen").robots == ("robot-1", "robot-2")


def test_of_two_commits_on_one_head_the_second_is_a_conflict(maps: MapRegistry) -> None:
    first = commit(maps, 1, None)
    second = commit(maps, 2, first)

    for parent in (None, first):
        with pytest.raises(Conflict):
            commit(maps, 3, parent)
    assert maps.head("kitchen").id == second


def test_a_rollback_moves_the_head_and_deletes_nothing(maps: MapRegistry) -> None:
    first = commit(maps, 1, None)
    second = commit(maps, 2, first)

    maps.move_head("kitchen", first, expected=second)

    assert maps.head("kitchen").id == first
    assert len(maps.versions("kitchen")) == 2
    with pytest.raises(Conflict):
        maps.move_head("kitchen", first, expected=second)
    with pytest.raises(NotFound):
        maps.move_head("kitchen", "0" * 64, expected=first)


def test_tenants_do_not_see_each_other(maps: MapRegistry) -> None:
    store = MemoryStore()
    commit(MapRegistry(store, "one"), 1, None)

    assert MapRegistry(store, "two").names() == []
    with pytest.raises(NotFound):
        MapRegistry(store, "two").head("kitchen")


def test_changed_bytes_in_the_store_are_detected() -> None:
    store = MemoryStore()
    maps = MapRegistry(store)
    commit(maps, 1, None)
    for info in list(store.list()):
        if "/blobs/" in info.name:
            store.put(info.name, store.get(info.name)[:-1] + b"?")

    with pytest.raises(StoreError, match="damaged"):
        maps.load("kitchen")


def test_a_difference_names_what_was_added_removed_and_moved() -> None:
    before = make_map(1)
    moved = before.keyframes[1]
    step = exp_se3(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    after = MapVersion(
        keyframes=(
            before.keyframes[0],
            Keyframe(
                id=moved.id,
                robot=moved.robot,
                timestamp_s=moved.timestamp_s,
                camera=moved.camera,
                T_world_camera=moved.T_world_camera @ step,
                pixels=moved.pixels,
                descriptors=moved.descriptors,
                points_camera=moved.points_camera,
            ),
        ),
        edges=before.edges[:1],
    )

    found = compare_versions(before, after)

    assert (found.added, found.removed, found.moved) == ((), (20, 30), (10,))
    assert found.largest_move_m == pytest.approx(0.3)
    assert found.edges_removed == ((10, 20, "odometry"), (20, 30, "odometry"))
    assert (found.points_before, found.points_after) == (20, 0)
    assert compare_versions(after, before).added == (20, 30)


_KILLED = """
import os, pathlib, signal, sys
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
step, folder, data, parent = int(sys.argv[1]), sys.argv[2], open(sys.argv[3], "rb").read(), sys.argv[4]
count = 0
for name in ("fsync", "replace"):
    def wrapped(*args, real=getattr(os, name)):
        global count
        count += 1
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*args)
    setattr(os, name, wrapped)
MapRegistry(DirectoryStore(pathlib.Path(folder))).commit(
    "kitchen", data, parent=parent, author="r", created_s=2e9)
print(count)
"""


def killed_at_each_step(folder: Path) -> Iterator[tuple[int, int, MapRegistry]]:
    """Yield step, exit code and registry of a commit that is killed before its n-th fsync or rename."""
    file = folder / "second.map"
    file.write_bytes(encode_map(make_map(2)))
    for step in range(1, 50):
        store = folder / f"store-{step}"
        maps = MapRegistry(DirectoryStore(store))
        first = commit(maps, 1, None)
        command = [sys.executable, "-c", _KILLED, str(step), str(store), str(file), first]
        done = subprocess.run(command, capture_output=True, timeout=60, env={**os.environ}, check=False)
        yield step, done.returncode, maps
        if done.returncode == 0:
            return


@pytest.mark.system
@pytest.mark.slow
def test_a_kill_at_any_step_leaves_the_old_or_the_new_head_complete(tmp_path: Path) -> None:
    seen = []
    for step, code, maps in killed_at_each_step(tmp_path):
        assert code in (0, -signal.SIGKILL)
        head = maps.head("kitchen")
        assert maps.data("kitchen") == encode_map(make_map(head.number))
        for record in maps.versions("kitchen"):
            assert maps.data("kitchen", record.id)
        seen.append((step, head.number))
        if head.number == 1:  # and it can be done again
            commit(maps, 2, head.id)
            assert maps.head("kitchen").number == 2

    assert len(seen) > 8
    assert seen[0][1] == 1
    assert seen[-1][1] == 2
    numbers = [number for _, number in seen]
    assert numbers == sorted(numbers)


def test_images_of_keyframes_are_those_of_robots_of_the_tenant_and_nothing_else() -> None:
    store = MemoryStore()
    jpeg, text = b"\xff\xd8\xffimage", b"no image"
    digests = {data: hashlib.sha256(data).hexdigest() for data in (jpeg, text)}
    for folder in ("default/robot-1", "default/robot-1=abc", "rival/robot-1"):
        for data, digest in digests.items():
            store.put(f"objects/{folder}/{digest}", data)
    forged = hashlib.sha256(b"other").hexdigest()
    store.put(f"objects/default/robot-1/{forged}", jpeg)
    good, of_text = digests[jpeg], digests[text]
    named = {
        "default/robot-1": {"0": good, "10": of_text, "20": forged, "30": "f" * 64, "99": good, "x": 5},
        "default/robot-1=abc": {"10": good},
        "rival/robot-1": {"20": good},
        "default/../rival/robot-1": {"20": good},
        "default": {"20": good},
        "default/": {"20": good},
        "default/robot-2": good,
        "/robot-1": {"20": good},
    }

    def images(of: object) -> list[int]:
        version = dataclasses.replace(make_map(), provenance={"images": of})
        found = list(MapRegistry(store).images(version))
        assert {data for _, data in found} <= {jpeg}
        return [keyframe.id for keyframe, _ in found]

    assert images(named) == [0, 10]
    for strange in (None, [], "x", 5, {"default/robot-1": None}, {"default/robot-1": {"0": [good]}}):
        assert images(strange) == []
    assert list(MapRegistry(store).images(make_map())) == []
