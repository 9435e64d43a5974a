"""Read recordings of EuRoC (ASL) and KITTI odometry: left camera or stereo pair, IMU, and true trajectory.

Frames of one camera are undistorted, those of a stereo pair are rectified.  The true trajectory is that of
the camera of the frames: the left camera, or the rectified left camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import check_size, image_files, probe_size_px, read_colour
from client_sdk.frontend import Frame, load_opencv
from client_sdk.image_map import map_to_pinhole
from client_sdk.rigs.benchmark_files import (
    read_euroc_camera,
    read_euroc_imu,
    read_kitti_rig,
    read_numbers,
    read_text,
)
from client_sdk.rigs.imu_track import ImuTrack
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig
from client_sdk.source_facts import (
    CameraFacts,
    Doubt,
    DoubtLog,
    DoubtName,
    LossFacts,
    SourceFacts,
    TimeFacts,
    check_source,
    rows_in_time,
    some_names,
    stamps_in_seconds,
)
from client_sdk.stamp_pairs import pair_stamps
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, from_quaternion

__all__ = ["CameraChoice", "is_euroc", "is_kitti", "open_euroc", "open_kitti"]

CameraChoice = Literal["stereo", "left"]
"""The cameras of a stereo rig that are used: both, or the left one alone."""

_EUROC_TRUTH = "state_groundtruth_estimate0/data.csv"  # file of the true trajectory in the folder mav0
_MAX_PAIR_DIFFERENCE_S = 0.005
"""Largest time between the two images of a stereo pair of EuRoC: the shutters of both cameras open together,
so images that are farther apart were not taken together."""
_KITTI_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))
"""Folders of the left and the right camera of KITTI: first the grey ones, then the colour ones.  The digit of
a folder is that of its camera's projection matrix in ``calib.txt``, such as ``P0``."""


def is_euroc(folder: Path) -> bool:
    """Return whether a folder, or the folder ``mav0`` in it, has the layout of EuRoC."""
    return (_mav0_of(folder) / "cam0" / "sensor.yaml").is_file()


def is_kitti(folder: Path) -> bool:
    """Return whether a folder has the layout of a sequence of KITTI's odometry benchmark."""
    return (folder / "calib.txt").is_file() and any((folder / left).is_dir() for left, _ in _KITTI_PAIRS)


