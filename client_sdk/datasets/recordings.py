"""Open a recording of any known format, and read RGB-D recordings: TUM folders, and NYU Depth V2.

Frames are undistorted RGB images with depth in metres; the depth images of NYU Depth V2 are registered to the
colour camera here, those of TUM folders must be already.  An image is read only when its frame is needed.
EuRoC and KITTI are read in `client_sdk.datasets.rig_recordings`, bags in `client_sdk.bags`.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bag_paths import is_bag
from client_sdk.datasets import nyu
from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import check_size, probe, probe_size_px, read_colour, read_depth
from client_sdk.datasets.rig_recordings import CameraChoice, is_euroc, is_kitti, open_euroc, open_kitti
from client_sdk.frontend import Frame
from client_sdk.image_map import map_to_pinhole
from client_sdk.rigs.folder_camera import OWN_FILE, find_folder_camera
from client_sdk.rigs.intrinsics import Intrinsics, calibration_hint
from client_sdk.rigs.rig_file import read_intrinsics
from client_sdk.source_facts import (
    CameraFacts,
    DepthFacts,
    DoubtLog,
    LossFacts,
    SourceFacts,
    TimeFacts,
    check_source,
    median_depth_m,
    rows_in_time,
    stamps_in_seconds,
)
from client_sdk.stamp_pairs import pair_stamps
from client_sdk.trajectory import Trajectory, read_trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, Lens
from rse_pf.storage.files import check_exists, read_regular_file

__all__ = ["associate_stamps", "is_listed", "open_dataset"]

_MAX_LIST_BYTES = 64 << 20  # a longer list of images is refused; this is enough for a million images
_MAX_STAMP_DIFFERENCE_S = 0.02
"""Largest time between the colour and the depth image of a frame of a TUM folder, as in TUM's
``associate.py``; a colour image without such a depth image is left out."""
_MAX_RAW_STAMP_DIFFERENCE_S = 0.05
"""Largest time between the colour and the depth image of a frame of a raw dump of NYU Depth V2: one period at
the lowest rate of its two streams, which are not synchronised and have 20 to 30 images per second.  A depth
image without such a colour image is left out."""
_FREIBURG: dict[str, tuple[float, float, float, float, tuple[float, ...]]] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, ()),
    "": (525.0, 525.0, 319.5, 239.5, ()),
}
"""Cameras of the TUM benchmark by a part of the folder's name: fx, fy, cx, cy (px), and distortion k1 k2 p1
p2 k3.  The last entry, for all other names, is the benchmark's default for a Kinect."""
_OTHER_SOURCES = "a video, or a folder of images only, is mapped by rse-pf map from-camera"
_FREIBURG_DEPTH_SCALE = 5000.0  # units of a depth image of the TUM benchmark per metre


