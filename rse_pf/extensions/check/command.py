"""Find what is wrong with a drive: calibration, depth, times, images, axes; by how much, and what to do.

SOURCE is a recording, a ROS bag, a folder of images, a video, a device, or the results of a map that was
checked while it was made.  All frames are tracked on this machine, without a platform.  The worst findings
come first; faults that this drive does not determine are listed with the reason.  The exit code is 1 if
something is wrong.

examples:
  rse-pf check recordings/kitchen
  rse-pf check kitchen.mcap --odometry odometry.txt --out out-check
  rse-pf check video.mp4 --intrinsics intrinsics.json --write better.json
  rse-pf check out-camera
"""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from client_sdk.check.drive_check import check_lines
from client_sdk.source_facts import check_accepted, ended_early, unresolved
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.command_line.sensors import AcceptRequest, SensorRequest, show_source
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.storage.files import read_document, replace_file
from rse_pf.terminal import show, show_json, show_progress

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from client_sdk.cameras import FrameSource
    from client_sdk.check.findings import CheckReport
    from client_sdk.check.motion import MotionReference
    from client_sdk.frontend import Frame
    from client_sdk.rigs.intrinsics import Intrinsics
    from client_sdk.rigs.stereo_pair_checks import PairFault

__all__ = ["ACTION"]

_MAX_DEVICE_FRAMES = 3000
"""Number of frames of a live camera that are checked unless ``--frames`` gives another number."""
_RECORDING_FILES = ("rgb.txt", "intrinsics.json", "metadata.yaml")
"""A folder with one of these files is a recording or a bag, and is checked even if it has a report.json."""


@dataclass(frozen=True, kw_only=True)
class CheckDriveRequest(SensorRequest, AcceptRequest):
    """The options of ``rse-pf check``."""

    source: str = option(
        metavar="SOURCE", help="a recording, bag, folder, video, device, or results of a map"
    )
    intrinsics: Path | None = option(
        "--intrinsics", metavar="FILE", help="file of the camera, used instead of the one in the source"
    )
    odometry: Path | None = option(
        "--odometry",
        metavar="FILE",
        help="compare the motion with this path (TUM format; default: truth or odometry.txt of the source)",
    )
    no_depth: bool = option("--no-depth", help="use the colour images only")
    frames: int | None = option("--frames", metavar="N", help="stop after N frames")
    write: Path | None = option(
        "--write", metavar="FILE", help="write intrinsics.json with the corrections that are certain"
    )
    out: Path | None = option("--out", metavar="DIR", help="write report.json to this folder")
    json: bool = option("--json", help="print the report as JSON")


def check_drive(request: CheckDriveRequest, settings: PlatformSettings) -> int:
    """Run ``rse-pf check``; return the exit code.

    The exit code is 1 if there is a finding, a doubt about the source that the user has not accepted, or no
    frame with a pose; else 0.  For a folder with the results of a map, the findings in its report.json are
    shown.
    """
    if request.frames is not None and request.frames < 2:
        raise UsageError(f"--frames {request.frames} is below 2", hint="leave it out to look at all frames")
    if request.write is not None and not request.write.absolute().parent.is_dir():
        raise UsageError(f"--write: there is no folder {request.write.absolute().parent}", hint="create it")
    folder = Path(request.source)
    results = folder / "report.json"
    if results.is_file() and not any((folder / name).exists() for name in _RECORDING_FILES):
        return _show_results(request, results)
    require("check")
    check_accepted(request.accept)
    if request.out is not None:
        try:
            request.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(
                f"cannot make {request.out}: {error.strerror}", hint="name another --out"
            ) from error
    report, own, shown = _checked(request, settings)
    document = report.to_dict()
    if request.out is not None:
        replace_file(request.out / "report.json", (json.dumps(document, indent=2) + "\n").encode())
    written = [] if request.write is None else _write(request.write, report, own)
    if request.json:
        show_json(document, indent=2)
    else:
        show(*check_lines(document, is_whole=True, shown=shown), *written)
    return 1 if report.findings or report.doubts or report.poses == 0 else 0


def _show_results(request: CheckDriveRequest, file: Path) -> int:
    """Show the check in the report.json of a map, and return the exit code; nothing is checked again."""
    report = read_document(file, "a report of a map", hint="check the recording itself")
    document = report.get("check") if isinstance(report, dict) else None
    if not isinstance(document, dict):
        raise UsageError(
            f"{request.source} was not checked while it was made, and its results have no images",
            hint="check the recording itself; only maps of cameras, recordings and bags are checked",
        )
    unused = ("write", "out", "odometry", "intrinsics", "frames")
    given = next((name for name in unused if getattr(request, name) is not None), None)
    if given is not None:
        raise UsageError(f"results of a map are shown only: no --{given}", hint="check the recording itself")
    if request.json:
        show_json(document, indent=2)
    else:
        show(*_lines_of_results(document, file))
    return 1 if document.get("findings") or document.get("source") or document.get("poses") == 0 else 0


def _lines_of_results(document: Mapping[str, Any], file: Path) -> list[str]:
    try:
        return check_lines(document, is_whole=True)
    except (TypeError, ValueError, AttributeError, MemoryError) as error:
        raise UsageError(f"{file} is not a report of a map", hint="check the recording itself") from error


