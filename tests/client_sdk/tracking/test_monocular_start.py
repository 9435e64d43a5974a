"""The start of a camera without depth: what begins a map, what does not, and the reason that is given."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame
from client_sdk.mapper import Mapper
from client_sdk.simulator.renderer import Renderer, add_image_noise
from client_sdk.simulator.world import make_world
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.geometry import Array, Camera, exp_se3
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import frame_at, tracked
from tests.kit.tracked_drives import run_all

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
ALONG_ROOMS = np.array([[0, 0, 1, 1.0], [-1, 0, 0, 2.3], [0, -1, 0, 1.3], [0, 0, 0, 1]], dtype=float)
"""Pose in the first room that looks through the doors of all rooms, along x."""
RATE_HZ = 10
RECORDED = Path(__file__).parents[4] / "shared" / "data"


def images(poses: list[Array], seed: int = 1) -> Iterator[np.ndarray]:
    """Yield what a noisy camera sees from poses in rendered rooms."""
    renderer, rng = Renderer(make_world(seed), CAMERA), np.random.default_rng(seed)
    for pose in poses:
        yield add_image_noise(renderer.draw(pose)[0], rng)


def frames(shown: Iterator[np.ndarray]) -> Iterator[Frame]:
    no_depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    for number, rgb in enumerate(shown):
        yield Frame(timestamp_s=number / RATE_HZ, rgb=rgb, depth_m=no_depth, camera=CAMERA)


def moved(twist: list[float], count: int) -> list[Array]:
    """Return poses that add the same *twist* in the frame of the camera, count by count."""
    return [ALONG_ROOMS @ exp_se3(number * np.array(twist)) for number in range(count)]


@pytest.mark.data
@pytest.mark.parametrize("step", [1, 2, -1])
def test_a_car_is_posed_from_its_first_image_also_backwards_and_at_half_rate(step: int) -> None:
    folder = RECORDED / "kitti_06_start"
    if not folder.exists():
        pytest.skip("no recordings at ../shared/data")
    recorded = list(islice(open_dataset(folder, camera="left"), 24))[::step]
    tracker = MonocularTracker()

    done = run_all(
        tracker,
        (replace(each, timestamp_s=number / RATE_HZ) for number, each in enumerate(recorded)),
    )

    first = next(number for number, each in enumerate(done, start=1) if each.status == "tracked")
    assert first <= 8
    assert len(tracker.trajectory()) == len(recorded)


@pytest.mark.data
def test_a_lens_that_nearly_only_turns_waits_until_a_third_view_agrees() -> None:
    folder = RECORDED / "tum_fr1_rpy_start"
    if not folder.exists():
        pytest.skip("no recordings at ../shared/data")
    turning = islice(open_dataset(folder), 20)

    done = run_all(MonocularTracker(), (replace(each, depth_m=0 * each.depth_m) for each in turning))

    assert {each.status for each in done} == {"starting"}


@pytest.mark.parametrize("step_m", [0.08, 0.16, -0.08])
def test_a_lens_that_drives_forward_or_backwards_is_posed_from_its_first_frame(step_m: float) -> None:
    poses = moved([0.0, 0.0, step_m, 0.0, 0.004, 0.0], 14)
    tracker = MonocularTracker()

    done = run_all(tracker, frames(images(poses)))

    first = next(number for number, each in enumerate(done, start=1) if each.status == "tracked")
    assert first <= 8
    assert tracker.segments == (0,)
    path = tracker.trajectory()
    assert len(path) == len(poses)
    truth = Trajectory(path.timestamps_s, np.array(poses))
    assert accuracy(path, truth, with_scale=True).ate_m <= 0.015 * truth.length_m


@pytest.mark.parametrize(
    ("twist", "reason"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], "the camera does not move"),
        ([0.0, 0.0, 0.0, 0.0, 0.02, 0.0], "the camera only turns"),
    ],
)
def test_a_lens_that_stands_or_only_turns_has_no_pose_and_says_so(twist: list[float], reason: str) -> None:
    tracker = MonocularTracker()

    done = run_all(tracker, frames(images(moved(twist, 20))))

    assert {each.status for each in done} == {"starting"}
    assert done[-1].reason.startswith(reason)


def test_the_report_of_a_lens_that_stands_says_why_it_has_no_pose() -> None:
    mapper = Mapper(ask=solve)

    tracked(mapper, (replace(frame_at(0, depth=False), timestamp_s=row / RATE_HZ) for row in range(4)))

    assert mapper.report()["frames_before_start"] == 4
    assert mapper.report()["not_started_because"].startswith("the camera does not move")


def test_a_thing_that_passes_before_a_lens_that_stands_is_no_start() -> None:
    background, texture = images([ALONG_ROOMS, ALONG_ROOMS @ exp_se3([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])])

    def passing() -> Iterator[np.ndarray]:
        rng = np.random.default_rng(2)
        for number in range(14):
            shown, left = background.astype(np.float32), 20 + 14 * number
            shown[100:360, left : left + 300] = texture[100:360, 200:500]
            yield add_image_noise(shown, rng)

    tracker = MonocularTracker()
    done = run_all(tracker, frames(passing()))

    assert {each.status for each in done} == {"starting"}
    assert "does not move" in done[-1].reason
