"""The frames of a robot with a base: transforms, odometry of the wheels, and the status of the pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from client_sdk.bags.message_types import (
    DIAGNOSTICS,
    OCCUPANCY_GRID,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    STRING,
    TF,
)
from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live import LiveMapper
from ros_bridge import Bridge
from ros_bridge.base_poses import project_to_plane
from ros_bridge.outgoing import Message
from rse_pf.errors import NotFound
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference
from rse_pf.slam.localise import PosePrior
from rse_pf.slam.occupancy import FREE, OCCUPIED, UNKNOWN, GridOptions, OccupancyGrid
from tests.kit.bridge_runs import (
    MAKER,
    START_NS,
    STEP_NS,
    Heard,
    count_of,
    pose_of,
    running,
    send,
    send_odometry,
    send_transforms,
    stamp_of,
)
from tests.kit.flat_world import STEP_M, covered, foreign, frame_at

ROWS = 6
LEVEL = GridOptions(up=(0.0, 0.0, 1.0))
CAMERA_AXES = np.eye(4)  # pose of an optical frame (z ahead, y down) in a frame with x ahead and z up
CAMERA_AXES[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
TILTED = exp_se3(np.array([0.25, 0.05, 0.6, 0.0, math.radians(30), 0.0]))
MOUNT: Array = TILTED @ CAMERA_AXES
ODOM_START = exp_se3(np.array([3.0, -2.0, 0.0, 0.0, 0.0, 2.2]))
MAP_START = exp_se3(np.array([0.4, 0.1, 0.05, 0.03, -0.02, 0.3]))


def true_pose(stamp_ns: int) -> Array:
    """Return ``T_map_base`` of a robot that drives a curve over a ramp."""
    seconds = (stamp_ns - START_NS) / 1e9
    pose: Array = MAP_START @ exp_se3(seconds * np.array([0.5, 0.02, 0.05, 0.1, -0.15, 0.6]))
    return pose


def wheels(stamp_ns: int) -> Array:
    """Return ``T_odom_base`` by wheels that slip."""
    seconds = (stamp_ns - START_NS) / 1e9
    pose: Array = ODOM_START @ exp_se3(seconds * np.array([0.45, 0.0, 0.0, 0.0, 0.0, 0.55]))
    return pose


class ExactMapper:
    """A mapper that knows the true pose of the base, and the mount that the bridge gave it."""

    scale, odometry_trouble = "metric, by depth", ""

    def __init__(self, T_base_camera: Array | None) -> None:
        self.T_base_camera = T_base_camera
        self.odometry: list[Any] = []
        none = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        self.map = SimpleNamespace(points=lambda min_readings: none)

    async def track(self, frame: Frame, *, odometry: Any = ()) -> TrackedFrame:
        self.odometry += odometry
        T_world_camera = true_pose(round(1e9 * frame.timestamp_s)) @ MOUNT
        mount = self.T_base_camera
        return TrackedFrame(
            frame=frame, T_world_camera=T_world_camera, keyframe=False, inliers=9, matches=9,
            T_world_base=None if mount is None else T_world_camera @ inverse(mount),
            pose_covariance=None if mount is None else np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        )  # fmt: skip

    def floor_plan(self, options: GridOptions) -> OccupancyGrid:
        assert options == LEVEL
        return OccupancyGrid(
            cells=np.array([[OCCUPIED, UNKNOWN, FREE], [FREE, FREE, FREE]], np.uint8), origin_m=(-1.0, 2.0),
            resolution_m=0.25, floor_m=-0.1, T_grid_world=np.eye(4), up_source="--up",
        )  # fmt: skip

    def restart_clock(self) -> None:
        self.odometry.clear()


def send_urdf(bridge: Bridge, *, footprint: bool = False) -> None:
    """Send the static transforms of a robot in two messages, as a URDF and a driver do."""
    above = [(START_NS, "base_footprint", "base_link", exp_se3(np.array([0, 0, 0.1, 0, 0, 0])))]
    send_transforms(
        bridge, "tf_static", [(START_NS, "base_link", "camera_link", TILTED), *(above if footprint else ())]
    )
    send_transforms(bridge, "tf_static", [(START_NS, "camera_link", "eye", CAMERA_AXES)])


def send_wheels(bridge: Bridge, source: str, row: int) -> None:
    """Send the odometry at 50 Hz, as a topic or as transforms, from the image before *row* to after *row*."""
    first, last = (0 if row else -50), 5
    for number in range(first, last):
        stamp_ns = START_NS + (row - 1) * STEP_NS + number * STEP_NS // 5 + 27_000_000
        if source == "topic":
            send_odometry(bridge, stamp_ns, wheels(stamp_ns), ("odom", "base_link"))
        elif source == "tf":
            send_transforms(bridge, "tf", [(stamp_ns, "odom", "base_link", wheels(stamp_ns))])


def near(T: Array, expected: Array) -> bool:
    distance_m, angle_deg = pose_difference(T, expected)
    return distance_m < 1e-3 and angle_deg < 0.1


def has_transform(heard: Heard, parent: str, child: str, expected: Array) -> Callable[[list[Message]], bool]:
    """Return whether the newest transform from *parent* to *child* is the expected one."""

    def enough(_: list[Message]) -> bool:
        found = heard.transforms(parent, child)
        return bool(found) and near(found[-1][1], expected)

    return enough


async def drive_exactly(bridge: Bridge, heard: Heard, source: str) -> None:
    """Send the images of `true_pose`, each followed by the odometry of its time."""
    for row in range(ROWS):
        send(bridge, frame_at(row, depth=True), row)
        if row:
            send_wheels(bridge, source, row)
        await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))


@pytest.mark.parametrize("planar", [False, True], ids=["free", "planar"])
@pytest.mark.parametrize("source", ["own", "tf", "topic"])
async def test_transforms_are_exact_and_no_frame_has_two_parents(source: str, planar: bool) -> None:
    heard, last_ns = Heard(), START_NS + (ROWS - 1) * STEP_NS
    stamps = [START_NS + row * STEP_NS for row in range(ROWS)]
    truth = [project_to_plane(true_pose(each)) if planar else true_pose(each) for each in stamps]
    options = {"base_frame": "base_link", "planar": planar, "odometry": "odom" if source == "topic" else ""}

    def before(bridge: Bridge) -> None:
        send_urdf(bridge)
        send_wheels(bridge, source, 0)

    async with running(heard, make_mapper=ExactMapper, before=before, **options) as bridge:
        await drive_exactly(bridge, heard, source)
        T_odom_base = truth[-1] if source == "own" else wheels(last_ns)
        await heard.until(has_transform(heard, "map", "odom", truth[-1] @ inverse(T_odom_base)))

    poses = heard.of(POSE_WITH_COVARIANCE)
    assert {each.header.frame_id for each in poses} == {"map"}
    assert [stamp_of(each) for each in poses] == stamps
    for message, expected in zip(poses, truth, strict=True):
        assert near(pose_of(message.pose.pose.position, message.pose.pose.orientation), expected)
    own = heard.transforms("odom", "base_link")
    assert [stamp for stamp, _ in own] == (stamps if source == "own" else [])
    assert all(near(T, expected) for (_, T), expected in zip(own, truth, strict=False))
    parents = heard.parents()
    assert parents == ({"odom": {"map"}, "base_link": {"odom"}} if source == "own" else {"odom": {"map"}})
    odometry = heard.of(ODOMETRY)
    assert {(each.header.frame_id, each.child_frame_id) for each in odometry} == {("odom", "base_link")}
    covariance = poses[-1].pose.covariance.reshape(6, 6)
    assert np.diag(covariance).tolist() == ([1, 2, 0, 0, 0, 6] if planar else [1, 2, 3, 4, 5, 6])


async def test_visual_odometry_begins_at_the_odometry_of_the_wheels_and_does_not_slip_with_them() -> None:
    heard = Heard()
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, base_frame="base_link") as bridge:
        send_wheels(bridge, "tf", 0)
        await drive_exactly(bridge, heard, "tf")

    found = {stamp_of(each): pose_of(each.pose.pose.position, each.pose.pose.orientation)
             for each in heard.of(ODOMETRY)}  # fmt: skip
    begin = min(found)
    last_ns = START_NS + (ROWS - 1) * STEP_NS
    T_odom_map = found[begin] @ inverse(true_pose(begin))
    assert near(found[last_ns], T_odom_map @ true_pose(last_ns))


async def test_the_mapper_gets_each_reading_of_the_odometry_once_and_in_order() -> None:
    heard, mappers = Heard(), []

    def make(T_base_camera: Array | None) -> ExactMapper:
        mappers.append(ExactMapper(T_base_camera))
        return mappers[-1]

    def before(bridge: Bridge) -> None:
        send_urdf(bridge)
        send_wheels(bridge, "topic", 0)

    options = {"base_frame": "base_link", "odometry": "odom"}
    async with running(heard, make_mapper=make, before=before, **options) as bridge:
        await drive_exactly(bridge, heard, "topic")

    (mapper,) = mappers
    stamps = [each.timestamp_s for each in mapper.odometry]
    assert np.allclose(mapper.T_base_camera, MOUNT)
    assert stamps[0] < START_NS / 1e9 < stamps[-1]
    assert np.allclose(np.diff(stamps), 0.02, atol=1e-6)
    assert all(near(each.T_odom_base, wheels(round(1e9 * each.timestamp_s))) for each in mapper.odometry)


async def test_the_topmost_static_frame_above_the_base_gets_the_transform() -> None:
    heard = Heard()
    async with running(
        heard, make_mapper=ExactMapper, before=lambda bridge: send_urdf(bridge, footprint=True),
        base_frame="base_link",
    ) as bridge:  # fmt: skip
        await drive_exactly(bridge, heard, "own")

    T_base_footprint = exp_se3(np.array([0, 0, -0.1, 0, 0, 0]))
    for stamp_ns, T in heard.transforms("odom", "base_footprint"):
        assert near(T, true_pose(stamp_ns) @ T_base_footprint)
    assert "base_link" not in heard.parents()


async def test_a_camera_without_a_base_is_the_base_and_its_driver_keeps_its_frames() -> None:
    """A driver gives the optical frame a parent, ``camera_link``, and there is no URDF."""
    heard = Heard()

    def before(bridge: Bridge) -> None:
        send_transforms(bridge, "tf_static", [(START_NS, "camera_link", "eye", CAMERA_AXES)])

    async with running(heard, make_mapper=ExactMapper, before=before) as bridge:
        await drive_exactly(bridge, heard, "own")

    assert heard.parents().keys() <= {"odom", "camera_link"}
    assert [each.child_frame_id for each in heard.of(ODOMETRY)] == ["eye"] * ROWS
    for stamp_ns, T in heard.transforms("odom", "camera_link"):
        assert near(T @ CAMERA_AXES, true_pose(stamp_ns) @ MOUNT)


async def test_a_missing_mount_is_named_and_the_topics_work(capsys: pytest.CaptureFixture[str]) -> None:
    heard = Heard()
    async with running(heard, make_mapper=ExactMapper, base_frame="base_link", queue_frames=10) as bridge:
        await drive_exactly(bridge, heard, "own")
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 1))

    status = heard.of(DIAGNOSTICS)[-1].status[0]
    values = {each.key: each.value for each in status.values}
    assert "no base_link -> eye on /tf_static" in values["base"]
    assert capsys.readouterr().out.count("no base_link -> eye on /tf_static") == 1


@pytest.mark.parametrize(("child", "kept"), [("odom", ("odom", "base_link")), ("base_link", ("map", "odom"))])
async def test_a_second_parent_is_named_and_the_bridge_stops_publishing_that_transform(
    child: str, kept: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    heard = Heard()
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, base_frame="base_link") as bridge:
        send(bridge, frame_at(0, depth=True), 0)
        await heard.until(has_transform(heard, "map", "odom", np.eye(4)))
        send_transforms(bridge, "tf", [(START_NS, "elsewhere", child, np.eye(4))])
        heard.messages.clear()
        for row in range(1, 4):
            send(bridge, frame_at(row, depth=True), row)
        await heard.until(lambda _: bool(heard.transforms(*kept)))
        heard.messages.clear()
        row = 4
        while not count_of(DIAGNOSTICS, 1)(heard.messages):  # a report without a new image names that
            send(bridge, frame_at(row % 5, depth=True), row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row - 3))
            row += 1

    assert child not in heard.parents()
    status = heard.of(DIAGNOSTICS)[-1].status[0]
    assert status.level == 1
    assert f"another node publishes elsewhere -> {child}" in status.message
    assert capsys.readouterr().out.count(f"another node publishes elsewhere -> {child}") == 1


async def test_the_bridge_does_not_take_its_own_transforms_for_those_of_another_node() -> None:
    heard = Heard()
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, base_frame="base_link") as bridge:
        for row in range(ROWS):
            send(bridge, frame_at(row, depth=True), row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))
            for message in list(heard.messages):
                if message.kind == TF:
                    bridge.receive("tf", message.data)
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 1))

    assert heard.of(DIAGNOSTICS)[-1].status[0].message == "poses are given"


@pytest.mark.parametrize("has_clock", [True, False], ids=["ros-clock", "replayed"])
async def test_map_to_odom_is_stamped_ahead_of_now_or_of_the_image(has_clock: bool) -> None:
    heard, now_ns = Heard(), START_NS + 40_000_000
    async with running(
        heard, make_mapper=ExactMapper, transform_tolerance_s=0.3,
        now_ns=lambda: now_ns if has_clock else 10**18,
    ) as bridge:  # fmt: skip
        send(bridge, frame_at(0, depth=True), 0)
        await heard.until(lambda _: bool(heard.transforms("map", "odom")))

    expected = (now_ns if has_clock else START_NS) + 300_000_000
    assert [stamp for stamp, _ in heard.transforms("map", "odom")] == [expected]


@pytest.mark.parametrize("fault", ["covered", "frozen"])
async def test_while_the_camera_fails_the_wheels_carry_the_pose_and_the_status_says_so(fault: str) -> None:
    """The camera of the flat world looks ahead, and moves to the right by one step in each frame."""
    heard, right = Heard(), np.array([0.0, -STEP_M, 0.0, 0.0, 0.0, 0.0])

    def wheels_at(stamp_ns: int) -> Array:
        pose: Array = ODOM_START @ exp_se3((stamp_ns - START_NS) / STEP_NS * right)
        return pose

    def before(bridge: Bridge) -> None:
        send_transforms(bridge, "tf_static", [(START_NS, "base_link", "eye", CAMERA_AXES)])

    options = {"base_frame": "base_link", "odometry": "odom"}
    async with running(heard, before=before, **options) as bridge:
        for row in range(8):
            for part in range(-4, 2):
                stamp_ns = START_NS + row * STEP_NS + part * STEP_NS // 5
                send_odometry(bridge, stamp_ns, wheels_at(stamp_ns), ("odom", "base_link"))
            is_faulty = row in (4, 5)
            frame = frame_at(3 if is_faulty and fault == "frozen" else row, depth=True)
            send(bridge, covered(frame) if is_faulty and fault == "covered" else frame, row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))

    poses = heard.of(POSE_WITH_COVARIANCE)
    steps = [each.pose.pose.position.y / -STEP_M for each in poses]
    assert steps == pytest.approx(range(8), abs=0.2)
    assert poses[5].pose.covariance[0] > poses[3].pose.covariance[0]
    stamps = [stamp_of(each) for each in heard.of(ODOMETRY)]
    assert [(each - START_NS) // STEP_NS for each in stamps] == [1, 2, 3, 6, 7]
    assert [each.data for each in heard.of(STRING)] == ["lost", "visual", "odometry", "visual"]
    distance_m, angle_deg = pose_difference(heard.transforms("map", "odom")[-1][1], inverse(ODOM_START))
    assert distance_m < 0.01
    assert angle_deg < 0.2


async def test_a_robot_that_was_carried_away_is_lost_although_its_wheels_report() -> None:
    heard = Heard()

    def before(bridge: Bridge) -> None:
        send_transforms(bridge, "tf_static", [(START_NS, "base_link", "eye", CAMERA_AXES)])

    options = {"base_frame": "base_link", "odometry": "odom", "queue_frames": 20}
    # The clock stands still, so that odometry does not become too old: the robot is lost by its images alone.
    async with running(heard, before=before, clock=lambda: 0.0, **options) as bridge:
        for row in range(20):
            for part in range(-4, 2):
                stamp_ns = START_NS + row * STEP_NS + part * STEP_NS // 5
                send_odometry(bridge, stamp_ns, ODOM_START, ("odom", "base_link"))
            frame = frame_at(row, depth=True)
            send(bridge, frame if row < 4 else foreign(frame), row)
        await heard.until(count_of(STRING, 4))
        statuses = heard.of(STRING)
        await heard.until(
            lambda _: "20" in [each.value for each in heard.of(DIAGNOSTICS)[-1].status[0].values]
        )

    assert [each.data for each in statuses] == ["lost", "visual", "odometry", "lost"]
    assert "not joined" in heard.of(DIAGNOSTICS)[-1].status[0].message


async def test_without_wheels_a_covered_camera_is_lost() -> None:
    heard = Heard()
    async with running(heard) as bridge:
        for row in range(4):
            frame = frame_at(row, depth=True)
            send(bridge, covered(frame) if row == 3 else frame, row)
            if row < 3:
                await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))
        await heard.until(count_of(STRING, 3))

    assert [each.data for each in heard.of(STRING)] == ["lost", "visual", "lost"]


async def test_a_clock_that_is_set_back_begins_the_odometry_anew() -> None:
    """As when a bag is played again, or a simulation starts again."""
    heard = Heard()
    options = {"base_frame": "base_link", "odometry": "odom"}
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, **options) as bridge:
        for _ in range(2):
            heard.messages.clear()
            send_wheels(bridge, "topic", 0)
            await drive_exactly(bridge, heard, "topic")
            for row in (30, 31):
                send(bridge, frame_at(row % 5, depth=True), row)
                send_wheels(bridge, "topic", row)
                await heard.until(count_of(POSE_WITH_COVARIANCE, ROWS + row - 29))
            last_ns = START_NS + 31 * STEP_NS
            expected = true_pose(last_ns) @ inverse(wheels(last_ns))
            await heard.until(has_transform(heard, "map", "odom", expected))


@pytest.mark.parametrize(
    ("options", "frames", "cause"),
    [
        ({"odometry": "odom"}, ("wheel_odom", "base_link"), "/odom is in wheel_odom, and odom_frame is odom"),
        ({"odometry": "odom"}, ("odom", "axle"), "/odom is of axle, which no /tf_static joins to base_link"),
        ({"odometry": "odom"}, None, "no message of /odom"),
        ({"publish_odom": "false"}, None, "no node publishes odom -> base_link"),
    ],
    ids=["frame", "child", "silent", "none"],
)
async def test_odometry_that_cannot_be_used_is_named_and_nothing_is_published_instead(
    options: dict[str, str], frames: tuple[str, str] | None, cause: str, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = Heard()
    async with running(
        heard, make_mapper=ExactMapper, before=send_urdf, base_frame="base_link", **options
    ) as bridge:
        for row in range(3):
            if frames:
                send_odometry(bridge, START_NS + row * STEP_NS, wheels(START_NS), frames)
            send(bridge, frame_at(row, depth=True), row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 2))

    assert not heard.parents()
    assert cause in capsys.readouterr().out


async def test_a_floor_plan_is_in_the_map_with_percents_of_occupancy() -> None:
    heard = Heard()
    options = {"base_frame": "base_link", "floor_plan_every_s": 0.01}
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, **options) as bridge:
        await drive_exactly(bridge, heard, "own")
        await heard.until(count_of(OCCUPANCY_GRID, 1))

    plan = heard.of(OCCUPANCY_GRID, topic="/rse_pf/floor_plan")[0]
    assert (plan.header.frame_id, plan.info.width, plan.info.height) == ("map", 3, 2)
    assert plan.data.tolist() == [100, -1, 0, 0, 0, 0]
    corner = plan.info.origin.position
    assert (corner.x, corner.y, plan.info.resolution) == (-1.0, 2.0, 0.25)


class LiveExactMapper(ExactMapper, LiveMapper):
    """An exact mapper in a live map, whose plan changes with the fourth request."""

    T_map_odom, covariance, name, state = np.eye(4), None, "hall", "live"  # type: ignore[assignment]
    aligned, trouble, reason, map = True, "", "", None  # type: ignore[assignment]

    def __init__(self, T_base_camera: Array | None) -> None:
        super().__init__(T_base_camera)
        self.asked: list[float] = []
        self.priors: list[PosePrior | None] = []
        self.plans = [ExactMapper(None).floor_plan(LEVEL) for _ in range(2)]

    async def floor_plan(self, options: Any = None, *, max_age_s: float = 0.0) -> OccupancyGrid:
        self.asked.append(max_age_s)
        if len(self.asked) == 2:
            raise NotFound("the map shows no floor")
        return self.plans[len(self.asked) >= 4]

    def relocalise(self, prior: PosePrior | None = None) -> None:
        self.priors.append(prior)


async def test_an_initial_pose_is_the_prior_of_the_camera_in_the_live_map() -> None:
    heard, mapper = Heard(), LiveExactMapper(MOUNT)
    covariance = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.068])

    def initial_pose(frame: str, T: Array) -> bytes:
        message = MAKER.pose_with_covariance(START_NS, frame, T, covariance)
        return MAKER.encode(POSE_WITH_COVARIANCE, message)

    options = {"base_frame": "base_link", "map": "hall"}
    async with running(heard, make_mapper=lambda _: mapper, before=send_urdf, **options) as bridge:
        send(bridge, frame_at(0, depth=True), 0)
        await heard.until(count_of(POSE_WITH_COVARIANCE, 1))
        for frame, T in (("odom", MAP_START), ("map", MAP_START + math.nan), ("map", MAP_START)):
            bridge.receive("initialpose", initial_pose(frame, T))
        await heard.until(lambda _: bool(mapper.priors))

    (prior,) = mapper.priors
    assert prior is not None
    np.testing.assert_allclose(prior.T_map_camera, MAP_START @ MOUNT, atol=1e-9)
    np.testing.assert_array_equal(prior.covariance, covariance)


async def test_the_floor_plan_of_a_live_map_is_published_when_it_has_changed() -> None:
    heard, mapper = Heard(), LiveExactMapper(MOUNT)
    options = {"base_frame": "base_link", "map": "hall", "floor_plan_every_s": 0.01}
    async with running(heard, make_mapper=lambda _: mapper, before=send_urdf, **options) as bridge:
        for row in range(100):
            send(bridge, frame_at(row, depth=True), row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))
            if len(mapper.asked) > 5:
                break

    assert set(mapper.asked) == {0.01}
    assert len(heard.of(OCCUPANCY_GRID, topic="/rse_pf/floor_plan")) == 2


async def test_wheels_that_start_late_replace_the_odometry_by_the_camera() -> None:
    heard = Heard()
    async with running(heard, make_mapper=ExactMapper, before=send_urdf, base_frame="base_link") as bridge:
        await drive_exactly(bridge, heard, "own")
        send_transforms(bridge, "tf", [(START_NS, "odom", "base_link", wheels(START_NS))])
        heard.messages.clear()
        for row in (ROWS, ROWS + 1):
            send(bridge, frame_at(row, depth=True), row)
            send_wheels(bridge, "tf", row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, row - ROWS + 1))
        last_ns = START_NS + (ROWS + 1) * STEP_NS
        expected = true_pose(last_ns) @ inverse(wheels(last_ns))
        await heard.until(has_transform(heard, "map", "odom", expected))

    assert heard.parents() == {"odom": {"map"}}
