"""Stereo pairs in bags: found, paired by stamps and rectified; what is wrong is refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.bags import BagKind, BagOptions, BagWriter, open_bag
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE, TF
from client_sdk.datasets import open_dataset
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import RigCamera
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3, inverse
from tests.kit.small_bags import (
    CX,
    CY,
    DEPTH,
    FIRST_KINDS,
    FRAMES,
    FX,
    HEIGHT,
    KINDS,
    WIDTH,
    Message,
    camera_info,
    raw_frames,
    raw_image,
    scene,
    stamp_of,
    write_bag,
)

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")

BASELINE_M, DISPARITY_PX = 0.12, 4
CAMERA = Camera(fx=FX, fy=FX, cx=CX, cy=CY, width=WIDTH, height=HEIGHT)
OTHER_CAMERA = Camera(fx=FX + 1, fy=FX, cx=CX - 1, cy=CY, width=WIDTH, height=HEIGHT)
LEFT, RIGHT = "/rig/left/image_rect", "/rig/right/image_rect"


def grey() -> Array:
    """Return what the left camera sees: ``(n, h, w)``."""
    return np.stack([cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in scene().colours])


def projection(step: float = 0.0) -> Array:
    P = np.array([FX, 0, CX, 0, 0, FX, CY, 0, 0, 0, 1.0, 0])
    P[3] = step
    return P


def pair_messages(w: BagWriter, *, left: str = LEFT, right: str = RIGHT, **of_right: Any) -> list[Message]:
    """Return a wall as two rectified cameras see it: at ``fx * baseline / disparity`` metres."""
    found: list[Message] = []
    for row, seen in enumerate(grey()):
        stamp = stamp_of(row)
        moved = np.roll(seen, -DISPARITY_PX, axis=1)
        fields = {"p": projection(-FX * BASELINE_M), "frame": "right_eye", **of_right}
        found += [
            (f"{left.rpartition('/')[0]}/camera_info", CAMERA_INFO, stamp, camera_info(w, stamp)),
            (f"{right.rpartition('/')[0]}/camera_info", CAMERA_INFO, stamp, camera_info(w, stamp, **fields)),
            (left, IMAGE, stamp, raw_image(w, stamp, seen, "mono8")),
            (right, IMAGE, stamp, raw_image(w, stamp, moved, "mono8", fields["frame"])),
        ]
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_pair_is_found_by_its_names_and_gives_rectified_frames(tmp_path: Path, kind: BagKind) -> None:
    with open_bag(write_bag(tmp_path, kind, pair_messages)) as bag:
        assert (bag.has_stereo, bag.has_depth, bag.camera) == (True, False, CAMERA)
        frames = list(bag)
        assert any(note.startswith("stereo pair: baseline 0.12 m") for note in bag.notes)

    assert len(frames) == FRAMES
    for frame, seen in zip(frames, grey(), strict=True):
        assert frame.stereo is not None
        assert frame.stereo.baseline_m == pytest.approx(BASELINE_M)
        np.testing.assert_array_equal(frame.rgb[..., 0], seen)
        # What the left image shows at u lies at u - disparity in the right one.
        np.testing.assert_array_equal(frame.stereo.gray[:, :-DISPARITY_PX], seen[:, DISPARITY_PX:])
        assert not frame.depth_m.any()


def true_rig(model: str) -> tuple[RigCamera, RigCamera]:
    T_left_right = exp_se3(np.array([BASELINE_M, 0.003, -0.002, 0.01, -0.03, 0.02]))
    numbers = (0.02, -0.01, 0.004, -0.002) if model == "fisheye" else (-0.2, 0.05, 0.001, -0.002, 0.0)
    lens = Intrinsics(camera=CAMERA, distortion=numbers, model=model)  # type: ignore[arg-type]
    return (
        RigCamera(name="left", lens=lens, T_body_camera=np.eye(4)),
        RigCamera(
            name="right",
            lens=replace(lens, camera=OTHER_CAMERA),
            T_body_camera=T_left_right,
        ),
    )


def raw_pair(w: BagWriter, rig: tuple[RigCamera, RigCamera], *, with_p: bool) -> list[Message]:
    """Return raw images with what a calibration writes: K, D, and R and P by OpenCV's own rectification."""
    left, right = rig
    T = inverse(right.T_body_camera)
    rectify = cv2.fisheye.stereoRectify if left.lens.model == "fisheye" else cv2.stereoRectify
    more = {"flags": cv2.CALIB_ZERO_DISPARITY} if left.lens.model == "fisheye" else {"alpha": 0.0}
    lenses = [
        np.array(each) for lens in (left.lens, right.lens) for each in (lens.camera.matrix, lens.distortion)
    ]
    R1, R2, P1, P2 = rectify(*lenses, (WIDTH, HEIGHT), T[:3, :3], T[:3, 3], **more)[:4]
    model = "equidistant" if left.lens.model == "fisheye" else "plumb_bob"
    messages = [("/tf_static", TF, stamp_of(0), w.transforms([
        w.transform(0, "body", "eye", np.eye(4)), w.transform(0, "body", "right_eye", right.T_body_camera),
    ]))] if not with_p else []  # fmt: skip
    for row, seen in enumerate(grey()):
        stamp = stamp_of(row)
        for side, camera, R, P, frame in (
            ("left", left, R1, P1, "eye"),
            ("right", right, R2, P2, "right_eye"),
        ):
            info = camera_info(
                w, stamp, camera.lens.distortion, model, frame, k=camera.lens.camera.matrix.ravel(),
                r=R.ravel() if with_p else np.eye(3).ravel(), p=P.ravel() if with_p else np.zeros(12),
            )  # fmt: skip
            messages.append((f"/{side}/camera_info", CAMERA_INFO, stamp, info))
            messages.append((f"/{side}/image_raw", IMAGE, stamp, raw_image(w, stamp, seen, "mono8", frame)))
    return messages


