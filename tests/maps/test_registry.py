"""The map registry: immutable versions, one winner, and a whole head after any crash."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rse_pf.errors import BadRequest, Conflict, NotFound, StoreError, UsageError
from rse_pf.geometry import Camera, exp_se3, inverse, transform
from rse_pf.maps.export import export_map
from rse_pf.maps.format import Edge, Keyframe, MapVersion, decode_map, encode_map
from rse_pf.maps.registry import MapRegistry, difference
from rse_pf.object_store import DirectoryStore, MemoryStore
from rse_pf.services.mapping.pose_graph import read_g2o

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)


def make_map(seed: int = 1, keyframes: int = 4, points: int = 20) -> MapVersion:
    rng = np.random.default_rng(seed)
    poses = [exp_se3(rng.normal(0.0, 0.5, 6)) for _ in range(keyframes)]
    depth = rng.normal(2.0, 0.3, (7, 3)).astype(np.float32)
    depth[2] = np.nan
    return MapVersion(
        keyframes=tuple(
            Keyframe(
                id=n * 10, robot=f"robot-{n % 2 + 1}", timestamp_s=100.0 + n, T_world_camera=pose,
                camera=CAMERA, pixels=rng.uniform(0, 600, (7, 2)).astype(np.float32),
                descriptors=rng.integers(0, 256, (7, 32), dtype=np.uint8), points_camera=depth,
            )
            for n, pose in enumerate(poses)
        ),
        edges=tuple(
            Edge(
                a=n * 10, b=n * 10 + 10, T_a_b=inverse(poses[n]) @ poses[n + 1],
                information=np.diag([100.0, 100.0, 100.0, 400.0, 400.0, 400.0]),
                kind="odometry" if n else "loop",
            )
            for n in range(keyframes - 1)
        ),
        points=rng.normal(0, 1, (points, 3)).astype(np.float32),
        colours=rng.integers(0, 256, (points, 3), dtype=np.uint8),
        provenance={"made": "by a test", "seed": seed},
    )  # fmt: skip


def commit(maps: MapRegistry, seed: int, parent: str | None) -> str:
    data = encode_map(make_map(seed))
    return maps.commit("kitchen", data, parent=parent, author="robot-1", created_s=1e9 + seed, note="n").id


@pytest.fixture
def maps() -> MapRegistry:
    return MapRegistry(MemoryStore())


def test_a_map_comes_back_as_it_was() -> None:
    before = make_map()

    after = decode_map(encode_map(before))

    assert encode_map(after) == encode_map(before)
    for old, new in zip(before.keyframes, after.keyframes, strict=True):
        assert (old.id, old.robot, old.timestamp_s, old.camera) == (
            new.id,
            new.robot,
            new.timestamp_s,
            new.camera,
        )
        np.testing.assert_array_equal(old.T_world_camera, new.T_world_camera)
        np.testing.assert_array_equal(old.points_camera, new.points_camera)
        np.testing.assert_array_equal(old.descriptors, new.descriptors)
    np.testing.assert_array_equal(before.points, after.points)
    assert after.provenance == before.provenance


@pytest.mark.parametrize("cut", [0, 5, 8, 50, -1])
def test_a_map_that_is_cut_short_is_refused(cut: int) -> None:
    with pytest.raises(BadRequest):
        decode_map(encode_map(make_map())[:cut])


def test_a_map_that_inflates_past_the_limit_is_refused() -> None:
    data = encode_map(make_map(points=100_000))

    with pytest.raises(BadRequest, match="more than 65536"):
        decode_map(data, 65_536)


def test_versions_follow_each_other_and_old_ones_stay(maps: MapRegistry) -> None:
    first = commit(maps, 1, None)
    second = commit(maps, 2, first)

    assert maps.names() == ["kitchen"]
    assert maps.head("kitchen").id == second
    assert [record.number for record in maps.versions("kitchen")] == [1, 2]
    assert [record.id for record in maps.lineage("kitchen")] == [second, first]
    assert maps.data("kitchen", first) == encode_map(make_map(1))
    assert maps.record("kitchen", first[:8]).id == first
    assert maps.head("kitchen").robots == ("robot-1", "robot-2")


def test_of_two_that_follow_one_head_the_second_is_told(maps: MapRegistry) -> None:
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


@pytest.mark.parametrize("name", ["", "..", "a/b", "A", "ä", "a" * 65, "-a"])
def test_a_name_is_plain(maps: MapRegistry, name: str) -> None:
    with pytest.raises(BadRequest):
        maps.commit(name, encode_map(make_map()), parent=None, author="r", created_s=0.0)


def test_bytes_that_changed_in_the_store_are_noticed() -> None:
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
                id=moved.id, robot=moved.robot, timestamp_s=moved.timestamp_s, camera=moved.camera,
                T_world_camera=moved.T_world_camera @ step, pixels=moved.pixels,
                descriptors=moved.descriptors, points_camera=moved.points_camera,
            ),
        ),
        edges=before.edges[:1],
    )  # fmt: skip

    found = difference(before, after)

    assert (found.added, found.removed, found.moved) == ((), (20, 30), (10,))
    assert found.largest_move_m == pytest.approx(0.3)
    assert found.edges_removed == ((10, 20, "odometry"), (20, 30, "odometry"))
    assert (found.points_before, found.points_after) == (20, 0)
    assert difference(after, before).added == (20, 30)


def test_the_g2o_file_says_what_the_map_says() -> None:
    version = make_map()

    graph = read_g2o(export_map(version, "g2o").decode().replace("FIX 0\n", ""))

    assert graph.ids.tolist() == [0, 10, 20, 30]
    np.testing.assert_allclose(graph.T_a_b[1], version.edges[1].T_a_b, atol=1e-7)
    np.testing.assert_allclose(graph.information[1], version.edges[1].information, atol=1e-6)
    np.testing.assert_allclose(graph.T_world_pose[2], version.keyframes[2].T_world_camera, atol=1e-7)


def test_the_clouds_hold_every_point_with_its_colour() -> None:
    version = make_map()

    head, _, body = export_map(version, "ply").partition(b"end_header\n")
    rows = np.frombuffer(body, dtype=[("xyz", "<f4", (3,)), ("rgb", "u1", (3,))])
    assert b"element vertex 20" in head
    np.testing.assert_array_equal(rows["xyz"], version.points)
    np.testing.assert_array_equal(rows["rgb"], version.colours)

    head, _, body = export_map(version, "pcd").partition(b"DATA binary\n")
    packed = np.frombuffer(body, dtype=[("xyz", "<f4", (3,)), ("rgb", "<u4")])
    assert b"POINTS 20" in head
    np.testing.assert_array_equal(packed["xyz"], version.points)
    np.testing.assert_array_equal(packed["rgb"] >> 16, version.colours[:, 0])
    np.testing.assert_array_equal(packed["rgb"] & 255, version.colours[:, 2])


def test_the_trajectory_is_in_order_of_time_and_of_one_robot() -> None:
    version = make_map()
    rows = np.loadtxt(export_map(version, "tum", "robot-2").decode().splitlines())

    np.testing.assert_allclose(rows[:, 0], [101.0, 103.0])
    np.testing.assert_allclose(
        rows[0, 1:4], transform(version.keyframes[1].T_world_camera, np.zeros((1, 3)))[0]
    )
    with pytest.raises(UsageError):
        export_map(version, "tum", "robot-7")
    with pytest.raises(UsageError):
        export_map(version, "obj")


_KILLED = """
import os, signal, sys
from rse_pf import objects
from rse_pf.maps.registry import MapRegistry
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
MapRegistry(objects.DirectoryStore(__import__("pathlib").Path(folder))).commit(
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
def test_a_kill_at_any_step_leaves_the_old_head_or_the_new_one_whole(tmp_path: Path) -> None:
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
