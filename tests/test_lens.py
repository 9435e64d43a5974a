"""Lens models: formulas of their papers, inverse of the distortion, refusal of wrong coefficients."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.errors import InvalidCamera
from rse_pf.geometry import LENS_MODELS, Array, Camera, Lens, find_lens_model

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=210.0, fy=211.0, cx=161.0, cy=118.0, width=320, height=240)
COEFFICIENTS = {
    "radial-tangential": (-0.28, 0.07, 2e-4, 2e-5, 0.003),
    "fisheye": (0.03, -0.01, 0.005, -0.001),
}
"""Coefficients of a real lens for each model; a new model needs an entry here and in `project`."""


def project(lens: Lens, rays: Array) -> Array:
    """Return the ``(n, 2)`` pixels of rays ``(x, y, 1)``, ``(n, 2)``, by the formula of the model's paper."""
    x, y = rays.T
    r = np.hypot(x, y)
    if lens.model == "radial-tangential":  # Brown, Decentering Distortion of Lenses, 1966
        k1, k2, p1, p2, k3 = lens.distortion
        radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    elif lens.model == "fisheye":  # Kannala and Brandt, PAMI 2006, eq. 6
        theta = np.arctan(r)
        k1, k2, k3, k4 = lens.distortion
        stretch = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / r
        x, y = x * stretch, y * stretch
    return np.stack([CAMERA.fx * x + CAMERA.cx, CAMERA.fy * y + CAMERA.cy], axis=1)


def lens_of(model: str) -> Lens:
    return Lens(camera=CAMERA, distortion=COEFFICIENTS[model], model=model)


def rays() -> Array:
    """Return directions ``(n, 2)`` in the plane z = 1 that cover the image."""
    return np.random.default_rng(1).uniform(-0.6, 0.6, (50, 2))


@pytest.mark.parametrize("model", LENS_MODELS)
def test_pixels_are_distorted_by_the_formula_of_the_model(model: str) -> None:
    lens = lens_of(model)
    pinhole_pixels = rays() * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    assert np.allclose(lens.distort_pixels(pinhole_pixels), project(lens, rays()), atol=1e-9)


@pytest.mark.parametrize("model", LENS_MODELS)
def test_undistortion_is_the_inverse_of_distortion(model: str) -> None:
    lens = lens_of(model)
    pinhole_pixels = rays() * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    assert np.allclose(lens.undistort_pixels(lens.distort_pixels(pinhole_pixels)), pinhole_pixels, atol=0.05)


@pytest.mark.parametrize("model", LENS_MODELS)
def test_a_pixel_looks_along_the_ray_that_was_projected(model: str) -> None:
    lens = lens_of(model)
    directions = np.column_stack([rays(), np.ones(len(rays()))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.allclose(lens.unit_rays(project(lens, rays())), directions, atol=2e-4)


@pytest.mark.parametrize("model", LENS_MODELS)
def test_maps_say_where_pixels_of_the_pinhole_camera_lie_in_the_image(model: str) -> None:
    lens = lens_of(model)
    map_x, map_y = lens.undistortion_maps(CAMERA)
    rows, columns = np.array([0, 7, 120, 239]), np.array([0, 311, 160, 5])
    expected = lens.distort_pixels(np.stack([columns, rows], axis=1).astype(np.float64))
    assert np.allclose(np.stack([map_x[rows, columns], map_y[rows, columns]], axis=1), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("plumb_bob", "radial-tangential"), ("Brown Conrady", "radial-tangential"),
        ("radtan", "radial-tangential"), ("rational_polynomial", "radial-tangential"),
        ("equidistant", "fisheye"), ("KannalaBrandt8", "fisheye"), ("fisheye", "fisheye"),
    ],
)  # fmt: skip
def test_other_programs_names_of_a_model_are_known(name: str, model: str) -> None:
    found = find_lens_model(name)
    assert found is not None
    assert found.name == model


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("radial-tangential", (0.1,) * 3),
        ("radial-tangential", (0.1,) * 9),
        ("radial-tangential", (0.1, float("nan"), 0.0, 0.0)),
        ("fisheye", (0.1,) * 5),
    ],
)
def test_coefficients_that_do_not_fit_the_model_are_refused(
    model: str, distortion: tuple[float, ...]
) -> None:
    with pytest.raises(InvalidCamera, match=f"{len(distortion)} distortion numbers"):
        Lens(camera=CAMERA, distortion=distortion, model=model)


def test_only_a_perspective_lens_without_distortion_is_a_pinhole() -> None:
    assert Lens(camera=CAMERA).is_pinhole
    assert Lens(camera=CAMERA, distortion=(0.0,) * 5).is_pinhole
    assert not lens_of("radial-tangential").is_pinhole
    assert not Lens(camera=CAMERA, model="fisheye").is_pinhole
