"""Features and their points, on pictures whose depth is known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.frontend import Frame, FrontEndOptions, describe, extract, points_at
from client_sdk.tracking.pose_queries import round_for_wire
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera
from rse_pf.pnp import PnpOptions
from rse_pf.services.pnp import make_request
from rse_pf.slam.descriptors import distances_of_pairs, match_all
from rse_pf.slam.orb import describe_at
from rse_pf.wire import Command, make_codec
from tests.oracles import depths

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

RECORDED = Path(__file__).parents[3] / "shared" / "data"
CAMERA = Camera(fx=500.0, fy=500.0, cx=159.5, cy=119.5, width=320, height=240)
OPTIONS = FrontEndOptions()
_rng = np.random.default_rng(5)
WALL = np.kron(_rng.integers(0, 256, (60, 120)), np.ones((8, 8))).astype(np.uint8)
PX_M = 2.0 / 500.0
"""Width of a pixel on the wall 2 m away; on the shelf 1 m away it is half of that."""


def wall_frame(shift_px: int, timestamp_s: float = 0.0) -> Frame:
    """Return the view of a wall (upper half) and a nearer shelf after moving *shift_px* to the right."""
    wall = WALL[100:220, 100 + shift_px : 420 + shift_px]
    shelf = WALL[300:420, 100 + 2 * shift_px : 420 + 2 * shift_px]
    rgb = np.repeat(np.vstack((wall, shelf))[..., None], 3, axis=2)
    depth_m = np.repeat(np.float32([2.0, 1.0]), 120)[:, None] * np.ones(320, np.float32)
    return Frame(timestamp_s=timestamp_s, rgb=rgb, depth_m=depth_m, camera=CAMERA)


def test_matches_of_a_known_motion_agree_with_it():
    before, after = extract(wall_frame(0), OPTIONS), extract(wall_frame(16), OPTIONS)

    rows, columns = match_all(before.descriptors, after.descriptors)

    known = np.isfinite(before.points_camera[rows, 2])
    rows, columns = rows[known], columns[known]
    expected = CAMERA.project(before.points_camera[rows] - (16 * PX_M, 0.0, 0.0))
    errors = np.linalg.norm(expected - after.pixels[columns], axis=1)
    assert len(rows) > 150
    assert np.mean(errors < 3.0) > 0.85
    assert np.median(errors) < 1.0


def test_points_are_where_the_depth_says():
    features = extract(wall_frame(0), OPTIONS)

    known = np.isfinite(features.points_camera[:, 2])
    np.testing.assert_array_equal(
        features.points_camera[known, 2], np.where(features.pixels[known, 1] < 119.5, 2.0, 1.0)
    )
    np.testing.assert_allclose(CAMERA.project(features.points_camera[known]), features.pixels[known])


@pytest.mark.parametrize(
    ("patch", "expected"),
    [
        ([[2, 2, 2], [2, 2, 2], [2, 2, 2]], 2.0),
        ([[0, 0, 0], [0, 2, 2], [2, 2, 2.05]], 2.0),  # five readings
        ([[0, 0, 0], [0, 0, 2], [2, 2, 2]], np.nan),  # four
        ([[2, 2, 2], [2, 2, 2], [2, 2, 2.2]], np.nan),  # spread over 5 %
        ([[0, 0, 0], [0, 0, 0], [0, 0, 0]], np.nan),
        ([[7, 7, 7], [7, 7, 7], [7, 7, 7]], np.nan),  # beyond 6 m
        ([[0.2, 0.2, 0.2], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]], np.nan),  # nearer than 0.3 m
    ],
)
def test_a_depth_is_used_only_on_a_surface(patch: list[list[float]], expected: float):
    frame = wall_frame(0)
    frame.depth_m[:] = np.tile(np.array(patch, np.float32), (80, 107))[:, :320]

    points = extract(frame, OPTIONS).points_camera

    found = points[:, 2]  # a 3x3 window of a tiling holds the same nine numbers everywhere
    np.testing.assert_allclose(found, np.full(len(found), expected), rtol=0.03)


@pytest.mark.parametrize("kind", ["plane", "holes", "edges", "nothing", "strange"])
def test_points_are_those_of_the_definition_to_the_last_bit(kind: str):
    rng = np.random.default_rng(7)
    camera = Camera(fx=500.0, fy=510.0, cx=31.5, cy=23.25, width=64, height=48)
    depth_m = rng.uniform(1.9, 2.1, (48, 64)).astype(np.float32)
    if kind == "holes":
        depth_m[rng.random(depth_m.shape) < 0.4] = 0.0
    elif kind == "edges":
        depth_m *= rng.choice([1.0, 1.02, 4.0], (48, 1)).astype(np.float32)
    elif kind == "nothing":
        depth_m[:] = 0.0
    elif kind == "strange":
        strange = np.float32([np.nan, np.inf, -np.inf, -2.0, -0.0, 1e-45, 3e38, 2.0])
        depth_m = strange[rng.choice(8, (48, 64), p=[0.06] * 7 + [0.58])]
    beyond = [[-5.0, 3.0], [0.5, 0.5], [1.5, 1.5], [62.5, 46.5], [62.4, 46.4], [1e9, 2.0], [64.0, 48.0]]
    pixels = np.vstack((rng.uniform(-1, 65, (500, 2)), np.round(rng.uniform(0, 64, (99, 2))) - 0.5, beyond))
    frame = Frame(timestamp_s=0.0, rgb=np.zeros((48, 64, 3), np.uint8), depth_m=depth_m, camera=camera)

    found = points_at(frame, pixels, OPTIONS)

    assert found.tobytes() == depths.points_at(depth_m, pixels, camera, 0.3, 6.0, 0.05).tobytes()
    assert np.isfinite(found).any() == (kind != "nothing")
    assert np.isnan(found).any()


def test_numbers_are_rounded_for_the_wire():
    points, pixels = round_for_wire(np.array([[1.23456, -0.00004, 2.0]]), np.array([[10.126, 5.0]]))
    assert points.tolist() == [[1.2346, -0.0, 2.0]]
    assert pixels.tolist() == [[10.13, 5.0]]


def test_options_that_cannot_work_and_frames_that_do_not_fit_are_refused():
    for bad in ({"min_inliers": 3}, {"inlier_px": 0.0}, {"max_matches": 5}, {"max_depth_m": 0.1}):
        with pytest.raises(UsageError):
            FrontEndOptions(**bad)
    with pytest.raises(UsageError, match="do not fit"):
        Frame(
            timestamp_s=0.0,
            rgb=np.zeros((4, 4, 3), np.uint8),
            depth_m=np.zeros((4, 4), np.float32),
            camera=CAMERA,
        )


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
@pytest.mark.parametrize(
    "preset", [FrontEndOptions(), FrontEndOptions.wide_baseline()], ids=["default", "wide"]
)
def test_a_command_with_all_matches_is_below_10_kb(codec: str, preset: FrontEndOptions):
    options = preset.sent_with(codec)
    n = options.max_matches
    rng = np.random.default_rng(5)
    # Random digits, of which only the columns ascend; a sign or three digits wherever there can be.
    camera = Camera(fx=525.25, fy=525.25, cx=719.75, cy=539.75, width=1440, height=1080)
    pixels = np.column_stack([np.sort(rng.uniform(100.0, 700.0, n)), rng.uniform(100.0, 530.0, n)])
    depth_m = rng.uniform(3.0, options.max_depth_m, n)
    request = make_request(
        camera.back_project(pixels, depth_m), pixels, camera,
        PnpOptions(inlier_px=options.inlier_px, max_iterations=options.max_iterations),
        depths_m=depth_m + rng.normal(size=n) * 0.01, binary=codec == "bin",
    )  # fmt: skip
    command = Command(id=10**6, service="pnp", payload=request, stream="pose", keep=True, trace="f" * 32)

    assert len(make_codec(codec).encode(command)) < 10_000


def test_an_unknown_codec_is_refused():
    with pytest.raises(UsageError, match="no codec named 'xml'"):
        FrontEndOptions().sent_with("xml")


def test_pixels_are_described_as_the_features_that_were_found_there():
    rgb = wall_frame(0).rgb
    found = describe(rgb, 300)

    rows, descriptors = describe_at(rgb, found.pixels, found.orientations, found.sizes)

    assert len(rows) > 200
    assert np.median(distances_of_pairs(descriptors, found.descriptors[rows])) <= 2  # angles are rounded
    at_the_edge = describe_at(rgb, np.array([[2.0, 2.0]]), np.array([[1.0, 0.0]]), np.ones(1))
    assert [len(part) for part in at_the_edge] == [0, 0]
