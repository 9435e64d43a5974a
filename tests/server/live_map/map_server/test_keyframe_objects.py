"""The cloud of a live map: points move with their keyframes, are their robot's own, and go with it."""

from __future__ import annotations

import dataclasses
import hashlib
import zlib

import msgspec
import numpy as np
import pytest

from rse_pf.errors import NotFound
from rse_pf.geometry import Camera, exp_se3, transform
from rse_pf.identity import RobotId, object_name
from rse_pf.live_map.versions import PointSource
from rse_pf.maps.format import UP_FIELD, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.server.live_map.map_server.environment import LIVE_MAP
from rse_pf.server.live_map.map_server.keyframe_objects import KeyframeObjects
from rse_pf.slam.cloud_deform import merge_clouds
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe, make_features
from rse_pf.slam.keyframe_points import ObjectReference, encode_points
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire.live_map import KeyframeRequest
from tests.kit.map_server_setup import MAP, MapServerSetup, settle

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
ONE, OTHER = RobotId("default", "one"), RobotId("default", "other")
NOWHERE = np.eye(4)


class Account:
    """Counts the bytes of deleted objects."""

    def __init__(self) -> None:
        self.released = 0

    def release(self, size: int) -> None:
        self.released += size


def some_points(depth_m: float) -> bytes:
    v, u = np.mgrid[10:480:40, 10:640:40]
    pixels = np.column_stack((u.ravel(), v.ravel()))
    colours = np.full((len(pixels), 3), 77, np.uint8)
    return encode_points(pixels, np.full(len(pixels), depth_m), colours, CAMERA)


def stored(store: MemoryStore, robot: RobotId, data: bytes) -> ObjectReference:
    """Store *data* as the data service does."""
    digest = hashlib.sha256(data).hexdigest()
    store.put(object_name(robot, digest), data)
    return ObjectReference(digest, len(data))


def source(robot: RobotId, reference: ObjectReference, T_world_camera: np.ndarray = NOWHERE) -> PointSource:
    return PointSource(robot=robot.folder, reference=reference, camera=CAMERA, T_world_camera=T_world_camera)


def objects(store: MemoryStore) -> KeyframeObjects:
    return KeyframeObjects(store, Account())  # type: ignore[arg-type]


def keyframe_request(
    number: int, reference: ObjectReference | None, image: ObjectReference | None = None
) -> bytes:
    noise = np.random.default_rng(number)
    seen = noise.uniform(10, 400, (50, 2)), np.full(50, 2.0), noise.integers(0, 255, (50, 32), dtype=np.uint8)
    keyframe = SentKeyframe(
        timestamp_s=float(number),
        T_odom_camera=exp_se3([0.2 * number, 0, 0, 0, 0, 0]),
        camera=CAMERA,
        features=make_features(*seen),
        points=reference,
        image=image,
    )
    return msgspec.msgpack.encode(
        KeyframeRequest(map=MAP, segment=0, number=number, keyframe=encode_keyframe(keyframe))
    )


def test_points_lie_where_their_keyframe_is_now() -> None:
    store = MemoryStore()
    reference = stored(store, ONE, some_points(2.0))
    moved = exp_se3([1.0, -2.0, 0.5, 0.1, 0.2, 0.3])

    before, after = (objects(store).build_cloud([source(ONE, reference, T)]).points for T in (NOWHERE, moved))

    assert len(before) == len(after) == 12 * 16
    wanted = transform(moved, before.astype(np.float64))
    apart_m = np.linalg.norm(wanted[:, None] - after[None], axis=2).min(axis=1)
    assert apart_m.max() < 1e-3


def test_a_reference_to_an_object_of_another_robot_gives_nothing() -> None:
    store = MemoryStore()
    reference = stored(store, OTHER, some_points(2.0))

    cloud = objects(store).build_cloud([source(ONE, reference)])

    assert (len(cloud.points), cloud.keyframes, cloud.missing) == (0, 0, 1)


def test_objects_that_are_no_points_are_left_out_and_the_rest_is_there() -> None:
    store = MemoryStore()
    good = stored(store, ONE, some_points(2.0))
    bomb = stored(store, ONE, b"KP\x01\x00\x01\x00\x00\x00" + zlib.compress(bytes(10**7)))
    large = stored(store, ONE, bytes(200_000))
    text = stored(store, ONE, b"hello")
    lying = ObjectReference(good.digest, good.size + 1)
    changed = stored(store, ONE, some_points(3.0))
    store.put(object_name(ONE, changed.digest), some_points(1.0))
    wrong = [bomb, large, text, lying, ObjectReference(changed.digest, len(some_points(1.0)))]

    cloud = objects(store).build_cloud([source(ONE, reference) for reference in [*wrong, good]])

    assert (cloud.keyframes, cloud.missing) == (1, 5)
    assert np.allclose(cloud.points[:, 2], 2.0)


