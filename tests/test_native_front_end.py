"""The front end in the native core: the bytes of the numpy and OpenCV path, with any instructions."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk import frontend
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Features, Frame, FrontEndOptions, extract, match
from rse_pf import native
from rse_pf.errors import ConfigurationError
from rse_pf.geometry import Array, Camera
from rse_pf.native_front_end import FrontEndCore, front_end_core, open_front_end
from rse_pf.slam import orb

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

LIBRARY = native.find_library()
needs_library = pytest.mark.skipif(
    front_end_core() is None, reason="the native core is not built: make -C native"
)
CAMERA = Camera(fx=500.0, fy=510.0, cx=31.5, cy=23.25, width=64, height=48)


@pytest.fixture(params=["portable", "avx2", "avx512"])
def core(request: pytest.FixtureRequest) -> FrontEndCore:
    assert LIBRARY is not None
    return open_front_end(LIBRARY, request.param)


def use(monkeypatch: pytest.MonkeyPatch, core: FrontEndCore | None) -> None:
    for module in (frontend, orb):
        monkeypatch.setattr(module, "front_end_core", lambda: core)


def made_features(pixels: Array, descriptors: npt.NDArray[np.uint8], points_camera: Array) -> Features:
    """Return features of which matches look at descriptors, pixels and points only."""
    n = len(pixels)
    return Features(
        pixels=pixels, descriptors=descriptors, points_camera=points_camera, turns=np.zeros((n, 2)),
        sizes=np.ones(n),
    )  # fmt: skip


def features(rng: np.random.Generator, n: int, *, distinct: int, noise: int = 0) -> Features:
    """Return features of which many have equal descriptors, columns and distances."""
    descriptors = np.random.default_rng(3).integers(0, 256, (distinct, 32), dtype=np.uint8)
    descriptors = descriptors[rng.integers(0, distinct, n)]
    for _ in range(noise):
        flipped = np.uint8(1) << rng.integers(0, 8, n).astype(np.uint8)
        descriptors[np.arange(n), rng.integers(0, 32, n)] ^= flipped
    points = rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-6, 4, (n, 1))
    points[rng.random(n) < 0.2, 2] = np.nan
    points[rng.random(n) < 0.05, 2] = np.inf
    pixels = np.round(rng.uniform(0, 640, (n, 2)) * rng.choice([1, 8])) / rng.choice([1, 8, 3])
    return made_features(pixels, descriptors, points)


def pairs() -> Iterator[tuple[Features, Features, FrontEndOptions]]:
    """Yield views of all sizes, from all descriptors alike to all different."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, m = rng.integers(1, 90, 2) if seed % 3 else rng.integers(200, 900, 2)
        distinct = int(rng.choice([1, 3, 20, 700]))
        noise = int(rng.choice([0, 2, 12]))
        options = FrontEndOptions(
            ratio=float(rng.choice([0.5, 0.75, 0.8, 1.0])),
            max_matches=int(rng.choice([12, 40, 700])),
            min_inliers=12,
        )
        yield (
            features(rng, n, distinct=distinct, noise=noise),
            features(rng, m, distinct=distinct, noise=noise),
            options,
        )


def assert_same_bytes(ours: Array, expected: Array) -> None:
    assert ours.dtype == expected.dtype
    assert ours.shape == expected.shape
    assert ours.tobytes() == expected.tobytes()


@needs_library
def test_matches_are_those_of_opencv_to_the_last_bit_among_many_ties(core, monkeypatch):
    counts = []
    for reference, frame, options in pairs():
        use(monkeypatch, core)
        ours = match(reference, frame, options)
        use(monkeypatch, None)
        expected = match(reference, frame, options)

        assert_same_bytes(ours.points_world, expected.points_world)
        assert_same_bytes(ours.pixels, expected.pixels)
        assert_same_bytes(ours.depths_m, expected.depths_m)
        counts.append(len(ours))
    assert min(counts) == 0
    assert max(counts) > 100
    assert {12, 40} <= set(counts)  # cut off at max_matches


