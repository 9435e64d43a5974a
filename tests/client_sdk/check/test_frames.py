"""Images of a drive: what is blurred, dark, repeated, missing or jittered is found, and nothing else is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.check.findings import FaultKind, Finding
from client_sdk.check.frames import FrameStatistics

Image = npt.NDArray[np.uint8]
FRAMES = 60


def images(step_px: int = 3) -> list[Image]:
    """Return a camera that moves past random tiles, with noise of two grey levels."""
    rng = np.random.default_rng(3)
    tiles = np.kron(rng.integers(20, 235, (20, 60)), np.ones((16, 16))).astype(np.float64)
    moved = (tiles[10:250, step_px * row : step_px * row + 320] for row in range(FRAMES))
    noisy = (each + 2.0 * rng.standard_normal(each.shape) for each in moved)
    return [np.repeat(np.clip(each, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2) for each in noisy]


def blurred(image: Image, length_px: int) -> Image:
    rows = np.cumsum(np.pad(image.astype(np.float64), ((0, 0), (length_px, 0), (0, 0)), mode="edge"), axis=1)
    return ((rows[:, length_px:] - rows[:, :-length_px]) / length_px).astype(np.uint8)


def found(
    frames: Iterable[Image], stamps_s: npt.NDArray[np.float64] | None = None
) -> dict[FaultKind, Finding]:
    statistics = FrameStatistics()
    for row, image in enumerate(frames):
        statistics.add(row / 10.0 if stamps_s is None else float(stamps_s[row]), image)
    return {each.kind: each for each in statistics.findings()[0]}


def test_a_healthy_drive_has_no_finding() -> None:
    assert found(images()) == {}


@pytest.mark.parametrize("length_px", [9, 15, 25])
def test_every_second_frame_is_blurred(length_px: int) -> None:
    frames = [blurred(each, length_px) if row % 2 else each for row, each in enumerate(images())]

    findings = found(frames)

    assert findings.keys() == {FaultKind.BLUR}
    assert findings[FaultKind.BLUR].value == pytest.approx(0.5, abs=0.03)
    assert findings[FaultKind.BLUR].is_certain


def test_frames_a_little_softer_than_their_neighbours_are_not_blurred() -> None:
    frames = [blurred(each, 7 if row % 2 else 5) for row, each in enumerate(images())]

    assert FaultKind.BLUR not in found(frames)


def test_a_lens_out_of_focus_blurs_all_frames() -> None:
    frames = [blurred(blurred(each, 15).swapaxes(0, 1), 15).swapaxes(0, 1) for each in images()]

    assert found(frames)[FaultKind.BLUR].value == 1.0


def test_a_plain_wall_is_not_blurred() -> None:
    rng = np.random.default_rng(4)
    wall = [np.clip(120 + 2 * rng.standard_normal((240, 320, 3)), 0, 255).astype(np.uint8) for _ in range(30)]

    assert found([*images()[:30], *wall]) == {}


def test_frames_without_an_edge_are_empty_and_not_blurred() -> None:
    statistics = FrameStatistics()
    for row, image in enumerate([*images()[:12], np.full((240, 320, 3), 128, np.uint8)]):
        statistics.add(row / 10.0, image)

    assert statistics.empty().tolist() == [False] * 12 + [True]
    assert not statistics.blurred().any()


def test_dark_frames_are_counted() -> None:
    frames = [np.uint8(12) * (each > 120) if row < 20 else each for row, each in enumerate(images())]

    assert found(frames)[FaultKind.DARK].value == pytest.approx(20 / FRAMES)


def test_repeated_frames_are_counted() -> None:
    shown = images()
    frames = [shown[row - row % 2] for row in range(FRAMES)]

    assert found(frames)[FaultKind.REPEATED].value == pytest.approx(0.5)


def test_a_camera_that_stands_still_repeats_nothing() -> None:
    shown = images()
    frames = [*shown[:20], *[shown[20]] * 20, *shown[20:40]]

    assert FaultKind.REPEATED not in found(frames)


def test_overexposed_frames_of_one_brightness_are_not_repeated() -> None:
    shown = images()
    white = np.full_like(shown[0], 255)
    statistics = FrameStatistics()
    for row, image in enumerate([*shown[:20], *[white] * 8, *shown[20:40], *[white] * 15, *shown[40:]]):
        statistics.add(row / 10.0, image)

    assert not statistics.repeated().any()
    assert statistics.frozen() == ()


def test_missing_frames_are_counted_despite_jitter_of_a_clock() -> None:
    rng = np.random.default_rng(5)
    rows = [row for row in range(FRAMES + 20) if row % 4 != 2][:FRAMES]
    stamps = np.array(rows) / 10.0 + rng.normal(0.0, 0.003, FRAMES)

    findings = found(images(), stamps)

    assert findings.keys() == {FaultKind.MISSING}
    assert findings[FaultKind.MISSING].value == pytest.approx(0.25, abs=0.02)


def test_an_uneven_rate_is_jitter_and_nothing_is_missing() -> None:
    stamps = (np.arange(FRAMES) + np.random.default_rng(6).uniform(-0.4, 0.4, FRAMES)) / 10.0

    assert found(images(), stamps).keys() == {FaultKind.JITTER}


def test_few_frames_have_no_finding() -> None:
    statistics = FrameStatistics()
    for row in range(5):
        statistics.add(float(row), images()[row])

    assert statistics.findings()[0] == []


def test_of_frames_that_were_left_out_on_purpose_no_gap_is_reported() -> None:
    statistics = FrameStatistics(is_thinned=True)
    for row, image in enumerate(images()):
        statistics.add((row + row // 2) / 30.0, image)

    findings, undetermined = statistics.findings()

    assert findings == []
    assert {each.kind for each in undetermined} == {FaultKind.MISSING, FaultKind.JITTER}
