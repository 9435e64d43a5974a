"""Write maps for other programs: ``rse-pf map export``.

A format is one file, or a folder of files that is made if need be; files of the same names are replaced.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from rse_pf.cli.maps.bags import BAG_FORMAT, export_bag
from rse_pf.cli.maps.keyframe_images import IMAGES_FOLDER
from rse_pf.errors import UsageError
from rse_pf.files import read_regular_file, replace_file
from rse_pf.maps.format import MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.slam.colmap import colmap_files, image_name
from rse_pf.slam.map_export import FORMATS, export_map
from rse_pf.slam.nerfstudio import nerfstudio_files
from rse_pf.slam.occupancy import GridOptions, occupancy_files, occupancy_grid
from rse_pf.terminal import at_work, counted, show, show_json, show_progress

__all__ = ["add_export_arguments", "run_export"]

_GRID = ("resolution", "robot_height", "step", "floor", "up")
_NO_IMAGES = (
    "this map names no images that are stored: set live.images for live maps, or name those of "
    "map from-camera --keep-images by --images"
)
_MAX_IMAGE_BYTES = 64 << 20


def add_export_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options, but for map and version."""
    add, default = parser.add_argument, GridOptions()
    add("--format", choices=(*FORMATS, *_FOLDERS, BAG_FORMAT), required=True, help="the format")
    add(
        "--out", type=Path, required=True, metavar="PATH",
        help="the file to write, or the folder of colmap, nerfstudio and occupancy",
    )  # fmt: skip
    add(
        "--images", type=Path, metavar="DIR",
        help="colmap, nerfstudio: folder of the images, as map from-camera --keep-images writes it "
        "(default: those that robots stored for a live map)",
    )  # fmt: skip
    add("--robot", help="tum: only the keyframes of this robot")
    add(
        "--resolution", type=float, metavar="M",
        help=f"occupancy: edge of a cell (default: {default.resolution_m} m)",
    )  # fmt: skip
    add(
        "--robot-height", type=float, metavar="M",
        help=f"occupancy: what is higher is no obstacle (default: {default.robot_height_m} m)",
    )  # fmt: skip
    add(
        "--step", type=float, metavar="M",
        help=f"occupancy: what is lower is no obstacle (default: {default.step_m} m)",
    )  # fmt: skip
    add(
        "--floor",
        type=float,
        metavar="M",
        help="occupancy: height of the floor (default: found in the cloud)",
    )
    add(
        "--up", metavar="X,Y,Z",
        help="occupancy: up in the world of the map (default: by an IMU, else across the floor)",
    )  # fmt: skip


def run_export(args: argparse.Namespace, maps: MapRegistry) -> None:
    """Write a version of a map in a format."""
    _check_options(args)
    folder = args.out.absolute().parent
    if not folder.is_dir():
        raise UsageError(
            f"there is no folder {folder}", hint=f"create it (mkdir -p {folder}), or name another file"
        )
    if args.format in _FOLDERS:
        if args.out.exists() and not args.out.is_dir():
            raise UsageError(f"{args.out} is a file", hint=f"{args.format} is a folder of files: name one")
        files, notes = _FOLDERS[args.format](args, maps, maps.load(args.name, args.version))
        args.out.mkdir(exist_ok=True)
        if any(name.startswith(f"{IMAGES_FOLDER}/") for name in files):
            (args.out / IMAGES_FOLDER).mkdir(exist_ok=True)
        written = {args.out / name: data for name, data in files.items()}
    else:
        if args.out.is_dir():
            raise UsageError(f"{args.out} is a folder", hint=f"{args.format} is one file: name it")
        version, notes = maps.load(args.name, args.version), []
        if args.format == BAG_FORMAT:
            size = export_bag(args.out, version)
            _say(args, [(args.out, size)], notes)
            return
        written = {args.out: export_map(version, args.format, args.robot)}
    for file, data in written.items():
        replace_file(file, data)
    _say(args, [(file, len(data)) for file, data in written.items()], notes)