def open_dataset(
    path: Path | str,
    *,
    scene: str | None = None,
    camera: CameraChoice | None = None,
    imu: bool | None = None,
    intrinsics: Path | str | None = None,
) -> Dataset:
    """Open a recording of any known format; its images are read during the iteration.

    Accepts a folder in TUM layout (``rgb.txt``, ``depth.txt``, or a list of associations; with or without
    ``intrinsics.json``), a recording of EuRoC or a sequence of KITTI's odometry benchmark, a raw NYU Depth V2
    folder (``r-*.ppm``, ``d-*.pgm``), its labelled ``.mat`` file, of which *scene* picks one scene, or a ROS
    bag.

    Args:
        path: The folder or file.
        scene: Name of a scene of the labelled file; None for all images, and for other formats.
        camera: ``stereo`` uses both cameras of a stereo pair, and refuses a recording without; ``left`` uses
            the left camera of a pair, or the only camera; None uses both cameras if there are two.
        imu: Whether frames have samples of the IMU; True refuses a recording without an IMU; None means yes
            if there is one.
        intrinsics: File of intrinsics or of a rig that replaces the calibration of a folder in TUM layout or
            of a bag (for a folder with depth it must state ``depth_scale``); None uses their own.

    Raises:
        UsageError: The path has no known format, a part of the recording is missing or broken, facts about it
            contradict each other, it has no such scene, camera or IMU, or *intrinsics* is given for a format
            that has a calibration of its own.
        MissingExtra: OpenCV, h5py or rosbags is needed and not installed.
    """
    path = Path(path)
    check_exists(path, "name a folder of TUM (rgb.txt, depth.txt, images), EuRoC or KITTI, or a ROS bag")
    if intrinsics is not None and not (_is_bag(path) or is_listed(path)):
        raise UsageError(
            f"{path} has a calibration in a format of its own",
            hint="leave out --intrinsics, or correct the calibration file of the recording",
        )
    if scene is None and is_euroc(path):
        return open_euroc(path, camera=camera, imu=imu)
    if scene is None and is_kitti(path):
        return open_kitti(path, camera=camera, imu=imu)
    if scene is None and _is_bag(path):
        bags = importlib.import_module("client_sdk.bags")  # an extension, which reads bags as data sets
        use_stereo = None if camera is None else camera == "stereo"
        lens, rig = (None, None) if intrinsics is None else bags.lens_or_rig(Path(intrinsics))
        options = bags.BagOptions(use_stereo=use_stereo, use_imu=imu, lens=lens, rig=rig)
        bag: Dataset = bags.open_bag(path, options)
        return bag
    _check_calibration(path)
    dataset = _open_single(path, scene, None if intrinsics is None else Path(intrinsics))
    if camera == "stereo":
        raise UsageError(f"{path} has one camera", hint="leave out --camera stereo")
    if imu:
        raise UsageError(f"{path} has no IMU", hint="leave out --imu")
    return dataset


def _check_calibration(path: Path) -> None:
    """Refuse a folder with the images of KITTI or EuRoC, and without the file of their calibration.

    Raises:
        UsageError: The file is missing.
    """
    layouts = (("image_0", "", "calib.txt"), ("image_2", "", "calib.txt"),
               ("mav0/cam0/data", "mav0/cam0/data", "mav0/cam0/sensor.yaml"))  # fmt: skip
    for images, calibrated, file in layouts:
        if (path / images).is_dir() and not (path / file).exists() and not is_listed(path):
            folder = path / calibrated
            raise UsageError(
                f"there is no {path / file}, and the intrinsics are not known",
                hint=f"restore the file; or use the images of one camera without it: rse-pf camera calibrate "
                f"{folder} --out {folder / OWN_FILE}, then rse-pf map from-camera {folder}",
            )


def _is_bag(path: Path) -> bool:
    return is_bag(path) and not is_listed(path)


def is_listed(path: Path) -> bool:
    """Return whether a folder has a list of its images: ``rgb.txt``, or a list of pairs (``*assoc*.txt``)."""
    return (path / "rgb.txt").is_file() or _find_associations(path) is not None


def _find_associations(folder: Path) -> Path | None:
    """Return the list of associations of a folder; None without one.

    It is the first file ``*assoc*.txt`` by name, as TUM's ``associate.py`` writes it.  Each line has a colour
    and a depth image, in either order, each after its time stamp.
    """
    return next(iter(sorted(folder.glob("*assoc*.txt"))), None)


def _open_single(path: Path, scene: str | None, intrinsics: Path | None) -> Dataset:
    if path.is_file():
        if path.suffix != ".mat":
            raise UsageError(
                f"{path} is not a recording",
                hint=f"name a folder, a ROS bag or the .mat file; {_OTHER_SOURCES}",
            )
        return _open_labelled(path, scene)
    if scene is not None:
        raise UsageError(f"{path} has no scenes", hint="name scenes for the labelled .mat file only")
    if not is_listed(path) and any(path.glob("d-*.pgm")):
        return _open_raw(path)
    return _open_tum(path, intrinsics)


def associate_stamps(
    first: Sequence[float], second: Sequence[float], max_difference_s: float
) -> list[tuple[int, int]]:
    """Return the pairs ``(row of first, row of second)`` of time stamps (s) that are nearest to each other.

    Both sequences must ascend, and the pairs are in the order of *first*.  Each row is in one pair at most.
    If several rows of *first* have the same nearest row of *second*, the closest one gets it, and the others
    are in no pair.  The time stamps of a pair are at most *max_difference_s* apart.
    """
    return pair_stamps(np.asarray(first, dtype=float), np.asarray(second, dtype=float), max_difference_s)


