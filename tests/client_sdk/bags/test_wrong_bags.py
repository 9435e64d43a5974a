"""Bags that are broken, incomplete or strange: one line each, or handled; never a traceback."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client_sdk.bags import BagKind, BagOptions, BagWriter, open_bag
from client_sdk.bags.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE
from rse_pf.errors import RsePfError, UsageError
from tests.kit.small_bags import (
    COLOUR,
    DEPTH,
    FIRST_KINDS,
    FRAMES,
    HEIGHT,
    KINDS,
    WIDTH,
    Message,
    camera_info,
    compressed_frames,
    raw_image,
    stamp_of,
    write_bag,
)


def without(topic: str) -> Change:
    return lambda _, messages: [each for each in messages if each[0] != topic]


pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")

Change = Callable[[BagWriter, list[Message]], list[Message]]


def replaced(topic: str, make: Callable[[BagWriter, int], object], kind: str = IMAGE) -> Change:
    def change(w: BagWriter, messages: list[Message]) -> list[Message]:
        return [(each[0], kind, each[2], make(w, each[2])) if each[0] == topic else each for each in messages]

    return change


def test_a_bag_without_camera_info_asks_for_intrinsics(tmp_path: Path) -> None:
    path = write_bag(tmp_path, change=without("/camera/color/camera_info"))

    with pytest.raises(UsageError, match="no camera_info for /camera/color/image_raw") as raised:
        open_bag(path)
    assert "--intrinsics" in raised.value.hint


@pytest.mark.parametrize("encoding", ["16SC1", "rgb16", "nv21", "\x1b[2J"])
def test_an_encoding_that_is_unknown_is_named(tmp_path: Path, encoding: str) -> None:
    def strange(w: BagWriter, stamp: int) -> object:
        return raw_image(w, stamp, np.zeros((HEIGHT, WIDTH), np.uint16), encoding)

    path = write_bag(tmp_path, change=replaced(COLOUR, strange))

    with pytest.raises(UsageError, match="no colour"):
        open_bag(path)
    with pytest.raises(UsageError, match="which is not colour that can be read"):
        open_bag(path, BagOptions(colour=COLOUR))


@pytest.mark.parametrize("kind", FIRST_KINDS)
def test_broken_messages_are_left_out_and_counted(tmp_path: Path, kind: BagKind) -> None:
    def broken(w: BagWriter, messages: list[Message]) -> list[Message]:
        serialise = w.types.serialize_ros1 if kind == "ros1" else w.types.serialize_cdr
        colours = [row for row, each in enumerate(messages) if each[0] == COLOUR]
        topic, message_kind, stamp, message = messages[colours[1]]
        messages[colours[1]] = (topic, message_kind, stamp, bytes(serialise(message, message_kind))[:900])
        messages[colours[3]] = (*messages[colours[3]][:3], b"\x01")
        return messages

    with open_bag(write_bag(tmp_path, kind, change=broken)) as bag:
        assert [frame.timestamp_s for frame in bag] == [stamp_of(row) / 1e9 for row in (0, 2, 4)]
        assert bag.log.doubts[0].sentence.startswith("2 broken messages left out; the first: /camera")


def test_compressed_images_that_are_cut_off_or_damaged_are_left_out(tmp_path: Path) -> None:
    def damaged(_: BagWriter, messages: list[Message]) -> list[Message]:
        images = [each for each in messages if each[1] == COMPRESSED_IMAGE]
        object.__setattr__(images[2][3], "data", images[2][3].data[:-30])
        data = images[5][3].data.copy()
        data[len(data) // 2] ^= 1
        object.__setattr__(images[5][3], "data", data)
        return messages

    with open_bag(write_bag(tmp_path, make=compressed_frames, change=damaged)) as bag:
        assert len(list(bag)) == FRAMES - 2
        assert bag.log.doubts[0].sentence.startswith("2 broken messages left out")


def test_clocks_that_differ_are_reported_with_the_smallest_difference(tmp_path: Path) -> None:
    def late(w: BagWriter, messages: list[Message]) -> list[Message]:
        for topic, _, stamp, message in messages:
            if topic == DEPTH:
                object.__setattr__(message, "header", w.header(stamp + 10_250_000_000, "eye"))
        return messages

    path = write_bag(tmp_path, change=late)

    with pytest.raises(UsageError, match=r"within 0.02 s; the nearest is 9.850 s away") as raised:
        open_bag(path)
    assert "--pair-within" in raised.value.hint


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"k": np.zeros(9)}, "holds no calibration"),
        ({"distortion_model": "cubic", "d": np.array([0.1])}, "unknown model cubic"),
        ({"d": np.array([0.1, 0.2, 0.3])}, "3 distortion numbers"),
        ({"d": np.array([0.1, np.nan, 0.3, 0, 0])}, "5 distortion numbers"),
        ({"binning_x": 2, "binning_y": 2}, "64x48 px, /camera/color/camera_info is for 32x24 px"),
        ({"width": 2 * WIDTH, "height": 2 * HEIGHT}, "has images of 64x48 px"),
    ],
)
def test_a_camera_that_cannot_be_used_is_refused(
    tmp_path: Path, fields: dict[str, object], says: str
) -> None:
    def other(w: BagWriter, stamp: int) -> object:
        return camera_info(w, stamp, **fields)  # type: ignore[arg-type]

    path = write_bag(tmp_path, change=replaced("/camera/color/camera_info", other, CAMERA_INFO))

    with pytest.raises(UsageError, match=says) as raised:
        open_bag(path)
    assert "--intrinsics" in raised.value.hint


def test_depth_of_another_size_without_a_transform_is_refused(tmp_path: Path) -> None:
    def small(w: BagWriter, stamp: int) -> object:
        return raw_image(w, stamp, np.full((24, 32), 900, np.uint16), "16UC1", frame="elsewhere")

    path = write_bag(tmp_path, change=lambda w, messages: [
        (each[0].replace("aligned_depth_to_color", "depth"), *each[1:])
        for each in replaced(DEPTH, small)(w, messages)
    ])  # fmt: skip

    with pytest.raises(UsageError, match="is not registered to /camera/color/image_raw") as raised:
        open_bag(path)
    assert "tf_static" in raised.value.hint


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (BagOptions(colour="/nothing"), "no topic /nothing; its topics: /camera"),
        (BagOptions(colour=DEPTH), "16UC1, which is not colour"),
        (BagOptions(depth=COLOUR), "bgr8, which is not depth"),
        (BagOptions(info="/tf"), "is a topic of tf2_msgs"),
        (BagOptions(truth=COLOUR), "is a topic of sensor_msgs"),
    ],
)
def test_a_topic_of_the_user_that_does_not_fit_is_refused(
    tmp_path: Path, options: BagOptions, says: str
) -> None:
    path = write_bag(tmp_path)

    with pytest.raises(UsageError, match=says):
        open_bag(path, options)


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else [each for each in path.iterdir() if each.suffix != ".yaml"]


@pytest.mark.parametrize("kind", FIRST_KINDS)
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_bag_that_was_cut_off_is_reported_in_one_line(tmp_path: Path, kind: BagKind, share: float) -> None:
    path = write_bag(tmp_path, kind)
    (file,) = files_of(path)
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])

    with pytest.raises(UsageError, match=r"cannot be read as a bag|no image of") as raised:
        open_bag(path)
    assert "\n" not in raised.value.message


@pytest.mark.parametrize("kind", FIRST_KINDS)
def test_bytes_that_were_changed_never_give_more_than_a_named_error(tmp_path: Path, kind: BagKind) -> None:
    attack(write_bag(tmp_path, kind), range(2))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_bytes_that_were_changed_never_give_more_than_a_named_error(
    tmp_path: Path, kind: BagKind
) -> None:
    (tmp_path / "c").mkdir()
    attack(write_bag(tmp_path, kind), range(100, 400))
    attack(write_bag(tmp_path / "c", kind, compressed_frames, is_compressed=True), range(400, 700))


def attack(path: Path, seeds: range) -> None:
    """Change some bytes of the bag for each seed, most of them in its last kilobytes, and read it."""
    (file,) = files_of(path)
    good = file.read_bytes()
    for seed in seeds:
        chance = random.Random(seed)
        data = bytearray(good)
        for _ in range(chance.choice((1, 3, 30))):
            first = chance.choice((0, max(0, len(data) - 4000)))
            data[chance.randrange(first, len(data))] = chance.randrange(256)
        file.write_bytes(data)
        with contextlib.suppress(RsePfError), open_bag(path) as bag:
            for _ in bag:
                pass