def test_a_camera_that_makes_metres_of_kilometres_adds_no_point_far_away() -> None:
    store = MemoryStore()
    reference = stored(store, ONE, some_points(60.0))
    wide = Camera(fx=32.0, fy=32.0, cx=319.5, cy=239.5, width=640, height=480)
    hostile = PointSource(robot=ONE.folder, reference=reference, camera=wide, T_world_camera=NOWHERE)

    points = objects(store).build_cloud([hostile]).points

    assert 0 < len(points) < 12 * 16
    assert np.abs(points).max() <= 100.0


def test_many_keyframes_of_many_points_take_no_more_memory_than_a_few(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """4,000 of the largest objects would be 640 MB of bytes and 1 GB of points."""
    module = "rse_pf.server.live_map.map_server.keyframe_objects"
    store = MemoryStore()
    references = [stored(store, ONE, some_points(1.0 + 0.1 * number)) for number in range(10)]
    monkeypatch.setattr(f"{module}._MAX_POINTS", 5 * 12 * 16)
    monkeypatch.setattr(f"{module}._MAX_CACHED_BYTES", 3 * max(reference.size for reference in references))
    keeper, joined = objects(store), []

    def join(clouds: list[np.ndarray], colours: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        joined.append(sum(map(len, clouds)))
        return merge_clouds(clouds, colours)

    monkeypatch.setattr(f"{module}.merge_clouds", join)
    clouds = [keeper.build_cloud([source(ONE, reference) for reference in references]) for _ in range(2)]

    assert [cloud.keyframes for cloud in clouds] == [10, 10]
    assert joined == [5 * 12 * 16] * 2
    assert sum(map(len, keeper._cache.values())) <= 3 * max(reference.size for reference in references)
    assert len(keeper._cache) == 3


def test_a_culled_keyframe_loses_its_objects_a_little_later() -> None:
    store, account = MemoryStore(), Account()
    held = [stored(store, ONE, bytes([number])) for number in range(70)]
    keeper = KeyframeObjects(store, account)  # type: ignore[arg-type]

    keeper.delete_of_culled([(ONE.folder, reference.digest) for reference in held])

    assert account.released == 6
    assert len(list(store.list(f"objects/{ONE.folder}/"))) == 64


async def test_a_forgotten_robots_points_are_in_no_later_version_and_not_in_the_store() -> None:
    store = MemoryStore()
    bench = MapServerSetup(store, implementation=LIVE_MAP, publish_pause_s=0.0)
    mine, late = stored(store, ONE, some_points(2.0)), some_points(2.5)
    theirs = stored(store, OTHER, some_points(3.0))
    arriving = ObjectReference(hashlib.sha256(late).hexdigest(), len(late))

    server, maps = await bench.start("a"), MapRegistry(store, "default")
    await server.map_server.answer(ONE, "live-keyframe", keyframe_request(0, mine))
    await server.map_server.answer(ONE, "live-keyframe", keyframe_request(1, arriving))
    await server.map_server.answer(OTHER, "live-keyframe", keyframe_request(0, theirs))
    await settle()
    await server.ask("live-publish")
    first = maps.load(MAP, "head")
    assert np.allclose(first.points[:, 2], 2.0)
    assert (first.colours == 77).all()

    await server.ask("live-forget", {"robot": "one"})

    with pytest.raises(NotFound):
        store.head(object_name(ONE, mine.digest))
    stored(store, ONE, late)  # it was on its way
    await server.ask("live-publish")
    assert np.allclose(maps.load(MAP, "head").points[:, 2], 3.0)
    assert not list(store.list(f"objects/{ONE.folder}/"))
    assert store.get(object_name(OTHER, theirs.digest))


@pytest.mark.parametrize("is_allowed", [True, False])
async def test_a_version_names_images_where_the_operator_allows_them_and_forget_deletes_them(
    is_allowed: bool,
) -> None:
    store = MemoryStore()
    bench = MapServerSetup(store, implementation=LIVE_MAP, publish_pause_s=0.0, images=is_allowed)
    mine, theirs = stored(store, ONE, b"my image"), stored(store, OTHER, b"their image")

    server, maps = await bench.start("a"), MapRegistry(store, "default")
    await server.map_server.answer(ONE, "live-keyframe", keyframe_request(0, None, mine))
    await server.map_server.answer(OTHER, "live-keyframe", keyframe_request(0, None, theirs))
    await settle()
    await server.ask("live-publish")
    assert (await server.ask("live-show"))["images"] is is_allowed
    named = {"images": {ONE.folder: {"0": mine.digest}}} if is_allowed else {}
    assert maps.load(MAP, "head").provenance == {"made_by": "live", "from": "", **named}

    await server.ask("live-forget", {"robot": "one"})

    assert not list(store.list(f"objects/{ONE.folder}/"))
    await server.ask("live-publish")
    assert ONE.folder not in maps.load(MAP, "head").provenance.get("images", {})


@pytest.mark.parametrize("up", [[0.0, 0.6, 0.8], None, "up"])
async def test_a_map_keeps_up_of_the_version_that_it_started_from(up: object) -> None:
    store = MemoryStore()
    maps, source = (
        MapRegistry(store, "default"),
        MapServerSetup(MemoryStore(), implementation=LIVE_MAP, publish_pause_s=0.0),
    )

    async def drive(bench: MapServerSetup, start: bool) -> None:
        server = await bench.start("a")
        if start:
            await server.ask("live-start", {"from": "origin"})
        await server.map_server.answer(ONE, "live-keyframe", keyframe_request(0, None))
        await settle()
        await server.ask("live-publish")

    await drive(source, False)
    first = MapRegistry(source.store, "default").load(MAP, "head")
    assert first.up is None
    origin = encode_map(dataclasses.replace(first, provenance={UP_FIELD: up}))
    maps.commit("origin", origin, parent=None, author="t", created_s=0.0)
    bench = MapServerSetup(store, implementation=LIVE_MAP, publish_pause_s=0.0)

    await drive(bench, True)

    up_of_version = maps.load(MAP, "head").up
    assert up_of_version is None if not isinstance(up, list) else np.allclose(up_of_version, up)


async def test_the_next_map_server_deletes_objects_that_the_last_one_could_not() -> None:
    store = MemoryStore()
    bench = MapServerSetup(store, implementation=LIVE_MAP, lease_s=1.5)
    mine = stored(store, ONE, some_points(2.0))

    server = await bench.start("a")
    await server.map_server.answer(ONE, "live-keyframe", keyframe_request(0, mine))
    await server.ask("live-forget", {"robot": "one"})
    stored(store, ONE, some_points(2.0))  # as if the server had ended before it deleted anything
    await server.map_server.release()
    await bench.start("b")
    await settle()

    assert not list(store.list(f"objects/{ONE.folder}/"))


def test_a_snapshot_knows_whose_objects_are_to_be_deleted() -> None:
    from rse_pf.live_map.events import KeyframeAdded, RobotForgotten
    from rse_pf.live_map.live_map import LiveMap

    live_map = LiveMap()
    for robot in (ONE, OTHER):
        reference = ObjectReference(hashlib.sha256(robot.name.encode()).hexdigest(), 10)
        request = msgspec.msgpack.decode(keyframe_request(0, reference), type=KeyframeRequest)
        live_map.apply(KeyframeAdded(robot=robot.folder, segment=0, number=0, data=request.keyframe))
    live_map.apply(RobotForgotten(robot=ONE.folder))
    parts = live_map.snapshot_parts()

    restored = LiveMap.restore_parts(parts.head, lambda name: parts.parts[name] or b"")

    assert [robot for robot, _ in restored.deletable_objects] == [ONE.folder]
    assert restored.objects_of([1]) == live_map.objects_of([1]) != []
    assert restored.digest() == live_map.digest()


def test_each_robot_has_its_share_of_a_map_with_many_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.server.live_map.map_server.keyframe_objects._MAX_SOURCES", 10)
    store = MemoryStore()
    mine, theirs = stored(store, ONE, some_points(1.0)), stored(store, OTHER, some_points(3.0))
    many = [source(OTHER, theirs) for _ in range(100)]

    cloud = objects(store).build_cloud([*many, source(ONE, mine), source(ONE, mine)])

    assert cloud.keyframes == 10
    assert {round(float(z)) for z in cloud.points[:, 2]} == {1, 3}

    both_many = objects(store).build_cloud([*many, *[source(ONE, mine) for _ in range(100)]])

    assert both_many.keyframes == 10
    assert {round(float(z)) for z in both_many.points[:, 2]} == {1, 3}
