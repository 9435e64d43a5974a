"""What a bag states of its clock, cameras, sizes and units is used, and what contradicts it is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")
cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from client_sdk.bags import BagOptions, BagWriter, open_bag  # noqa: E402
from client_sdk.bags.message_types import (  # noqa: E402
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FLOAT,
    IMAGE,
    TRANSFORM,
)
from rse_pf.errors import UsageError  # noqa: E402
from tests.kit.flat_world import CAMERA, frame_at  # noqa: E402
from tests.kit.small_bags import (  # noqa: E402
    COLOUR,
    CX,
    CY,
    DEPTH,
    FRAMES,
    FX,
    HEIGHT,
    PERIOD_NS,
    WIDTH,
    Message,
    camera_info,
    compressed,
    raw_image,
    scene,
    stamp_of,
    write_bag,
)

INFO = "/camera/color/camera_info"
COLOURS_MM = (-150.0, 0.0, 0.0)
"""Where reference 0 sits for the colour camera of `recorded_by_realsense`."""

Make = Callable[[BagWriter], list[Message]]


def frames(
    colour: Callable[[BagWriter, int, int], tuple[str, str, Any]] | None = None,
    depth: Callable[[BagWriter, int, int], Any] | None = None,
    info: Callable[[BagWriter, int, int], Any] | None = None,
    stamp: Callable[[int], int] = stamp_of,
    depth_topic: str = DEPTH,
) -> Make:
    """Return what makes the scene of `small_bags` with messages that differ."""
    shown = scene()

    def make(w: BagWriter) -> list[Message]:
        found: list[Message] = []
        for row in range(FRAMES):
            logged, stamped = stamp_of(row), stamp(row)
            image = raw_image(w, stamped, shown.colours[row][:, :, ::-1], "bgr8")
            topic, kind, image = (COLOUR, IMAGE, image) if colour is None else colour(w, stamped, row)
            deep = raw_image(w, stamped, shown.depths_mm[row], "16UC1")
            found += [
                (
                    INFO,
                    CAMERA_INFO,
                    logged,
                    camera_info(w, stamped) if info is None else info(w, stamped, row),
                ),
                (topic, kind, logged, image),
                (depth_topic, IMAGE, logged, deep if depth is None else depth(w, stamped, row)),
            ]
        return found

    return make


def small_jpeg(w: BagWriter, stamp: int, row: int) -> tuple[str, str, Any]:
    image = cv2.resize(scene().colours[row], (WIDTH // 2, HEIGHT // 2))
    data = cv2.imencode(".jpg", image)[1].tobytes()
    return f"{COLOUR}/compressed", COMPRESSED_IMAGE, compressed(w, stamp, data, "bgr8; jpeg compressed bgr8")


def float_mm(w: BagWriter, stamp: int, row: int) -> Any:
    return raw_image(w, stamp, scene().depths_mm[row].astype(np.float32), "32FC1")


def binned(w: BagWriter, stamp: int, row: int) -> Any:
    """The camera of the scene as a driver states it that bins the right lower part of its sensor by 2."""
    roi = w.make(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=100, y_offset=50, height=2 * HEIGHT, width=2 * WIDTH, do_rectify=False,
    )  # fmt: skip
    across, down = 2 * CX + 0.5 + 100, 2 * CY + 0.5 + 50
    k = np.array([2 * FX, 0, across, 0, 2 * FX, down, 0, 0, 1.0])
    return camera_info(w, stamp, width=4 * WIDTH, height=4 * HEIGHT, binning_x=2, binning_y=2, roi=roi, k=k)


def lens_with_distortion(w: BagWriter, stamp: int, row: int) -> Any:
    return camera_info(w, stamp, (-0.3, 0.1, 0.0, 0.0, 0.0))


def zooming(w: BagWriter, stamp: int, row: int) -> Any:
    zoomed = np.array([2 * FX, 0, CX, 0, 2 * FX, CY, 0, 0, 1.0])
    return camera_info(w, stamp, k=zoomed) if row == 0 else camera_info(w, stamp)


def recorded_by_realsense(w: BagWriter) -> list[Message]:
    """Frames as librealsense records them: all of frame "0", unregistered depth, units of 0.25 mm."""
    shown, found = scene(), []
    colour, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    turn = w.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    for stream, (x, y, z) in ((colour, COLOURS_MM), (depth, (0.0, 0.0, 0.0))):
        step = w.make("geometry_msgs/msg/Vector3", x=x / 1000, y=y / 1000, z=z / 1000)
        mount = w.make(TRANSFORM, translation=step, rotation=turn)
        focal = FX if stream == colour else 0.75 * FX
        k = np.array([focal, 0, CX, 0, focal, CY, 0, 0, 1.0])
        found += [
            (f"{stream}/tf/0", TRANSFORM, stamp_of(0), mount),
            (f"{stream}/info/camera_info", CAMERA_INFO, stamp_of(0), camera_info(w, 0, k=k, frame="0")),
        ]
    unit = w.make(FLOAT, data=0.00025)
    found.append(("/device_0/sensor_0/option/Depth_Units/value", FLOAT, stamp_of(0), unit))
    for row in range(FRAMES):
        stamp = stamp_of(row)
        patch = np.zeros((HEIGHT, WIDTH), np.uint16)
        patch[20:25, 20:25] = 4000
        found += [
            (f"{colour}/image/data", IMAGE, stamp, raw_image(w, stamp, shown.colours[row], "rgb8", "0")),
            (f"{depth}/image/data", IMAGE, stamp, raw_image(w, stamp, patch, "mono16", "0")),
        ]
    return found


def plane_frames(stated_fx: Callable[[int], float], zoom: Callable[[int], float] = lambda row: 1.0) -> Make:
    """Return what makes the drive of `flat_world` with a stated focal length, and a zoom, of each row."""

    def make(w: BagWriter) -> list[Message]:
        found: list[Message] = []
        for row in range(FRAMES):
            stamp, frame, fx = stamp_of(row), frame_at(row, depth=True), stated_fx(row)
            centre, size = (CAMERA.cx, CAMERA.cy), (CAMERA.width, CAMERA.height)
            larger = cv2.getRotationMatrix2D(centre, 0.0, zoom(row))
            rgb = cv2.warpAffine(frame.rgb, larger, size)
            depth_m = cv2.warpAffine(frame.depth_m, larger, size, flags=cv2.INTER_NEAREST)
            k = np.array([fx, 0, CAMERA.cx, 0, fx, CAMERA.cy, 0, 0, 1.0])
            lens = camera_info(w, stamp, k=k, width=CAMERA.width, height=CAMERA.height)
            depth_mm = np.rint(1e3 * depth_m).astype(np.uint16)
            found += [
                (INFO, CAMERA_INFO, stamp, lens),
                (COLOUR, IMAGE, stamp, raw_image(w, stamp, rgb, "rgb8")),
                (DEPTH, IMAGE, stamp, raw_image(w, stamp, depth_mm, "16UC1")),
            ]
        return found

    return make


@pytest.mark.parametrize("step_ns", [250_000_000, 300_000_000, 3_600_000_000_000])
def test_frames_keep_their_order_where_the_clock_is_set_back(tmp_path: Path, step_ns: int) -> None:
    make = frames(stamp=lambda row: stamp_of(row) - (step_ns if row > 2 else 0))

    with open_bag(write_bag(tmp_path, make=make)) as bag:
        assert np.diff(bag.timestamps_s) == pytest.approx([PERIOD_NS / 1e9] * (FRAMES - 1), abs=1e-6)
        for row, frame in enumerate(bag):
            assert (frame.rgb == scene().colours[row]).all()
        assert any(f"set back by {step_ns / 1e9:.3f} s" in note for note in bag.notes)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (frames(colour=small_jpeg), "images of 32x24 px, .*camera_info is for 64x48 px"),
        (frames(colour=small_jpeg, info=lens_with_distortion), "images of 32x24 px, .* is for 64x48 px"),
        (frames(depth=float_mm), "median depth of small.bag is 1[0-9.]+ m at 1 units a metre"),
    ],
)
def test_what_contradicts_the_bag_is_refused_with_both_numbers(
    tmp_path: Path, make: Make, expected: str
) -> None:
    with pytest.raises(UsageError, match=expected) as refused:
        open_bag(write_bag(tmp_path, make=make))
    assert refused.value.hint


@pytest.mark.parametrize(
    ("options", "is_assumed"), [(BagOptions(), True), (BagOptions(depth_scale=1000.0), False)]
)
def test_a_unit_of_depth_that_is_assumed_is_a_note(
    tmp_path: Path, options: BagOptions, is_assumed: bool
) -> None:
    with open_bag(write_bag(tmp_path, make=frames()), options) as bag:
        assert any("1000 units a metre are assumed" in note for note in bag.notes) is is_assumed


def test_a_binned_region_of_a_sensor_has_the_camera_of_its_images(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path, make=frames(info=binned))) as bag:
        camera = bag.camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((FX, CX, CY))


def test_images_of_a_camera_that_changes_are_resampled_and_told(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path, make=frames(info=zooming))) as bag:
        first, second = bag.read(0), bag.read(1)

        assert bag.camera.fx == FX
        assert [doubt.name.value for doubt in bag.log.doubts] == ["camera-changes"]
        # What was seen with twice the focal length fills the inner half of the image.
        inner = np.abs(first.rgb[14:34, 18:46].astype(float) - cv2.resize(
            scene().colours[0], (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA
        )[2:22, 2:30])  # fmt: skip
        assert inner.mean() < 8.0
        assert not first.rgb[:8].any()
        assert (second.rgb == scene().colours[1]).all()


@pytest.mark.parametrize("stated_fx", [700.0, 400.0, 560.0])
@pytest.mark.parametrize("first", [1, 4])
def test_a_change_of_the_camera_that_the_images_contradict_is_refused(
    tmp_path: Path, stated_fx: float, first: int
) -> None:
    make = plane_frames(stated_fx=lambda row: CAMERA.fx if row < first else stated_fx)

    with pytest.raises(UsageError, match=rf"fx {CAMERA.fx:g} before .* and fx {stated_fx:g} from") as refused:
        open_bag(write_bag(tmp_path, make=make))
    assert "the lens did not change" in refused.value.message
    assert "--intrinsics" in refused.value.hint


@pytest.mark.parametrize("zoom", [1.4, 1.1])
def test_a_change_of_the_camera_that_the_images_show_is_a_finding(tmp_path: Path, zoom: float) -> None:
    make = plane_frames(
        stated_fx=lambda row: CAMERA.fx * (zoom if row > 2 else 1.0),
        zoom=lambda row: zoom if row > 2 else 1.0,
    )

    with open_bag(write_bag(tmp_path, make=make)) as bag:
        assert [doubt.name.value for doubt in bag.log.doubts] == ["camera-changes"]


def test_a_recorder_of_realsense_states_unit_cameras_and_mounts(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path, make=recorded_by_realsense)) as bag:
        depth_m = bag.read(0).depth_m

        assert bag.camera.fx == FX
        assert not bag.log.doubts
        assert np.unique(depth_m[depth_m > 0]) == pytest.approx([1.0])
        middle = np.argwhere(depth_m > 0).mean(axis=0)
        assert middle == pytest.approx(
            [CY + FX * (22 - CY) / (0.75 * FX), CX + FX * ((22 - CX) / (0.75 * FX) - 0.15)], abs=1.0
        )


def test_depth_of_another_lens_without_a_mount_is_a_doubt(tmp_path: Path) -> None:
    def without_mount(w: BagWriter) -> list[Message]:
        return [each for each in recorded_by_realsense(w) if each[1] != TRANSFORM]

    with open_bag(write_bag(tmp_path, make=without_mount)) as bag:
        assert [doubt.name.value for doubt in bag.log.doubts] == ["depth-registration"]
        assert "fx 45) is taken as seen from where" in bag.log.doubts[0].sentence
