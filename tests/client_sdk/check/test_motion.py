"""Motion compared with odometry or an IMU: delay, scale, mirror and axes, each with its deviation."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.check.findings import FaultKind, Finding
from client_sdk.check.motion import (
    CameraMotion,
    MotionReference,
    check_imu,
    check_motion,
    nothing_to_compare,
)
from client_sdk.imu.history import ImuHistory
from client_sdk.imu.samples import ImuModel
from client_sdk.trajectory import Trajectory
from rse_pf.geometry import Array, exp_se3, from_quaternion, to_quaternion
from tests.kit.inertial_drive import InertialDrive, Motion, SimulatedImu

MODEL = ImuModel(
    T_imu_camera=np.eye(4), gyro_noise=1e-3, gyro_walk=1e-5, accel_noise=1e-2, accel_walk=1e-4, rate_hz=200.0
)
RATE_HZ = 10.0


def stamps(seconds: float = 20.0) -> Array:
    return 1.0 + np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def drive(turn_rad: float = 0.4) -> InertialDrive:
    return InertialDrive(MODEL, Motion(reach_m=0.8, turn_rad=turn_rad), seed=3)


def tracked(stamps_s: Array) -> Array:
    """Return poses of the drive as a tracker gives them: off by 1 mm and 0.03 degrees."""
    noise = np.random.default_rng(4).standard_normal((len(stamps_s), 6)) * np.repeat((1e-3, 5e-4), 3)
    return drive().T_world_camera(stamps_s) @ exp_se3(noise)


def odometry() -> Trajectory:
    known_s = np.arange(0.0, 23.0, 0.05)
    return Trajectory(known_s, drive().T_world_camera(known_s))


def found(T: Array, path: Trajectory | None = None, **changed: bool) -> dict[FaultKind, Finding]:
    reference = MotionReference(path=path or odometry(), **changed)
    return {
        each.kind: each
        for each in check_motion(CameraMotion(stamps_s=stamps(), T_world_camera=T), reference)[0]
    }


def test_a_healthy_drive_has_no_finding() -> None:
    assert found(tracked(stamps())) == {}


@pytest.mark.parametrize("delay_s", [0.05, 0.1, -0.2])
def test_stamps_of_images_are_late(delay_s: float) -> None:
    finding = found(tracked(stamps() - delay_s))[FaultKind.STAMP_DELAY]

    assert finding.value == pytest.approx(delay_s, abs=0.01)
    assert finding.is_certain
    assert finding.deviation >= 0.1 / RATE_HZ  # between frames nobody saw how the camera moved


@pytest.mark.parametrize("scale", [1.03, 0.9, 5.0])
def test_metres_of_the_camera_are_wrong(scale: float) -> None:
    T = tracked(stamps())
    T[:, :3, 3] /= scale

    finding = found(T)[FaultKind.DEPTH_SCALE]

    assert finding.value == pytest.approx(scale - 1.0, abs=0.01 * scale)
    assert finding.is_certain


def test_mirrored_images_are_distinguished_from_swapped_axes() -> None:
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])

    assert found(mirror @ tracked(stamps()) @ mirror).keys() == {FaultKind.MIRRORED}


def test_an_odometry_of_another_body_may_have_other_axes_and_no_mirror_hides_in_them() -> None:
    body = np.array([[0.0, -1, 0, 0.3], [0, 0, -1, 0.1], [1, 0, 0, 0.2], [0, 0, 0, 1]])
    path = odometry()
    mounted = Trajectory(path.timestamps_s, path.T_world_camera @ body)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])

    assert found(tracked(stamps()), mounted, is_camera=False) == {}
    assert found(mirror @ tracked(stamps()) @ mirror, mounted, is_camera=False).keys() == {FaultKind.MIRRORED}
    swapped = found(tracked(stamps()), mounted)[FaultKind.SWAPPED_AXES]
    assert "-y, -z, x" in swapped.sentence or "z, -x, -y" in swapped.sentence


@pytest.mark.parametrize("order", [[3, 0, 1, 2], [1, 2, 3, 0]])
def test_quaternions_with_w_at_the_wrong_end_are_named(order: list[int]) -> None:
    path = odometry()
    poses = path.T_world_camera.copy()
    poses[:, :3, :3] = [from_quaternion(to_quaternion(pose[:3, :3])[order]) for pose in poses]

    (finding,) = found(tracked(stamps()), Trajectory(path.timestamps_s, poses)).values()

    assert "quaternions of odometry" in finding.sentence


def test_a_drive_at_one_speed_without_turns_tells_no_delay() -> None:
    rng = np.random.default_rng(5)
    stamps_s, known_s = stamps(), np.arange(0.0, 23.0, 0.05)

    def straight(seconds: Array) -> Array:
        T = np.tile(np.eye(4), (len(seconds), 1, 1))
        T[:, 2, 3] = 0.3 * seconds
        return T

    noise = rng.standard_normal((len(stamps_s), 6)) * np.repeat((1e-3, 5e-4), 3)
    reference = MotionReference(path=Trajectory(known_s, straight(known_s)))
    findings, undetermined = check_motion(
        CameraMotion(stamps_s=stamps_s, T_world_camera=straight(stamps_s) @ exp_se3(noise)), reference
    )

    assert findings == []
    assert {FaultKind.STAMP_DELAY, FaultKind.MIRRORED} <= {each.kind for each in undetermined}


def test_paths_that_have_nothing_in_common_are_not_compared() -> None:
    known_s = np.arange(0.0, 23.0, 0.05)
    other = InertialDrive(MODEL, Motion(), seed=99).T_world_camera(known_s)

    findings, undetermined = check_motion(
        CameraMotion(stamps_s=stamps(), T_world_camera=tracked(stamps())),
        MotionReference(path=Trajectory(known_s, other)),
    )

    assert findings == []
    assert undetermined


def test_without_a_reference_it_is_said_what_cannot_be_checked() -> None:
    kinds = {each.kind for each in nothing_to_compare(has_depth=True)}

    assert kinds == {
        FaultKind.STAMP_DELAY, FaultKind.MIRRORED, FaultKind.SWAPPED_AXES, FaultKind.DEPTH_SCALE,
    }  # fmt: skip


def imu_history(shift_s: float = 0.0) -> ImuHistory:
    imu, history = SimulatedImu(drive(), 22.0, seed=3), ImuHistory(MODEL)
    history.add(imu.between(0.0, 22.0 + shift_s))
    return history


def test_stamps_of_images_that_are_later_than_those_of_the_imu_are_found() -> None:
    (finding,), _ = check_imu(imu_history(), stamps(18.0) + 0.08, tracked(stamps(18.0)))

    assert finding.kind is FaultKind.STAMP_DELAY
    assert finding.value == pytest.approx(0.08, abs=0.01)


def test_axes_of_an_imu_that_are_turned_are_found() -> None:
    turned = tracked(stamps(18.0)) @ np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

    (finding,), _ = check_imu(imu_history(), stamps(18.0), turned)

    assert finding.kind is FaultKind.SWAPPED_AXES


def test_an_undetermined_scale_of_a_pair_is_its_baseline() -> None:
    near, known_s = tracked(stamps()).copy(), np.arange(0.0, 23.0, 0.05)
    path = drive().T_world_camera(known_s).copy()
    near[:, :3, 3] *= 0.02
    path[:, :3, 3] *= 0.02
    motion = CameraMotion(stamps_s=stamps(), T_world_camera=near, scale_source="stereo")

    _, undetermined = check_motion(motion, MotionReference(path=Trajectory(known_s, path)))

    assert FaultKind.BASELINE in {each.kind for each in undetermined}
    assert FaultKind.DEPTH_SCALE not in {each.kind for each in undetermined}
