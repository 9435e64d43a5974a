"""RGB-D recordings as frames: TUM folders, NYU Depth V2 (labelled file or raw dump), ROS bags.

Every `Frame` is undistorted and registered, with depth in metres and colours in the order red, green, blue.
An image is read only when its frame is needed.  A path that cannot be used is reported in one line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags import Bag, BagOptions, is_bag, lens_or_rig, open_bag
from client_sdk.bags.index import pair_stamps
from client_sdk.datasets import nyu
from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import read_image_file
from client_sdk.datasets.rig_recordings import CameraChoice, is_euroc, is_kitti, open_euroc, open_kitti
from client_sdk.frontend import Frame
from client_sdk.mapping import Trajectory, read_trajectory
from client_sdk.rigs.intrinsics import Intrinsics, Undistortion, read_intrinsics
from rse_pf.errors import UsageError
from rse_pf.files import read_regular_file
from rse_pf.geometry import Camera

__all__ = ["associate_stamps", "dataset_of_bag", "open_dataset"]

_MAX_LIST_BYTES = 64 << 20
"""Of ``rgb.txt`` and ``depth.txt``: a million images."""
_MAX_STAMP_DIFFERENCE_S = 0.02
# The raw dump's two streams run freely; the nearest images are at most half a period apart.
_MAX_RAW_STAMP_DIFFERENCE_S = 0.05

# Intrinsics of the TUM benchmark by folder name; the last is its default for unnamed cameras.
_FREIBURG: dict[str, tuple[float, float, float, float, tuple[float, ...]]] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, ()),
    "": (525.0, 525.0, 319.5, 239.5, ()),
}
_FREIBURG_DEPTH_SCALE = 5000.0


def open_dataset(
    path: Path | str,
    *,
    scene: str | None = None,
    camera: CameraChoice | None = None,
    imu: bool | None = None,
    intrinsics: Path | str | None = None,
) -> Dataset:
    """Detect the format of *path* and return its frames; images are read later.

    Accepts a folder in TUM layout (``rgb.txt``, ``depth.txt``, with or without ``intrinsics.json``), a
    recording of EuRoC or a sequence of KITTI's odometry benchmark, a raw NYU Depth V2 folder (``r-*.ppm``,
    ``d-*.pgm``), its labelled ``.mat`` file, of which *scene* picks one scene, or a ROS bag.

    Args:
        path: The folder or file.
        scene: Of the labelled file.
        camera: ``stereo`` for both cameras of a rig, ``left`` for one; None for both where there are two.
        imu: Whether frames carry samples of the IMU; None for yes where there is one.
        intrinsics: File of the camera, in the place of ``intrinsics.json`` of a folder in TUM layout (it
            names ``depth_scale`` then) or of what a bag says.

    Raises:
        UsageError: The path is none of these, has a calibration of its own format beside *intrinsics*, a
            part is missing or broken, or it has no such camera or IMU.
        MissingExtra: OpenCV, h5py or rosbags is needed and not installed.
    """
    path = Path(path)
    if intrinsics is not None and not (_is_bag(path) or (path / "rgb.txt").is_file()):
        raise UsageError(
            f"{path} has a calibration of its own format", hint="leave out --intrinsics, or change that file"
        )
    if scene is None and is_euroc(path):
        return open_euroc(path, camera=camera, imu=imu)
    if scene is None and is_kitti(path):
        return open_kitti(path, camera=camera, imu=imu)
    if scene is None and _is_bag(path):
        use_stereo = None if camera is None else camera == "stereo"
        lens, rig = (None, None) if intrinsics is None else lens_or_rig(Path(intrinsics))
        options = BagOptions(use_stereo=use_stereo, use_imu=imu, lens=lens, rig=rig)
        return dataset_of_bag(open_bag(path, options))
    dataset = _open_single(path, scene, None if intrinsics is None else Path(intrinsics))
    if camera == "stereo":
        raise UsageError(f"{path} has one camera", hint="leave out --camera stereo")
    if imu:
        raise UsageError(f"{path} has no IMU", hint="leave out --imu")
    return dataset


def _is_bag(path: Path) -> bool:
    return is_bag(path) and not (path / "rgb.txt").is_file()


def _open_single(path: Path, scene: str | None, intrinsics: Path | None) -> Dataset:
    if path.is_file():
        if path.suffix != ".mat":
            raise UsageError(f"{path} is not a recording", hint="name a folder, a ROS bag or the .mat file")
        return _open_labelled(path, scene)
    if not path.is_dir():
        raise UsageError(
            f"no folder {path}",
            hint="name a folder of TUM (rgb.txt, depth.txt, images), EuRoC or KITTI",
        )
    if scene is not None:
        raise UsageError(f"{path} has no scenes", hint="name scenes for the labelled .mat file only")
    if not (path / "rgb.txt").exists() and any(path.glob("d-*.pgm")):
        return _open_raw(path)
    return _open_tum(path, intrinsics or path / "intrinsics.json")


def dataset_of_bag(bag: Bag) -> Dataset:
    """Return the frames of an open bag as a recording; they can be read until the bag is closed."""
    return Dataset(
        name=bag.name,
        camera=bag.camera,
        timestamps_s=bag.timestamps_s,
        truth=bag.truth,
        truth_kind=bag.truth_kind,
        rows=tuple(range(len(bag))),
        read=bag.read,
        notes=bag.notes,
        has_depth=bag.has_depth,
        has_stereo=bag.has_stereo,
        imu=bag.imu,
    )


def associate_stamps(
    first: Sequence[float], second: Sequence[float], max_difference_s: float
) -> list[tuple[int, int]]:
    """Return ``(row of first, row of second)`` pairs, nearest in time, each row at most once.

    Both must ascend.  If several rows are nearest to one partner, the closest of them gets it.
    """
    return pair_stamps(np.asarray(first, dtype=float), np.asarray(second, dtype=float), max_difference_s)


# --- TUM layout --------------------------------------------------------------------------------


def _open_tum(folder: Path, of_camera: Path) -> Dataset:
    colours, depths = _read_list(folder, "rgb.txt"), _read_list(folder, "depth.txt")
    pairs = associate_stamps(
        [stamp for stamp, _ in colours], [stamp for stamp, _ in depths], _MAX_STAMP_DIFFERENCE_S
    )
    for name, entries in (("rgb.txt", colours), ("depth.txt", depths)):
        if not entries:
            raise UsageError(
                f"{folder / name} lists no image", hint="write a line for each image: timestamp filename"
            )
    if not pairs:
        raise UsageError(
            f"no colour image of {folder} has a depth image within {_MAX_STAMP_DIFFERENCE_S:g} s",
            hint="check that rgb.txt and depth.txt use the same clock",
        )
    intrinsics, notes = _intrinsics(folder, of_camera)
    camera, undistort = intrinsics.camera, Undistortion(intrinsics)

    def read(row: int) -> Frame:
        colour_row, depth_row = pairs[row]
        rgb = read_image_file(folder / colours[colour_row][1], is_depth=False)
        png = read_image_file(folder / depths[depth_row][1], is_depth=True)
        _check_size(rgb, camera, folder / colours[colour_row][1])
        _check_size(png, camera, folder / depths[depth_row][1])
        depth_m = png.astype(np.float32) / np.float32(intrinsics.depth_scale)
        depth_m[png == np.iinfo(png.dtype).max] = 0.0  # some recorders write "no reading" so
        _check_metres(depth_m, folder)
        return Frame(
            timestamp_s=colours[colour_row][0],
            rgb=undistort.colour(rgb),
            depth_m=undistort.depth(depth_m),
            camera=camera,
        )

    truth, truth_kind = _read_truth(folder)
    return Dataset(
        name=folder.name,
        camera=camera,
        timestamps_s=tuple(colours[row][0] for row, _ in pairs),
        truth=truth,
        truth_kind=truth_kind,
        rows=tuple(range(len(pairs))),
        read=read,
        notes=notes,
    )


def _read_list(folder: Path, name: str) -> list[tuple[float, str]]:
    try:
        text = read_regular_file(folder / name, _MAX_LIST_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            f"no {name} in {folder}", hint="name a folder in TUM layout: rgb.txt, depth.txt, images"
        ) from error
    entries = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp, image = float(words[0]), words[1].strip()
        except (ValueError, IndexError) as error:
            raise UsageError(
                f"{folder / name}, line {number} is not an image", hint="write: timestamp filename"
            ) from error
        inside = Path(image)
        if not math.isfinite(stamp) or inside.is_absolute() or ".." in inside.parts:
            raise UsageError(
                f"{folder / name}, line {number} names no time, or no image below its folder",
                hint="write seconds, and a path such as rgb/1.png",
            )
        entries.append((stamp, image))
    return sorted(entries)


def _intrinsics(folder: Path, file: Path) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the intrinsics of a file, and notes on what was assumed where the folder has none."""
    if file.exists() or file.parent != folder:
        return read_intrinsics(file, with_depth_scale=True), ()
    name = next(key for key in _FREIBURG if key in folder.resolve().name)
    fx, fy, cx, cy, distortion = _FREIBURG[name]
    camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480)
    whose = f"those of {name} are used" if name else "a Kinect's are assumed"
    note = (
        f"{folder} has no intrinsics.json, so {whose}: fx {fx:g} fy {fy:g} cx {cx:g} cy {cy:g}, "
        f"{camera.width}x{camera.height} px, depth_scale {_FREIBURG_DEPTH_SCALE:g}"
    )
    assumed = Intrinsics(camera=camera, distortion=distortion, depth_scale=_FREIBURG_DEPTH_SCALE)
    return assumed, (note,)