# --- Folders in the layout of TUM: rgb.txt, depth.txt, groundtruth.txt ---


@dataclass(frozen=True, slots=True, kw_only=True)
class _ImageList:
    """The colour or the depth images of a folder in TUM layout, in the order of time.

    Attributes:
        times: All time stamps of the list, in the order of its lines, for `check_source`.
        stamps_s: Time stamps of the images that are used, s, which increase.
        images: Paths of the images that are used, relative to the folder.
        notes: Sentences for the user on the assumed unit of the time stamps.
    """

    times: TimeFacts
    stamps_s: tuple[float, ...]
    images: tuple[str, ...]
    notes: tuple[str, ...]


def _open_tum(folder: Path, named_intrinsics: Path | None) -> Dataset:
    """Return the recording of a folder in TUM layout, with the intrinsics of `_find_intrinsics`.

    Raises:
        UsageError: A file is missing or broken, or facts about the recording contradict each other.
        MissingExtra: OpenCV is not installed.
    """
    # 1. Read the lists of images.
    colours, depths = _read_lists(folder)
    # 2. Pair each colour image with the depth image that is nearest in time, and leave out those without one;
    #    in a folder without depth images, use all colour images.  Read the intrinsics.
    pairs = [(row, row) for row in range(len(colours.images))]
    if depths is not None:
        pairs = associate_stamps(colours.stamps_s, depths.stamps_s, _MAX_STAMP_DIFFERENCE_S)
        if not pairs:
            raise UsageError(
                f"no colour image of {folder} has a depth image within {_MAX_STAMP_DIFFERENCE_S:g} s: "
                f"colours begin at {colours.stamps_s[0]:.3f} s, depth at {depths.stamps_s[0]:.3f} s",
                hint="check that rgb.txt and depth.txt use the same clock",
            )
    stated_by, intrinsics, is_unit_stated, notes = _find_intrinsics(
        folder,
        named_intrinsics,
        lambda: probe_size_px([folder / image for image in colours.images]),
        has_depth=depths is not None,
    )
    total, lost = len(colours.images), len(colours.images) - len(pairs)
    unpaired = LossFacts(
        sentence=f"{lost} of {total} colour images of {folder} have no depth image of their own within "
        f"{_MAX_STAMP_DIFFERENCE_S:g} s and are left out",
        lost=lost,
        total=total,
        is_usual=True,
    )
    # 3. Prepare the undistortion with which a frame is read later.
    camera, undistortion = intrinsics.camera, map_to_pinhole(intrinsics)
    units_per_m = intrinsics.depth_units_per_m
    empty_depth: npt.NDArray[np.float32] = np.zeros((camera.height, camera.width), dtype=np.float32)

    def read_depth_of(row: int) -> npt.NDArray[np.float32]:
        if depths is None:
            return empty_depth
        path = folder / depths.images[pairs[row][1]]
        depth_m = read_depth(path, units_per_m)
        check_size(depth_m, camera, path)
        return depth_m

    def read(row: int) -> Frame:
        path = folder / colours.images[pairs[row][0]]
        rgb = read_colour(path)
        check_size(rgb, camera, path)
        return Frame(
            timestamp_s=colours.stamps_s[pairs[row][0]],
            rgb=undistortion.colour(rgb),
            depth_m=undistortion.depth(read_depth_of(row)),
            camera=camera,
        )

    # 4. Collect the facts about the recording, and compare them.
    truth, truth_kind, truth_notes = _read_truth(folder)
    probed = probe(range(len(pairs)), read_depth_of)
    depth = DepthFacts(
        median_m=median_depth_m(probed),
        units_per_m=units_per_m,
        is_unit_stated=is_unit_stated,
        is_registered=intrinsics.is_depth_registered,
    )
    lists = (colours,) if depths is None else (colours, depths)
    facts = SourceFacts(
        name=str(folder),
        cameras=(CameraFacts(stated_by=stated_by, lens=intrinsics),),
        depth=None if depths is None else depth,
        times=tuple(images.times for images in lists),
        references=()
        if truth is None
        else (TimeFacts(stated_by=truth_notes[0], stamps_s=truth.timestamps_s),),
        losses=(unpaired,) if unpaired.lost else (),
        assumed=(*notes, *(note for images in lists for note in images.notes), *truth_notes[1:]),
    )
    return Dataset(
        name=folder.name,
        camera=camera,
        timestamps_s=tuple(colours.stamps_s[row] for row, _ in pairs),
        truth=truth,
        truth_kind=truth_kind,
        rows=tuple(range(len(pairs))),
        read=read,
        has_depth=depths is not None,
        log=DoubtLog(check_source(facts)),
        notes=facts.notes,
    )


