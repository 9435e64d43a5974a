"""Which right images a frame takes."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.stereo.view import StereoView
from rse_pf.errors import UsageError

GRAY = np.zeros((24, 32), dtype=np.uint8)


@pytest.mark.parametrize("baseline_m", [0.0, -0.1, 110.0, float("nan")])
def test_a_baseline_that_is_none_in_metres_is_refused(baseline_m: float) -> None:
    with pytest.raises(UsageError, match="baseline"):
        StereoView(GRAY, baseline_m)