def _read_truth(folder: Path) -> tuple[Trajectory | None, Literal["ground truth", "reference", "none"]]:
    if (folder / "groundtruth.txt").exists():
        return read_trajectory(folder / "groundtruth.txt"), "ground truth"
    if (folder / "reference_poses.txt").exists():
        return read_trajectory(folder / "reference_poses.txt"), "reference"
    return None, "none"


def _check_size(image: npt.NDArray[Any], camera: Camera, path: Path) -> None:
    """Refuse an image of another size: the intrinsics would be those of another camera."""
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise UsageError(
            f"{path} is {width}x{height} px, the camera of the recording {camera.width}x{camera.height} px",
            hint="give colour and depth the size in intrinsics.json, and scale fx, fy, cx, cy with it",
        )


def _check_metres(depth_m: npt.NDArray[np.float32], folder: Path) -> None:
    some = depth_m[::8, ::8]
    readings = some[some > 0]
    if len(readings) and not 0.05 <= float(np.median(readings)) <= 30.0:
        raise UsageError(
            f"the median depth in {folder} is {float(np.median(readings)):g} m",
            hint="set depth_scale in intrinsics.json: 5000 for TUM, 1000 for millimetres",
        )


# --- NYU Depth V2 ------------------------------------------------------------------------------