@pytest.mark.parametrize("model", ["radial-tangential", "fisheye"])
@pytest.mark.parametrize("with_p", [True, False])
def test_raw_pairs_are_rectified_as_those_of_a_rig(tmp_path: Path, model: str, with_p: bool) -> None:
    rig = true_rig(model)
    wanted = Rectification(*rig)

    with open_bag(write_bag(tmp_path, make=lambda w: raw_pair(w, rig, with_p=with_p))) as bag:
        frame = bag.read(1)

    assert frame.stereo is not None
    assert frame.stereo.baseline_m == pytest.approx(wanted.baseline_m, rel=1e-6)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(bag.camera, name) == pytest.approx(getattr(wanted.camera, name), rel=1e-6)
    seen = grey()[1]
    np.testing.assert_allclose(frame.rgb, wanted.left(np.repeat(seen[..., None], 3, axis=2)), atol=1)
    np.testing.assert_allclose(frame.stereo.gray, wanted.right(seen).gray, atol=1)


def test_depth_is_taken_before_a_pair_unless_the_pair_is_wanted(tmp_path: Path) -> None:
    path = write_bag(tmp_path, make=lambda w: [*raw_frames(w), *pair_messages(w)])

    with open_bag(path) as bag:
        assert (bag.has_depth, bag.has_stereo) == (True, False)
    with open_bag(path, BagOptions(right=RIGHT)) as bag:
        assert (bag.has_depth, bag.has_stereo, bag.topics["colour"]) == (False, True, LEFT)
    assert open_dataset(path, camera="stereo").sensors == "stereo"
    with pytest.raises(UsageError, match="are not used together"):
        open_bag(path, BagOptions(right=RIGHT, depth=DEPTH))


@pytest.mark.parametrize(
    "names",
    [("/cam0/image_raw", "/cam1/image_raw"), ("/d/infra1/image_rect_raw", "/d/infra2/image_rect_raw"),
     ("/left_arm/left/image", "/left_arm/right/image")],
)  # fmt: skip
def test_names_of_drivers_tell_which_camera_is_the_left_one(tmp_path: Path, names: tuple[str, str]) -> None:
    with open_bag(write_bag(tmp_path, make=lambda w: pair_messages(w, left=names[0], right=names[1]))) as bag:
        assert (bag.topics["colour"], bag.topics["right"]) == names