def _checked(
    request: CheckDriveRequest, settings: PlatformSettings
) -> tuple[CheckReport, Intrinsics, tuple[str, ...]]:
    """Track the source; return the result of its check, its intrinsics, and the printed lines about doubts.

    A path that is no recording and no bag is opened as a camera, a video or a folder of images.
    """
    from client_sdk.bag_paths import is_bag
    from client_sdk.cameras import open_camera, source_of_recording
    from client_sdk.cameras.open_camera import is_device, is_recording
    from client_sdk.check.motion import MotionReference
    from client_sdk.datasets import open_dataset
    from client_sdk.rigs.intrinsics import Intrinsics
    from client_sdk.rigs.stereo_pair_checks import find_fault_of_frames

    path, has_depth = Path(request.source), not request.no_depth
    fault = truth = None
    if path.exists() and (is_recording(path) or is_bag(path)):
        dataset = open_dataset(path, camera=request.camera, imu=request.imu, intrinsics=request.intrinsics)
        fault = find_fault_of_frames(dataset.sample_pairs()) if dataset.has_stereo else None
        truth = MotionReference.of_truth(dataset)
        source = source_of_recording(request.source, dataset, depth=has_depth)
    else:
        source = open_camera(request.source, intrinsics=request.intrinsics, depth=has_depth,
                             camera=request.camera, imu=request.imu)  # fmt: skip
    with source:
        reference = _reference(request, truth)
        if reference is not None and reference is not truth:
            source.log.add_reference(f"the {reference.name}", reference.path.timestamps_s, source.span_s)
        shown = show_source(source.notes, unresolved(source.log.doubts, request.accept))
        most = request.frames or (_MAX_DEVICE_FRAMES if is_device(request.source) else None)
        report = _watched(source, settings, reference, fault, request.accept, most=most)
        return report, _base(request, Intrinsics(camera=source.camera)), shown


def _reference(request: CheckDriveRequest, truth: MotionReference | None) -> MotionReference | None:
    """Return the path with which the motion is compared: the file of the user, the truth, or odometry.txt.

    The first of these that exists is returned; None without one.
    """
    from client_sdk.check.motion import MotionReference

    if request.odometry is not None:
        return MotionReference.of_file(request.odometry)
    return truth or MotionReference.of_folder(request.source)


def _watched(
    source: FrameSource,
    settings: PlatformSettings,
    reference: MotionReference | None,
    fault: PairFault | None,
    accepted: Sequence[str],
    *,
    most: int | None,
) -> CheckReport:
    """Track at most *most* frames (None for all) in this process, and return the result of their check.

    If the source fails after its first frame, the frames before are checked.  *accepted* are the names of the
    doubts that the user has accepted.
    """
    from client_sdk.check.observer import DriveObserver
    from client_sdk.mapper import Mapper
    from rse_pf.extensions.experiments.compare.solvers import InProcessSolver

    observer = DriveObserver(reference)
    observer.add_pairs(fault)
    mapper = Mapper(ask=InProcessSolver(settings).ask, depth=source.has_depth, adds_frames=False)

    async def drive() -> None:
        for count, frame in enumerate(_until_it_fails(source), 1):
            observer.add(frame, await mapper.track(frame))
            if count % 10 == 0:
                show_progress(f"{count} frames, {mapper.lost_frames} lost", is_over=False)
            if most is not None and count >= most:
                break

    asyncio.run(drive())
    show_progress("", is_over=False)
    if not mapper.frames:
        raise UsageError("the source gives no frame", hint="look at it: rse-pf camera check SOURCE")
    observer.add_offsets(mapper.adjust_pairs())
    return observer.finish(unresolved(source.log.doubts, accepted), accepted)


def _until_it_fails(source: FrameSource) -> Iterator[Frame]:
    """Yield the frames until the source fails; add the failure to its log as a doubt.

    An error before the first frame is raised.
    """
    count = 0
    try:
        for frame in source:
            count += 1
            yield frame
    except RsePfError as error:
        if not count:
            raise
        source.log.add(ended_early(error, count))


def _base(request: CheckDriveRequest, seen: Intrinsics) -> Intrinsics:
    """Return the intrinsics to correct: those of ``--intrinsics``, else of the folder's file, else *seen*.

    The file of a rig is not corrected: *seen* is returned instead.
    """
    from client_sdk.rigs.intrinsics import Intrinsics
    from client_sdk.rigs.rig_file import read_calibration

    own = Path(request.source) / "intrinsics.json"
    file = request.intrinsics or (own if own.is_file() else None)
    known = None if file is None else read_calibration(file)
    return known if isinstance(known, Intrinsics) else seen


def _write(file: Path, report: CheckReport, own: Intrinsics) -> list[str]:
    """Write *own* with the corrections of certain findings to *file*, and return a line for the user.

    Nothing is written if no finding changes the intrinsics.
    """
    from client_sdk.check.corrections import corrected
    from client_sdk.rigs.intrinsics import write_intrinsics

    intrinsics, changes = corrected(own, report.findings)
    if not changes:
        return [f"{file} was not written: no finding changes intrinsics"]
    write_intrinsics(file, intrinsics)
    return [f"{file}: {', '.join(changes)}"]


ACTION = Action(request=CheckDriveRequest, run=check_drive)
