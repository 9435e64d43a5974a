"""Write maps for other programs: the options and the work of ``rse-pf map export``.

Some formats are one file; others are a folder of files, which is created if it does not exist.  Files that
exist under the same names are replaced.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.colmap import encode_colmap
from rse_pf.extensions.map_export.nerfstudio import encode_nerfstudio
from rse_pf.extensions.map_export.occupancy import GridOptions, encode_occupancy, make_occupancy_grid
from rse_pf.extensions.map_export.single_files import SINGLE_FILE_FORMATS, encode_single_file
from rse_pf.maps.format import IMAGES_FOLDER, MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.files import read_regular_file, replace_file
from rse_pf.terminal import at_work, counted, show, show_json, show_progress

__all__ = ["add_export_arguments", "run_export"]

_BAG_FORMAT = "mcap"  # the name of the format of bags that ROS 2 and Foxglove read
_GRID_OPTIONS = ("resolution", "robot_height", "step", "floor", "up")
"""Names of the options that belong to the format occupancy alone."""
_NO_IMAGES = (
    "this map names no images that are stored: set live.images for live maps, or name those of "
    "map from-camera --keep-images by --images"
)
_MAX_IMAGE_BYTES = 64 << 20  # largest size in bytes of an image file in the folder --images: 64 MiB

_Files = tuple[dict[str, bytes], list[str]]
"""The contents of the files of a folder by their names, and notes for the user about what is missing."""


def add_export_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``map export``, except for the map and its version."""
    add, default = parser.add_argument, GridOptions()
    add(
        "--format",
        choices=(*SINGLE_FILE_FORMATS, *_FOLDER_FORMATS, _BAG_FORMAT),
        required=True,
        help="the format",
    )
    add(
        "--out",
        type=Path,
        required=True,
        metavar="PATH",
        help="the file to write, or the folder of colmap, nerfstudio and occupancy",
    )
    add(
        "--images",
        type=Path,
        metavar="DIR",
        help="colmap, nerfstudio: folder of the images, as map from-camera --keep-images writes it "
        "(default: those that robots stored for a live map)",
    )
    add("--robot", help="tum: only the keyframes of this robot")
    add(
        "--resolution",
        type=float,
        metavar="M",
        help=f"occupancy: edge of a cell (default: {default.resolution_m} m)",
    )
    add(
        "--robot-height",
        type=float,
        metavar="M",
        help=f"occupancy: what is higher is no obstacle (default: {default.robot_height_m} m)",
    )
    add(
        "--step",
        type=float,
        metavar="M",
        help=f"occupancy: what is lower is no obstacle (default: {default.step_m} m)",
    )
    add(
        "--floor",
        type=float,
        metavar="M",
        help="occupancy: height of the floor (default: found in the cloud)",
    )
    add(
        "--up",
        metavar="X,Y,Z",
        help="occupancy: up in the world of the map (default: by an IMU, else across the floor)",
    )


def run_export(
    args: argparse.Namespace, maps: MapRegistry, write_bag: Callable[[Path, MapVersion], int]
) -> None:
    """Write a version of a map in the chosen format, and print the names and sizes of the files.

    Args:
        args: The options that `add_export_arguments` declares, and ``name`` and ``version`` of the map.
        maps: The registry that holds the map.
        write_bag: Writes the map to a file as an MCAP bag and returns the size of the file in bytes.

    Raises:
        UsageError: An option belongs to another format, ``--out`` is a folder where the format is one file or
            the reverse, its parent folder is missing, an image cannot be read, or the map lacks what the
            format needs.
    """
    _check_options(args)
    parent = args.out.absolute().parent
    if not parent.is_dir():
        raise UsageError(
            f"there is no folder {parent}", hint=f"create it (mkdir -p {parent}), or name another file"
        )
    if args.format in _FOLDER_FORMATS:
        _export_folder(args, maps)
        return
    if args.out.is_dir():
        raise UsageError(f"{args.out} is a folder", hint=f"{args.format} is one file: name it")
    version = maps.load(args.name, args.version)
    if args.format == _BAG_FORMAT:
        size = write_bag(args.out, version)
    else:
        data = encode_single_file(version, args.format, args.robot)
        replace_file(args.out, data)
        size = len(data)
    _show_files(args, [(args.out, size)], [])


def _export_folder(args: argparse.Namespace, maps: MapRegistry) -> None:
    if args.out.exists() and not args.out.is_dir():
        raise UsageError(f"{args.out} is a file", hint=f"{args.format} is a folder of files: name one")
    files, notes = _FOLDER_FORMATS[args.format](args, maps, maps.load(args.name, args.version))
    args.out.mkdir(exist_ok=True)
    if any(name.startswith(f"{IMAGES_FOLDER}/") for name in files):
        (args.out / IMAGES_FOLDER).mkdir(exist_ok=True)
    for name, data in files.items():
        replace_file(args.out / name, data)
    _show_files(args, [(args.out / name, len(data)) for name, data in files.items()], notes)