def _open_raw(folder: Path) -> Dataset:
    depths, colours = nyu.raw_files(folder, "d"), nyu.raw_files(folder, "r")
    pairs = associate_stamps(
        [file.timestamp_s for file in depths],
        [file.timestamp_s for file in colours],
        _MAX_RAW_STAMP_DIFFERENCE_S,
    )
    if not pairs:
        raise UsageError(
            f"no depth image of {folder} has a colour image within {_MAX_RAW_STAMP_DIFFERENCE_S:g} s",
            hint="unpack the whole scene: r-*.ppm and d-*.pgm",
        )
    colour = Undistortion(Intrinsics(camera=nyu.COLOUR_CAMERA, distortion=nyu.COLOUR_DISTORTION))
    depth = Undistortion(Intrinsics(camera=nyu.DEPTH_CAMERA, distortion=nyu.DEPTH_DISTORTION))

    def read(row: int) -> Frame:
        depth_row, colour_row = pairs[row]
        depth_m = nyu.depth_from_raw(nyu.read_pnm(depths[depth_row].path))
        return Frame(
            timestamp_s=depths[depth_row].timestamp_s,
            rgb=colour.colour(nyu.read_pnm(colours[colour_row].path)),
            depth_m=nyu.register_depth(depth.depth(depth_m)),
            camera=nyu.COLOUR_CAMERA,
        )

    return Dataset(
        name=folder.name,
        camera=nyu.COLOUR_CAMERA,
        timestamps_s=tuple(depths[row].timestamp_s for row, _ in pairs),
        truth=None,
        truth_kind="none",
        rows=tuple(range(len(pairs))),
        read=read,
    )


def _open_labelled(path: Path, scene: str | None) -> Dataset:
    """Return the labelled images, one second apart, because the file holds no time stamps."""
    file = nyu.LabelledFile(path)
    rows = file.rows(scene)

    def read(row: int) -> Frame:
        rgb, depth_m = file.read(rows[row])
        return Frame(timestamp_s=float(row), rgb=rgb, depth_m=depth_m, camera=nyu.COLOUR_CAMERA)

    return Dataset(
        name=scene or path.stem,
        camera=nyu.COLOUR_CAMERA,
        timestamps_s=tuple(float(row) for row in range(len(rows))),
        truth=None,
        truth_kind="none",
        rows=tuple(range(len(rows))),
        read=read,
    )
