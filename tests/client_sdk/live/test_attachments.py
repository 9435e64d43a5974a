"""Attachments of keyframes: the choice of points, and their upload with its rate limits and failures."""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import replace

import numpy as np
import pytest

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, extract
from client_sdk.live import LiveMapper, LiveOptions
from client_sdk.live.attachments import encode_keyframe_points
from rse_pf.errors import ConnectError, Forbidden, UsageError
from rse_pf.slam.keyframe import decode_keyframe
from rse_pf.slam.keyframe_points import decode_points
from tests.client_sdk.live.test_live_mapper import QUICK, drive
from tests.kit.fake_live_map import FakeLiveRobot, solve
from tests.kit.flat_world import CAMERA, DEPTHS_M, frame_at

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

NO_FEATURES = extract(frame_at(0, depth=True), FrontEndOptions())


class Objects:
    """An object store in memory; ``error`` is raised instead of storing, if it is set."""

    def __init__(self) -> None:
        self.held: dict[str, bytes] = {}
        self.error: Exception | None = None
        self.tries = 0

    async def store(self, data: bytes) -> str:
        self.tries += 1
        await asyncio.sleep(0)
        if self.error is not None:
            raise self.error
        digest = hashlib.sha256(data).hexdigest()
        self.held[digest] = data
        return digest


def mapper_of(robot: FakeLiveRobot, objects: Objects, live: LiveOptions = QUICK, ask=solve) -> LiveMapper:
    return LiveMapper(robot, "lab", ask=ask, live=live, store=objects.store)


def test_points_lie_on_surfaces_and_not_between_them_and_have_their_colours() -> None:
    frame = frame_at(3, depth=True)
    frame.depth_m[40:60, 100:120] = np.nan

    data = encode_keyframe_points(frame, NO_FEATURES, 2_000)

    assert data is not None
    points, colours = decode_points(data, CAMERA)
    assert 1_000 < len(points) <= 2_000
    assert {round(float(z), 3) for z in points[:, 2]} == {round(depth, 3) for depth in DEPTHS_M}
    u, v = np.rint(points[:, :2] / points[:, 2:] * 500.0 + [159.5, 119.5]).astype(int).T
    assert not ((v >= 39) & (v <= 60) & (u >= 99) & (u <= 120)).any()
    assert not np.isin(v, (79, 80, 159, 160)).any(), "beside an edge"
    assert np.array_equal(colours, frame.rgb[v, u])


def test_near_points_are_thinned_to_one_for_each_centimetre() -> None:
    frame = frame_at(0, depth=True)
    near = Frame(timestamp_s=0.0, rgb=frame.rgb, depth_m=np.full_like(frame.depth_m, 0.4), camera=CAMERA)

    data = encode_keyframe_points(near, NO_FEATURES, 12_000)

    assert data is not None
    points, _ = decode_points(data, CAMERA)
    width_m, height_m = 0.4 * 320 / 500, 0.4 * 240 / 500
    assert len(points) <= (width_m / 0.01 + 2) * (height_m / 0.01 + 2)


async def test_each_keyframe_refers_to_points_that_the_robot_stores(robot: FakeLiveRobot) -> None:
    objects = Objects()
    async with mapper_of(robot, objects, replace(QUICK, points_bytes_per_s=1e9, leave_s=5.0)) as mapper:
        await drive(mapper, range(9))

    keyframes = [decode_keyframe(request.keyframe) for request in robot.kept]
    references = [each.points for each in keyframes if each.points is not None]
    assert len(references) == len(keyframes) == 3
    assert {each.digest: each.size for each in references} == {
        digest: len(data) for digest, data in objects.held.items()
    }
    assert mapper.report()["live"]["points"]["sent"] == 3


async def test_points_wait_while_a_pose_query_is_open(robot: FakeLiveRobot) -> None:
    objects, is_asked, may_answer = Objects(), asyncio.Event(), asyncio.Event()
    may_answer.set()

    async def ask(query: PoseQuery) -> PoseAnswer:
        is_asked.set()
        await may_answer.wait()
        return await solve(query)

    live = replace(QUICK, points_bytes_per_s=1e9, leave_s=5.0)
    async with mapper_of(robot, objects, live, ask) as mapper:
        await drive(mapper, range(2))
        await robot.until(lambda: len(objects.held) == 1)
        robot.before_answer = lambda service: None
        may_answer.clear()
        is_asked.clear()
        tracking = asyncio.ensure_future(mapper.track(frame_at(2, depth=True)))
        await is_asked.wait()
        mapper._attachments._point_uploader.add(b"more")  # type: ignore[union-attr]
        for _ in range(200):
            await asyncio.sleep(0)
        assert len(objects.held) == 1
        may_answer.set()
        await tracking
        await robot.until(lambda: len(objects.held) == 2)


