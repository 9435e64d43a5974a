"""The example of learned features: its weights, and that it finds the same points in a warped image."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.plugins import FeaturesFunction, FeaturesPlugin
from rse_pf.slam.descriptors import match_all

FOLDER = Path(__file__).parents[2] / "examples" / "features"


@pytest.fixture(scope="module")
def xfeat() -> FeaturesFunction:
    pytest.importorskip("cv2", reason="needs the extra 'vision'")
    pytest.importorskip("onnxruntime", reason="needs the extra 'xfeat'")
    spec = importlib.util.spec_from_file_location("xfeat_example", FOLDER / "xfeat.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function: FeaturesFunction = module.xfeat
    return function


def picture(height: int, width: int, seed: int = 3) -> npt.NDArray[np.uint8]:
    """Return an image of overlapping boxes."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), 128, dtype=np.uint8)
    for _ in range(150):
        x, y, w, h = rng.integers((0, 0, 8, 8), (width, height, 70, 70))
        image[y : y + h, x : x + w] = rng.integers(0, 256, 3)
    return image


@pytest.mark.parametrize("shape", [(480, 640), (250, 333)])
def test_it_finds_the_same_points_in_a_warped_image(xfeat: FeaturesFunction, shape: tuple[int, int]) -> None:
    import cv2

    image = picture(*shape)
    warp = cv2.getRotationMatrix2D((shape[1] / 2, shape[0] / 2), 6.0, 1.1)
    warped = cv2.warpAffine(image, warp, shape[::-1], borderMode=cv2.BORDER_REFLECT)
    slot = FeaturesPlugin(xfeat)

    first, second = slot(image), slot(warped)
    rows, columns = match_all(first.descriptors, second.descriptors)

    expected = first.pixels[rows] @ warp[:, :2].T + warp[:, 2]
    away = second.pixels[columns] - expected
    near = np.linalg.norm(away, axis=1) < 3.0
    assert (str(slot.kind), first.descriptors.dtype) == ("xfeat (64 dimensions)", np.int8)
    assert near.sum() >= 60
    assert near.mean() >= 0.7
    assert np.abs(away[near].mean(axis=0)).max() < 0.3, "pixels are shifted"
