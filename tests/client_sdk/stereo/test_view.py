"""Which right images a frame takes."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.frontend import Frame
from client_sdk.stereo.view import StereoView
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera

GRAY = np.zeros((24, 32), dtype=np.uint8)


CAMERA = Camera(fx=50.0, fy=50.0, cx=15.5, cy=11.5, width=32, height=24)


@pytest.mark.parametrize("baseline_m", [0.0, -0.1, 110.0, float("nan")])
def test_a_baseline_that_is_none_in_metres_is_refused(baseline_m: float) -> None:
    with pytest.raises(UsageError, match="baseline"):
        StereoView(GRAY, baseline_m)


def test_a_right_image_in_colour_is_refused() -> None:
    with pytest.raises(UsageError, match="right image"):
        StereoView(np.zeros((24, 32, 3), dtype=np.uint8), 0.1)


def test_a_right_image_of_another_size_does_not_fit_a_frame() -> None:
    with pytest.raises(UsageError, match="does not fit"):
        Frame(
            timestamp_s=0.0, rgb=np.zeros((24, 32, 3), dtype=np.uint8),
            depth_m=np.zeros((24, 32), dtype=np.float32), camera=CAMERA,
            stereo=StereoView(GRAY[:20], 0.1),
        )  # fmt: skip