async def test_keyframes_that_follow_fast_have_fewer_points_within_the_rate_limit(
    robot: FakeLiveRobot,
) -> None:
    objects = Objects()
    live = replace(QUICK, points_bytes_per_s=5_000.0)
    mapper = LiveMapper(
        robot, "lab", ask=solve, live=live, store=objects.store, clock=lambda: 0.0
    )  # no time passes
    async with mapper:
        await drive(mapper, range(13))
        await robot.until(lambda: mapper.keyframes_waiting == 0)
        sizes = [decode_keyframe(request.keyframe).points for request in robot.kept]
        assert len(sizes) == 4
        assert sum(each.size for each in sizes if each is not None) < 2 * 5_000 + 4 * 2_000


@pytest.mark.parametrize("error", [Forbidden("no scope data:write"), ConnectError("no data service")])
async def test_a_robot_that_cannot_store_points_still_maps_and_leaves(
    robot: FakeLiveRobot, error: Exception
) -> None:
    objects = Objects()
    objects.error = error
    live = replace(QUICK, points_bytes_per_s=1e9, leave_s=0.2)
    async with mapper_of(robot, objects, live) as mapper:
        done = await drive(mapper, range(9))
    assert all(each.T_world_camera is not None for each in done)
    assert len(robot.kept) == 3
    assert mapper.report()["live"]["points"]["sent"] == 0
    assert mapper.report()["live"]["points"]["trouble"]


async def test_a_keyframe_has_at_most_the_points_of_the_options(robot: FakeLiveRobot) -> None:
    objects = Objects()
    live = replace(QUICK, points=50, points_bytes_per_s=1e9, leave_s=5.0)
    async with mapper_of(robot, objects, live) as mapper:
        await drive(mapper, range(5))

    assert objects.held
    assert all(len(decode_points(data, CAMERA)[0]) <= 50 for data in objects.held.values())


async def test_no_points_are_made_where_none_are_wanted(robot: FakeLiveRobot) -> None:
    objects = Objects()
    async with mapper_of(robot, objects, replace(QUICK, points=0)) as mapper:
        await drive(mapper, range(5))
        await robot.until(lambda: mapper.keyframes_waiting == 0)
    assert not objects.tries
    assert all(decode_keyframe(request.keyframe).points is None for request in robot.kept)


def test_more_points_than_an_object_holds_are_refused() -> None:
    with pytest.raises(UsageError, match="points = 20000 is above 16000"):
        LiveOptions(points=20_000)


@pytest.mark.parametrize(("is_allowed", "is_wanted"), [(True, True), (True, False), (False, True)])
async def test_an_image_is_stored_where_operator_and_robot_want_it(
    robot: FakeLiveRobot, is_allowed: bool, is_wanted: bool
) -> None:
    cv2 = pytest.importorskip("cv2")

    objects = Objects()
    robot.has_images, robot.foreign_keyframes = is_allowed, 1
    live = replace(QUICK, images=is_wanted, images_bytes_per_s=1e9, points=0, leave_s=5.0)
    async with mapper_of(robot, objects, live) as mapper:
        await drive(mapper, range(5))

    images = [decode_keyframe(request.keyframe).image for request in robot.kept]
    assert len(images) == 2
    if not (is_allowed and is_wanted):
        assert images == [None, None]
        assert not objects.tries
        return
    first = cv2.imdecode(np.frombuffer(objects.held[images[0].digest], np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(first[:, :, ::-1].astype(int) - frame_at(0, depth=True).rgb).mean() < 8.0
    assert {each.digest for each in images} == set(objects.held)


async def test_keyframes_beyond_the_rate_limit_of_images_have_none(
    robot: FakeLiveRobot,
) -> None:
    objects = Objects()
    robot.has_images, robot.foreign_keyframes = True, 1
    live = replace(QUICK, images_bytes_per_s=1_000.0, points=0)
    mapper = LiveMapper(robot, "lab", ask=solve, live=live, store=objects.store, clock=lambda: 0.0)
    async with mapper:
        await drive(mapper, range(9))
        await robot.until(lambda: mapper.keyframes_waiting == 0)
        images = [decode_keyframe(request.keyframe).image for request in robot.kept]
        assert [each is not None for each in images] == [True, False, False]


async def test_a_store_function_that_raises_is_reported_and_called_again(
    robot: FakeLiveRobot, caplog: pytest.LogCaptureFixture
) -> None:
    objects = Objects()
    objects.error = KeyError("a bug of the program")
    async with mapper_of(robot, objects, replace(QUICK, points_bytes_per_s=1e9, leave_s=5.0)) as mapper:
        await drive(mapper, range(1))
        await robot.until(lambda: objects.tries == 1)
        objects.error = None
        await robot.until(lambda: len(objects.held) == 1)

    assert len([record for record in caplog.records if record.exc_info]) == 1
