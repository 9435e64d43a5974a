"""Estimate the camera poses of images in a map: in this process, or by a platform over HTTP."""

from __future__ import annotations

import re
import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from rse_pf.command_line.map_store import MapRequest, split_version
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera, rotation_angle_deg, to_quaternion
from rse_pf.maps.descriptors import check_same_kind
from rse_pf.maps.format import MapVersion
from rse_pf.maps.photos import PhotoLens, PhotoLocation
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.files import read_regular_file
from rse_pf.terminal import at_work, show, show_json

if TYPE_CHECKING:
    from client_sdk.datasets import Dataset
    from client_sdk.plugins import FeaturesPlugin
    from client_sdk.transfer.data_client import DataClient
    from rse_pf.slam.relative_pose import View

__all__ = ["LocaliseRequest", "run_localise"]

# RECORDING:ROW or RECORDING:FIRST-LAST.
_FRAME_RANGE = re.compile(r"(?P<folder>.+):(?P<first>\d+)(-(?P<last>\d+))?")
# Largest image file that is read and sent to a platform, in bytes: it protects the memory of this process;
# the platform has a limit of its own.
_MAX_PHOTO_BYTES = 1 << 26


@dataclass(frozen=True, kw_only=True)
class LocaliseRequest(MapRequest):
    """The options of rse-pf map localise: a map, frames, their camera, and the platform or store."""

    frames: tuple[str, ...] = option(
        nargs="+",
        metavar="FRAME",
        help="an image, a folder of images, a recording, RECORDING:ROW or RECORDING:FIRST-LAST",
    )
    every: int = option("--every", default=1, metavar="N", help="only every n-th frame")
    camera: str | None = option(
        "--camera",
        metavar="FX,FY,CX,CY",
        help="camera of images, pixels (default: the camera of the map with the same image size)",
    )
    features: str | None = option(
        "--features",
        metavar="MODULE:FUNCTION",
        help="function that finds features, the one with which the map was made (default: ORB)",
    )
    url: str | None = option(
        "--url", help="localise at the platform of this address, http(s): or ws(s):, with --token-file"
    )
    token_file: Path | None = option(
        "--token-file", metavar="FILE", help="with --url: file that holds the token"
    )
    authority: Path | None = option(
        "--authority", metavar="FILE", help="with --url: certificate to trust, authority.crt"
    )
    enrolment: Path | None = option(
        "--enrolment", metavar="FILE", help="localise at the platform of this enrolment"
    )
    intrinsics: Path | None = option(
        "--intrinsics", metavar="FILE", help="with --url or --enrolment: file of the camera, with distortion"
    )


def run_localise(request: LocaliseRequest, settings: PlatformSettings) -> int:
    """Estimate the pose of each frame, by the platform that an option names, else in this process.

    Returns 0 if at least one pose has the verdict ok, else 1.
    """
    if request.url is not None or request.enrolment is not None:
        return _localise_photos(request)
    return _localise_frames(request, request.open_maps(settings))


def _localise_frames(request: LocaliseRequest, maps: MapRegistry) -> int:
    """Estimate the pose of each frame in a map of the store, and print it; return 1 if no verdict is ok."""
    from rse_pf.services.mapping.localise import locate
    from rse_pf.services.mapping.photo import location_of
    from rse_pf.services.mapping.place import open_map

    if request.intrinsics is not None or request.token_file is not None or request.authority is not None:
        raise UsageError(
            "--intrinsics, --token-file and --authority are for a platform", hint="add --url, or use --camera"
        )
    if request.every < 1:
        raise UsageError(f"--every {request.every} is below 1", hint="1 takes every frame")
    from client_sdk.plugins import FeaturesPlugin, load_features

    features = load_features(request.features)
    plugin = None if features is None else FeaturesPlugin(features)
    name, version = split_version(request.name)
    data = maps.data(name, version)
    with at_work(f"reading {request.name}"):
        version_map, index = open_map(data)
    frames = [each for word in request.frames for each in _frames(word, request.every)]
    found: list[dict[str, Any]] = []
    for each in frames:
        reply = locate(index, _view_of(each, version_map, request.camera, plugin))
        found.append(_location_document(each.label, location_of(reply, version)))
        if not request.json:
            show(_location_line(found[-1]))
    return _finish(request, found)


