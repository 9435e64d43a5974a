"""Tests of `ros_bridge.incoming`: which images make a frame, when, and what is counted."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE
from client_sdk.frontend import Frame
from ros_bridge import BridgeOptions, IncomingFrames
from ros_bridge.incoming import Role
from tests.kit.small_bags import camera_info, raw_image, scene, stamp_of

SHOWN = scene()
MS = 1_000_000


class MessageStream:
    """The messages of a robot, as bytes of ROS 1 or CDR, into what is tested."""

    def __init__(self, *, is_ros1: bool = True, **options: object) -> None:
        self.maker = MessageMaker(is_ros1=is_ros1)
        self.frames = IncomingFrames(self.maker, BridgeOptions.of(options))
        self.send("info", camera_info(self.maker, stamp_of(0)))

    def send(self, role: Role, message: object) -> bool:
        kind = CAMERA_INFO if role == "info" else IMAGE
        return self.frames.add(role, self.maker.encode(kind, message))

    def colour(self, stamp_ns: int, row: int = 0) -> bool:
        return self.send("colour", raw_image(self.maker, stamp_ns, SHOWN.colours[row], "rgb8"))

    def depth(self, stamp_ns: int, row: int = 0) -> bool:
        return self.send("depth", raw_image(self.maker, stamp_ns, SHOWN.depths_mm[row], "16UC1"))

    def frame(self) -> Frame | None:
        """Return the next frame, None if its images cannot be used."""
        images = self.frames.take()
        assert images is not None
        return self.frames.decode(images)

    def taken(self) -> list[int]:
        found = []
        while (images := self.frames.take()) is not None:
            found.append(images.stamp_ns)
        return found


@pytest.mark.parametrize("is_ros1", [True, False])
def test_a_frame_has_the_pixels_the_depth_and_the_stamp_of_its_messages(is_ros1: bool) -> None:
    robot = MessageStream(is_ros1=is_ros1)

    assert not robot.colour(stamp_of(1), 1)
    assert robot.depth(stamp_of(1), 1)
    images = robot.frames.take()
    assert images is not None
    frame = robot.frames.decode(images)

    assert frame is not None
    assert (images.stamp_ns, images.camera_frame) == (stamp_of(1), "eye")
    assert frame.timestamp_s == stamp_of(1) / 1e9
    assert np.array_equal(frame.rgb, SHOWN.colours[1])
    assert np.array_equal(frame.depth_m, SHOWN.depths_mm[1].astype(np.float32) / np.float32(1000))


def test_colours_take_the_nearest_depth_and_wait_while_a_nearer_one_may_come() -> None:
    robot = MessageStream()
    stamp = stamp_of(0)

    robot.depth(stamp - 8 * MS, 0)
    assert not robot.colour(stamp)
    assert robot.depth(stamp + 3 * MS, 1)

    frame = robot.frame()
    assert frame is not None
    assert frame.depth_m[20, 20] == pytest.approx(SHOWN.depths_mm[1][20, 20] / 1000)


def test_colours_without_depth_within_the_bound_are_left_out_and_counted() -> None:
    robot = MessageStream(pair_within_s=0.01)

    robot.colour(stamp_of(0))
    robot.depth(stamp_of(0) + 30 * MS)
    robot.colour(stamp_of(1))
    robot.depth(stamp_of(1))

    assert robot.taken() == [stamp_of(1)]
    assert robot.frames.check.left_out["without partner"] == 2


def test_frames_leave_in_the_order_of_their_stamps_and_late_ones_are_counted() -> None:
    robot = MessageStream()
    for stamp in (stamp_of(1), stamp_of(0)):
        robot.colour(stamp)
    for stamp in (stamp_of(0), stamp_of(1)):
        robot.depth(stamp)
    robot.colour(stamp_of(0) + MS)

    assert robot.taken() == [stamp_of(0), stamp_of(1)]
    assert robot.frames.check.left_out["too late"] == 1


def test_a_bag_that_is_played_again_gives_frames_again() -> None:
    robot = MessageStream(queue_frames=10)
    for row in (0, 1, 2, 3):
        robot.colour(stamp_of(row) + 10 * row * MS)
        robot.depth(stamp_of(row) + 10 * row * MS)
    robot.colour(stamp_of(90))  # waits for its depth when the bag ends
    robot.depth(stamp_of(20))
    robot.colour(stamp_of(20))

    robot.colour(stamp_of(0))
    robot.depth(stamp_of(0))

    assert robot.taken()[-2:] == [stamp_of(20), stamp_of(0)]
    assert robot.frames.check.left_out == {"without partner": 0, "before the clock jumped back": 1}


@pytest.mark.parametrize("cut", [0, 3, 40, 2000])
def test_a_broken_message_is_counted_and_the_next_one_is_taken(cut: int) -> None:
    robot = MessageStream(depth="")
    whole = robot.maker.encode(IMAGE, raw_image(robot.maker, stamp_of(0), SHOWN.colours[0], "rgb8"))

    assert not robot.frames.add("colour", whole[:cut])
    assert robot.colour(stamp_of(1))

    assert robot.frames.check.left_out["broken"] == 1
    assert robot.taken() == [stamp_of(1)]


def test_a_topic_of_the_wrong_content_says_so() -> None:
    robot = MessageStream()
    robot.send("colour", raw_image(robot.maker, stamp_of(0), SHOWN.depths_mm[0], "16UC1"))
    assert "holds depth, where colour is expected" in robot.frames.check.fault


def test_a_lens_with_distortion_is_undistorted() -> None:
    robot = MessageStream(depth="")
    robot.frames._cameras.clear()
    robot.send("info", camera_info(robot.maker, stamp_of(0), (0.3, -0.1, 0.0, 0.0, 0.0)))
    robot.colour(stamp_of(0))
    frame = robot.frame()
    assert frame is not None
    assert not np.array_equal(frame.rgb, SHOWN.colours[0])


def test_a_topic_that_lags_behind_when_the_bag_begins_again_hides_no_partner() -> None:
    robot = MessageStream(queue_frames=10)
    for row in (0, 1, 20):
        robot.colour(stamp_of(row))
        robot.depth(stamp_of(row))
    robot.colour(stamp_of(30))

    robot.colour(stamp_of(0))  # the depth of row 30 comes only now
    robot.depth(stamp_of(30))
    robot.depth(stamp_of(0))
    robot.colour(stamp_of(1))
    robot.depth(stamp_of(1))

    assert robot.taken() == [stamp_of(row) for row in (0, 1, 20, 0, 1)]
    assert robot.frames.check.left_out["before the clock jumped back"] == 2


def with_lens(maker: MessageMaker, fx: float, **other: object) -> object:
    K = np.array([fx, 0, 31.5, 0, fx, 23.5, 0, 0, 1.0])
    return camera_info(maker, stamp_of(1), k=K, **other)


def test_images_of_a_camera_info_that_changed_are_mapped_to_the_first_one_and_it_is_named() -> None:
    robot = MessageStream(depth="")
    robot.send("info", with_lens(robot.maker, 96.0))
    robot.colour(stamp_of(0), 0)
    robot.colour(stamp_of(1), 1)

    before = robot.frame()
    assert before is not None
    assert np.array_equal(before.rgb, SHOWN.colours[0])
    assert not robot.frames.check.fault
    after = robot.frame()
    assert after is not None
    assert after.camera == before.camera
    assert np.allclose(after.rgb[23, 20], SHOWN.colours[1][23, 13], atol=2)
    assert "camera_info has changed: fx 60.0 to 96.0" in robot.frames.check.fault


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"k": np.zeros(9)}, "holds no calibration"),
        ({"k": np.full(9, np.nan)}, "holds no calibration"),
        ({"distortion": (0.1, 0.2), "model": "thin_prism_of_vendor"}, "unknown model thin_prism_of_vendor"),
        ({"width": 32, "height": 24}, "has changed: width 64 to 32"),
    ],
    ids=["zeros", "nan", "model", "size"],
)
@pytest.mark.parametrize("is_first", [True, False])
def test_a_camera_info_that_cannot_be_used_is_named_and_its_images_are_left_out(
    other: dict[str, object], named: str, is_first: bool
) -> None:
    if is_first and "width" in other:
        named = "do not fit the camera_info of 32x24 px"
    robot = MessageStream(depth="")
    if is_first:
        robot.frames = IncomingFrames(robot.maker, BridgeOptions.of({"depth": ""}))
    robot.send("info", camera_info(robot.maker, stamp_of(0), **other))  # type: ignore[arg-type]
    robot.colour(stamp_of(0))

    assert robot.frame() is None
    assert named in robot.frames.check.fault
    assert "hint" not in robot.frames.check.fault


@pytest.mark.parametrize(("stamps", "named"), [([0, 0], "is not set"), ([5, 5], "stands still at")])
def test_images_whose_stamps_give_no_order_are_named(stamps: list[int], named: str) -> None:
    robot = MessageStream(depth="")
    for row, stamp in enumerate(stamps):
        robot.colour(stamp, row)

    assert named in robot.frames.check.fault
    assert robot.taken() == [stamp for stamp in stamps[:1] if stamp]


def test_an_image_with_the_bytes_of_the_one_before_is_left_out_and_named() -> None:
    robot = MessageStream(depth="")
    for row, shown in enumerate((0, 0, 1)):
        robot.colour(stamp_of(row), shown)

    assert [robot.frame() is not None for _ in range(3)] == [True, False, True]
    assert "repeats an image" in robot.frames.check.fault


@pytest.mark.parametrize("unit", [1000.0, 0.001], ids=["millimetres", "kilometres"])
def test_depth_of_another_unit_is_named_with_its_median(unit: float) -> None:
    robot = MessageStream()
    robot.colour(stamp_of(0))
    depth = (SHOWN.depths_mm[0] / 1000 * unit).astype(np.float32)
    robot.send("depth", raw_image(robot.maker, stamp_of(0), depth, "32FC1"))

    assert robot.frame() is None
    assert "the median depth of /camera/aligned_depth_to_color/image_raw is " in robot.frames.check.fault