def _read_lists(folder: Path) -> tuple[_ImageList, _ImageList | None]:
    """Return the lists of the colour and of the depth images.

    If there is an ``rgb.txt``, a list of associations is not read.  The list of depth images is None if there
    is neither ``depth.txt`` nor a folder ``depth``.  In a list of associations, the second images of the
    lines are the depth images, unless only the path of the first image contains ``depth``.

    Raises:
        UsageError: A list is missing, empty or broken.
    """
    associations = _find_associations(folder)
    if not (folder / "rgb.txt").is_file() and associations is not None:
        rows = _read_rows(associations, 4)
        colours, depths = ([(row[column], row[column + 1]) for row in rows] for column in (0, 2))
        if rows and "depth" in colours[0][1].lower() and "depth" not in depths[0][1].lower():
            colours, depths = depths, colours
        name = associations.name
        return _make_list(folder, name, colours), _make_list(folder, name, depths)
    colour_list = _make_list(folder, "rgb.txt", _read_rows(folder / "rgb.txt", 2))
    if not (folder / "depth.txt").exists() and not (folder / "depth").is_dir():
        return colour_list, None
    return colour_list, _make_list(folder, "depth.txt", _read_rows(folder / "depth.txt", 2))


def _make_list(folder: Path, name: str, rows: Sequence[Sequence[str]]) -> _ImageList:
    """Return the images of the *rows* of the file *name*, each row a time stamp and a path.

    `rows_in_time` leaves out the images with the time stamp of the image before, and all images after the
    clock went back.

    Raises:
        UsageError: There is no row, or the time stamps go back more than once.
    """
    if not rows:
        raise UsageError(
            f"{folder / name} lists no image", hint="write a line for each image: timestamp filename"
        )
    stamps_s, notes = stamps_in_seconds(np.array([float(row[0]) for row in rows]), str(folder / name))
    times = TimeFacts(stated_by=str(folder / name), stamps_s=stamps_s)
    used, _ = rows_in_time(times)
    return _ImageList(
        times=times,
        notes=notes,
        stamps_s=tuple(stamps_s[used].tolist()),
        images=tuple(rows[row][1].strip() for row in used),
    )


def _read_rows(path: Path, columns: int) -> list[list[str]]:
    """Return the words of each line of a list of images: time stamps, each followed by a path.

    *columns*, the number of words of a line, is 2 for ``rgb.txt`` and 4 for a list of associations.

    Raises:
        UsageError: The file is missing, or a line has no finite time stamp or no path below the folder.
    """
    try:
        text = read_regular_file(path, _MAX_LIST_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            f"no {path.name} in {path.parent}",
            hint="name a folder in TUM layout (rgb.txt, depth.txt, images), or of EuRoC or KITTI; "
            f"{_OTHER_SOURCES}",
        ) from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split(maxsplit=columns - 1)
        if not words or words[0].startswith("#"):
            continue
        try:
            stamps = [float(word) for word in words[::2]]
            images = [Path(word.strip()) for word in words[1::2]]
        except ValueError:
            stamps, images = [], []
        if len(images) * 2 != columns:
            raise UsageError(
                f"{path}, line {number} has not {columns} words: a time stamp and a path",
                hint="write: timestamp filename" + (" timestamp filename" if columns == 4 else ""),
            )
        is_inside = not any(image.is_absolute() or ".." in image.parts for image in images)
        if not all(map(math.isfinite, stamps)) or not is_inside:
            raise UsageError(
                f"{path}, line {number} has no finite time stamp, or no path below its folder",
                hint="write seconds, and a path such as rgb/1.png",
            )
        rows.append(words)
    return rows