def _localise_photos(request: LocaliseRequest) -> int:
    """Have a platform estimate the pose of each photo, and print it; return 1 if no verdict is ok."""
    if request.store is not None or request.features is not None or request.every != 1:
        raise UsageError(
            "--store, --features and --every are for a map of a store", hint="leave them out, or leave --url"
        )
    lens = _lens_of(request)
    photos = [(str(path), _photo(path)) for word in request.frames for path in _photo_files(Path(word))]
    client = _client(request)
    found: list[dict[str, Any]] = []
    try:
        for label, photo in photos:
            found.append(_location_document(label, client.localise(request.name, photo, lens)))
            if not request.json:
                show(_location_line(found[-1]))
    finally:
        client.close()
    return _finish(request, found)


def _lens_of(request: LocaliseRequest) -> PhotoLens:
    """Return the intrinsics of --camera or --intrinsics; raises UsageError unless exactly one is given."""
    if request.camera is not None and request.intrinsics is None:
        fx, fy, cx, cy = _four_numbers(request.camera)
        return PhotoLens(fx=fx, fy=fy, cx=cx, cy=cy)
    if request.intrinsics is None or request.camera is not None:
        raise UsageError(
            "a platform needs --intrinsics FILE, or --camera FX,FY,CX,CY, and not both",
            hint="make a file: rse-pf camera calibrate SOURCE, without or with a board (docs/cameras.md)",
        )
    from client_sdk.rigs.rig_file import read_intrinsics

    read = read_intrinsics(request.intrinsics)
    camera = read.camera
    return PhotoLens(
        fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, width=camera.width, height=camera.height,
        distortion=read.distortion, model=read.model,
    )  # fmt: skip


def _photo_files(path: Path) -> list[Path]:
    """Return *path*, or the image files in it if it is a folder; raises UsageError if it has none."""
    from client_sdk.datasets.images import image_files

    if not path.is_dir():
        return [path]
    photos = image_files(path)
    if not photos:
        raise UsageError(f"there is no image in the folder {path}", hint="name JPEG or PNG files")
    return photos


def _photo(path: Path) -> bytes:
    """Return the content of an image file; raises UsageError if it cannot be read, or is too large."""
    try:
        return read_regular_file(path, _MAX_PHOTO_BYTES)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="name a JPEG or PNG file") from error
    except ValueError as error:
        raise UsageError(f"{path} is not a photo", hint="name a JPEG or PNG file") from error


def _client(request: LocaliseRequest) -> DataClient:
    """Return a client of the data service of the platform that --enrolment, or --url with a token, names."""
    from client_sdk.transfer.data_client import DataClient, DataOptions

    if request.enrolment is not None:
        if request.url is not None or request.token_file is not None or request.authority is not None:
            raise UsageError("--enrolment names address and key", hint="leave out --url and its options")
        return DataClient.enrolled(request.enrolment)
    if request.url is None or request.token_file is None:
        raise UsageError("--url needs --token-file", hint="get a token: rse-pf token issue NAME > FILE")
    try:
        token = request.token_file.read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise UsageError(
            f"cannot read the token in {request.token_file}", hint="rse-pf token issue NAME > FILE"
        ) from error
    trusted = None
    if request.authority is not None:
        try:
            trusted = ssl.create_default_context(cafile=str(request.authority))
        except OSError as error:
            raise UsageError(
                f"{request.authority} is not a certificate", hint="name the platform's file authority.crt"
            ) from error
    return DataClient(request.url, token, DataOptions(ssl_context=trusted))


def _finish(request: LocaliseRequest, found: list[dict[str, Any]]) -> int:
    """Print all results as JSON, or the number of poses that are ok; return 1 if that is 0, else 0."""
    good = sum(each["verdict"] == "ok" for each in found)
    if request.json:
        show_json(found, indent=2, sort_keys=True)
    else:
        show(f"{good} of {len(found)} found")
    return 0 if good else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class _NamedFrame:
    """A frame to localise: an image file, or the frame ``row`` of a recording; ``label`` is its name."""

    label: str
    path: Path
    recording: Dataset | None = None
    row: int = 0


def _frames(word: str, every: int) -> Iterator[_NamedFrame]:
    """Yield every *every*-th frame of *word*: an image, a folder of images, a recording or a range of one.

    Raises:
        UsageError: There is no such image or recording, or it has fewer frames.
    """
    path = Path(word)
    if path.is_file():
        yield _NamedFrame(label=word, path=path)
        return
    first, last = 0, -1
    match = None if path.is_dir() else _FRAME_RANGE.fullmatch(word)
    if match is not None:
        path = Path(match["folder"])
        first = int(match["first"])
        last = int(match["last"] or first)
    if not path.exists():
        raise UsageError(
            f"there is no image or recording {word}",
            hint="name an image, a recording, or RECORDING:FIRST-LAST",
        )
    from client_sdk.cameras.open_camera import is_recording
    from client_sdk.datasets import open_dataset
    from client_sdk.datasets.images import image_files

    photos = image_files(path) if path.is_dir() and not is_recording(path) else []
    if photos:
        yield from (_NamedFrame(label=photo.name, path=photo) for photo in photos[::every])
        return
    recording = open_dataset(path)
    count = len(recording)
    if match is not None and not first <= last < count:
        raise UsageError(
            f"{path} has the frames 0 to {count - 1}, not {word.rpartition(':')[2]}",
            hint="count frames from 0",
        )
    for row in range(first, count if last < 0 else last + 1, every):
        yield _NamedFrame(label=f"{path.name}:{row}", path=path, recording=recording, row=row)


