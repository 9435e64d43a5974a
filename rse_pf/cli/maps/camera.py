"""Calibrate a camera, print a board for it, or check what a camera gives.

SOURCE is a device number (0), a video, images, a folder or a recording.  calibrate writes intrinsics.json,
which every command that opens a camera reads.  With --board it looks for a board; a board of 9x6 has 9 by 6
inner corners.  Without --board it uses the motion of the camera in a video or recording.

examples:
  rse-pf camera board --board 9x6 --square-mm 25 --out board.pdf
  rse-pf camera calibrate 0 --board 9x6 --square-mm 25 --out intrinsics.json
  rse-pf camera calibrate images/*.png --board 9x6 --square-mm 25
  rse-pf camera calibrate drive.mp4
  rse-pf camera calibrate --stereo 0 2 --board 9x6 --square-mm 25 --out rig.json
  rse-pf camera check 0
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from client_sdk.bag_paths import BAG_ENDINGS
from rse_pf.cli.maps.frame_table import named_frames
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.storage.files import check_exists
from rse_pf.terminal import show, show_json, show_progress

if TYPE_CHECKING:
    import numpy.typing as npt

    from client_sdk.cameras.board import Board

__all__ = ["ACTION"]

# A calibration with a board stops reading images once this many of them show the board in different views.
_WANTED_VIEWS = 25
# Images after which a calibration with a live camera, or by motion, stops reading: 100 s at 30 Hz.
_MAX_IMAGES = 3000


@dataclass(frozen=True, kw_only=True)
class _BoardRequest:
    board: str | None = option(
        "--board", metavar="CxR", help="inner corners of a board (9x6 if only its squares are stated)"
    )
    square_mm: float | None = option(
        "--square-mm", metavar="MM", help="edge of a square (25 if only a board is stated)"
    )

    def read_board(self) -> Board:
        """Return the board of the options (default: 9x6 inner corners, 25 mm squares); raises UsageError."""
        from client_sdk.cameras.board import Board

        return Board.parse(self.board or "9x6", 25.0 if self.square_mm is None else self.square_mm)


@dataclass(frozen=True, kw_only=True)
class _WriteRequest(_BoardRequest):
    out: Path = option("--out", default=Path("board.pdf"), metavar="FILE", help="a .pdf file")


@dataclass(frozen=True, kw_only=True)
class _CalibrateRequest(_BoardRequest):
    sources: tuple[str, ...] = option(
        nargs="+",
        metavar="SOURCE",
        help="a device number, a video, images or a recording; with --stereo one or two, which see a board",
    )
    stereo: bool = option(
        "--stereo",
        help="calibrate a pair by a board: two sources, or one whose images show both cameras side by side",
    )
    out: Path | None = option(
        "--out", metavar="FILE", help="default: intrinsics.json; with --stereo: rig.json"
    )
    max_rms_px: float = option(
        "--max-rms-px",
        default=1.0,
        metavar="PX",
        help="refuse a calibration with a larger reprojection error (default: 1)",
    )
    depth_scale: float | None = option(
        "--depth-scale",
        metavar="N",
        help="units of a 16-bit depth image in a metre (default: left out, which means 1000)",
    )

    @property
    def file(self) -> Path:
        """The file that the calibration is written to."""
        return self.out or Path("rig.json" if self.stereo else "intrinsics.json")


@dataclass(frozen=True, kw_only=True)
class _CheckRequest:
    source: str = option(metavar="SOURCE", help="a device, a video, a folder or a recording")
    frames: int = option("--frames", default=60, metavar="N", help="frames to look at (default: 60)")
    json: bool = option("--json", help="print JSON")


def write_board_file(request: _WriteRequest, settings: PlatformSettings) -> None:
    """Write a chessboard as a PDF that can be printed, and print its size."""
    from client_sdk.cameras.board import write_board

    board = request.read_board()
    write_board(request.out, board)
    square_mm = 25.0 if request.square_mm is None else request.square_mm
    show(
        f"{request.out}: {board.columns}x{board.rows} inner corners, squares of {square_mm:g} mm",
        "print it at 100 %, measure a square, and fix it to something flat",
    )


def calibrate_camera(request: _CalibrateRequest, settings: PlatformSettings) -> None:
    """Estimate the intrinsics of a camera, or with --stereo of a rig, and write them to a file.

    With --board, --square-mm or --stereo, images of a chessboard are used, else the motion of the camera.
    """
    from client_sdk.cameras.open_camera import is_device

    has_board = request.board is not None or request.square_mm is not None or request.stereo
    board = request.read_board() if has_board else None
    if not request.max_rms_px > 0:
        raise UsageError(f"--max-rms-px {request.max_rms_px:g} is not above 0", hint="good cameras reach 0.5")
    if not request.file.absolute().parent.is_dir():
        folder = request.file.absolute().parent
        raise UsageError(f"--out: there is no folder {folder}", hint="create it")
    for source in request.sources:
        is_bag = Path(source).suffix in BAG_ENDINGS
        if is_bag or (source == "realsense" and is_device(source)):
            verb = "map from-bag" if is_bag else "map from-camera"
            raise UsageError(
                f"{source} states its own calibration, and is not calibrated here",
                hint=f"use rse-pf {verb} {source}, or calibrate a video or a folder of its images",
            )
        if not is_device(source) and "://" not in source:
            check_exists(source, "name a device by its number, a video, images or a recording that exists")
    if board is None:
        _calibrate_from_motion(request)
    elif request.stereo:
        _calibrate_stereo(request, board)
    else:
        _calibrate_with_board(request, board)


def _calibrate_with_board(request: _CalibrateRequest, board: Board) -> None:
    """Calibrate one camera by images of *board*; a live camera is read until there are enough views."""
    from client_sdk.cameras.calibration import BoardViews, calibrate
    from client_sdk.cameras.open_camera import is_device
    from client_sdk.rigs.intrinsics import write_intrinsics

    views = BoardViews(board)
    is_live = len(request.sources) == 1 and is_device(request.sources[0])
    for image in _raw_images(request.sources):
        views.add(image)
        show_progress(
            f"{len(views.views)} of {_WANTED_VIEWS} views in {views.images} images; move and tilt the board",
            is_over=False,
        )
        if len(views.views) >= _WANTED_VIEWS or (is_live and views.images >= _MAX_IMAGES):
            break
    show_progress(f"{len(views.views)} views in {views.images} images; computing", is_over=True)
    calibration = calibrate(views, max_rms_px=request.max_rms_px, depth_scale=request.depth_scale)
    write_intrinsics(request.file, calibration)
    camera = calibration.camera
    show(
        f"{request.file}: fx {camera.fx:.2f}  fy {camera.fy:.2f}  cx {camera.cx:.2f}  cy {camera.cy:.2f}, "
        f"{camera.width}x{camera.height} px",
        f"reprojection error {calibration.rms_px:.3f} px rms over {calibration.views} views",
    )


def _calibrate_from_motion(request: _CalibrateRequest) -> None:
    """Calibrate one camera by selected views of a scene, and write its standard deviations, too."""
    from client_sdk.cameras.self_calibration import calibrate_from_motion
    from client_sdk.cameras.view_selection import select_views
    from client_sdk.rigs.intrinsics import intrinsics_to_json, write_json

    require("camera calibrate without --board")

    def on_progress(step: str) -> None:
        show_progress(f"{len(views)} views of {images} images: {step}", is_over=False)

    views, images = select_views(itertools.islice(_raw_images(request.sources), _MAX_IMAGES))
    found = calibrate_from_motion(
        views,
        max_rms_px=request.max_rms_px,
        depth_scale=request.depth_scale,
        on_progress=on_progress,
    )
    deviations = found.standard_deviations
    stated = {name: float(f"{value:.3g}") for name, value in deviations.items()}
    write_json(request.file, intrinsics_to_json(found.intrinsics) | {"standard_deviations": stated})
    camera, distortion = found.intrinsics.camera, found.intrinsics.distortion
    centre = "in the middle of the image, not estimated"
    if "cx" in deviations:
        centre = f"+- {deviations['cx']:.1f} and {deviations['cy']:.1f}"
    show(
        f"{request.file}: fx = fy = {camera.fx:.1f} +- {deviations['f']:.1f} px, "
        f"cx {camera.cx:.1f}, cy {camera.cy:.1f} ({centre}), {camera.width}x{camera.height} px",
        f"k1 {distortion[0]:.4f} +- {deviations['k1']:.4f}, k2 {distortion[1]:.4f} +- {deviations['k2']:.4f}",
        f"reprojection error {found.intrinsics.rms_px:.3f} px rms over {found.intrinsics.views} views "
        f"of {images} images",
    )


def _calibrate_stereo(request: _CalibrateRequest, board: Board) -> None:
    """Calibrate two cameras and their relative pose by pairs of images of *board*."""
    from client_sdk.cameras.open_camera import is_device
    from client_sdk.cameras.stereo_calibration import PairViews, calibrate_pair
    from client_sdk.rigs.rig_file import write_rig

    views = PairViews(board)
    is_live = all(is_device(source) for source in request.sources)
    for left, right in _raw_pairs(request.sources):
        views.add(left, right)
        show_progress(
            f"{len(views.pairs)} of {_WANTED_VIEWS} views of both in {views.left.images} pairs; "
            "move and tilt the board",
            is_over=False,
        )
        if len(views.pairs) >= _WANTED_VIEWS or (is_live and views.left.images >= _MAX_IMAGES):
            break
    show_progress(f"{len(views.pairs)} views of both; computing", is_over=True)
    found = calibrate_pair(views, max_rms_px=request.max_rms_px)
    write_rig(request.file, found.rig)
    show(
        f"{request.file}: baseline {1e3 * found.baseline_m:.2f} mm; "
        f"reprojection error {found.rms_px:.3f} px rms over {found.views} views of both cameras",
        *(
            f"{each.name}: fx {each.lens.camera.fx:.2f}  fy {each.lens.camera.fy:.2f}, "
            f"{each.lens.rms_px:.3f} px rms over {each.lens.views} views"
            for each in found.rig.cameras
        ),
    )


def _raw_pairs(sources: Sequence[str]) -> Iterator[tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]]:
    """Yield pairs of grey images, left and right.

    They are of two sources, of the folders ``left`` and ``right`` of one source, or halves of the images of
    one source, in which both cameras are side by side.

    Raises:
        UsageError: There are more than two sources.
    """
    if len(sources) > 2:
        raise UsageError(
            f"--stereo takes 1 or 2 sources, not {len(sources)}",
            hint="name two devices, videos or folders, or one whose images show both cameras",
        )
    folder = Path(sources[0])
    if len(sources) == 1 and (folder / "left").is_dir() and (folder / "right").is_dir():
        sources = [str(folder / "left"), str(folder / "right")]
    if len(sources) == 2:
        yield from zip(_raw_images(sources[:1]), _raw_images(sources[1:]), strict=False)
        return
    for image in _raw_images(sources):
        half = image.shape[1] // 2
        yield np.ascontiguousarray(image[:, :half]), np.ascontiguousarray(image[:, half : 2 * half])


def _raw_images(sources: Sequence[str]) -> Iterator[npt.NDArray[np.uint8]]:
    """Yield grey images of *sources* without undistortion: image files, folders, or one video or device.

    Of a EuRoC recording, the images of its left camera.

    Raises:
        UsageError: A folder has no image, or several sources are not all images.
    """
    from client_sdk.cameras.folder import list_folder
    from client_sdk.cameras.opencv_video import open_video
    from client_sdk.datasets.images import is_image, read_colour

    paths: list[Path] = []
    for word in sources:
        euroc = Path(word) / "mav0" / "cam0" / "data"
        folder = euroc if euroc.is_dir() else Path(word)
        paths += list_folder(folder).images if folder.is_dir() else [folder] if is_image(folder) else []
    for path in paths:
        yield _gray(read_colour(path))
    if paths:
        return
    if len(sources) > 1 or Path(sources[0]).is_dir():
        raise UsageError(f"there is no image {sources[0]}", hint="name images, one video, or one device")
    video = open_video(sources[0])
    try:
        for _, rgb, _ in video.images:
            yield _gray(rgb)
    finally:
        video.close()


def check_camera(request: _CheckRequest, settings: PlatformSettings) -> int:
    """Print size, rate, depth and blur of the first --frames frames of a source.

    Returns 1 if more than half of them are blurred or empty, else 0.
    """
    if request.frames < 2:
        raise UsageError(f"--frames {request.frames} is below 2", hint="60 is two seconds of a webcam")
    from client_sdk.check.frames import FrameStatistics

    stamps, statistics, size = [], FrameStatistics(), (0, 0)
    lengths: Counter[str] = Counter()
    for stamp, rgb, length in itertools.islice(_frames(request.source), request.frames):
        stamps.append(stamp)
        statistics.add(stamp, rgb)
        lengths[length] += 1
        size = (rgb.shape[1], rgb.shape[0])
    if len(stamps) < 2:
        raise UsageError(f"{request.source} gives {len(stamps)} frames", hint="a check needs 2 or more")
    unsharp = [int(row) + 1 for row in np.flatnonzero(statistics.blurred() | statistics.empty())]
    rate_hz = (len(stamps) - 1) / max(stamps[-1] - stamps[0], 1e-9)
    figures: dict[str, Any] = {
        "source": request.source, "width": size[0], "height": size[1], "frames": len(stamps),
        "rate_hz": round(rate_hz, 2), "with_depth": lengths["depth"],
        "with_stereo": lengths["a stereo pair"], "blurred": len(unsharp),
    }  # fmt: skip
    if request.json:
        show_json(figures)
    else:
        length = next(filter(None, lengths), "no depth")
        show(
            f"{request.source}: {size[0]}x{size[1]} px, {rate_hz:.1f} frames per second, {length}",
            f"{len(unsharp)} of the first {len(stamps)} frames are blurred or empty"
            + (f": {named_frames(unsharp)}" if unsharp else ""),
        )
    return 1 if len(unsharp) > len(stamps) / 2 else 0


def _frames(source: str) -> Iterator[tuple[float, npt.NDArray[np.uint8], str]]:
    """Yield for each frame of *source* its time stamp in s, its colours, and what measures distances.

    That is ``depth``, ``a stereo pair``, or "" for neither.  A video and a device need no intrinsics here.
    """
    from client_sdk.cameras import open_camera
    from client_sdk.cameras.folder import list_folder
    from client_sdk.cameras.open_camera import is_recording
    from client_sdk.cameras.opencv_video import open_video
    from client_sdk.source_facts import DoubtLog

    path = Path(source)
    has_pairs = (path / "left").is_dir() and (path / "right").is_dir()
    if path.is_dir() and not has_pairs and not is_recording(path) and not (path / "rgb.txt").exists():
        images = list_folder(path).frames(DoubtLog(), 1000.0)
        yield from ((stamp, rgb, "" if depth_m is None else "depth") for stamp, rgb, depth_m in images)
    elif source == "realsense" or path.is_dir() or path.suffix in (*BAG_ENDINGS, ".mat"):
        with open_camera(source) as frames:
            for frame in frames:
                by_depth = "depth" if frame.depth_m.any() else ""
                yield frame.timestamp_s, frame.rgb, by_depth if frame.stereo is None else "a stereo pair"
    else:
        video = open_video(source)
        try:
            yield from ((stamp, rgb, "") for stamp, rgb, _ in video.images)
        finally:
            video.close()


def _gray(rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the luminance, ITU-R BT.601, as OpenCV does."""
    gray: npt.NDArray[np.uint8] = np.rint(rgb @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return gray


ACTION = Action(
    actions={
        "calibrate": Action(
            help="write the intrinsics of a camera, from views of a board or from motion",
            description="Without --board, --square-mm and --stereo, the motion of the camera is used.",
            example="rse-pf camera calibrate 0 --board 9x6 --square-mm 25",
            request=_CalibrateRequest,
            run=calibrate_camera,
        ),
        "board": Action(
            help="write a board to print",
            example="rse-pf camera board --board 9x6 --square-mm 25 --out board.pdf",
            request=_WriteRequest,
            run=write_board_file,
        ),
        "check": Action(
            help="show what a camera gives: size, rate, depth, blur",
            example="rse-pf camera check 0",
            request=_CheckRequest,
            run=check_camera,
        ),
    }
)
