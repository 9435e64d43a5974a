"""ORB features of the native core are those of OpenCV to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.datasets import open_dataset
from rse_pf.slam.orb import Keypoints, describe_keypoints, describe_orb, detect_keypoints

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

SIZES = [(480, 752), (479, 637), (240, 320), (301, 200), (90, 1000), (101, 110), (62, 62)]
Gray = npt.NDArray[np.uint8]


def picture(seed: int, height: int, width: int) -> Gray:
    """Return blocks and noise, with black and white areas."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.integers(-60, 316, (height // 7 + 1, width // 7 + 1)), np.ones((7, 7)))
    noisy = blocks[:height, :width] + rng.normal(size=(height, width)) * rng.choice([0, 3, 40])
    return np.clip(noisy, 0, 255).astype(np.uint8)


def by_opencv(gray: Gray, count: int, threshold: int) -> tuple[Keypoints, Any]:
    orb = cv2.ORB_create(nfeatures=count, scaleFactor=1.2, nlevels=8, fastThreshold=threshold)
    found, descriptors = orb.detectAndCompute(gray, None)
    keypoints = Keypoints(
        np.array([each.pt for each in found], np.float32).reshape(-1, 2),
        np.array([each.response for each in found], np.float32),
        np.array([each.angle for each in found], np.float32),
        np.array([each.octave for each in found], np.int32),
    )
    return keypoints, descriptors


def assert_equal_bytes(ours: Keypoints, expected: Keypoints) -> None:
    assert [each.dtype for each in ours] == [each.dtype for each in expected]
    assert [each.tobytes() for each in ours] == [each.tobytes() for each in expected]


@pytest.fixture(autouse=True)
def needs_avx2() -> None:
    if detect_keypoints(np.zeros((9, 9), np.uint8), 1, 7) is None:
        pytest.skip("this processor has no AVX2: OpenCV finds the features")


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize(("count", "threshold"), [(3000, 7), (1000, 10), (60, 20), (9000, 0), (500, 255)])
def test_keypoints_are_those_of_opencv_in_its_order(
    height: int, width: int, count: int, threshold: int
) -> None:
    left_to_opencv = 0
    for seed in range(4):
        gray = picture(seed, height, width)

        found = detect_keypoints(gray, count, threshold)

        if found is None:  # too many equals, whose order is another one
            left_to_opencv += 1
            continue
        assert_equal_bytes(found, by_opencv(gray, count, threshold)[0])
    assert left_to_opencv <= 1


@pytest.mark.parametrize(("height", "width"), SIZES[1:-1])
def test_descriptors_are_those_of_opencv(height: int, width: int) -> None:
    described = 0
    for seed in (0, 1, 2, 95, 153):  # in the last two, of 480x640, a product rounded for itself changes a bit
        gray = picture(seed, height, width)
        keypoints, expected = by_opencv(gray, 2000, 10)

        descriptors = describe_keypoints(gray, keypoints)

        assert descriptors is not None
        assert descriptors.tobytes() == expected.tobytes()
        described += len(expected)
    assert described > 50


def test_a_picture_without_corners_and_one_of_one_pattern_are_those_of_opencv_or_left_to_it() -> None:
    tiles = np.tile(np.kron([[0, 255], [255, 0]], np.ones((9, 9))), (20, 30)).astype(np.uint8)
    for gray, count in [(np.full((300, 400), 90, np.uint8), 500), (tiles, 50), (tiles, 5000)]:
        found, (expected, _) = detect_keypoints(gray, count, 7), by_opencv(gray, count, 7)
        if found is None:
            assert len(expected.pixels) > 2 * count
            assert len(describe_orb(np.repeat(gray[..., None], 3, axis=2), count, is_spread=False).pixels)
        else:
            assert_equal_bytes(found, expected)


@pytest.mark.parametrize(
    ("x", "y"),
    [(21, 99), (99, 21), (298, 99), (99, 218), (-1e9, 99), (np.nan, 99), (99, np.inf), (1e30, 99)],
)
def test_keypoints_too_near_to_the_edge_are_not_described(x: float, y: float) -> None:
    gray = picture(1, 240, 320)
    inside = Keypoints(np.float32([[160, 120]]), np.float32([1]), np.float32([30]), np.int32([0]))
    assert describe_keypoints(gray, inside) is not None

    assert describe_keypoints(gray, inside._replace(pixels=np.float32([[x, y]]))) is None
    for bad in (
        {"octaves": np.int32([8])}, {"octaves": np.int32([-1])}, {"angles_deg": np.float32([np.nan])},
        {"angles_deg": np.float32([np.inf])},
    ):  # fmt: skip
        assert describe_keypoints(gray, inside._replace(**bad)) is None
    assert describe_keypoints(np.zeros((1, 1), np.uint8), inside) is None


@pytest.mark.parametrize(("height", "width"), [(480, 640), (240, 320), (300, 417)])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_features_of_a_mirrored_image_are_at_the_mirrored_pixels(
    height: int, width: int, axis: int
) -> None:
    rgb = np.repeat(picture(3, height, width)[..., None], 3, axis=2)
    found = describe_orb(rgb, 2000, is_spread=False)

    mirrored = describe_orb(np.flip(rgb, axis), 2000, is_spread=False)

    expected = mirrored.pixels.copy()
    expected[:, 1 - axis] = (height, width)[axis] - 1 - expected[:, 1 - axis]
    for size in np.unique(found.sizes):
        ours, theirs = found.pixels[found.sizes == size], expected[mirrored.sizes == size]
        offsets = ours[:, None] - theirs
        nearest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
        offset = offsets[np.arange(len(ours)), nearest, 1 - axis]
        assert len(ours) > 10
        assert abs(float(np.median(offset))) < 0.05


@pytest.mark.data
@pytest.mark.parametrize("name", ["7scenes_redkitchen", "nyu_dining_room", "tum_fr1_xyz_start"])
def test_the_features_of_a_recording_are_those_of_opencv(recordings: Path, name: str) -> None:
    if not (recordings / name).exists():
        pytest.skip(f"no recording {name}")
    gray = cv2.cvtColor(open_dataset(recordings / name).read(0).rgb, cv2.COLOR_RGB2GRAY)
    expected, descriptors = by_opencv(gray, 3000, 10)

    found = detect_keypoints(gray, 3000, 10)

    assert found is not None
    assert_equal_bytes(found, expected)
    assert np.array_equal(describe_keypoints(gray, found), descriptors)