def _show_files(args: argparse.Namespace, files: list[tuple[Path, int]], notes: list[str]) -> None:
    """Print the files with their sizes in bytes, images as one line with their number and total size.

    With ``--json``, print one object instead: ``--out``, the total size, the names of several files, and
    notes.
    """
    if args.json:
        names = {} if len(files) == 1 else {"files": [str(file) for file, _ in files]}
        size = sum(size for _, size in files)
        value = {"file": str(args.out), "bytes": size, **names, **({"notes": notes} if notes else {})}
        show_json(value, indent=2, sort_keys=True)
        return
    image_sizes = [size for file, size in files if file.parent.name == IMAGES_FOLDER]
    lines = [f"{file}: {size} bytes" for file, size in files if file.parent.name != IMAGES_FOLDER]
    if image_sizes:
        count = counted(len(image_sizes), "image")
        lines.append(f"{args.out / IMAGES_FOLDER}: {count}, {sum(image_sizes)} bytes")
    show(*lines, *(f"note: {note}" for note in notes))


def _check_options(args: argparse.Namespace) -> None:
    """Raise UsageError if an option was given that belongs to another format."""
    if args.images is not None and args.format not in ("colmap", "nerfstudio"):
        raise UsageError(
            f"--images is for colmap and nerfstudio, not {args.format}", hint="leave --images out"
        )
    options = [("--robot", args.robot, "tum")]
    options += [(f"--{name.replace('_', '-')}", getattr(args, name), "occupancy") for name in _GRID_OPTIONS]
    for option, value, format_name in options:
        if value is not None and args.format != format_name:
            raise UsageError(f"{option} is for {format_name}, not {args.format}", hint=f"leave {option} out")


def _add_images(
    args: argparse.Namespace, maps: MapRegistry, version: MapVersion, files: dict[str, bytes]
) -> _Files:
    """Return *files* together with the images of the keyframes, and notes about missing images.

    The images come from the folder ``--images`` if it is named, else from the store of the maps.

    Raises:
        UsageError: The folder ``--images`` does not exist, or an image in it cannot be read or is too large.
    """
    if args.images is None:
        stored = {f"{IMAGES_FOLDER}/{keyframe.image_name}": data for keyframe, data in maps.images(version)}
        notes = _note_missing_images("the store", version, stored) if stored else [_NO_IMAGES]
        return {**files, **stored}, notes
    if not args.images.is_dir():
        raise UsageError(f"there is no folder {args.images}", hint="map from-camera --keep-images makes one")
    images = {}
    for keyframe in version.keyframes:
        file = args.images / keyframe.image_name
        if file.is_file():
            try:
                images[f"{IMAGES_FOLDER}/{file.name}"] = read_regular_file(file, _MAX_IMAGE_BYTES)
            except OSError as error:
                raise UsageError(f"cannot read {file}: {error}", hint="leave --images out") from error
    return {**files, **images}, _note_missing_images(str(args.images), version, images)


def _note_missing_images(where: str, version: MapVersion, images: dict[str, bytes]) -> list[str]:
    missing = len(version.keyframes) - len(images)
    return [f"{where} has no image of {counted(missing, 'keyframe')}"] if missing else []


def _colmap(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    def report(done: float) -> None:
        show_progress(f"{100 * done:3.0f} %  matching keyframes", is_over=done >= 1.0)

    return _add_images(args, maps, version, encode_colmap(version, report))


def _nerfstudio(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    files, notes = _add_images(args, maps, version, encode_nerfstudio(version))
    if version.up is None:
        notes.append("this map does not say where up is: its axes are kept")
    return files, notes


def _occupancy(args: argparse.Namespace, maps: MapRegistry, version: MapVersion) -> _Files:
    with at_work("looking for free space"):
        grid = make_occupancy_grid(version, _grid_options(args))
    notes = []
    if grid.up_source not in ("the map", "--up"):
        notes.append(f"this map does not say where up is: taken by {grid.up_source}; --up names it")
    if grid.points_left_out:
        notes.append(f"{grid.points_left_out} points were left out: they are far from all poses")
    return encode_occupancy(grid), notes


def _grid_options(args: argparse.Namespace) -> GridOptions:
    values: dict[str, Any] = {
        field.name: getattr(args, field.name.removesuffix("_m")) for field in fields(GridOptions)
    }
    if args.up is not None:
        try:
            x, y, z = (float(number) for number in args.up.split(","))
        except ValueError as error:
            raise UsageError(f"--up {args.up[:80]!r} is not three numbers", hint="write x,y,z") from error
        values["up"] = (x, y, z)
    return GridOptions(**{name: value for name, value in values.items() if value is not None})


_FOLDER_FORMATS: dict[str, Callable[[argparse.Namespace, MapRegistry, MapVersion], _Files]] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "occupancy": _occupancy,
}
"""The function that makes the files of each format that is a folder, by the name of the format."""
