"""The IMU of a bag: its samples on the frames, placed by tf or a rig; an unusable IMU is reported."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client_sdk.bags import BagKind, BagOptions, BagWriter, open_bag
from client_sdk.bags.message_types import IMU, TF
from client_sdk.datasets import open_dataset
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_se3, inverse
from tests.kit.small_bags import (
    FRAMES,
    KINDS,
    PERIOD_NS,
    Message,
    raw_frames,
    stamp_of,
    write_bag,
)

pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")

IMU_TOPIC = "/imu/data"
STEP_NS = PERIOD_NS // 10
SAMPLES = 10 * FRAMES
T_CAMERA_IMU = exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.4]))
"""Pose of the IMU in the camera: no symmetry that would hide an inverse."""


def samples_of(row: int) -> tuple[Array, Array]:
    return np.array([0.01 * row, -0.2, 0.3]), np.array([0.1, 9.8, -0.01 * row])


def imu_messages(
    w: BagWriter, *, topic: str = IMU_TOPIC, first_ns: int = stamp_of(0) - STEP_NS
) -> list[Message]:
    found: list[Message] = []
    for row in range(SAMPLES):
        stamp = first_ns + row * STEP_NS
        found.append((topic, IMU, stamp, w.imu(stamp, "imu_link", *samples_of(row))))
    return found


def place(w: BagWriter, camera: str = "eye") -> Message:
    """Return the mount of the IMU, through a frame between both."""
    T_base_camera = exp_se3(np.array([0.1, 0.2, 0.3, -0.5, 0.2, 0.9]))
    mounts = [
        w.transform(0, "base", camera, T_base_camera),
        w.transform(0, "base", "imu_link", T_base_camera @ T_CAMERA_IMU),
    ]
    return ("/tf_static", TF, stamp_of(0), w.transforms(mounts))


def drive(w: BagWriter) -> list[Message]:
    """Return frames with depth and an IMU, without moving tf."""
    frames = [each for each in raw_frames(w) if each[1] != TF]
    return sorted([place(w), *frames, *imu_messages(w)], key=lambda each: each[2])


@pytest.mark.parametrize("kind", KINDS)
def test_each_frame_has_the_samples_since_the_one_before_it(tmp_path: Path, kind: BagKind) -> None:
    with open_bag(write_bag(tmp_path, kind, drive)) as bag:
        frames = list(bag)
        notes = bag.notes

    assert f"IMU: {IMU_TOPIC}, {SAMPLES} samples, 100 Hz, the noise of a small MEMS IMU is assumed" in notes
    for last, frame in itertools.pairwise(frames):
        samples = frame.imu
        assert samples is not None
        assert len(samples) == 11
        assert samples.timestamps_s[0] == pytest.approx(last.timestamp_s)
        assert samples.timestamps_s[-1] == pytest.approx(frame.timestamp_s)
        row = round((frame.timestamp_s * 1e9 - stamp_of(0) + STEP_NS) / STEP_NS)
        np.testing.assert_array_equal((samples.gyro[-1], samples.accel[-1]), samples_of(row))


def test_tf_tells_where_the_camera_sits_in_the_frame_of_the_imu(tmp_path: Path) -> None:
    with open_bag(write_bag(tmp_path, make=drive)) as bag:
        assert bag.imu is not None
        np.testing.assert_allclose(bag.imu.model.T_imu_camera, inverse(T_CAMERA_IMU), atol=1e-12)


def test_samples_in_any_order_copies_and_broken_ones(tmp_path: Path) -> None:
    def shuffled(w: BagWriter, messages: list[Message]) -> list[Message]:
        rows = [row for row, each in enumerate(messages) if each[1] == IMU]
        order = np.random.default_rng(3).permutation(rows)
        moved = list(messages)
        for row, other in zip(rows, order, strict=True):
            moved[row] = (*messages[row][:3], messages[other][3])
        bad = w.imu(stamp_of(1) + 5, "imu_link", np.array([np.nan, 0, 0]), np.zeros(3))
        far = w.imu(stamp_of(1) + 6, "imu_link", np.zeros(3), np.array([0, np.inf, 0]))
        moved += [(IMU_TOPIC, IMU, stamp_of(4), each) for each in (moved[rows[5]][3], bad, far, b"\x01")]
        return moved

    with open_bag(write_bag(tmp_path, make=drive, change=shuffled)) as bag:
        assert bag.imu is not None
        assert len(bag.imu.timestamps_s) == SAMPLES
        np.testing.assert_array_equal(bag.imu.gyro[7], samples_of(7)[0])
        assert bag.log.doubts[0].sentence.startswith("3 broken messages left out; the first: /imu/data: ")


def unplaced(w: BagWriter) -> list[Message]:
    return [each for each in drive(w) if each[1] != TF]


def of_another_clock(w: BagWriter) -> list[Message]:
    frames = [each for each in drive(w) if each[1] != IMU]
    return [*frames, *imu_messages(w, first_ns=stamp_of(5000))]


def of_one_sample(w: BagWriter) -> list[Message]:
    frames = [each for each in drive(w) if each[1] != IMU]
    return [*frames, imu_messages(w)[1]]


def too_slow(w: BagWriter) -> list[Message]:
    messages = drive(w)
    kept = [each for each in messages if each[1] == IMU][::20]
    return [*(each for each in messages if each[1] != IMU), *kept]


def without_rates(w: BagWriter) -> list[Message]:
    messages = drive(w)
    for _, kind, _, message in messages:
        if kind == IMU:
            message.angular_velocity_covariance[0] = -1.0
    return messages


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (unplaced, "no tf_static joins the frame of /imu/data with that of the camera"),
        (of_another_clock, "no sample of /imu/data lies between the first and the last frame"),
        (of_one_sample, "/imu/data has fewer than 2 samples"),
        (too_slow, "rate_hz = 5 is not within"),
        (without_rates, "/imu/data has fewer than 2 samples"),
    ],
)
def test_an_imu_that_cannot_be_used_is_reported_and_refused_if_it_is_named(
    tmp_path: Path, make: Callable[[BagWriter], list[Message]], says: str
) -> None:
    path = write_bag(tmp_path, make=make)

    with open_bag(path) as bag:
        assert bag.imu is None
        assert all(frame.imu is None for frame in bag)
        assert any(note.startswith("the IMU is not used: ") and says in note for note in bag.notes)
    with pytest.raises(UsageError, match=says):
        open_bag(path, BagOptions(imu=IMU_TOPIC))
    with pytest.raises(UsageError, match=says):
        open_dataset(path, imu=True)