def _find_intrinsics(
    folder: Path, named: Path | None, size_px: Callable[[], tuple[int, int]], *, has_depth: bool
) -> tuple[str, Intrinsics, bool, tuple[str, ...]]:
    """Find the intrinsics of a folder in TUM layout.

    They are those of the file *named*, else of `find_folder_camera`, else of the benchmark's camera whose
    name is part of the folder's name, else of a Kinect.

    Args:
        folder: The folder, whose name may contain that of a camera of the benchmark.
        named: A file of intrinsics or of a rig that the user named; None without one.
        size_px: Returns width and height of the colour images, px.
        has_depth: Whether the folder has depth images.

    Returns:
        The file that states the intrinsics, or the folder; the intrinsics (those of the left camera of a
        rig); False if the unit of depth is assumed, else True; and sentences for the user on what was
        assumed.

    Raises:
        UsageError: The file cannot be read, or *named* or ``intrinsics.json`` states no unit of depth
            although there is depth.
    """
    found = find_folder_camera(folder, size_px) if named is None else (named, read_intrinsics(named))
    if found is not None:
        file, lens = found
        if lens.depth_scale is not None or not has_depth:
            return str(file), lens, True, ()
        if named is not None or file.name == OWN_FILE:
            raise UsageError(
                f"{file} has no depth_scale", hint="state it: 5000 for TUM, 1000 for millimetres"
            )
        note = (
            f"{file} states no unit of depth: {_FREIBURG_DEPTH_SCALE:g} units a metre are assumed, as TUM's"
        )
        return str(file), replace(lens, depth_scale=_FREIBURG_DEPTH_SCALE), False, (note,)
    name = next(key for key in _FREIBURG if key in folder.resolve().name)
    fx, fy, cx, cy, distortion = _FREIBURG[name]
    camera = Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=640, height=480)
    width, height = size_px()
    calibrate = calibration_hint(f"{folder} --depth-scale {_FREIBURG_DEPTH_SCALE:g}", folder / OWN_FILE)
    if (width, height) != (camera.width, camera.height):
        raise UsageError(
            f"there is no {folder / OWN_FILE}, and images of {width}x{height} px are not those of the "
            f"benchmark's cameras, which have {camera.width}x{camera.height} px",
            hint=calibrate,
        )
    whose = f"those of {name} are used" if name else "a Kinect's are assumed"
    note = (
        f"{folder} has no intrinsics.json, so {whose}: fx {fx:g} fy {fy:g} cx {cx:g} cy {cy:g}, "
        f"{camera.width}x{camera.height} px, depth_scale {_FREIBURG_DEPTH_SCALE:g}"
        + ("" if name else f"; if the camera is another one, {calibrate}")
    )
    assumed = Intrinsics(camera=camera, distortion=distortion, depth_scale=_FREIBURG_DEPTH_SCALE)
    return str(folder), assumed, bool(name), (note,)


def _read_truth(
    folder: Path,
) -> tuple[Trajectory | None, Literal["ground truth", "reference", "none"], tuple[str, ...]]:
    """Return the true trajectory of the camera, its kind as `Dataset.truth_kind`, and a tuple of texts.

    The first text is the file of the trajectory; the others are sentences for the user on its time stamps.
    The file is ``groundtruth.txt`` (a ground truth), else ``reference_poses.txt`` (an estimate of another
    program).  Without both, the trajectory is None, the kind ``none`` and the only text empty.

    Raises:
        UsageError: The file is broken.
    """
    known: tuple[tuple[str, Literal["ground truth", "reference"]], ...] = (
        ("groundtruth.txt", "ground truth"),
        ("reference_poses.txt", "reference"),
    )
    for name, kind in known:
        if (folder / name).exists():
            path = str(folder / name)
            trajectory = read_trajectory(folder / name)
            stamps_s, notes = stamps_in_seconds(trajectory.timestamps_s, path)
            if bool((np.diff(stamps_s) < 0.0).any()):
                notes = (*notes, f"the poses of {path} are not in the order of time, and are sorted")
            return Trajectory(stamps_s, trajectory.T_world_camera), kind, (path, *notes)
    return None, "none", ("",)