def open_euroc(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the recording of a folder in the layout of EuRoC: ``cam0`` or both cameras, with ``imu0``.

    Args:
        folder: The folder ``mav0``, or the folder that contains it.
        camera: ``stereo`` or ``left``; None means both cameras if there are two.
        imu: Whether frames have samples of the IMU; None means yes if there is one.

    Raises:
        UsageError: A file is missing or broken, facts about the recording contradict each other, or there is
            no such camera or IMU.
        MissingExtra: OpenCV is not installed.
    """
    # 1. Read the lists of images, and the rig.
    folder = _mav0_of(folder)
    wants_stereo = None if camera is None else camera == "stereo"
    has_stereo = _is_used(folder / "cam1" / "sensor.yaml", wants_stereo, "cam1")
    has_imu = _is_used(folder / "imu0" / "sensor.yaml", imu, "imu0")
    cameras = [read_euroc_camera(folder / "cam0" / "sensor.yaml", "left")]
    lefts, stamps_s, notes, doubts = _read_euroc_images(folder / "cam0")
    rights: list[Path] | None = None
    losses: tuple[LossFacts, ...] = ()
    if has_stereo:
        cameras.append(read_euroc_camera(folder / "cam1" / "sensor.yaml", "right"))
        all_rights, right_stamps_s, *_ = _read_euroc_images(folder / "cam1")
        pairs, losses = _pair_images(stamps_s, right_stamps_s, folder.parent.name)
        lefts, stamps_s = [lefts[row] for row, _ in pairs], stamps_s[[row for row, _ in pairs]]
        rights = [all_rights[row] for _, row in pairs]
    rig = Rig(
        cameras=tuple(cameras), imu=read_euroc_imu(folder / "imu0" / "sensor.yaml") if has_imu else None
    )
    # 2. Read the true trajectory of the body, if the recording has one.
    body_path = None
    if (folder / _EUROC_TRUTH).is_file():
        rows = [row[:8] for row in _read_table(folder / _EUROC_TRUTH, 8)]
        values = read_numbers(folder / _EUROC_TRUTH, [word for row in rows for word in row]).reshape(-1, 8)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, 3] = values[:, 1:4]
        poses[:, :3, :3] = [from_quaternion(xyzw) for xyzw in values[:, [5, 6, 7, 4]]]
        truth_s, truth_notes = stamps_in_seconds(values[:, 0], str(folder / _EUROC_TRUTH), "nanoseconds")
        body_path = Trajectory(truth_s, poses)
        notes += truth_notes
    name = folder.parent.name if folder.name == "mav0" else folder.name
    # 3. Read the samples of the IMU, if they are used.
    samples = None
    if has_imu:
        rows = [row[:7] for row in _read_table(folder / "imu0" / "data.csv", 7)]
        values = read_numbers(folder / "imu0" / "data.csv", [word for row in rows for word in row])
        samples = values.reshape(-1, 7)
        samples[:, 0], imu_notes = stamps_in_seconds(samples[:, 0], str(folder / "imu0"), "nanoseconds")
        notes += imu_notes
    return _make_dataset(
        name or folder.name,
        rig,
        lefts=lefts,
        rights=rights,
        stamps_s=stamps_s,
        body_path=body_path,
        samples=samples,
        stated_by=(str(folder / "cam0" / "sensor.yaml"), str(folder / "cam0" / "data.csv"), _EUROC_TRUTH),
        notes=notes,
        losses=losses,
        doubts=doubts,
    )


def open_kitti(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return a sequence of KITTI's odometry benchmark: one camera, or a stereo pair.

    The grey cameras are used if the sequence has them, else the colour cameras.

    The true trajectory is in ``poses.txt`` of the folder, or in ``../../poses/NAME.txt``, where NAME is the
    name of the folder; a sequence with neither file has none.

    Args:
        folder: The folder of the sequence.
        camera: ``stereo`` or ``left``; None means both cameras if there are two.
        imu: Must not be True, because the sequences have no IMU.

    Raises:
        UsageError: A file is missing or broken, facts about the recording contradict each other, or there is
            no such camera or IMU.
        MissingExtra: OpenCV is not installed.
    """
    if imu:
        raise UsageError(f"{folder} has no IMU: KITTI's sequences hold none", hint="leave out --imu")
    # 1. Find the lines of times.txt and poses.txt that belong to each image.
    left, right = next(pair for pair in _KITTI_PAIRS if (folder / pair[0]).is_dir())
    wants_stereo = None if camera is None else camera == "stereo"
    has_stereo = _is_used(folder / right, wants_stereo, right)
    times_s = read_numbers(folder / "times.txt", read_text(folder / "times.txt").split())
    paths = image_files(folder / left)
    if not paths or not len(times_s):
        raise UsageError(f"{folder} lacks images or times", hint="unpack the sequence again")
    truth_files = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    truth_file = next((file for file in truth_files if file.is_file()), None)
    poses = None if truth_file is None else _read_kitti_poses(truth_file)
    line_counts = {"times.txt": len(times_s)} | ({} if poses is None else {"poses.txt": len(poses)})
    rows, notes = _match_kitti_lines(paths, line_counts, folder)
    stamps_s = times_s[rows["times.txt"]]
    used, doubts = rows_in_time(TimeFacts(stated_by=str(folder / "times.txt"), stamps_s=stamps_s))
    # 2. Find the right image of each left one by its number, and leave out left images without a right one.
    rights: list[Path] | None = None
    if has_stereo:
        partners = {path.stem: path for path in image_files(folder / right)}
        alone = [paths[row].name for row in used if paths[row].stem not in partners]
        used = [row for row in used if paths[row].stem in partners]
        if not used:
            raise UsageError(
                f"no image of {folder / left} has one of the same number in {folder / right}",
                hint="unpack the sequence again, or --camera left",
            )
        if alone:
            sentence = f"{len(alone)} of {len(paths)} images of {folder} left out, without a right image: "
            doubt = Doubt(
                name=DoubtName.LEFT_OUT, sentence=sentence + some_names(alone), hint="unpack it again"
            )
            doubts = (*doubts, doubt)
        rights = [partners[paths[row].stem] for row in used]
    # 3. Select the poses of the used images, and read the rig.
    truth = None
    if poses is not None:
        truth = Trajectory(stamps_s[used], poses[rows["poses.txt"]][used])
    lefts = [paths[row] for row in used]
    projections = (f"P{left[-1]}", f"P{right[-1]}") if has_stereo else (f"P{left[-1]}",)
    rig = read_kitti_rig(folder / "calib.txt", probe_size_px(lefts), projections)
    dataset = _make_dataset(
        folder.name,
        rig,
        lefts=lefts,
        rights=rights,
        stamps_s=stamps_s[used],
        body_path=truth,
        samples=None,
        stated_by=(str(folder / "calib.txt"), str(folder / "times.txt"), str(truth_file)),
        notes=notes,
        doubts=doubts,
    )
    # KITTI states no pose of a camera in a vehicle, so that the pose of the camera in its body is not known;
    # the body of `read_kitti_rig` is the camera of P0 instead.
    return replace(dataset, T_body_camera=None)


def _read_kitti_poses(path: Path) -> Array:
    """Return the poses ``(n, 4, 4)``, m, of the camera with the projection matrix ``P0`` in the world.

    Each line of the file has the 12 numbers of a 3x4 matrix, row by row.

    Raises:
        UsageError: The file cannot be read, or the count of its numbers is no multiple of 12.
    """
    values = read_numbers(path, read_text(path).split())
    if len(values) % 12:
        raise UsageError(
            f"{path} has {len(values)} numbers, which are not 12 in each line",
            hint="unpack the sequence again",
        )
    poses = np.tile(np.eye(4), (len(values) // 12, 1, 1))
    poses[:, :3] = values.reshape(-1, 3, 4)
    return poses


def _match_kitti_lines(
    paths: Sequence[Path], line_counts: Mapping[str, int], folder: Path
) -> tuple[dict[str, list[int]], tuple[str, ...]]:
    """Return for each file, by its name, the line that belongs to each image, and notes on what was assumed.

    Line *n* (from 0) belongs to the image of number *n*.  If a file is too short for these numbers, or a name
    is no number, but the file has as many lines as there are images, both are a part of the sequence: the
    lines then belong to the images in their order.

    Args:
        paths: The images; their names are their numbers.
        line_counts: The number of lines of each file, by its name.
        folder: The folder of the sequence, for messages.

    Raises:
        UsageError: A file is too short for the numbers of the images, and does not have one line for each
            image.
    """
    numbers = [int(path.stem) if path.stem.isdecimal() else None for path in paths]
    rows: dict[str, list[int]] = {}
    notes: tuple[str, ...] = ()
    for name, line_count in line_counts.items():
        by_number = [number for number in numbers if number is not None and number < line_count]
        if len(by_number) == len(paths):
            rows[name] = by_number
        elif line_count == len(paths):
            rows[name] = list(range(line_count))
            notes += (
                f"{name} of {folder} has a line for each of the {line_count} images, and none for the number "
                f"{paths[-1].stem}: they are joined in their order",
            )
        else:
            counts = ", ".join(f"{count} lines in {file}" for file, count in line_counts.items())
            raise UsageError(
                f"{folder}: lines and images do not match: {len(paths)} images with numbers up to "
                f"{paths[-1].stem}, {counts}",
                hint="unpack the sequence again: line n belongs to the image of number n",
            )
    return rows, notes


def _make_dataset(
    name: str,
    rig: Rig,
    *,
    lefts: Sequence[Path],
    rights: Sequence[Path] | None,
    stamps_s: Array,
    body_path: Trajectory | None,
    samples: Array | None,
    stated_by: tuple[str, str, str],
    notes: tuple[str, ...],
    losses: tuple[LossFacts, ...] = (),
    doubts: tuple[Doubt, ...],
) -> Dataset:
    """Return the recording of a rig.

    Args:
        name: Name of the recording.
        rig: The cameras that are used, and the IMU.
        lefts: Image files of the left camera, or of the only camera, in the order of time.
        rights: For each left image, the image file of the right camera; None if the right camera is not used.
        stamps_s: ``(n,)``, s, time stamps of the left images.
        body_path: True trajectory of the body in the world; None if the recording has none.
        samples: ``(n, 7)``, samples of the IMU: time stamp (s), angular rate (rad/s), specific force (m/s^2);
            None if no IMU is used.
        stated_by: The files of the calibration, of the time stamps and of the true trajectory, for messages.
        notes: Sentences for the user on what was assumed.
        losses: For EuRoC, which pairs images by time: the left images without a right one, if there are some.
        doubts: Doubts about time stamps; for KITTI, which pairs images by number, also about the left images
            without a right one.

    Raises:
        UsageError: There is no image, the cameras are no stereo pair, or facts contradict each other.
        MissingExtra: OpenCV is not installed.
    """
    # 1. Refuse a recording without images; prepare the undistortion or rectification of frames.
    if not len(lefts):
        raise UsageError(f"{name} has no images", hint="unpack the recording again")
    left, right = rig.left, rig.right
    rectification = None if rights is None or right is None else Rectification(left, right)
    undistortion = map_to_pinhole(left.lens)
    right_camera = (left if right is None else right).lens.camera
    camera = left.lens.camera if rectification is None else rectification.camera
    T_body_camera = left.T_body_camera if rectification is None else rectification.T_body_camera
    empty_depth: npt.NDArray[np.float32] = np.zeros((camera.height, camera.width), dtype=np.float32)

    def read(row: int) -> Frame:
        rgb, stamp_s = read_colour(lefts[row]), float(stamps_s[row])
        check_size(rgb, left.lens.camera, lefts[row])
        if rectification is None or rights is None:
            return Frame(
                timestamp_s=stamp_s, rgb=undistortion.colour(rgb), depth_m=empty_depth, camera=camera
            )
        cv2 = load_opencv()
        right_rgb = read_colour(rights[row])
        check_size(right_rgb, right_camera, rights[row])
        return Frame(
            timestamp_s=stamp_s,
            rgb=rectification.left(rgb),
            depth_m=empty_depth,
            camera=camera,
            stereo=rectification.right(cv2.cvtColor(right_rgb, cv2.COLOR_RGB2GRAY)),
        )

    # 2. Convert the time stamps of the IMU to the clock of the left camera, and the true trajectory of the
    #    body to that of the camera of the frames.
    track = None
    if samples is not None and rig.imu is not None:
        track = ImuTrack(
            samples[:, 0] - left.time_offset_s,
            np.ascontiguousarray(samples[:, 1:4]),
            np.ascontiguousarray(samples[:, 4:7]),
            rig.imu.model(T_body_camera),
        )
    truth = None
    if body_path is not None:
        truth = Trajectory(body_path.timestamps_s, body_path.T_world_camera @ T_body_camera)
    # 3. Collect the facts about the recording, and compare them.
    cameras = [
        CameraFacts(
            stated_by=stated_by[0] if rig_camera is left else f"the right camera of {name}",
            lens=rig_camera.lens,
        )
        for rig_camera in rig.cameras
    ]
    references = () if truth is None else (TimeFacts(stated_by=stated_by[2], stamps_s=truth.timestamps_s),)
    facts = SourceFacts(
        name=name,
        cameras=cameras,
        losses=losses,
        doubts=doubts,
        assumed=notes,
        times=(TimeFacts(stated_by=stated_by[1], stamps_s=stamps_s),),
        references=references,
    )
    return Dataset(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamps_s.tolist()),
        truth=truth,
        truth_kind="none" if truth is None else "ground truth",
        rows=tuple(range(len(lefts))),
        read=read,
        notes=facts.notes,
        log=DoubtLog(check_source(facts)),
        has_depth=False,
        has_stereo=rectification is not None,
        T_body_camera=T_body_camera,
        imu=track,
    )


def _pair_images(
    left_stamps_s: Array, right_stamps_s: Array, name: str
) -> tuple[list[tuple[int, int]], tuple[LossFacts, ...]]:
    """Return the pairs (left row, right row) of images that were taken together, and the loss of left images.

    The loss is one fact in a tuple, which is empty if each left image has a right one.  *name* is the
    recording, for messages.

    Raises:
        UsageError: No two images are within 5 ms.
    """
    pairs = pair_stamps(left_stamps_s, right_stamps_s, _MAX_PAIR_DIFFERENCE_S)
    if not pairs:
        raise UsageError(
            f"no image of {name}'s cam0 has one of cam1 within {1e3 * _MAX_PAIR_DIFFERENCE_S:g} ms: "
            "the cameras are not synchronised",
            hint="check data.csv of both, or take one camera: --camera left",
        )
    lost, total = len(left_stamps_s) - len(pairs), len(left_stamps_s)
    sentence = f"{lost} of {total} images of {name}'s left camera have no right one, and are left out"
    loss = LossFacts(sentence=sentence, lost=lost, total=total, is_usual=True)
    return pairs, (loss,) if lost else ()


def _is_used(path: Path, wanted: bool | None, name: str) -> bool:
    """Return whether the sensor *name* is used: *wanted*, or whether *path* exists if that is None.

    Raises:
        UsageError: *wanted* is True, and *path*, the sensor's file or folder, does not exist.
    """
    if wanted and not path.exists():
        option = "--imu" if name == "imu0" else "--camera stereo"
        raise UsageError(
            f"{path.parent if path.name == name else path.parent.parent} has no {name}",
            hint=f"unpack it, or leave out {option}",
        )
    return path.exists() if wanted is None else wanted


def _mav0_of(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _read_euroc_images(folder: Path) -> tuple[list[Path], Array, tuple[str, ...], tuple[Doubt, ...]]:
    """Return the images of a camera, their time stamps ``(n,)`` (s), notes, and doubts.

    `rows_in_time` leaves out images, so that the time stamps increase.  A note names the unit in which the
    time stamps were read, if that is not the nanosecond.

    Raises:
        UsageError: ``data.csv`` cannot be read, or names a file outside of the folder ``data``.
    """
    file = folder / "data.csv"
    lines = _read_table(file, 2)
    stamps_s, notes = stamps_in_seconds(
        read_numbers(file, [line[0] for line in lines]), str(file), "nanoseconds"
    )
    rows, doubts = rows_in_time(TimeFacts(stated_by=str(file), stamps_s=stamps_s))
    names = [lines[row][1].strip() for row in rows]
    outside = [name for name in names if Path(name).name != name]
    if outside:
        raise UsageError(
            f"{file} names {outside[0]!r}, which is no image of its folder data",
            hint="write the name of a file alone",
        )
    return [folder / "data" / name for name in names], stamps_s[rows], notes, doubts


def _read_table(path: Path, columns: int) -> list[list[str]]:
    """Return the words of each line of a CSV file of EuRoC, without headings (lines that begin with ``#``).

    Raises:
        UsageError: The file cannot be read, or a line has less than *columns* words.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    rows = [line.split(",") for line in lines]
    if any(len(row) < columns for row in rows):
        raise UsageError(f"{path} has a line of less than {columns} values", hint="unpack it again")
    return rows
