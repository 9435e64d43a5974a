"""Make a map from a camera: ``rse-pf map from-camera``.

Starts a platform on this machine unless an option names another, tracks the frames of the camera until there
are no more or Ctrl-C is pressed, and writes map, trajectory, report and picture into a folder of results.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import urlsplit

from client_sdk.source_facts import check_accepted, ended_early, unresolved
from rse_pf.cli.maps.frame_table import FRAMES_FILE, FrameTable
from rse_pf.cli.maps.keyframe_images import KeyframeImages
from rse_pf.command_line.drive_output import accuracy_lines, lost_line, offset_lines
from rse_pf.command_line.extras import is_installed
from rse_pf.command_line.map_store import KeepRequest, drive_store, keep_map, map_name
from rse_pf.command_line.options import option
from rse_pf.command_line.sensors import CheckRequest, SensorRequest, show_source
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, RsePfError, UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.maps.format import IMAGES_FOLDER, decode_map
from rse_pf.storage.files import replace_file
from rse_pf.terminal import show, show_progress

if TYPE_CHECKING:
    from client_sdk import MarkerScale, OdometryScale, Robot, TrackedFrame
    from client_sdk.cameras.source import FrameSource
    from client_sdk.check.drive_check import DriveCheck
    from client_sdk.check.motion import MotionReference
    from client_sdk.frontend import Frame
    from client_sdk.mapper import Mapper

__all__ = [
    "DriveRequest",
    "FromCameraRequest",
    "check_drive",
    "map_source",
    "run_from_camera",
]

# Name of the robot in the map and its picture.
_ROBOT = "camera"
# Part of all frames: if at least so many have no pose in the map, the command fails.
_MAX_LOST = 0.5
# Time between two lines of progress, in seconds, if standard error is a file or pipe.
_LINE_EVERY_S = 5.0


@dataclass(frozen=True, kw_only=True)
class DriveRequest(CheckRequest, KeepRequest):
    """The options of every drive: how frames are tracked, the platform, and where the map is kept."""

    author: ClassVar[str]
    """The command that made the map; the record of a version of the map names it."""

    source: str
    out: Path
    intrinsics: Path | None = option(
        "--intrinsics",
        metavar="FILE",
        help="file of the camera, or rig.json of a rig: see rse-pf camera calibrate",
    )
    scale: str | None = option(
        "--scale",
        metavar="SOURCE",
        help="without depth: marker:MM (edge of an ArUco 4x4_50 marker) or odometry:FILE (TUM format)",
    )
    features: str | None = option(
        "--features",
        metavar="MODULE:FUNCTION",
        help="find features with this function instead of ORB: see docs/own_parts.md",
    )
    no_depth: bool = option("--no-depth", help="use the colour images only")
    rate: float | None = option(
        "--rate", metavar="HZ", help="play this number of frames per second (default: all)"
    )
    frames: int | None = option("--frames", metavar="N", help="stop after N frames")
    keep_images: bool = option(
        "--keep-images", help="write the images of keyframes into DIR/images, for map export --images"
    )
    url: tuple[str, ...] = option(
        "--url",
        action="append",
        default=(),
        help="use the platform at this address, with --token-file; with several, the nearest of them",
    )
    token_file: Path | None = option(
        "--token-file", metavar="FILE", help="with --url: file that holds the robot's token"
    )
    enrolment: Path | None = option(
        "--enrolment", metavar="FILE", help="use the platform of rse-pf robot enrol --out FILE"
    )


@dataclass(frozen=True, kw_only=True)
class FromCameraRequest(SensorRequest, DriveRequest):
    """The options of rse-pf map from-camera: the source of frames, and those of every drive."""

    author = "rse-pf map from-camera"
    source: str = option(
        metavar="SOURCE", help="a device (0), two (0,2), a video, a folder, a recording or realsense"
    )
    out: Path = option(
        "--out", default=Path("out-camera"), metavar="DIR", help="results (default: %(default)s)"
    )


def run_from_camera(request: FromCameraRequest, settings: PlatformSettings) -> int:
    """Track the frames of a source and write the results; return 0.

    Raises:
        CommandFailed: Half of the frames or more have no pose, or the source failed in between; the results
            are written nevertheless.
        UsageError: The source cannot be opened, or options contradict each other.
    """
    scale = check_drive(request)
    from client_sdk.cameras import open_camera
    from client_sdk.trajectory import read_odometry

    reference = None
    kind, _, scale_file = (request.scale or "").partition(":")
    odometries = [Path(scale_file)] if kind == "odometry" else []
    if _is_checked(request):
        from client_sdk.check.motion import MotionReference

        try:
            reference = MotionReference.of_folder(request.source)
            if reference is not None:
                odometries.append(Path(request.source) / "odometry.txt")
        except UsageError as error:
            show(f"note: {error}: it is not compared with the motion", error=True)
    with open_camera(
        request.source,
        intrinsics=request.intrinsics,
        rate_hz=request.rate,
        depth=not request.no_depth,
        camera=request.camera,
        imu=request.imu,
    ) as source:
        for file in odometries:
            source.log.add_reference(str(file), read_odometry(file).timestamps_s, source.span_s)
        return map_source(request, settings, source, scale, reference=reference)


def _is_checked(request: DriveRequest) -> bool:
    """Return whether the drive is checked: it is wanted, and the extension was not removed."""
    return request.check and is_installed("client_sdk.check")


def map_source(
    request: DriveRequest,
    settings: PlatformSettings,
    source: FrameSource,
    scale: OdometryScale | MarkerScale | None,
    *,
    about: Mapping[str, Any] | None = None,
    reference: MotionReference | None = None,
) -> int:
    """Track the frames of *source*, write the results, and commit the map to the store; return 0.

    Args:
        request: The options of the drive.
        settings: Settings of the platform and the store.
        source: The frames, with what is known about their camera.
        scale: The source of metric scale for a camera without depth and stereo; None leaves it unknown.
        about: Further fields of the report.
        reference: A motion with which the tracked motion is compared unless *source* is a recording with a
            truth; None compares nothing then.

    Raises:
        UsageError: *scale* is given although the source has depth or stereo, or the source gives no frame.
        CommandFailed: Half of the frames or more have no pose, or the source failed in between; the results
            are written nevertheless.
    """
    if scale is not None and (source.has_depth or source.has_stereo):
        what, option = ("depth", "--no-depth") if source.has_depth else ("a pair of cameras", "--camera left")
        raise UsageError(
            f"{request.source} has {what}, so that its scale is known",
            hint=f"leave out --scale, or add {option}",
        )
    from client_sdk.trajectory_error import trajectory_figures
    from rse_pf.maps.map_image import RobotPath, draw_map

    _make_folder(request.out)
    kept_in = drive_store(request.objects, settings)
    frames = FrameTable()
    images = KeyframeImages(request.out) if request.keep_images else None
    check: DriveCheck | None = None
    if _is_checked(request):
        from client_sdk.check.drive_check import DriveCheck

        check = DriveCheck(is_thinned=request.rate is not None)

    def watch(frame: Frame, tracked: TrackedFrame) -> None:
        """Check a tracked frame, and write its image if it is a keyframe."""
        if check is not None:
            check.add(frame, tracked)
        if images is not None:
            images.add(tracked)

    check_accepted(request.accept)
    shown = show_source(source.notes, unresolved(source.log.doubts, request.accept))
    mapper, failed = asyncio.run(_drive(request, settings, source, scale, frames, watch))
    if failed is not None:
        source.log.add(ended_early(failed, mapper.frames))
    doubts = unresolved(source.log.doubts, request.accept)
    report = {**mapper.save(request.out), "assumed": list(source.notes), **(about or {})}
    recording = source.recording
    checked = None
    if check is not None:
        from client_sdk.check.motion import MotionReference

        truth = None if recording is None else MotionReference.of_truth(recording)
        checked = check.finish(mapper, truth or reference, doubts, request.accept)
    if recording is not None:
        errors = trajectory_figures(mapper.trajectory, recording.truth, recording.T_body_camera)
        if report["unit"] != "m":
            errors |= dict.fromkeys(("path_m", "ate_cm", "rpe_cm"))  # no metres without metric scale
        report |= {"truth": recording.truth_kind, **errors}
    if checked is not None:
        report["check"] = checked
    kept, kept_line = _keep(request, mapper, kept_in, images)
    report = {**report, **kept}
    replace_file(request.out / "report.json", (json.dumps(report, indent=2) + "\n").encode())
    frames.write(request.out / FRAMES_FILE)
    points, colours = mapper.map.points()
    path = mapper.trajectory
    unit = "m" if report["unit"] == "m" else "units"
    if len(path) and len(points):
        caption = (
            f"{request.source}: {report['frames']} frames, {report['map_points']:,} points, {mapper.scale}"
        )
        drawn = RobotPath(name=_ROBOT, T_world_camera=path.T_world_camera)
        draw_map(request.out / "map.png", points, colours, [drawn], caption, unit=unit)
    posed = len(path)
    trip = report["round_trip_ms"]["p50"]
    show(
        f"{report['frames']} frames, {lost_line(report)}, {report['keyframes']} keyframes, "
        f"{report['map_points']} points; path {report['path']:.2f} {unit}; scale: {mapper.scale}"
        + ("" if trip is None else f"; round trip p50 {trip} ms"),
        *offset_lines(report),
        *accuracy_lines(report),
        *frames.lines(),
        *([f"the IMU is {report['imu']}"] if str(report.get("imu") or "").startswith("not") else []),
        *([] if request.check else [line for doubt in doubts if (line := doubt.line()) not in shown]),
        *(check.lines(checked, shown) if check is not None and checked is not None else []),
        f"results: {request.out}/map.ply, map.png, trajectory.txt, {FRAMES_FILE}, report.json",
        kept_line,
    )
    if failed is not None:
        raise CommandFailed(f"the source failed after {report['frames']} frames: {failed.message}",
                            hint=failed.hint)  # fmt: skip
    if posed <= (1 - _MAX_LOST) * report["frames"]:
        findings = (checked or {}).get("source") or [doubt.to_dict() for doubt in doubts]
        raise CommandFailed(
            f"{report['frames'] - posed} of {report['frames']} frames have no pose in the map: "
            f"{report['lost_frames']} lost, {report['frames_before_start']} before the start, "
            f"{report['frames_apart']} in parts of the drive that were not connected",
            hint=_advice(mapper, source, check, findings),
        )
    return 0


def _keep(
    request: DriveRequest, mapper: Mapper, settings: PlatformSettings, images: KeyframeImages | None
) -> tuple[dict[str, Any], str]:
    """Commit the map to the store, where others can localise in it; return fields of the report, and a line.

    A map that cannot be kept is no error: fields and line then state the reason.  The *images* of its
    keyframes are renamed as the map names them.
    """
    data, kept = None, {}
    try:
        data = mapper.encoded_map()
        kept = keep_map(
            data, map_name(request.map, request.out), settings, tenant=request.tenant, author=request.author
        )
    except RsePfError as error:
        why = "its scale is not known" if isinstance(error, UsageError) else f"{error.code}: {error.message}"
        if mapper.keyframes == 0:
            why = "it has no keyframe"
        kept = {"map": None, "map_reason": why}
        line = f"the map is only in {request.out}, and not in a store: {why}"
    else:
        tenant = "" if request.tenant == DEFAULT_TENANT else f" --tenant {request.tenant}"
        line = f"map: {kept['map']} in {kept['store']}; see rse-pf map show {kept['map']}{tenant}"
    if images is not None:
        count = images.finish(None if data is None else decode_map(data))
        kept["images"] = count
        line += f"; {count} images in {request.out / IMAGES_FOLDER}"
    return kept, line


def check_drive(request: DriveRequest) -> OdometryScale | MarkerScale | None:
    """Check the options of a drive, before its source is opened, and return the source of metric scale.

    None without --scale.

    Raises:
        UsageError: Options contradict each other, or a value is not valid.
    """
    from client_sdk.plugins import load_features

    load_features(request.features)
    map_name(request.map, request.out)
    if request.frames is not None and request.frames < 2:
        raise UsageError(f"--frames {request.frames} is below 2", hint="leave it out to use all frames")
    if request.enrolment is not None and (request.url or request.token_file is not None):
        raise UsageError("--enrolment names address and key", hint="leave out --url and --token-file")
    if bool(request.url) != (request.token_file is not None):
        raise UsageError("--url and --token-file need each other", hint="get a token: rse-pf token")
    for url in request.url:
        if urlsplit(url).scheme not in ("ws", "wss"):
            raise UsageError(f"{url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws")
    return _scale(request.scale)


def _scale(word: str | None) -> OdometryScale | MarkerScale | None:
    """Return the source of metric scale that *word*, ``marker:MM`` or ``odometry:FILE``, names.

    None if *word* is None.

    Raises:
        UsageError: *word* has another form, or the file cannot be read.
    """
    from client_sdk import MarkerScale, OdometryScale
    from client_sdk.trajectory import read_odometry

    if word is None:
        return None
    kind, _, value = word.partition(":")
    if kind == "odometry" and value:
        path = read_odometry(Path(value))
        return OdometryScale(path.timestamps_s, path.positions)
    with contextlib.suppress(ValueError):
        if kind == "marker":
            return MarkerScale(float(value) / 1e3)
    raise UsageError(f"--scale {word} is unknown", hint="write marker:100 (mm) or odometry:FILE")


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make {folder}: {error.strerror}", hint="name another --out") from error


async def _drive(
    request: DriveRequest,
    settings: PlatformSettings,
    source: FrameSource,
    scale: Any,
    frames: FrameTable,
    watch: Callable[[Frame, TrackedFrame], None],
) -> tuple[Mapper, RsePfError | None]:
    """Track the frames of *source* until there are no more, --frames are tracked, or Ctrl-C.

    Returns the mapper with the map, and the error with which the source failed after its first frame, else
    None; what was mapped until then is kept.  *frames* and *watch* get the result of each frame.

    Raises:
        UsageError: The source gives no frame.
        RsePfError: The source failed at its first frame.
    """
    from client_sdk.plugins import load_features

    stop = asyncio.Event()
    with contextlib.suppress(NotImplementedError, ValueError, RuntimeError):  # signals need the main thread
        asyncio.get_running_loop().add_signal_handler(signal.SIGINT, stop.set)
    async with _robot(request, settings) as robot:
        mapper = robot.mapper(scale=scale, depth=source.has_depth, features=load_features(request.features),
                              keyframes_of=_ROBOT)  # fmt: skip
        status = _Status(time.monotonic)
        failed: RsePfError | None = None
        while not stop.is_set() and (request.frames is None or mapper.frames < request.frames):
            try:
                frame = await asyncio.to_thread(next, source, None)
            except RsePfError as error:
                if not mapper.frames:
                    raise
                failed = error
                break
            if frame is None:
                break
            tracked = await mapper.track(frame)
            frames.add(tracked)
            await asyncio.to_thread(watch, frame, tracked)
            status.show(mapper, tracked)
        status.end()
    if not mapper.frames:
        raise UsageError(f"{request.source} gives no frame", hint="look at it: rse-pf camera check")
    return mapper, failed


@contextlib.asynccontextmanager
async def _robot(request: DriveRequest, settings: PlatformSettings) -> AsyncIterator[Robot]:
    """Yield a robot that is connected to the platform that the options name, or to one that is started.

    A platform that is started has its state in the folder of results, and is stopped after the block.
    """
    from client_sdk import connect

    if request.enrolment is not None:
        async with connect(enrolment=request.enrolment, settings=settings.session) as robot:
            yield robot
    elif request.token_file is not None:
        try:
            token = request.token_file.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(
                f"cannot read the token in {request.token_file}", hint="rse-pf token issue NAME > FILE"
            ) from error
        async with connect(list(request.url), token=token, settings=settings.session) as robot:
            yield robot
    else:
        from rse_pf.local.control.platform import LocalPlatform
        from rse_pf.local.state import remove_keys

        folder = request.out / "platform"
        show("starting the platform: Envoy and backend servers")
        try:
            async with LocalPlatform(settings, port=0, state=folder, name="from-camera") as platform:

                async def fresh() -> str:
                    return platform.issue_token(_ROBOT)

                async with connect(platform.url, token=fresh, settings=settings.session) as robot:
                    yield robot
        finally:
            remove_keys(folder)


class _Status:
    """The line of progress of a drive: rewritten on a terminal, else written every `_LINE_EVERY_S` seconds.

    *now* is a monotonic clock in seconds.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._due_s = now() + _LINE_EVERY_S
        self._last = ""

    def show(self, mapper: Mapper, done: TrackedFrame) -> None:
        """Show the result of the last frame, *done*, and the counts of *mapper*."""
        trip = "" if done.round_trip_ms is None else f", {done.round_trip_ms:.1f} ms ({done.source})"
        how = f"{done.inliers} inliers{trip}" if done.T_world_camera is not None else done.reason
        scale = "" if done.scale == "metric" else ", up to scale"
        self._last = (
            f"frame {mapper.frames}: {done.status}{scale}, {how}; {mapper.keyframes} keyframes, "
            f"{mapper.lost_frames} lost"
        )
        if not show_progress(self._last, is_over=False) and self._now() >= self._due_s:
            show(self._last, error=True)
            self._due_s = self._now() + _LINE_EVERY_S

    def end(self) -> None:
        """Show the last line once more, and leave it on the terminal."""
        show_progress(self._last, is_over=True)


def _advice(
    mapper: Mapper, source: FrameSource, check: DriveCheck | None, findings: Sequence[Mapping[str, Any]]
) -> str:
    """Return the hint about frames without a pose.

    It names the cause that *check* sees in the images, else the first of *findings*, else a cause that
    follows from the sensors of *source*.
    """
    cause = None if check is None else check.cause_of_loss()
    if cause is not None:
        return cause
    if findings:
        return f"settle the finding {findings[0]['name']} first: {findings[0]['hint']}"
    if mapper.keyframes == 0 and not source.has_depth and not source.has_stereo:
        advice = "without depth the camera must move, not only turn, over texture; or use a depth camera"
        return f"{mapper.start_reason}; {advice}" if mapper.start_reason else advice
    return f"move more slowly, and compare the intrinsics with the camera; {FRAMES_FILE} has the reasons"
