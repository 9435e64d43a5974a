"""Write maps for other programs: the options and the work of ``rse-pf map export``.

Some formats are one file; others are a folder of files, which is created if it does not exist.  Files that
exist under the same names are replaced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rse_pf.command_line.map_store import VersionRequest
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.map_export.colmap import encode_colmap
from rse_pf.extensions.map_export.mcap_bag import export_bag
from rse_pf.extensions.map_export.nerfstudio import encode_nerfstudio
from rse_pf.extensions.map_export.occupancy import encode_occupancy
from rse_pf.extensions.map_export.single_files import SINGLE_FILE_FORMATS, encode_single_file
from rse_pf.maps.format import IMAGES_FOLDER, MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.slam.occupancy import GridOptions, make_occupancy_grid
from rse_pf.storage.files import read_regular_file, replace_file
from rse_pf.terminal import at_work, counted, show, show_json, show_progress

__all__ = ["ACTION"]

_FOLDER_NAMES = ("colmap", "nerfstudio", "occupancy")  # names of the formats that are a folder of files
_BAG_FORMAT = "mcap"  # the name of the format of bags that ROS 2 and Foxglove read
_GRID_OPTIONS = ("resolution", "robot_height", "step", "floor", "up")
"""Names of the options that belong to the format occupancy alone."""
# Note for the user if the store has no images of the map's keyframes.
_NO_IMAGES = (
    "this map names no images that are stored: set live.images for live maps, or name those of "
    "map from-camera --keep-images by --images"
)
_MAX_IMAGE_BYTES = 64 << 20  # largest size in bytes of an image file in the folder --images: 64 MiB

_Files = tuple[dict[str, bytes], list[str]]
"""The contents of the files of a folder by their names, and notes for the user about what is missing."""

_GRID = GridOptions()  # the default options of a floor plan, which the help texts state


@dataclass(frozen=True, kw_only=True)
class ExportRequest(VersionRequest):
    """A version of a map that is written in the format of another program."""

    format: str = option(
        "--format",
        choices=(*SINGLE_FILE_FORMATS, *_FOLDER_NAMES, _BAG_FORMAT),
        required=True,
        help="the format",
    )
    out: Path = option(
        "--out",
        required=True,
        metavar="PATH",
        help="the file to write, or the folder of colmap, nerfstudio and occupancy",
    )
    images: Path | None = option(
        "--images",
        metavar="DIR",
        help="colmap, nerfstudio: folder of the images, as map from-camera --keep-images writes it "
        "(default: those that robots stored for a live map)",
    )
    robot: str | None = option("--robot", help="tum: only the keyframes of this robot")
    resolution: float | None = option(
        "--resolution", metavar="M", help=f"occupancy: edge of a cell (default: {_GRID.resolution_m} m)"
    )
    robot_height: float | None = option(
        "--robot-height",
        metavar="M",
        help=f"occupancy: what is higher is no obstacle (default: {_GRID.robot_height_m} m)",
    )
    step: float | None = option(
        "--step", metavar="M", help=f"occupancy: what is lower is no obstacle (default: {_GRID.step_m} m)"
    )
    floor: float | None = option(
        "--floor", metavar="M", help="occupancy: height of the floor (default: found in the cloud)"
    )
    up: str | None = option(
        "--up",
        metavar="X,Y,Z",
        help="occupancy: up in the world of the map (default: by an IMU, else across the floor)",
    )


def run_export(request: ExportRequest, settings: PlatformSettings) -> None:
    """Write a version of a map in the chosen format, and print the names and sizes of the files.

    Raises:
        UsageError: An option belongs to another format, ``--out`` is a folder where the format is one file or
            the reverse, its parent folder is missing, an image cannot be read, or the map lacks what the
            format needs.
    """
    _check_options(request)
    parent = request.out.absolute().parent
    if not parent.is_dir():
        raise UsageError(
            f"there is no folder {parent}", hint=f"create it (mkdir -p {parent}), or name another file"
        )
    maps = request.open_maps(settings)
    if request.format in _FOLDER_NAMES:
        _export_folder(request, maps)
        return
    if request.out.is_dir():
        raise UsageError(f"{request.out} is a folder", hint=f"{request.format} is one file: name it")
    version = maps.load(request.name, request.version)
    if request.format == _BAG_FORMAT:
        size = export_bag(request.out, version)
    else:
        data = encode_single_file(version, request.format, request.robot)
        replace_file(request.out, data)
        size = len(data)
    _show_files(request, [(request.out, size)], [])


def _export_folder(request: ExportRequest, maps: MapRegistry) -> None:
    if request.out.exists() and not request.out.is_dir():
        raise UsageError(f"{request.out} is a file", hint=f"{request.format} is a folder of files: name one")
    files, notes = _FOLDER_FORMATS[request.format](request, maps, maps.load(request.name, request.version))
    request.out.mkdir(exist_ok=True)
    if any(name.startswith(f"{IMAGES_FOLDER}/") for name in files):
        (request.out / IMAGES_FOLDER).mkdir(exist_ok=True)
    for name, data in files.items():
        replace_file(request.out / name, data)
    _show_files(request, [(request.out / name, len(data)) for name, data in files.items()], notes)


def _show_files(request: ExportRequest, files: list[tuple[Path, int]], notes: list[str]) -> None:
    """Print the files with their sizes in bytes, images as one line with their number and total size.

    With ``--json``, print one object instead: ``--out``, the total size, the names of several files, and
    notes.
    """
    if request.json:
        names = {} if len(files) == 1 else {"files": [str(file) for file, _ in files]}
        size = sum(size for _, size in files)
        value = {"file": str(request.out), "bytes": size, **names, **({"notes": notes} if notes else {})}
        show_json(value, indent=2, sort_keys=True)
        return
    image_sizes = [size for file, size in files if file.parent.name == IMAGES_FOLDER]
    lines = [f"{file}: {size} bytes" for file, size in files if file.parent.name != IMAGES_FOLDER]
    if image_sizes:
        count = counted(len(image_sizes), "image")
        lines.append(f"{request.out / IMAGES_FOLDER}: {count}, {sum(image_sizes)} bytes")
    show(*lines, *(f"note: {note}" for note in notes))


def _check_options(request: ExportRequest) -> None:
    """Raise UsageError if an option was given that belongs to another format."""
    if request.images is not None and request.format not in ("colmap", "nerfstudio"):
        raise UsageError(
            f"--images is for colmap and nerfstudio, not {request.format}", hint="leave --images out"
        )
    options = [("--robot", request.robot, "tum")]
    options += [
        (f"--{name.replace('_', '-')}", getattr(request, name), "occupancy") for name in _GRID_OPTIONS
    ]
    for flag, value, format_name in options:
        if value is not None and request.format != format_name:
            raise UsageError(f"{flag} is for {format_name}, not {request.format}", hint=f"leave {flag} out")


def _add_images(
    request: ExportRequest, maps: MapRegistry, version: MapVersion, files: dict[str, bytes]
) -> _Files:
    """Return *files* together with the images of the keyframes, and notes about missing images.

    The images come from the folder ``--images`` if it is named, else from the store of the maps.

    Raises:
        UsageError: The folder ``--images`` does not exist, or an image in it cannot be read or is too large.
    """
    if request.images is None:
        stored = {f"{IMAGES_FOLDER}/{keyframe.image_name}": data for keyframe, data in maps.images(version)}
        notes = _note_missing_images("the store", version, stored) if stored else [_NO_IMAGES]
        return {**files, **stored}, notes
    if not request.images.is_dir():
        raise UsageError(
            f"there is no folder {request.images}", hint="map from-camera --keep-images makes one"
        )
    images = {}
    for keyframe in version.keyframes:
        file = request.images / keyframe.image_name
        if file.is_file():
            try:
                images[f"{IMAGES_FOLDER}/{file.name}"] = read_regular_file(file, _MAX_IMAGE_BYTES)
            except OSError as error:
                raise UsageError(f"cannot read {file}: {error}", hint="leave --images out") from error
    return {**files, **images}, _note_missing_images(str(request.images), version, images)


def _note_missing_images(where: str, version: MapVersion, images: dict[str, bytes]) -> list[str]:
    missing = len(version.keyframes) - len(images)
    return [f"{where} has no image of {counted(missing, 'keyframe')}"] if missing else []


def _colmap(request: ExportRequest, maps: MapRegistry, version: MapVersion) -> _Files:
    def report(done: float) -> None:
        show_progress(f"{100 * done:3.0f} %  matching keyframes", is_over=done >= 1.0)

    return _add_images(request, maps, version, encode_colmap(version, report))


def _nerfstudio(request: ExportRequest, maps: MapRegistry, version: MapVersion) -> _Files:
    files, notes = _add_images(request, maps, version, encode_nerfstudio(version))
    if version.up is None:
        notes.append("this map does not say where up is: its axes are kept")
    return files, notes


def _occupancy(request: ExportRequest, maps: MapRegistry, version: MapVersion) -> _Files:
    with at_work("looking for free space"):
        grid = make_occupancy_grid(version, _grid_options(request))
    notes = []
    if grid.up_source not in ("the map", "--up"):
        notes.append(f"this map does not say where up is: taken by {grid.up_source}; --up names it")
    if grid.points_left_out:
        notes.append(f"{grid.points_left_out} points were left out: they are far from all poses")
    return encode_occupancy(grid), notes


def _grid_options(request: ExportRequest) -> GridOptions:
    values: dict[str, Any] = {
        field.name: getattr(request, field.name.removesuffix("_m")) for field in fields(GridOptions)
    }
    if request.up is not None:
        try:
            x, y, z = (float(number) for number in request.up.split(","))
        except ValueError as error:
            raise UsageError(f"--up {request.up[:80]!r} is not three numbers", hint="write x,y,z") from error
        values["up"] = (x, y, z)
    return GridOptions(**{name: value for name, value in values.items() if value is not None})


_FOLDER_FORMATS: dict[str, Callable[[ExportRequest, MapRegistry, MapVersion], _Files]] = {
    "colmap": _colmap,
    "nerfstudio": _nerfstudio,
    "occupancy": _occupancy,
}
"""The function that makes the files of each format that is a folder, by the name of the format."""

ACTION = Action(
    help="write a version in the format of another program",
    example="rse-pf map export kitchen --format colmap --out kitchen-colmap",
    request=ExportRequest,
    run=run_export,
)