@needs_library
@pytest.mark.parametrize("rows", [[0, 255], [255, 0], [255, 255], [0, 0]])
def test_all_bits_and_no_bit_may_differ(core, monkeypatch, rows):
    zeros = made_features(np.ones((1, 2)), np.zeros((1, 32), np.uint8), np.ones((1, 3)))
    frame = made_features(
        np.array([[1.0, 2.0], [3.0, 4.0]]),
        np.repeat(np.uint8(rows)[:, None], 32, axis=1),
        np.ones((2, 3)),
    )
    use(monkeypatch, core)

    found = match(zeros, frame, FrontEndOptions(ratio=1.0))

    # Two at one distance are no clear match.
    assert found.pixels.tolist() == {(0, 255): [[1.0, 2.0]], (255, 0): [[3.0, 4.0]]}.get(tuple(rows), [])


@needs_library
@pytest.mark.parametrize("kind", ["plane", "holes", "edges", "nothing", "strange"])
def test_points_are_those_of_numpy_to_the_last_bit(core, monkeypatch, kind):
    rng = np.random.default_rng(7)
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
    frame = Frame(timestamp_s=0.0, rgb=np.zeros((48, 64, 3), np.uint8), depth_m=depth_m, camera=CAMERA)
    options = FrontEndOptions()

    use(monkeypatch, core)
    ours = frontend.points_at(frame, pixels, options)
    use(monkeypatch, None)
    expected = frontend.points_at(frame, pixels, options)

    assert_same_bytes(ours, expected)
    assert np.isfinite(ours).any() == (kind != "nothing")
    assert np.isnan(ours).any()