def _view_of(
    named: _NamedFrame, version: MapVersion, camera: str | None, plugin: FeaturesPlugin | None
) -> View:
    """Return the camera and the features of a frame, to be matched with the map *version*.

    The intrinsics of an image are those of *camera*, FX,FY,CX,CY, else of a camera of the map; a recording
    has its own.  *plugin* finds the features; None uses ORB.
    """
    from client_sdk.datasets import read_colour
    from client_sdk.frontend import Frame, FrontEndOptions, extract
    from rse_pf.slam.relative_pose import View

    if named.recording is not None:
        frame = named.recording.read(named.recording.rows[named.row])
    else:
        rgb = read_colour(named.path)
        height, width = rgb.shape[:2]
        lens = (
            _parse_lens(camera, width, height)
            if camera
            else _lens_of_map(version, width, height, named.label)
        )
        nothing = np.zeros((height, width), dtype=np.float32)
        frame = Frame(timestamp_s=0.0, rgb=rgb, depth_m=nothing, camera=lens)
    features = extract(frame, FrontEndOptions(), plugin)
    check_same_kind(version.kind, features.kind, "the map")
    return View(camera=frame.camera, pixels=features.pixels, descriptors=features.descriptors)


def _parse_lens(numbers: str, width: int, height: int) -> Camera:
    fx, fy, cx, cy = _four_numbers(numbers)
    return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _four_numbers(numbers: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in px from the value of --camera; raises UsageError if it is not four numbers."""
    try:
        fx, fy, cx, cy = (float(number) for number in numbers.split(","))
    except ValueError as error:
        raise UsageError(
            f"--camera {numbers} is not four numbers", hint="write fx,fy,cx,cy in pixels"
        ) from error
    return fx, fy, cx, cy


def _lens_of_map(version: MapVersion, width: int, height: int, label: str) -> Camera:
    """Return the camera of the first keyframe whose images have this size, which likely took the image.

    Raises:
        UsageError: No camera of the map has this size; *label* names the image.
    """
    for keyframe in version.keyframes:
        if (keyframe.camera.width, keyframe.camera.height) == (width, height):
            return keyframe.camera
    raise UsageError(
        f"{label} is {width}x{height} px, and no camera of the map has that size",
        hint="name the camera of the image: --camera fx,fy,cx,cy",
    )


def _location_document(label: str, location: PhotoLocation) -> dict[str, Any]:
    """Return the fields of *location* as plain JSON values, with *label* as ``frame`` and the pose in parts.

    The parts are the position of the camera in the map (``position_m``), its rotation (``quaternion_xyzw``),
    and the angle of that rotation, 0 to 180 degrees (``turned_deg``).  They are None if no pose was found.
    """
    T = None if location.T_map_camera is None else np.array(location.T_map_camera)
    return {
        "frame": label, **msgspec.structs.asdict(location),
        "position_m": None if T is None else [round(float(x), 4) + 0.0 for x in T[:3, 3]],
        "quaternion_xyzw": None if T is None else [round(float(x), 6) for x in to_quaternion(T[:3, :3])],
        "turned_deg": None if T is None else round(rotation_angle_deg(T[:3, :3]), 2),
    }  # fmt: skip


def _location_line(found: dict[str, Any]) -> str:
    """Return the result of `_location_document` as one line."""
    start = f"{found['frame']:<24} {found['verdict']:<4}"
    if found["position_m"] is None:
        return f"{start}  {found['reason']}, {found['inliers']} inliers"
    x, y, z = found["position_m"]
    reason = f" ({found['reason']})" if found["reason"] else ""
    keyframes = ", ".join(str(keyframe) for keyframe in found["keyframes"])
    return (
        f"{start}  x {x:7.3f}  y {y:7.3f}  z {z:7.3f} m, sigma {found['position_sigma_m']:.3f} m, "
        f"turned {found['turned_deg']:6.2f} deg; "
        f"{found['inliers']} inliers, {found['rmse_px']:.2f} px, keyframes {keyframes}{reason}"
    )
