"""Rectified pairs, against points that are projected by the formulas of the lenses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from client_sdk.cameras import Intrinsics, RigCamera
from client_sdk.rigs.rectification import Rectification
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=210.0, fy=211.0, cx=161.0, cy=118.0, width=320, height=240)
LENSES = {
    "radial-tangential": Intrinsics(camera=CAMERA, distortion=(-0.28, 0.07, 2e-4, 2e-5)),
    "fisheye": Intrinsics(camera=CAMERA, distortion=(0.03, -0.01, 0.005, -0.001), model="fisheye"),
    "plain": Intrinsics(camera=CAMERA),
}
T_LEFT_RIGHT = exp_se3(np.array([0.11, 0.002, -0.001, 0.01, -0.02, 0.015]))
T_BODY_LEFT = exp_se3(np.array([0.1, 0.2, -0.1, 0.5, -1.0, 0.3]))


def distorted(lens: Intrinsics, points: Array) -> Array:
    """Return the pixels of ``(n, 3)`` points of the camera, by the formulas of its lens."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k = np.array([*lens.distortion, 0.0, 0.0, 0.0, 0.0][:4])
    if lens.model == "fisheye":
        r = np.hypot(x, y)
        theta = np.arctan(r)
        stretch = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8) / r
        x, y = x * stretch, y * stretch
    else:
        r2 = x**2 + y**2
        radial = 1 + k[0] * r2 + k[1] * r2**2
        x, y = (
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2),
            y * radial + k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y,
        )
    camera = lens.camera
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)


def spots(pixels: Array) -> Any:
    """Return a grey image with a smooth spot at each pixel."""
    v, u = np.mgrid[:240, :320]
    image = np.zeros((240, 320))
    for x, y in pixels:
        image = np.maximum(image, 250 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 8.0))
    return image.astype(np.uint8)


def centre(image: Any, near: Array) -> Array:
    """Return the centre of the spot near a pixel."""
    u0, v0 = np.rint(near).astype(int)
    window = image[v0 - 8 : v0 + 9, u0 - 8 : u0 + 9].astype(float)
    v, u = np.mgrid[v0 - 8 : v0 + 9, u0 - 8 : u0 + 9]
    return np.array([(u * window).sum(), (v * window).sum()]) / window.sum()


@pytest.mark.parametrize("model", list(LENSES))
def test_a_point_is_seen_on_one_row_at_the_disparity_of_its_depth(model: str) -> None:
    lens = LENSES[model]
    left = RigCamera(name="left", lens=lens, T_body_camera=T_BODY_LEFT)
    right = RigCamera(name="right", lens=lens, T_body_camera=T_BODY_LEFT @ T_LEFT_RIGHT)
    rectify = Rectification(left, right)
    # Points of the rectified left camera, by its pose in the body: this is what truth is expressed in.
    points = np.array([[x, y, z] for x, y in ((-0.3, -0.2), (0.35, 0.2), (0.05, 0.0)) for z in (1.0, 3.0)])
    T_left_rectified = inverse(T_BODY_LEFT) @ rectify.T_body_camera
    assert rectify.baseline_m == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), rel=1e-9)
    for point in points * [[1.0, 1.0, 1.0]]:
        in_left = transform(T_left_rectified, point[None] * [[point[2], point[2], 1.0]])
        in_right = transform(inverse(T_LEFT_RIGHT), in_left)
        rgb = np.repeat(spots(distorted(lens, in_left))[:, :, None], 3, axis=2)
        pair = rectify.right(spots(distorted(lens, in_right)))
        expected = rectify.camera.project(point[None] * [[point[2], point[2], 1.0]])[0]
        shift = rectify.camera.fx * pair.baseline_m / point[2]

        np.testing.assert_allclose(centre(rectify.left(rgb)[:, :, 0], expected), expected, atol=0.25)
        there = expected - [shift, 0.0]
        np.testing.assert_allclose(centre(pair.gray, there), there, atol=0.25)


def test_a_pair_that_is_rectified_is_left_as_it_is() -> None:
    lens = LENSES["plain"]
    T_right = np.eye(4)
    T_right[0, 3] = 0.5
    rectify = Rectification(
        RigCamera(name="left", lens=lens, T_body_camera=np.eye(4)),
        RigCamera(name="right", lens=lens, T_body_camera=T_right),
    )
    image = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)

    assert (rectify.camera, rectify.baseline_m) == (CAMERA, 0.5)
    assert rectify.right(image).gray is image


def moved(x: float, y: float, z: float) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


@pytest.mark.parametrize(
    ("pose", "says"),
    [
        (moved(-0.11, 0.0, 0.0), "the cameras are swapped"),
        (moved(0.0, 0.11, 0.0), "is not beside"),
        (moved(0.0, 0.0, 0.0), "no stereo pair"),
        (moved(0.00011, 0.0, 0.0), "no stereo pair"),
    ],
)
def test_cameras_that_are_no_pair_are_one_line(pose: Array, says: str) -> None:
    with pytest.raises(UsageError, match=says) as told:
        Rectification(
            RigCamera(name="left", lens=LENSES["plain"], T_body_camera=np.eye(4)),
            RigCamera(name="right", lens=LENSES["plain"], T_body_camera=pose),
        )
    assert told.value.hint


def test_a_baseline_in_millimetres_is_no_pose() -> None:
    with pytest.raises(UsageError, match="no rigid motion within 10 m"):
        RigCamera(name="right", lens=LENSES["plain"], T_body_camera=moved(110.0, 0.0, 0.0))