def _say(args: argparse.Namespace, written: list[tuple[Path, int]], notes: list[str]) -> None:
    size = sum(count for _, count in written)
    if args.json:
        names = {} if len(written) == 1 else {"files": [str(file) for file, _ in written]}
        value = {"file": str(args.out), "bytes": size, **names, **({"notes": notes} if notes else {})}
        show_json(value, indent=2, sort_keys=True)
        return
    images = [count for file, count in written if file.parent.name == IMAGES_FOLDER]
    lines = [f"{file}: {count} bytes" for file, count in written if file.parent.name != IMAGES_FOLDER]
    if images:
        lines.append(f"{args.out / IMAGES_FOLDER}: {counted(len(images), 'image')}, {sum(images)} bytes")
    show(*lines, *(f"note: {note}" for note in notes))


def _check_options(args: argparse.Namespace) -> None:
    """Refuse options that belong to another format."""
    if args.images is not None and args.format not in ("colmap", "nerfstudio"):
        raise UsageError(
            f"--images is for colmap and nerfstudio, not {args.format}", hint="leave --images out"
        )
    given = [("--robot", args.robot, "tum")]
    given += [(f"--{name.replace('_', '-')}", getattr(args, name), "occupancy") for name in _GRID]
    for option, value, kind in given:
        if value is not None and args.format != kind:
            raise UsageError(f"{option} is for {kind}, not {args.format}", hint=f"leave {option} out")


_Files = tuple[dict[str, bytes], list[str]]


def _with_images(
    args: argparse.Namespace, maps: MapRegistry, version: MapVersion, files: dict[str, bytes]
) -> _Files:
    """Return the files with the images of keyframes, as far as they are known."""
    if args.images is None:
        stored = {f"{IMAGES_FOLDER}/{image_name(each)}": data for each, data in maps.images(version)}
        return {**files, **stored}, _missing("the store", version, stored) if stored else [_NO_IMAGES]
    if not args.images.is_dir():
        raise UsageError(f"there is no folder {args.images}", hint="map from-camera --keep-images makes one")
    images = {}
    for name in map(image_name, version.keyframes):
        file = args.images / name
        if file.is_file():
            try:
                images[f"{IMAGES_FOLDER}/{name}"] = read_regular_file(file, _MAX_IMAGE_BYTES)
            except OSError as error:
                raise UsageError(f"cannot read {file}: {error}", hint="leave --images out") from error
    return {**files, **images}, _missing(str(args.images), version, images)


def _missing(where: str, version: MapVersion, images: dict[str, bytes]) -> list[str]:
    missing = len(version.keyframes) - len(images)
    return [f"{where} has no image of {counted(missing, 'keyframe')}"] if missing else []


def _colmap(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    def report(done: float) -> None:
        show_progress(f"{100 * done:3.0f} %  matching keyframes", is_over=done >= 1.0)

    files = colmap_files(version, report)
    return _with_images(args, maps, version, files)


def _nerfstudio(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    files, notes = _with_images(args, maps, version, nerfstudio_files(version))
    if version.up is None:
        notes.append("this map does not say where up is: its axes are kept")
    return files, notes


def _occupancy(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    with at_work("looking for free space"):
        grid = occupancy_grid(version, _grid_options(args))
    notes = []
    if grid.up_by not in ("the map", "--up"):
        notes.append(f"this map does not say where up is: taken by {grid.up_by}; --up names it")
    if grid.points_left_out:
        notes.append(f"{grid.points_left_out} points were left out: they are far from all poses")
    return occupancy_files(grid), notes


def _grid_options(args: argparse.Namespace) -> GridOptions:
    named: dict[str, Any] = {
        field.name: getattr(args, field.name.removesuffix("_m")) for field in fields(GridOptions)
    }
    if args.up is not None:
        try:
            x, y, z = (float(number) for number in args.up.split(","))
        except ValueError as error:
            raise UsageError(f"--up {args.up[:80]!r} is not three numbers", hint="write x,y,z") from error
        named["up"] = (x, y, z)
    return GridOptions(**{name: value for name, value in named.items() if value is not None})


_FOLDERS: dict[str, Callable[[argparse.Namespace, MapRegistry, MapVersion], _Files]] = {
    "colmap": _colmap, "nerfstudio": _nerfstudio, "occupancy": _occupancy,
}  # fmt: skip
"""The formats that are folders of files, by name."""
