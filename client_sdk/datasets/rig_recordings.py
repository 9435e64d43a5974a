"""Recordings of EuRoC (ASL) and KITTI odometry as frames of their left camera or of the stereo pair.

Frames of one camera are undistorted, those of a pair rectified; the truth is that of the frames' camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from client_sdk.bags.index import pair_stamps
from client_sdk.datasets.dataset import Dataset
from client_sdk.datasets.images import check_size, image_files, probe, read_colour
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
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, from_quaternion

__all__ = ["CameraChoice", "is_euroc", "is_kitti", "open_euroc", "open_kitti"]

CameraChoice = Literal["stereo", "left"]

_EUROC_TRUTH = "state_groundtruth_estimate0/data.csv"
_MAX_PAIR_S = 0.005
"""The shutters of a pair open together; stamps that are farther apart are those of other images."""
_KITTI_PAIRS = ("image_0", "image_1"), ("image_2", "image_3")
"""The grey and the colour cameras; the digit is that of their projection in ``calib.txt``."""


def is_euroc(folder: Path) -> bool:
    """Return whether a folder, or its ``mav0``, has the layout of EuRoC."""
    return (_asl(folder) / "cam0" / "sensor.yaml").is_file()


def is_kitti(folder: Path) -> bool:
    """Return whether a folder has the layout of a sequence of KITTI's odometry benchmark."""
    return (folder / "calib.txt").is_file() and any((folder / left).is_dir() for left, _ in _KITTI_PAIRS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Files:
    """Images of the left camera, and of the right one where it is used, with their ``(n,)`` times.

    ``stated_by`` are the files of the calibration, and of the times; ``truth`` is the file of the true path.
    """

    lefts: Sequence[Path]
    rights: Sequence[Path] | None
    stamps_s: Array
    stated_by: tuple[str, str]
    truth: str = ""
    notes: tuple[str, ...] = ()
    losses: tuple[LossFacts, ...] = ()
    doubts: tuple[Doubt, ...] = ()


def open_euroc(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the frames of ``cam0``, or of both cameras, with the samples of ``imu0``.

    Time stamps are seconds; the truth is ``T_world_body @ T_body_camera``.

    Args:
        folder: With ``mav0``, or that itself.
        camera: None takes both cameras where there are two.
        imu: None takes the IMU where there is one.

    Raises:
        UsageError: A file is missing or broken, or there is no such camera or IMU.
    """
    folder = _asl(folder)
    stereo = _takes(folder / "cam1" / "sensor.yaml", None if camera is None else camera == "stereo", "cam1")
    has_imu = _takes(folder / "imu0" / "sensor.yaml", imu, "imu0")
    cameras = [read_euroc_camera(folder / "cam0" / "sensor.yaml", "left")]
    paths, stamps_s, notes, doubts = _euroc_images(folder / "cam0")
    rights: list[Path] | None = None
    losses: tuple[LossFacts, ...] = ()
    if stereo:
        cameras.append(read_euroc_camera(folder / "cam1" / "sensor.yaml", "right"))
        others, others_s, *_ = _euroc_images(folder / "cam1")
        pairs, losses = _pairs(stamps_s, others_s, folder.parent.name)
        paths, stamps_s = [paths[row] for row, _ in pairs], stamps_s[[row for row, _ in pairs]]
        rights = [others[row] for _, row in pairs]
    rig = Rig(
        cameras=tuple(cameras), imu=read_euroc_imu(folder / "imu0" / "sensor.yaml") if has_imu else None
    )
    bodies = None
    if (folder / _EUROC_TRUTH).is_file():
        lines = [row[:8] for row in _csv(folder / _EUROC_TRUTH, 8)]
        values = read_numbers(folder / _EUROC_TRUTH, [word for row in lines for word in row]).reshape(-1, 8)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, 3] = values[:, 1:4]
        poses[:, :3, :3] = [from_quaternion(xyzw) for xyzw in values[:, [5, 6, 7, 4]]]
        truth_s, of_truth = stamps_in_seconds(values[:, 0], str(folder / _EUROC_TRUTH), "nanoseconds")
        bodies = Trajectory(truth_s, poses)
        notes += of_truth
    name = folder.parent.name if folder.name == "mav0" else folder.name
    samples = None
    if has_imu:
        rows = [row[:7] for row in _csv(folder / "imu0" / "data.csv", 7)]
        values = read_numbers(folder / "imu0" / "data.csv", [word for row in rows for word in row])
        samples = values.reshape(-1, 7)
        samples[:, 0], of_imu = stamps_in_seconds(samples[:, 0], str(folder / "imu0"), "nanoseconds")
        notes += of_imu
    stated_by = str(folder / "cam0" / "sensor.yaml"), str(folder / "cam0" / "data.csv")
    files = _Files(
        lefts=paths, rights=rights, stamps_s=stamps_s, notes=notes, doubts=doubts, stated_by=stated_by,
        truth=_EUROC_TRUTH, losses=losses,
    )  # fmt: skip
    return _dataset(name or folder.name, rig, files, bodies, samples)


def open_kitti(folder: Path, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the frames of ``image_0``, or of both grey cameras; of the colour cameras without grey ones.

    The truth is in ``poses.txt``, or in ``../../poses/NAME.txt``.

    Args:
        folder: Of one sequence.
        camera: None takes both cameras where there are two.
        imu: The sequences hold none.

    Raises:
        UsageError: A file is missing or broken, or there is no such camera.
    """
    if imu:
        raise UsageError(f"{folder} has no IMU: KITTI's sequences hold none", hint="leave out --imu")
    left, right = next(pair for pair in _KITTI_PAIRS if (folder / pair[0]).is_dir())
    stereo = _takes(folder / right, None if camera is None else camera == "stereo", right)
    times_s = read_numbers(folder / "times.txt", read_text(folder / "times.txt").split())
    paths = image_files(folder / left)
    if not paths or not len(times_s):
        raise UsageError(f"{folder} lacks images or times", hint="unpack the sequence again")
    known = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    truth_file = next((each for each in known if each.is_file()), None)
    poses = None if truth_file is None else _kitti_poses(truth_file)
    lists = {"times.txt": len(times_s)} | ({} if poses is None else {"poses.txt": len(poses)})
    rows, notes = _kitti_rows(paths, lists, folder)
    stamps_s = times_s[rows["times.txt"]]
    used, doubts = rows_in_time(TimeFacts(stated_by=str(folder / "times.txt"), stamps_s=stamps_s))
    rights: list[Path] | None = None
    if stereo:
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
    truth = None
    if poses is not None:
        truth = Trajectory(stamps_s[used], poses[rows["poses.txt"]][used])
    lefts = [paths[row] for row in used]
    height, width = probe(lefts, read_colour)[0].shape[:2]
    keys = (f"P{left[-1]}", f"P{right[-1]}") if stereo else (f"P{left[-1]}",)
    rig = read_kitti_rig(folder / "calib.txt", (width, height), keys)
    files = _Files(
        lefts=lefts, rights=rights, stamps_s=stamps_s[used], notes=notes, doubts=doubts,
        stated_by=(str(folder / "calib.txt"), str(folder / "times.txt")), truth=str(truth_file),
    )  # fmt: skip
    dataset = _dataset(folder.name, rig, files, truth, None)
    # The path that KITTI measured is that of the left camera itself, as it is rectified.
    return replace(dataset, T_body_camera=None)


def _kitti_poses(path: Path) -> Array:
    """Return the ``(n, 4, 4)`` poses of a file of 12 numbers a line."""
    values = read_numbers(path, read_text(path).split())
    if len(values) % 12:
        raise UsageError(f"{path} has not 12 numbers in each line", hint="unpack the sequence again")
    poses = np.tile(np.eye(4), (len(values) // 12, 1, 1))
    poses[:, :3] = values.reshape(-1, 3, 4)
    return poses


def _kitti_rows(
    paths: Sequence[Path], lists: Mapping[str, int], folder: Path
) -> tuple[dict[str, list[int]], tuple[str, ...]]:
    """Return for each list, by its name and length, the row of each image, and what was assumed.

    An image has the row of its number.  A list that is too short for the numbers, and as long as there are
    images, was cut out with them.

    Raises:
        UsageError: A list is too short for the images.
    """
    numbers = [int(path.stem) if path.stem.isdecimal() else None for path in paths]
    rows: dict[str, list[int]] = {}
    notes: tuple[str, ...] = ()
    for name, length in lists.items():
        by_number = [number for number in numbers if number is not None and number < length]
        if len(by_number) == len(paths):
            rows[name] = by_number
        elif length == len(paths):
            rows[name] = list(range(length))
            notes += (
                f"{name} of {folder} has a line for each of the {length} images, and none for the number "
                f"{paths[-1].stem}: they are joined in their order",
            )
        else:
            counts = ", ".join(f"{each} lines in {other}" for other, each in lists.items())
            raise UsageError(
                f"{folder}: {len(paths)} images with numbers up to {paths[-1].stem}, {counts}",
                hint="unpack the sequence again: line n belongs to the image of number n",
            )
    return rows, notes


def _dataset(name: str, rig: Rig, files: _Files, bodies: Trajectory | None, samples: Array | None) -> Dataset:
    """Return the frames of a rig; *bodies* is the true path of its body, *samples* ``(n, 7)`` of its IMU."""
    paths, rights, stamps_s = files.lefts, files.rights, files.stamps_s
    if not len(paths):
        raise UsageError(f"{name} has no images", hint="unpack the recording again")
    left, right = rig.left, rig.right
    rectify = None if rights is None or right is None else Rectification(left, right)
    undistort = map_to_pinhole(left.lens)
    right_camera = (left if right is None else right).lens.camera
    camera = left.lens.camera if rectify is None else rectify.camera
    T_body_camera = left.T_body_camera if rectify is None else rectify.T_body_camera
    no_depth: npt.NDArray[np.float32] = np.zeros((camera.height, camera.width), dtype=np.float32)

    def read(row: int) -> Frame:
        rgb, stamp_s = read_colour(paths[row]), float(stamps_s[row])
        check_size(rgb, left.lens.camera, paths[row])
        if rectify is None or rights is None:
            return Frame(timestamp_s=stamp_s, rgb=undistort.colour(rgb), depth_m=no_depth, camera=camera)
        cv2 = load_opencv()
        other = read_colour(rights[row])
        check_size(other, right_camera, rights[row])
        gray = cv2.cvtColor(other, cv2.COLOR_RGB2GRAY)
        return Frame(
            timestamp_s=stamp_s,
            rgb=rectify.left(rgb),
            depth_m=no_depth,
            camera=camera,
            stereo=rectify.right(gray),
        )

    track = None
    if samples is not None and rig.imu is not None:
        track = ImuTrack(
            samples[:, 0] - left.time_offset_s,
            np.ascontiguousarray(samples[:, 1:4]),
            np.ascontiguousarray(samples[:, 4:7]),
            rig.imu.model(T_body_camera),
        )
    truth = None
    if bodies is not None:
        truth = Trajectory(bodies.timestamps_s, bodies.T_world_camera @ T_body_camera)
    stated = [
        CameraFacts(
            stated_by=files.stated_by[0] if each is left else f"the right camera of {name}",
            lens=each.lens,
        )
        for each in rig.cameras
    ]  # fmt: skip
    facts = SourceFacts(
        name=name, cameras=stated, losses=files.losses, doubts=files.doubts, assumed=files.notes,
        times=(TimeFacts(stated_by=files.stated_by[1], stamps_s=stamps_s),),
        references=() if truth is None else (TimeFacts(stated_by=files.truth, stamps_s=truth.timestamps_s),),
    )  # fmt: skip
    return Dataset(
        name=name,
        camera=camera,
        timestamps_s=tuple(stamps_s.tolist()),
        truth=truth,
        truth_kind="none" if truth is None else "ground truth",
        rows=tuple(range(len(paths))),
        read=read,
        notes=facts.notes,
        log=DoubtLog(check_source(facts)),
        has_depth=False,
        has_stereo=rectify is not None,
        T_body_camera=T_body_camera,
        imu=track,
    )


def _pairs(lefts_s: Array, rights_s: Array, name: str) -> tuple[list[tuple[int, int]], tuple[LossFacts, ...]]:
    """Return rows of images that were taken together, and what a camera lost."""
    pairs = pair_stamps(lefts_s, rights_s, _MAX_PAIR_S)
    if not pairs:
        raise UsageError(
            f"no image of {name}'s cam0 has one of cam1 within {1e3 * _MAX_PAIR_S:g} ms: "
            "the cameras are not synchronised",
            hint="check data.csv of both, or take one camera: --camera left",
        )
    alone = len(lefts_s) - len(pairs)
    note = f"{alone} of {len(lefts_s)} images of {name}'s left camera have no right one, and are left out"
    loss = LossFacts(sentence=note, lost=alone, total=len(lefts_s), is_usual=True)
    return pairs, (loss,) if alone else ()


def _takes(path: Path, wanted: bool | None, name: str) -> bool:
    if wanted and not path.exists():
        option = "--imu" if name == "imu0" else "--camera stereo"
        raise UsageError(
            f"{path.parent if path.name == name else path.parent.parent} has no {name}",
            hint=f"unpack it, or leave out {option}",
        )
    return path.exists() if wanted is None else wanted


def _asl(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def _euroc_images(folder: Path) -> tuple[list[Path], Array, tuple[str, ...], tuple[Doubt, ...]]:
    """Return the images of a camera whose times increase, their times, and notes and doubts on these."""
    file = folder / "data.csv"
    lines = _csv(file, 2)
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


def _csv(path: Path, columns: int) -> list[list[str]]:
    """Return the rows of a table of EuRoC; a line that begins with ``#`` is a heading."""
    lines = [line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    rows = [line.split(",") for line in lines]
    if any(len(row) < columns for row in rows):
        raise UsageError(f"{path} has a row of less than {columns} values", hint="unpack it again")
    return rows