def picture(seed: int, height: int, width: int) -> npt.NDArray[np.uint8]:
    """Return blocks and noise, with black and white areas."""
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.integers(-60, 316, (height // 7 + 1, width // 7 + 1)), np.ones((7, 7)))
    noisy = blocks[:height, :width] + rng.normal(size=(height, width)) * rng.choice([0, 3, 40])
    return np.clip(noisy, 0, 255).astype(np.uint8)


def keypoints_of(gray: npt.NDArray[np.uint8], features: int) -> tuple[npt.NDArray[Any], ...]:
    """Return pixels, angles, octaves and descriptors by OpenCV."""
    orb = cv2.ORB_create(nfeatures=features, scaleFactor=1.2, nlevels=8, fastThreshold=10)
    found, descriptors = orb.detectAndCompute(gray, None)
    angles_deg = np.array([each.angle for each in found], np.float32)
    octaves = np.array([each.octave for each in found], np.int32)
    return cv2.KeyPoint_convert(found), angles_deg, octaves, descriptors


def describes() -> FrontEndCore:
    assert LIBRARY is not None
    core = open_front_end(LIBRARY)
    blank = np.zeros((100, 100), np.uint8), np.empty((0, 2), np.float32)
    none = np.empty(0, np.float32), np.empty(0, np.int32)
    if core.describe(*blank, *none, scale=1.2, levels=8) is None:
        pytest.skip("this processor has no AVX2 or no FMA")
    return core


@needs_library
@pytest.mark.parametrize(
    ("height", "width"), [(480, 640), (479, 637), (240, 320), (301, 200), (90, 1000), (101, 110)]
)
def test_descriptors_are_those_of_opencv_to_the_last_bit(height, width):
    core, count = describes(), 0
    for seed in (0, 1, 2, 95, 153):  # in the last two, of 480x640, a product rounded for itself changes a bit
        gray = picture(seed, height, width)
        *keypoints, expected = keypoints_of(gray, 2000)

        assert_same_bytes(core.describe(gray, *keypoints, scale=1.2, levels=8), expected)
        count += len(expected)
    assert count > 50


def detected_by_opencv(gray: npt.NDArray[np.uint8], count: int, threshold: int) -> list[Array]:
    found = cv2.ORB_create(nfeatures=count, scaleFactor=1.2, nlevels=8, fastThreshold=threshold).detect(gray)
    return [
        np.array([each.pt for each in found], np.float32).reshape(-1, 2),
        np.array([each.response for each in found], np.float32),
        np.array([each.angle for each in found], np.float32),
        np.array([each.octave for each in found], np.int32),
    ]


@needs_library
@pytest.mark.parametrize(
    ("height", "width"), [(480, 752), (479, 637), (240, 320), (301, 200), (90, 1000), (101, 110), (62, 62)]
)
@pytest.mark.parametrize(("count", "threshold"), [(3000, 7), (1000, 10), (60, 20), (9000, 0), (500, 255)])
def test_keypoints_are_those_of_opencv_to_the_last_bit_and_in_its_order(height, width, count, threshold):
    core, asked, answered = describes(), 0, 0
    for seed in range(4):
        gray = picture(seed, height, width)

        found = core.detect(gray, count, scale=1.2, levels=8, threshold=threshold)

        asked += 1
        if found is None:  # too many equals, whose order is another one
            continue
        answered += 1
        for ours, expected in zip(found, detected_by_opencv(gray, count, threshold), strict=True):
            assert_same_bytes(ours, expected)
    assert answered >= asked - 1


@needs_library
def test_a_picture_without_corners_and_one_of_one_pattern_are_those_of_opencv_or_left_to_it():
    core = describes()
    tiles = np.tile(np.kron([[0, 255], [255, 0]], np.ones((9, 9))), (20, 30)).astype(np.uint8)
    for gray, count in [(np.full((300, 400), 90, np.uint8), 500), (tiles, 50), (tiles, 5000)]:
        found = core.detect(gray, count, scale=1.2, levels=8, threshold=7)
        expected = detected_by_opencv(gray, count, 7)
        assert found is None or [each.tobytes() for each in found] == [each.tobytes() for each in expected]
        assert found is not None or len(expected[1]) > 2 * count


@needs_library
def test_what_no_detector_can_do_is_refused():
    core, gray = describes(), picture(1, 240, 320)

    def detected(image=gray, count=100, scale=1.2, levels=8, threshold=7):
        return core.detect(image, count, scale=scale, levels=levels, threshold=threshold)

    assert detected() is not None
    assert len(detected(count=0).pixels) == 0
    for bad in (
        {"image": gray.astype(np.float32)}, {"image": gray[0]}, {"image": np.zeros((1, 9), np.uint8)},
        {"count": -1}, {"count": 2**40}, {"scale": 0.5}, {"scale": np.nan}, {"scale": 1e5}, {"levels": 0},
        {"levels": 33}, {"threshold": -1}, {"threshold": 256},
    ):  # fmt: skip
        assert detected(**bad) is None, bad


@needs_library
def test_a_core_that_detects_otherwise_than_opencv_is_not_asked(monkeypatch):
    core, gray = describes(), picture(2, 240, 320)
    rgb = np.repeat(gray[..., None], 3, axis=2)
    use(monkeypatch, None)
    expected = orb.describe_orb(rgb, 300)
    use(monkeypatch, core)
    right, asked = core.detect, []

    def wrong(*arguments, **options):
        asked.append(arguments)
        found = right(*arguments, **options)
        return found._replace(angles_deg=np.nextafter(found.angles_deg, np.float32(0)))

    monkeypatch.setattr(core, "detect", wrong)
    found = orb.describe_orb(rgb, 300)

    assert len(asked) == 1  # for the comparison, and never again
    assert_same_bytes(found.turns, expected.turns)
    assert_same_bytes(found.descriptors, expected.descriptors)


@needs_library
def test_keypoints_that_opencv_would_not_find_are_not_described():
    core, gray = describes(), picture(1, 240, 320)
    good = np.float32([[160, 120]]), np.float32([30]), np.int32([0])

    def described(pixels=good[0], angles_deg=good[1], octaves=good[2], levels=8, image=gray, scale=1.2):
        return core.describe(image, pixels, angles_deg, octaves, scale=scale, levels=levels)

    assert described() is not None
    for x, y in [(22, 22), (297, 217)]:
        assert described(np.float32([[x, y]])) is not None
    for x, y in [
        (21, 99),
        (99, 21),
        (298, 99),
        (99, 218),
        (-1e9, 99),
        (np.nan, 99),
        (99, np.inf),
        (1e30, 99),
    ]:
        assert described(np.float32([[x, y]])) is None
    assert described(octaves=np.int32([8])) is None
    assert described(octaves=np.int32([-1])) is None
    assert described(angles_deg=np.float32([np.nan])) is None
    assert described(octaves=np.int32([40]), levels=41) is None
    assert described(octaves=np.int32([1]), scale=0.5) is None
    assert described(octaves=np.int32([1]), scale=np.nan) is None
    assert described(octaves=np.int32([7]), scale=1000.0) is None
    assert described(octaves=np.int32([1]), levels=32, scale=1e30) is None
    assert described(angles_deg=np.float32([np.inf])) is None
    assert described(angles_deg=np.float32([1, 2])) is None
    assert described(pixels=np.float64([[160, 120]])) is None
    assert described(image=np.zeros((1, 1), np.uint8)) is None


@needs_library
def test_a_core_that_describes_otherwise_than_opencv_is_not_asked(monkeypatch):
    core = describes()
    camera = Camera(fx=300, fy=300, cx=160, cy=120, width=320, height=240)
    rgb = np.repeat(picture(2, 240, 320)[..., None], 3, axis=2)
    frame = Frame(timestamp_s=0.0, rgb=rgb, depth_m=np.ones((240, 320), np.float32), camera=camera)
    use(monkeypatch, core)
    right = core.describe
    asked = []

    def wrong(*arguments, **options):
        asked.append(arguments)
        return right(*arguments, **options) ^ 1

    monkeypatch.setattr(core, "describe", wrong)
    found = extract(frame, FrontEndOptions())
    use(monkeypatch, None)
    expected = extract(frame, FrontEndOptions())

    assert len(asked) == 1  # for the comparison, and never again
    assert len(expected.descriptors) > 20
    assert_same_bytes(found.descriptors, expected.descriptors)


@needs_library
def test_arrays_of_other_kinds_are_left_to_opencv(core):
    rng = np.random.default_rng(1)
    view = features(rng, 9, distinct=9)
    give = {"ratio": 0.75, "max_matches": 9}

    def matches(*arrays):
        return core.matches(*arrays, **give)

    good = (view.descriptors, view.points_camera, view.descriptors, view.pixels, view.points_camera)
    assert matches(*good) is not None
    wide = np.zeros((9, 64), np.uint8)
    for place, bad in [
        (0, wide), (2, wide), (0, view.descriptors.astype(np.float32)), (1, view.points_camera[:8]),
        (1, view.points_camera.astype(np.float32)), (3, view.pixels[:8]), (3, view.pixels[:, :1]),
        (4, view.points_camera[:8]), (4, view.pixels),
    ]:  # fmt: skip
        assert matches(*good[:place], bad, *good[place + 1 :]) is None
    limits = {"min_depth_m": 0.3, "max_depth_m": 6.0, "spread": 0.05}
    assert core.points_at(np.ones((48, 64)), view.pixels, CAMERA, **limits) is None
    assert core.points_at(np.ones((48, 64), np.float32), view.points_camera, CAMERA, **limits) is None


@needs_library
def test_arrays_need_not_be_contiguous(core, monkeypatch):
    reference, frame, options = next(pairs())
    spread = made_features(
        np.repeat(frame.pixels, 2, axis=0)[::2],
        np.asfortranarray(frame.descriptors),
        frame.points_camera[::-1][::-1],
    )
    use(monkeypatch, core)

    ours, expected = match(reference, spread, options), match(reference, frame, options)

    assert_same_bytes(ours.points_world, expected.points_world)
    assert_same_bytes(ours.pixels, expected.pixels)


@needs_library
@pytest.mark.data
@pytest.mark.parametrize("name", ["7scenes_redkitchen", "nyu_dining_room", "tum_fr1_xyz_start"])
def test_the_front_end_of_a_recording_is_the_same_without_the_library(core, monkeypatch, recordings, name):
    if not (recordings / name).exists():
        pytest.skip(f"no recording {name}")
    dataset = open_dataset(recordings / name)
    options = FrontEndOptions.wide_baseline() if name.startswith("nyu") else FrontEndOptions()
    found = []
    for each in (core, None):
        use(monkeypatch, each)
        first, second = (extract(dataset.read(row), options) for row in (0, 1))
        matches = match(first, second, options)
        found.append(
            (first.pixels, first.points_camera, matches.points_world, matches.pixels, matches.depths_m)
        )

    for ours, expected in zip(*found, strict=True):
        assert_same_bytes(ours, expected)


def test_a_missing_library_and_one_without_a_front_end_are_done_without(monkeypatch, tmp_path):
    other = tmp_path / "other.so"
    if shutil.which("gcc") is None:
        other.write_bytes(b"no library")
    else:
        empty = tmp_path / "other.c"
        empty.write_text("int other;\n")
        subprocess.run(["gcc", "-shared", "-o", str(other), str(empty)], check=True)
    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        open_front_end(other)
    for path in (None, other, Path(tmp_path / "missing.so")):
        monkeypatch.setattr(native, "find_library", lambda path=path: path)
        front_end_core.cache_clear()
        assert front_end_core() is None
    front_end_core.cache_clear()
