"""One run of a configuration on a drive: its poses, their errors, and their cost in bytes and CPU time."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.datasets import Dataset
from client_sdk.mapper import Mapper
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import Accuracy, accuracy
from rse_pf.errors import RsePfError, UsageError
from rse_pf.extensions.experiments.compare.configurations import Configuration, failure_line
from rse_pf.extensions.experiments.compare.solvers import MeteredSolver
from rse_pf.geometry import Array

__all__ = ["TrackingRun", "longest_gap_s", "score", "track"]

# Name of the robot in the keyframes of a run.
_ROBOT = "compare"
# Number of the first segment; only its poses count for the errors of online poses.
_FIRST_SEGMENT = 0
# Smallest number of poses of a run from which errors are computed.
_MIN_POSES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackingRun:
    """The result of one run.

    ``figures`` depend on poses and messages only, so that a deterministic run repeats them; ``times_ms`` are
    CPU times.  ``errors`` is None if the poses cannot be compared with a truth, and ``why`` says the reason;
    a figure without a value is None.  ``digest`` is a hash of all poses and their time stamps.
    """

    trajectory: Trajectory
    errors: Accuracy | None
    is_metric: bool
    figures: dict[str, float | int | None]
    times_ms: dict[str, float]
    digest: str
    why: str = ""


@dataclass(slots=True)
class _Costs:
    """The cost of each frame, in the order of frames: bytes sent, and CPU time (ms) of robot and server."""

    sent_bytes: list[int] = field(default_factory=list)
    robot_ms: list[float] = field(default_factory=list)
    server_ms: list[float] = field(default_factory=list)


async def track(
    configuration: Configuration,
    drive: Dataset,
    solver: MeteredSolver,
    progress: Callable[[int], None] = lambda frames: None,
) -> TrackingRun:
    """Track all frames of *drive* as fast as possible, and return the final poses with their errors.

    *progress* is called with the number of tracked frames.  Without depth all keyframes are adjusted together
    after the last frame, as `Mapper.save` does.

    Raises:
        UsageError: The recording cannot be read, or a function of the configuration fails.
    """
    if configuration.depth and not (drive.has_depth or drive.has_stereo):
        raise UsageError(
            f"{configuration.name} needs depth, and {drive.name} has none", hint="leave out depth = true"
        )
    slots: dict[str, Any] = dict(configuration.slots)
    mapper = Mapper(
        ask=solver.ask,
        options=configuration.frontend,
        monocular=configuration.monocular,
        depth=drive.has_depth if configuration.depth is None else configuration.depth,
        keyframes_of=_ROBOT,
        adds_frames=False,
        **slots,
    )
    costs, tracked = _Costs(), list[tuple[float, int, Array | None]]()
    for number, frame in enumerate(drive, start=1):
        sent, server_s, inside_s = solver.sent_bytes, solver.server_s, solver.inside_s
        if configuration.depth is False and frame.stereo is not None:
            frame = replace(frame, stereo=None)
        began_s = time.process_time()
        try:
            done = await mapper.track(frame)
        except Exception as error:
            # The mapper raises an RsePfError for a user's function; the exception of the function is its
            # cause.
            cause = error.__cause__ if isinstance(error, RsePfError) else error
            if not configuration.slots or cause is None:
                raise
            raise UsageError(
                f"frame {number} of {drive.name_at_rate}: {failure_line(configuration.source, cause)}",
                hint=f"correct {configuration.source}",
            ) from error
        took_s = time.process_time() - began_s
        costs.sent_bytes.append(solver.sent_bytes - sent)
        costs.robot_ms.append(1e3 * (took_s - (solver.inside_s - inside_s)))
        costs.server_ms.append(1e3 * (solver.server_s - server_s))
        if done.T_new_old is not None:
            # The mapper has rotated its world frame: the poses before are moved to the new frame, as a robot
            # does.
            tracked = [(at_s, segment, _moved(done.T_new_old, pose)) for at_s, segment, pose in tracked]
        tracked.append((frame.timestamp_s, done.segment, done.T_world_camera))
        progress(number)
    began_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        report = mapper.save(Path(folder))
    finish_ms = 1e3 * (time.process_time() - began_s)
    return _run_of(mapper, report, drive, costs, tracked, finish_ms)


def _moved(T_new_old: Array, pose: Array | None) -> Array | None:
    return None if pose is None else T_new_old @ pose


def longest_gap_s(stamps_s: Array, posed_s: Array) -> float:
    """Return the longest time (s) without a pose, within the time from the first to the last frame."""
    ends = np.concatenate([stamps_s[:1], posed_s, stamps_s[-1:]])
    return float(np.diff(ends).max(initial=0.0))


def score(
    estimate: Trajectory, drive: Dataset, *, is_metric: bool, T_body_camera: Array | None = None
) -> tuple[Accuracy | None, str]:
    """Return the errors of *estimate* against the truth of *drive* and "", or None and the reason."""
    truth = drive.truth
    if truth is None or len(truth) < 2:
        return None, "the recording has no truth: no ATE, no RPE"
    if len(estimate) < _MIN_POSES:
        posed = f"{len(estimate)} of {len(drive)} frames have a pose"
        return None, f"{posed}, an evaluation needs {_MIN_POSES}"
    try:
        return accuracy(estimate, truth, with_scale=not is_metric, T_body_camera=T_body_camera), ""
    except UsageError as error:
        return None, error.message


def _run_of(
    mapper: Mapper,
    report: dict[str, Any],
    drive: Dataset,
    costs: _Costs,
    tracked: list[tuple[float, int, Array | None]],
    finish_ms: float,
) -> TrackingRun:
    trajectory, is_metric = mapper.trajectory, mapper.scale.startswith("metric")
    body = drive.T_body_camera
    errors, why = score(trajectory, drive, is_metric=is_metric, T_body_camera=body)
    if mapper.start_reason:
        why = f"no frame has a pose: {mapper.start_reason}"
    arrived = [
        (stamp_s, pose)
        for stamp_s, segment, pose in tracked
        if segment == _FIRST_SEGMENT and pose is not None
    ]
    online = None
    if arrived:
        came = Trajectory(np.array([each[0] for each in arrived]), np.array([each[1] for each in arrived]))
        online, _ = score(came, drive, is_metric=is_metric, T_body_camera=body)
    stamps_s = np.array(drive.timestamps_s)
    figures: dict[str, float | int | None] = {
        "frames": len(stamps_s),
        "posed": len(trajectory),
        "posed_apart": report["frames_apart"],
        "longest_gap_s": longest_gap_s(stamps_s, trajectory.timestamps_s),
        **_figures_of(errors),
        "ate_online_cm": None if online is None else 100 * online.ate_m,
        "bytes_a_frame": float(np.median(costs.sent_bytes)) if costs.sent_bytes else None,
        "keyframes": mapper.keyframes,
        "bytes_a_keyframe": _keyframe_bytes(mapper),
    }
    times_ms = {
        "robot": float(np.mean(costs.robot_ms)),
        "robot_p95": float(np.percentile(costs.robot_ms, 95)),
        "server": float(np.mean(costs.server_ms)),
        "finish": finish_ms,
    }
    poses = np.ascontiguousarray(trajectory.T_world_camera)
    digest = hashlib.sha256(trajectory.timestamps_s.tobytes() + poses.tobytes()).hexdigest()[:16]
    return TrackingRun(
        trajectory=trajectory, errors=errors, is_metric=is_metric, figures=figures, times_ms=times_ms,
        digest=digest, why=why,
    )  # fmt: skip


def _keyframe_bytes(mapper: Mapper) -> float | None:
    """Return the mean size of an encoded keyframe in bytes.

    None without depth, where maps are not encoded.
    """
    try:
        return len(mapper.encoded_map()) / max(1, mapper.keyframes)
    except UsageError:
        return None


def _figures_of(errors: Accuracy | None) -> dict[str, float | int | None]:
    if errors is None:
        names = ("ate_cm", "rpe_cm", "rpe_deg", "rpe_max_deg", "scale")
        return {**dict.fromkeys(names), "poses_with_truth": 0}
    return {
        **errors.figures(),
        "rpe_max_deg": errors.rpe_max_deg,
        "scale": errors.scale,
        "poses_with_truth": errors.poses,
    }
