"""The sharpness of edges and the depths around features are those of the definition."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.check.frames import sharpness
from client_sdk.check.keyframes import depths_at
from tests.oracles import depths


@pytest.mark.parametrize("size", [(480, 640), (120, 100), (61, 47), (30, 900), (2000, 1500)])
@pytest.mark.parametrize("contrast", [4, 60, 255])
def test_edges_are_as_sharp(size: tuple[int, int], contrast: int) -> None:
    rng = np.random.default_rng(contrast)
    coarse = rng.integers(0, contrast + 1, (-(-size[0] // 20), -(-size[1] // 20), 3))
    gray = np.kron(coarse, np.ones((20, 20, 1)))[: size[0], : size[1], 1].astype(np.uint8)

    found = sharpness(gray)

    rows, columns = (max(1, side // 60) for side in size)
    np.testing.assert_array_equal(
        found, (depths.sharpness(gray[::rows]), depths.sharpness(gray[:, ::columns].T))
    )


def test_depths_around_features_are_equal() -> None:
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(1.0, 1.03, (48, 64)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.02] = 0.0
    depth_m[rng.random(depth_m.shape) < 0.02] = np.nan
    depth_m[rng.random(depth_m.shape) < 0.02] = np.inf
    depth_m[:, 40:] *= 1.5
    pixels = np.concatenate([rng.uniform(-9.0, 75.0, (300, 2)), rng.integers(0, 64, (100, 2)) + 0.5])
    views = (depth_m, depth_m[:, ::-1], depth_m[::-1], depth_m[::-1, ::-1], depth_m[::2, 1::2])

    found = [depths_at(view, pixels) for view in views]

    assert sum(int(np.isfinite(each).sum()) for each in found) > 500
    np.testing.assert_array_equal(found, [depths.depths_at(view, pixels, 0.05) for view in views])
