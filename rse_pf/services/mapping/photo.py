"""Localise a photo: from a JPEG or PNG and the lens that took it to the pose of the camera in a map.

The photo gets the features that keyframes have, and `rse_pf.services.mapping.localise` decides.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera
from rse_pf.images import decode_photo, load_opencv, photo_size
from rse_pf.maps.descriptors import ORB, check_same_kind
from rse_pf.maps.format import MapVersion
from rse_pf.maps.photos import Lens, MapOutline, PhotoLocation
from rse_pf.services.mapping.localise import LocaliseOptions, LocaliseReply, locate
from rse_pf.services.mapping.place import MapIndex, check_comparisons
from rse_pf.slam.level_surfaces import estimate_up
from rse_pf.slam.orb import describe_orb
from rse_pf.slam.relative_pose import View

__all__ = ["localise_photo", "location_of", "outline_of"]

_FEATURES = 1000
"""As many as a robot finds in a frame of its own."""
_LEVEL = 1.2
"""A photo whose focal length is longer than the map's by more than one level of the pyramid is made
smaller."""
_MOST_PIXELS = 4
"""Times the pixels of the map's largest image: features are sought in no more."""
_ASPECT = 0.01
"""Intrinsics of another size of the same image may differ so much in its aspect ratio."""
_UNDISTORTED_PX = 0.5
"""A pixel that its lens does not bring back to where it was is not used."""
_MOST_KEYFRAMES, _MOST_POINTS = 2000, 4000
"""Of an outline."""


def localise_photo(data: bytes, lens: Lens, index: MapIndex) -> LocaliseReply:
    """Return where a photo was taken among the keyframes of *index*.

    Args:
        data: A JPEG or PNG.
        lens: What took it.
        index: Of a map with ORB features.

    Raises:
        BadRequest, LimitExceeded: The photo or its intrinsics cannot be used, or the map has other features.
        InvalidCamera: An intrinsic is impossible.
        MissingExtra: OpenCV or the native core is not installed.
    """
    check_same_kind(index.kind, ORB, "the map")
    whole = _camera_of(lens, *photo_size(data))
    camera = _searched(whole, [keyframe.camera for keyframe in index.keyframes])
    rgb = decode_photo(data)
    if camera != whole:
        cv2 = load_opencv()
        rgb = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    found = describe_orb(rgb, _FEATURES)
    pixels, is_used = _undistorted(found.pixels, camera, lens)
    view = View(camera=camera, pixels=pixels[is_used], descriptors=found.descriptors[is_used])
    check_comparisons(index, view, LocaliseOptions().candidates)
    return locate(index, view)


def location_of(found: LocaliseReply, version: str) -> PhotoLocation:
    """Return a reply of `localise_photo` as it is sent."""
    pose, covariance = found.T_map_camera, found.covariance
    said = PhotoLocation(
        version=version, verdict=found.verdict, reason=found.reason, inliers=found.inliers,
        rmse_px=round(found.rmse_px, 3), keyframes=found.keyframes,
    )  # fmt: skip
    if pose is None or covariance is None:
        return said
    x, y, z = pose[:3, 3]
    # The twist moves the camera's place by its own metres, and by its turn around the origin of the map.
    moved = np.hstack([np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]])
    return msgspec.structs.replace(
        said, T_map_camera=pose.tolist(), covariance=covariance.tolist(),
        position_sigma_m=_sigma(moved @ covariance @ moved.T),
        turn_sigma_deg=math.degrees(_sigma(covariance[3:, 3:])),
    )  # fmt: skip


def outline_of(map_version: MapVersion, version: str) -> MapOutline:
    """Return a map, which has keyframes, as it is seen from above.

    Up is that of its floor plan: what the map says, or what its floor and its cameras tell.
    """
    poses = np.array([keyframe.T_world_camera for keyframe in map_version.keyframes])
    up = estimate_up(map_version)
    axes = _top_view(np.array([0.0, 0.0, 1.0]) if up is None else up[0])
    points = np.asarray(map_version.points, dtype=np.float64).reshape(-1, 3)
    return MapOutline(
        version=version,
        top_view=axes.tolist(),
        keyframes=np.round(_thinned(poses[:, :3, 3], _MOST_KEYFRAMES) @ axes.T, 3).tolist(),
        points=np.round(_thinned(points, _MOST_POINTS) @ axes.T, 3).tolist(),
    )


def _camera_of(lens: Lens, width: int, height: int) -> Camera:
    """Return the camera of a photo of this size.

    Raises:
        BadRequest: The intrinsics are for an image of another shape.
        InvalidCamera: A number is impossible.
    """
    given = lens.width or width, lens.height or height
    if abs((width / given[0]) / (height / given[1]) - 1.0) > _ASPECT:
        raise BadRequest(
            f"the intrinsics are for {given[0]}x{given[1]} px, the photo has {width}x{height}",
            hint="send those of this camera, without cropping or turning the photo",
        )
    whole = Camera(fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy, width=given[0], height=given[1])
    return _resized(whole, width, height)


def _sigma(covariance: Array) -> float:
    return math.sqrt(float(np.trace(covariance)))


def _top_view(up: Array) -> Array:
    """Return the ``(2, 3)`` axes of a plane that is seen from above, of the unit vector *up*."""
    right = np.eye(3)[int(np.argmin(np.abs(up)))]
    right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


def _thinned(points: Array, most: int) -> Array:
    return points[:: max(1, math.ceil(len(points) / most))]


def _searched(camera: Camera, of_map: list[Camera]) -> Camera:
    """Return the camera of the photo as features are sought in it: as finely as the map's images show."""
    focal = float(np.median([each.fx for each in of_map]))
    scale = focal / camera.fx if camera.fx > _LEVEL * focal else 1.0
    most = _MOST_PIXELS * max(each.width * each.height for each in of_map)
    scale = min(scale, math.sqrt(most / (camera.width * camera.height)))
    if scale >= 1.0:
        return camera
    return _resized(camera, max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the same image in another size; centres of pixels are whole numbers."""
    across, down = width / camera.width, height / camera.height
    return Camera(
        fx=camera.fx * across, fy=camera.fy * down, cx=(camera.cx + 0.5) * across - 0.5,
        cy=(camera.cy + 0.5) * down - 0.5, width=width, height=height,
    )  # fmt: skip


def _undistorted(pixels: Array, camera: Camera, lens: Lens) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return ``(n, 2)`` pixels without the distortion of *lens*, and which of them can be used."""
    if not len(pixels) or not any(lens.distortion):
        return pixels, np.ones(len(pixels), dtype=bool)
    cv2 = load_opencv()
    matrix, numbers = camera.matrix, np.array(lens.distortion)
    seen = np.ascontiguousarray(pixels).reshape(-1, 1, 2)
    with np.errstate(all="ignore"):
        if lens.model == "fisheye":
            straight = cv2.fisheye.undistortPoints(seen, matrix, numbers, None, None, matrix)
            rays = (straight.reshape(-1, 2) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
            again = cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), matrix, numbers)
        else:
            straight = cv2.undistortPoints(seen, matrix, numbers, None, None, matrix)
            rays = (straight.reshape(-1, 2) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
            points = np.column_stack([rays, np.ones(len(rays))])
            again, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, numbers)
        off_px = np.abs(again.reshape(-1, 2) - pixels).max(axis=1)
    return straight.reshape(-1, 2), np.isfinite(off_px) & (off_px <= _UNDISTORTED_PX)
