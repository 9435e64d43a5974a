"""Faults that are planted into drives: the frames show what their names say."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from benchmarks.check.drives import rendered_drive
from benchmarks.check.faults import FAULTS, plant
from client_sdk.check.findings import FaultKind
from client_sdk.frontend import Frame


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return list(rendered_drive(1, 12).frames)


def changed(frames: list[Frame], kind: FaultKind, severity: int) -> list[Frame]:
    return list(plant(iter(frames), kind, severity))


def test_each_fault_has_a_name_of_its_own_and_three_severities() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    severities = Counter(fault.name.rpartition("-")[0] for fault in FAULTS)
    assert severities.pop("swapped") == 1
    assert set(severities.values()) == {3}
    assert len(severities) >= 12


def test_settings_that_are_wrong_leave_the_images_as_they_are(frames: list[Frame]) -> None:
    focal = changed(frames, FaultKind.FOCAL_LENGTH, 3)[0]
    principal = changed(frames, FaultKind.PRINCIPAL_POINT, 2)[0]

    assert focal.camera.fx == pytest.approx(1.1 * frames[0].camera.fx)
    assert principal.camera.cx == frames[0].camera.cx + 15.0
    assert focal.rgb is frames[0].rgb


def test_depth_is_that_of_an_earlier_frame(frames: list[Frame]) -> None:
    late = changed(frames, FaultKind.DEPTH_DELAY, 3)

    assert late[-1].timestamp_s == frames[-1].timestamp_s
    assert late[-1].depth_m is frames[-4].depth_m


def test_a_depth_scale_that_is_set_too_large_makes_depths_small(frames: list[Frame]) -> None:
    near = changed(frames, FaultKind.DEPTH_SCALE, 3)[0]

    seen = frames[0].depth_m > 0
    np.testing.assert_allclose(near.depth_m[seen], frames[0].depth_m[seen] / 5.0, rtol=1e-5)
    assert (near.depth_m[~seen] == 0).all()


def test_a_lens_with_distortion_leaves_no_empty_border(frames: list[Frame]) -> None:
    bent = changed(frames, FaultKind.DISTORTION, 3)[0]

    camera, true = bent.camera, frames[0].camera
    assert camera.fx > true.fx
    assert camera.cx == true.cx
    middle = (slice(235, 245), slice(315, 325))
    assert np.abs(bent.rgb[middle].mean() - frames[0].rgb[middle].mean()) < 12.0


def test_half_of_the_frames_are_blurred_repeated_or_of_another_camera(frames: list[Frame]) -> None:
    for kind in (FaultKind.BLUR, FaultKind.REPEATED, FaultKind.TWO_CAMERAS):
        differing = [
            not np.array_equal(new.rgb, old.rgb)
            for new, old in zip(changed(frames, kind, 3), frames, strict=True)
        ]
        assert sum(differing) == 6, kind


def test_frames_are_missing(frames: list[Frame]) -> None:
    assert len(changed(frames, FaultKind.MISSING, 2)) == 12 - 3
