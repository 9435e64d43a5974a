"""Bags as frames: three kinds, raw and compressed, give the same pixels, depths, cameras and true poses."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.bags import BagKind, BagOptions, BagWriter, open_bag
from client_sdk.bags.bag import Bag
from client_sdk.bags.images import decode_colour
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE, POSE, TF, load_types
from client_sdk.bags.poses import PoseTopic
from client_sdk.datasets import open_dataset
from rse_pf.geometry import Camera
from tests.kit.recorded_bags import write_recording
from tests.kit.small_bags import (
    COLOUR,
    CX,
    CY,
    DEPTH,
    FIRST_KINDS,
    FRAMES,
    FX,
    HEIGHT,
    KINDS,
    PERIOD_NS,
    WIDTH,
    Message,
    camera_info,
    compressed_frames,
    pose,
    raw_frames,
    raw_image,
    scene,
    stamp_of,
    transforms,
    write_bag,
)

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")


def assert_is_the_scene(bag: Bag) -> None:
    shown = scene()
    frames = list(bag)
    assert [frame.timestamp_s for frame in frames] == [stamp_of(row) / 1e9 for row in range(FRAMES)]
    np.testing.assert_array_equal([frame.rgb for frame in frames], shown.colours)
    np.testing.assert_array_equal(
        [frame.depth_m for frame in frames], shown.depths_mm.astype(np.float32) / np.float32(1000)
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("make", "is_compressed"), [(raw_frames, True), (compressed_frames, False)])
def test_every_kind_of_bag_gives_the_same_frames(
    tmp_path: Path, kind: BagKind, make: Any, is_compressed: bool
) -> None:
    with open_bag(write_bag(tmp_path, kind, make, is_compressed=is_compressed)) as bag:
        assert_is_the_scene(bag)
        assert bag.camera == Camera(fx=FX, fy=FX, cx=CX, cy=CY, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize("kind", FIRST_KINDS)
def test_time_stamps_that_are_not_in_order_are_sorted_and_told(tmp_path: Path, kind: BagKind) -> None:
    def shuffled(_: BagWriter, messages: list[Message]) -> list[Message]:
        images = [each for each in messages if each[1] == IMAGE]
        others = [each for each in messages if each[1] != IMAGE]
        order = [2, 1, 0, 3, 6, 5, 4, 7, 8, 9]  # neighbours change places
        logged = sorted(each[2] for each in images)
        moved = [(*images[row][:2], log, images[row][3]) for row, log in zip(order, logged, strict=True)]
        return sorted([*others, *moved], key=lambda each: each[2])

    with open_bag(write_bag(tmp_path, kind, change=shuffled)) as bag:
        assert_is_the_scene(bag)
        assert "the time stamps were not in order; frames are sorted by them" in bag.notes


def test_stamps_of_zero_are_replaced_by_the_times_of_recording(tmp_path: Path) -> None:
    def without(w: BagWriter, messages: list[Message]) -> list[Message]:
        for _, kind, _, message in messages:
            if kind == IMAGE:
                object.__setattr__(message, "header", w.header(0, "eye"))
        return messages

    with open_bag(write_bag(tmp_path, change=without)) as bag:
        assert_is_the_scene(bag)


def test_colour_and_depth_are_paired_within_the_bound(tmp_path: Path) -> None:
    def delayed(w: BagWriter, messages: list[Message]) -> list[Message]:
        for row, (topic, _, _, message) in enumerate(messages):
            if topic == DEPTH:  # 0 to 20 ms late
                delay = 5_000_000 * (row // 4)
                object.__setattr__(message, "header", w.header(stamp_of(row // 4) + delay, "eye"))
        return messages

    path = write_bag(tmp_path, change=delayed)
    with open_bag(path, BagOptions(pair_within_s=0.0125)) as bag:
        assert len(bag) == 3
        (doubt,) = bag.log.doubts
        assert re.search(r"^2 colour images of \d+ without depth within 0.0125 s left out", doubt.sentence)
    with open_bag(path) as bag:
        assert_is_the_scene(bag)


def test_the_true_path_comes_from_tf_and_is_interpolated(tmp_path: Path) -> None:
    def moved(w: BagWriter, messages: list[Message]) -> list[Message]:
        kept = [each for each in messages if each[1] != TF]
        fixed = transforms(w, 0, "base", "eye", (0, 0, 1.0))
        kept.insert(0, ("/tf_static", TF, stamp_of(0), fixed))
        for row in range(FRAMES + 1):  # between the frames
            stamp = stamp_of(row) - PERIOD_NS // 2
            kept.append(("/tf", TF, stamp, transforms(w, stamp, "world", "base", (0.1 * row - 0.05, 0, 0))))
        return sorted(kept, key=lambda each: each[2])

    with open_bag(write_bag(tmp_path, change=moved)) as bag:
        assert bag.truth is not None
        assert bag.truth_kind == "ground truth"
        np.testing.assert_allclose(
            bag.truth.positions, [[0.1 * row, 0, 1] for row in range(FRAMES)], atol=1e-9
        )


def posed_at(*stamps_ns: int) -> PoseTopic:
    """Return poses at these times, all of them the identity."""
    types = load_types(is_ros1=False).types
    poses = PoseTopic()
    for stamp_ns in stamps_ns:
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        place = types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0)
        header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, stamp_ns), "world")
        poses.add(types[POSE](header, types["geometry_msgs/msg/Pose"](place, turn)))
    return poses


def test_no_pose_is_made_up_between_two_that_are_far_apart() -> None:
    poses = posed_at(0, 200_000_000, 400_000_001, 500_000_000)

    path = poses.path([100_000_000, 300_000_000, 450_000_000])

    assert path is not None
    assert path.timestamps_s.tolist() == [0.1, 0.45]


def test_a_topic_of_poses_is_the_true_path_where_tf_does_not_move_the_camera(tmp_path: Path) -> None:
    def posed(w: BagWriter, messages: list[Message]) -> list[Message]:
        kept = [each for each in messages if each[1] != TF]
        return kept + [
            ("/vicon", POSE, stamp_of(row), pose(w, stamp_of(row), (0, 2.0 * row, 0)))
            for row in range(FRAMES)
        ]

    with open_bag(write_bag(tmp_path, change=posed)) as bag:
        assert bag.truth is not None
        np.testing.assert_allclose(bag.truth.positions[:, 1], [0, 2, 4, 6, 8])
        assert "ground truth: /vicon, taken as poses of the colour camera" in bag.notes


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((-0.6, 0.3, 0.001, -0.002, 0.0), "plumb_bob"),
        ((0.3, 0.1, 0.001, 0.0, 0.01, -0.3, 0.05, 0.0), "rational_polynomial"),
        ((-0.4, 0.02, 0.0, 0.0), "equidistant"),
    ],
)
def test_colour_and_depth_of_a_distorted_lens_are_undistorted(
    tmp_path: Path, distortion: tuple[float, ...], model: str
) -> None:
    """A point that the lens moved is where a pinhole camera would have seen it."""
    K = np.array([[FX, 0, CX], [0, FX, CY], [0, 0, 1]])
    wanted = np.array([[[12.0, 9.0]], [[52.0, 38.0]]])
    rays = np.concatenate(((wanted - (CX, CY)) / FX, np.ones((2, 1, 1))), axis=2)
    zero = np.zeros(3)
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    seen = project(rays, zero, zero, K, np.array(distortion))[0].reshape(-1, 2)
    grey, depth = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), 1000, np.uint16)
    for x, y in np.round(seen).astype(int):
        grey[y - 1 : y + 2, x - 1 : x + 2] = 250
        depth[y - 1 : y + 2, x - 1 : x + 2] = 3000

    def spotted(w: BagWriter, _: list[Message]) -> list[Message]:
        info = camera_info(w, stamp_of(0), distortion, model)
        return [
            ("/camera/color/camera_info", CAMERA_INFO, stamp_of(0), info),
            (COLOUR, IMAGE, stamp_of(0), raw_image(w, stamp_of(0), grey, "mono8")),
            (DEPTH, IMAGE, stamp_of(0), raw_image(w, stamp_of(0), depth, "16UC1")),
        ]

    with open_bag(write_bag(tmp_path, change=spotted)) as bag:
        (frame,) = bag
    for x, y in wanted.reshape(-1, 2).astype(int):
        assert frame.rgb[y, x, 0] > 150
        assert frame.depth_m[y, x] == 3.0
    assert np.abs(seen - wanted.reshape(-1, 2)).max() > 1.5  # so that it could have failed


def test_a_depth_camera_beside_the_colours_is_registered_by_tf_static(tmp_path: Path) -> None:
    """The depth camera stands 0.1 m to the left and sees a wall at 1 m: all moves by 6 pixels."""
    depth = np.full((HEIGHT, WIDTH), 1000, np.uint16)
    depth[20:24, 30:34] = 500

    def second_camera(w: BagWriter, messages: list[Message]) -> list[Message]:
        colour = next(each for each in messages if each[0] == COLOUR)
        s = stamp_of(0)
        return [
            ("/tf_static", TF, s, transforms(w, 0, "eye", "depth_eye", (-0.1, 0, 0))),
            ("/camera/color/camera_info", CAMERA_INFO, s, camera_info(w, s)),
            ("/camera/depth/camera_info", CAMERA_INFO, s, camera_info(w, s, frame="depth_eye")),
            colour,
            ("/camera/depth/image_raw", IMAGE, s, raw_image(w, s, depth, "16UC1", frame="depth_eye")),
        ]

    with open_bag(write_bag(tmp_path, change=second_camera)) as bag:
        (frame,) = bag
    expected = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    expected[:, WIDTH - 6 :] = 0.0
    expected[20:24, 24:28] = 1.0
    found = frame.depth_m
    assert np.all(found[20:24, 18:22] == 0.5)  # 12 pixels at half the distance, before the wall
    expected[20:24, 18:22] = 0.5
    expected[20:24, 24:28] = 0.0  # what stood behind it was not seen
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("encoding", "pixel"),
    [
        ("rgb8", (200, 100, 50)), ("bgr8", (50, 100, 200)), ("rgba8", (200, 100, 50, 9)),
        ("bgra8", (50, 100, 200, 9)), ("8UC3", (50, 100, 200)),
    ],
)  # fmt: skip
def test_colours_are_returned_red_first(encoding: str, pixel: tuple[int, ...]) -> None:
    image = message_of(np.full((4, 6, len(pixel)), pixel, np.uint8), encoding)

    assert decode_colour(image)[2, 3].tolist() == [200, 100, 50]


@pytest.mark.parametrize(
    ("encoding", "tile"),
    [
        ("bayer_rggb8", [[200, 100], [100, 50]]), ("bayer_bggr8", [[50, 100], [100, 200]]),
        ("bayer_gbrg8", [[100, 50], [200, 100]]), ("bayer_grbg8", [[100, 200], [50, 100]]),
    ],
)  # fmt: skip
def test_bayer_patterns_are_turned_into_colours(encoding: str, tile: list[list[int]]) -> None:
    image = message_of(np.tile(np.array(tile, np.uint8), (5, 5)), encoding)

    assert decode_colour(image)[5, 5].tolist() == [200, 100, 50]


def message_of(pixels: np.ndarray[Any, Any], encoding: str) -> Any:
    """Return an ``Image`` without a bag."""
    types = load_types(is_ros1=False).types
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    is_big = int(pixels.dtype.byteorder == ">")
    return types[IMAGE](None, len(pixels), pixels.shape[1], encoding, is_big, rows.shape[1], rows.ravel())


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("kind", KINDS)
def test_the_kitchen_as_a_bag_gives_the_frames_of_the_folder(
    recordings: Path, tmp_path: Path, kind: BagKind
) -> None:
    folder = recordings / "7scenes_redkitchen"
    for is_raw in (True, False):
        path = tmp_path / f"kitchen-{is_raw}{'.bag' if kind == 'ros1' else ''}"
        write_recording(folder, path, kind, is_raw=is_raw, frames=60)
        dataset = open_dataset(folder)
        with open_bag(path) as bag:
            assert len(bag) == 60
            for wanted, found in zip(dataset, bag, strict=False):
                np.testing.assert_array_equal(found.rgb, wanted.rgb)
                np.testing.assert_array_equal(found.depth_m, wanted.depth_m)
                assert found.camera == wanted.camera
            assert bag.truth is not None
            assert dataset.truth is not None
            np.testing.assert_allclose(bag.truth.positions, dataset.truth.positions[:60], atol=1e-9)
