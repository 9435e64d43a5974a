"""Disparities of a stereo pair agree with their definition, and with the truth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.simulator import SIMULATED_CAMERA, make_world, true_trajectory
from client_sdk.simulator.renderer import Renderer, add_image_noise
from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.pnp import DepthNoise
from rse_pf.slam.stereo import StereoOptions, disparities, stereo_noise
from tests.oracles import disparities as oracle

Gray = npt.NDArray[np.uint8]
BASELINE_M = 0.12
F_BASELINE = SIMULATED_CAMERA.fx * BASELINE_M


@pytest.fixture(scope="module")
def pair() -> tuple[Gray, Gray, Array]:
    """A rendered pair, and the true disparities of the left image, 0 where there is no depth."""
    painter, right, rng = Renderer(make_world(3), SIMULATED_CAMERA), np.eye(4), np.random.default_rng(4)
    right[0, 3] = BASELINE_M
    pose = true_trajectory(0, 1, 3, 3).T_world_camera[2]
    colour, depth_m, _ = painter.draw(pose)
    images = [add_image_noise(each, rng)[..., 1] for each in (colour, painter.draw(pose @ right)[0])]
    with np.errstate(divide="ignore"):
        true = np.where(depth_m > 0.0, F_BASELINE / depth_m, 0.0)
    return np.ascontiguousarray(images[0]), np.ascontiguousarray(images[1]), true.astype(np.float64)


def textured(gray: Gray, count: int, seed: int = 1) -> Array:
    """Return whole pixels where the picture changes most within a row, one of each of *count* places."""
    rng = np.random.default_rng(seed)
    slope = np.abs(np.diff(gray.astype(int), axis=1))
    rows, columns = np.nonzero(slope > np.percentile(slope, 90))
    chosen = rng.choice(len(rows), count, replace=False)
    return np.column_stack([columns[chosen], rows[chosen]]).astype(np.float64)


def errors(found: Array, true: Array, pixels: Array) -> Array:
    """Return the errors of the disparities that were found."""
    rows = np.flatnonzero(np.isfinite(found))
    columns, lines = pixels[rows].astype(int).T
    return np.asarray(found[rows] - true[lines, columns])


def test_disparities_are_right_to_a_tenth_of_a_pixel(pair: tuple[Gray, Gray, Array]) -> None:
    left, right, true = pair
    pixels = textured(left, 1000)

    wrong = errors(disparities(left, right, pixels), true, pixels)

    assert len(wrong) > 500
    assert abs(float(np.median(wrong))) < 0.03
    assert 1.4826 * float(np.median(np.abs(wrong))) < 0.1
    assert float((np.abs(wrong) > 1.0).mean()) < 0.03


@pytest.mark.parametrize("most", [16, 64, 200])
def test_disparities_are_those_of_the_definition(pair: tuple[Gray, Gray, Array], most: int) -> None:
    left, right, _ = pair
    pixels = np.concatenate([textured(left, 400), np.random.default_rng(2).uniform(-20, 660, (400, 2))])
    options = StereoOptions(max_disparity_px=most)

    found = disparities(left, right, pixels, options)

    assert np.isfinite(found).any()
    np.testing.assert_allclose(
        found, oracle.disparities(left, right, pixels, options), atol=1e-9, equal_nan=True
    )


@pytest.mark.parametrize("most", [16, 64, 1024])
def test_the_processor_changes_no_byte_of_a_disparity(pair: tuple[Gray, Gray, Array], most: int) -> None:
    """The darkest and brightest patches have the largest sums."""
    left, right, _ = pair
    rng = np.random.default_rng(3)
    harsh = (255 * (rng.uniform(size=left.shape) < 0.995)).astype(np.uint8)
    pixels = np.concatenate([textured(left, 400), rng.uniform(-20, 660, (400, 2))])
    options = StereoOptions(max_disparity_px=most)

    for one, other in ((left, right), (harsh, np.roll(harsh, -7, axis=1))):
        found = disparities(one, other, pixels, options)

        assert np.isfinite(found).any()
        assert found.tobytes() == disparities(one, other, pixels, options, portable=True).tobytes()


@pytest.mark.parametrize("fraction", np.linspace(0.0, 0.875, 8).tolist())
def test_no_fraction_of_a_pixel_is_preferred(fraction: float) -> None:
    rng = np.random.default_rng(5)
    spectrum = np.fft.rfft(rng.normal(size=(60, 512)), axis=1)
    spectrum[:, 100:] = 0.0
    shift = np.exp(2j * np.pi * np.fft.rfftfreq(512) * (10.0 + fraction))
    images = [np.fft.irfft(each, axis=1) * 60.0 + 128.0 for each in (spectrum, spectrum * shift)]
    left, right = (np.clip(np.rint(each), 0, 255).astype(np.uint8) for each in images)
    pixels = rng.uniform((80, 10), (430, 50), (300, 2))

    found = disparities(left, right, pixels, StereoOptions(max_disparity_px=40))

    assert np.isfinite(found).mean() > 0.95
    assert abs(float(np.nanmedian(found)) - 10.0 - fraction) < 0.03


def test_what_the_right_camera_does_not_see_has_no_disparity() -> None:
    """A place hidden from the right camera looks like another one that it sees, whose disparity is 5."""
    rng = np.random.default_rng(6)
    left = np.kron(rng.integers(0, 256, (30, 240)), np.ones((2, 2))).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    left[:, 200:240] = left[:, 160:200]
    right[:, 195:235] = rng.integers(0, 256, (60, 40))
    hidden = np.array([[u, v] for u in range(208, 232) for v in range(10, 50, 5)], dtype=np.float64)
    unchecked = StereoOptions(max_disparity_px=80, left_right_px=-1)

    found = disparities(left, right, hidden, StereoOptions(max_disparity_px=80))

    assert np.isfinite(disparities(left, right, hidden, unchecked)).mean() > 0.9
    assert not np.isfinite(found).any()
    seen = disparities(left, right, hidden - (40, 0), StereoOptions(max_disparity_px=80))
    np.testing.assert_allclose(seen, 5.0, atol=0.05)


def test_a_repeated_pattern_and_a_plain_wall_have_no_disparity() -> None:
    stripes = np.tile(np.repeat(np.array([40, 200], dtype=np.uint8), 6), (60, 40))
    plain = np.full((60, 480), 90, dtype=np.uint8)
    pixels = np.random.default_rng(7).uniform((100, 8), (400, 52), (200, 2))

    for image in (stripes, plain):
        assert not np.isfinite(disparities(image, image, pixels)).any()


def test_a_pair_whose_images_are_swapped_has_no_disparities_to_speak_of(
    pair: tuple[Gray, Gray, Array],
) -> None:
    left, right, _ = pair
    pixels = textured(left, 500)

    right_way = np.isfinite(disparities(left, right, pixels)).mean()

    assert right_way > 0.5
    assert np.isfinite(disparities(right, left, pixels)).mean() < 0.2 * right_way


@pytest.mark.parametrize(
    "options",
    [
        {"min_disparity_px": 0.0}, {"max_disparity_px": 1025}, {"min_likeness": float("nan")},
        {"uniqueness": 1.5}, {"min_disparity_px": 200.0},
    ],
)  # fmt: skip
def test_options_that_mean_nothing_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(BadRequest, match="cannot be used"):
        StereoOptions(**options)  # type: ignore[arg-type]


def test_images_of_two_sizes_are_refused() -> None:
    with pytest.raises(BadRequest, match="do not fit"):
        disparities(np.zeros((9, 9), np.uint8), np.zeros((9, 8), np.uint8), np.zeros((1, 2)))


def test_the_noise_of_a_depth_is_that_of_its_disparity() -> None:
    noise, z = stereo_noise(48.0, 0.2), np.array([0.5, 5.0, 40.0])

    apart = 48.0 / (48.0 / z - 0.1) - 48.0 / (48.0 / z + 0.1)

    np.testing.assert_allclose(np.sqrt(noise.variance_m2(z)), apart, rtol=0.02)
    assert noise != DepthNoise()