# --- NYU Depth V2: raw dumps, and the labelled file ---


def _open_raw(folder: Path) -> Dataset:
    """Return the raw dump of a folder; camera and unit of depth are those of the data set's toolbox."""
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
    colour_undistortion = map_to_pinhole(nyu.COLOUR_LENS)
    depth_undistortion = map_to_pinhole(nyu.DEPTH_LENS)

    def read(row: int) -> Frame:
        depth_row, colour_row = pairs[row]
        depth_m = nyu.read_raw_depth(depths[depth_row].path)
        return Frame(
            timestamp_s=depths[depth_row].timestamp_s,
            rgb=colour_undistortion.colour(read_colour(colours[colour_row].path)),
            depth_m=nyu.register_depth(depth_undistortion.depth(depth_m)),
            camera=nyu.COLOUR_CAMERA,
        )

    lost = len(depths) - len(pairs)
    unpaired = LossFacts(
        sentence=f"{lost} of {len(depths)} depth images of {folder} have no colour image "
        f"within {_MAX_RAW_STAMP_DIFFERENCE_S:g} s and are left out",
        lost=lost,
        total=len(depths),
        is_usual=True,
    )
    stamps_s = [depths[row].timestamp_s for row, _ in pairs]
    return _nyu_dataset(folder.name, stamps_s, read, (unpaired,) if lost else ())


def _open_labelled(path: Path, scene: str | None) -> Dataset:
    """Return the images of the labelled file, one second apart, because the file has no time stamps."""
    file = nyu.LabelledFile(path)
    rows = file.rows(scene)

    def read(row: int) -> Frame:
        rgb, depth_m = file.read(rows[row])
        return Frame(timestamp_s=float(row), rgb=rgb, depth_m=depth_m, camera=nyu.COLOUR_CAMERA)

    stamps_s = [float(row) for row in range(len(rows))]
    assumed = f"{path} holds no time stamps: 1 s between images is assumed"
    return _nyu_dataset(scene or path.stem, stamps_s, read, assumed=(assumed,))


def _nyu_dataset(
    name: str,
    stamps_s: Sequence[float],
    read: Callable[[int], Frame],
    losses: Sequence[LossFacts] = (),
    assumed: tuple[str, ...] = (),
) -> Dataset:
    """Return a recording of NYU Depth V2, whose camera and depth unit the toolbox of the data set states.

    *read* reads the frame of a row, with depth in metres; *stamps_s* has a time stamp for each row.
    """
    camera = nyu.COLOUR_CAMERA
    depths_m = probe(range(len(stamps_s)), lambda row: read(row).depth_m)
    whose = (
        f"the camera of {name} is that of the toolbox of NYU Depth V2: fx {camera.fx:.2f} fy {camera.fy:.2f} "
        f"cx {camera.cx:.2f} cy {camera.cy:.2f}"
    )
    facts = SourceFacts(
        name=name,
        cameras=(CameraFacts(stated_by="the toolbox of NYU Depth V2", lens=Lens(camera=camera)),),
        depth=DepthFacts(
            median_m=median_depth_m(depths_m), units_per_m=1.0, is_unit_stated=True, is_registered=True
        ),
        times=(TimeFacts(stated_by=name, stamps_s=np.array(stamps_s)),),
        losses=losses,
        assumed=(whose, *assumed),
    )
    return Dataset(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamps_s),
        truth=None,
        truth_kind="none",
        rows=tuple(range(len(stamps_s))),
        read=read,
        notes=facts.notes,
        log=DoubtLog(check_source(facts)),
    )