def test_of_several_pairs_the_user_names_one(tmp_path: Path) -> None:
    others = ("/rear/left/image_rect", "/rear/right/image_rect")
    path = write_bag(
        tmp_path,
        make=lambda w: [*pair_messages(w), *pair_messages(w, left=others[0], right=others[1])],
    )

    with pytest.raises(UsageError, match=r"the bag has no depth; its topics: ") as raised:
        open_bag(path)
    assert "--right TOPIC" in raised.value.hint
    with open_bag(path, BagOptions(right=others[1])) as bag:
        assert bag.topics["colour"] == others[0]
    with pytest.raises(UsageError, match="no pair of cameras, or several"):
        open_bag(path, BagOptions(use_stereo=True))


@pytest.mark.parametrize(
    ("of_right", "says"),
    [
        ({"p": projection(0.0)}, r"right/camera_info states a baseline of 0 \(P\[3\]\), and no tf_static"),
        ({"p": projection(0.0), "frame": "eye"}, "states a baseline of 0"),
        ({"p": projection(FX * BASELINE_M)}, "the cameras are swapped"),
        ({"p": projection(-FX * 120.0)}, "places the right camera 120 m from the left one, above 10 m"),
        ({"p": projection(float("nan"))}, "P of /rig/right/camera_info holds a number that is not finite"),
        ({"p": projection(-1e-6)}, "that is no stereo pair"),
        ({"width": WIDTH // 2}, "/rig/right/image_rect has images of 64x48 px"),
        ({"p": projection(-FX * BASELINE_M) * np.repeat([np.nan, 1, 1], 4)}, "not finite"),
    ],
)  # fmt: skip
def test_cameras_that_make_no_pair_are_refused(tmp_path: Path, of_right: dict[str, Any], says: str) -> None:
    path = write_bag(tmp_path, make=lambda w: pair_messages(w, **of_right))

    with pytest.raises(UsageError, match=says) as raised:
        open_bag(path)
    assert "\n" not in raised.value.message
    assert raised.value.hint


@pytest.mark.parametrize(
    ("of_right", "says"),
    [
        ({"r": np.full(9, 0.5)}, "R of /rig/right/camera_info is no rotation"),
        ({"r": np.full(9, np.nan)}, "R of /rig/right/camera_info is no rotation"),
        ({"distortion": (0.1,) * 8, "model": "rational_polynomial"}, "a lens of 8 distortion numbers"),
        ({"distortion": (0.1,) * 4, "model": "equidistant"}, "a stereo pair needs two cameras of one size"),
    ],
)
def test_raw_cameras_that_make_no_pair_are_refused(
    tmp_path: Path, of_right: dict[str, Any], says: str
) -> None:
    names = {"left": "/rig/left/image_raw", "right": "/rig/right/image_raw"}
    path = write_bag(tmp_path, make=lambda w: pair_messages(w, **names, **of_right))

    with pytest.raises(UsageError, match=says) as raised:
        open_bag(path)
    assert "--intrinsics" in raised.value.hint or "of one size and model" in raised.value.hint


def test_a_right_camera_without_camera_info_is_reported(tmp_path: Path) -> None:
    def silent(_: BagWriter, messages: list[Message]) -> list[Message]:
        return [each for each in messages if each[0] != "/rig/right/camera_info"]

    # Where both images bear one frame, the lens of the left must not become that of the right.
    path = write_bag(tmp_path, make=lambda w: pair_messages(w, frame="eye"), change=silent)

    with pytest.raises(UsageError, match="no camera_info for /rig/right/image_rect") as raised:
        open_bag(path)
    assert "rig.json" in raised.value.hint


@pytest.mark.parametrize("kind", FIRST_KINDS)
def test_broken_images_of_the_right_camera_are_left_out(tmp_path: Path, kind: BagKind) -> None:
    def broken(w: BagWriter, messages: list[Message]) -> list[Message]:
        rows = [row for row, each in enumerate(messages) if each[0] == RIGHT]
        messages[rows[1]] = (*messages[rows[1]][:3], b"\x01")
        small = raw_image(w, stamp_of(3), np.zeros((4, 4), np.uint8), "mono8")
        messages[rows[3]] = (*messages[rows[3]][:3], small)
        return messages

    with open_bag(write_bag(tmp_path, kind, pair_messages, broken)) as bag:
        assert [frame.timestamp_s for frame in bag] == [stamp_of(row) / 1e9 for row in (0, 2, 4)]
        assert bag.log.doubts[0].sentence.startswith("2 broken messages left out")
