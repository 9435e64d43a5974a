"""Localise a photo: from a JPEG or PNG and the lens that took it to the pose of the camera in a map.

The photo gets the same ORB features as keyframes, and `rse_pf.services.mapping.localise` computes the pose.
This module also draws the outline of a map, on which clients show the result.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, Camera, Lens
from rse_pf.images import decode_photo, load_opencv, photo_size
from rse_pf.maps.descriptors import ORB, check_same_kind
from rse_pf.maps.format import MapVersion
from rse_pf.maps.photos import MapOutline, PhotoLens, PhotoLocation
from rse_pf.services.mapping.localise import LocaliseOptions, LocaliseReply, locate
from rse_pf.services.mapping.place import MapIndex, check_comparisons
from rse_pf.slam.level_surfaces import estimate_up
from rse_pf.slam.orb import describe_orb
from rse_pf.slam.relative_pose import View

__all__ = ["localise_photo", "location_of", "outline_of"]

_MAX_FEATURES = 1000  # most ORB features of a photo: as many as a robot finds in one of its frames
_MAX_FOCAL_RATIO = 1.2
"""Largest quotient of the focal length of a photo and the median focal length of the map's images, both in
pixels.  A photo with a larger quotient is resized so that its focal length is the median: if the scale
differs by more than one level of ORB's image pyramid (1.2), the same corners get other descriptors."""
_MAX_PIXEL_RATIO = 4
"""Largest quotient of the number of pixels of a photo and that of the map's largest image; a photo with more
pixels is resized to this number, which bounds the time of the detection."""
_MAX_ASPECT_DIFFERENCE = 0.01
"""Largest relative difference between the aspect ratio of a photo and that of the image which its intrinsics
describe.  If a photo was resized, the rounding of its width and height to whole pixels changes the ratio by
less than 1 %; if it was cropped or rotated, the ratio usually differs by more."""
_MAX_ROUND_TRIP_PX = 0.5
"""Largest difference, in each coordinate, between a pixel and the same pixel undistorted and distorted again:
beyond it, the iterative inverse of the distortion has failed, and the feature at the pixel is not used."""
_MAX_OUTLINE_KEYFRAMES = 2000  # largest number of keyframes in an outline, so that it stays below 100 kB
_MAX_OUTLINE_POINTS = 4000  # largest number of map points in an outline, so that it stays below 100 kB


def localise_photo(data: bytes, photo_lens: PhotoLens, index: MapIndex) -> LocaliseReply:
    """Return the pose in the map of *index* of the camera that took a photo.

    Args:
        data: A JPEG or PNG file.
        photo_lens: The intrinsics and the distortion of the photo.
        index: The index of a map with ORB features.

    Returns:
        The reply of `locate`: ``T_map_camera`` is ``(4, 4)`` and ``covariance`` ``(6, 6)``, both None without
        a pose.

    Raises:
        BadRequest, LimitExceeded: The photo or its intrinsics cannot be used, or the map has other features.
        InvalidCamera: The intrinsics describe no camera.
        MissingExtra: OpenCV or the native core is not installed.
    """
    # 1. Find the camera of the photo, and of the smaller image in which features are detected.
    check_same_kind(index.kind, ORB, "the map")
    camera_of_photo = _camera_of_photo(photo_lens, *photo_size(data))
    camera = _camera_for_features(camera_of_photo, [keyframe.camera for keyframe in index.keyframes])
    # 2. Detect ORB features in the photo, resized for that camera.
    rgb = decode_photo(data)
    if camera != camera_of_photo:
        cv2 = load_opencv()
        rgb = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    features = describe_orb(rgb, _MAX_FEATURES)
    # 3. Undistort the pixels of the features.
    lens = Lens(camera=camera, distortion=photo_lens.distortion, model=photo_lens.model)
    pixels, is_valid = _undistort_features(features.pixels, lens)
    # 4. Localise the features in the map, without those whose pixels could not be undistorted.
    view = View(camera=camera, pixels=pixels[is_valid], descriptors=features.descriptors[is_valid])
    check_comparisons(index, view, LocaliseOptions().candidates)
    return locate(index, view)


def location_of(reply: LocaliseReply, version: str) -> PhotoLocation:
    """Return the result of `localise_photo` as the HTTP reply, which also states two standard deviations.

    ``position_sigma_m`` is the square root of the sum of the variances of the camera's position along the
    three axes, and ``turn_sigma_deg`` the square root of the sum of the variances of its rotation about them.
    Both, the pose and the covariance are None if *reply* has no pose.  *version* is the id of the map version
    that was searched.
    """
    pose, covariance = reply.T_map_camera, reply.covariance
    location = PhotoLocation(
        version=version,
        verdict=reply.verdict,
        reason=reply.reason,
        inliers=reply.inliers,
        rmse_px=round(reply.rmse_px, 3),
        keyframes=reply.keyframes,
    )
    if pose is None or covariance is None:
        return location
    x, y, z = pose[:3, 3]
    # A twist (rho, phi) left of the pose moves the camera's position t by rho + phi x t: J = [I, -skew(t)].
    J = np.hstack([np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]])
    return msgspec.structs.replace(
        location,
        T_map_camera=pose.tolist(),
        covariance=covariance.tolist(),
        position_sigma_m=_total_deviation(J @ covariance @ J.T),
        turn_sigma_deg=math.degrees(_total_deviation(covariance[3:, 3:])),
    )


def outline_of(map_version: MapVersion, version: str) -> MapOutline:
    """Return a map seen from above: positions of keyframes and points, projected along the vertical.

    At most 2000 keyframes and 4000 points are chosen evenly; their positions are in metres, rounded to 1 mm.
    The vertical is the one that `estimate_up` returns, or the z axis of the map if it returns None.  The map
    must have a keyframe.  *version* is the id of the map version.
    """
    poses = np.array([keyframe.T_world_camera for keyframe in map_version.keyframes])
    up = estimate_up(map_version)
    axes = _top_view_axes(np.array([0.0, 0.0, 1.0]) if up is None else up[0])
    points = np.asarray(map_version.points, dtype=np.float64).reshape(-1, 3)
    keyframes_2d = _take_evenly(poses[:, :3, 3], _MAX_OUTLINE_KEYFRAMES) @ axes.T
    points_2d = _take_evenly(points, _MAX_OUTLINE_POINTS) @ axes.T
    return MapOutline(
        version=version,
        top_view=axes.tolist(),
        keyframes=np.round(keyframes_2d, 3).tolist(),
        points=np.round(points_2d, 3).tolist(),
    )


def _camera_of_photo(photo_lens: PhotoLens, width: int, height: int) -> Camera:
    """Return the camera of a photo of *width* by *height* pixels; intrinsics of another size are scaled.

    Raises:
        BadRequest: The intrinsics are for an image of another aspect ratio.
        InvalidCamera: The intrinsics describe no camera.
    """
    stated = photo_lens.width or width, photo_lens.height or height
    if abs((width / stated[0]) / (height / stated[1]) - 1.0) > _MAX_ASPECT_DIFFERENCE:
        raise BadRequest(
            f"the intrinsics are for {stated[0]}x{stated[1]} px, the photo has {width}x{height}",
            hint="send intrinsics of this camera, and a photo that was neither cropped nor rotated",
        )
    camera = Camera(
        fx=photo_lens.fx,
        fy=photo_lens.fy,
        cx=photo_lens.cx,
        cy=photo_lens.cy,
        width=stated[0],
        height=stated[1],
    )
    return _resize_camera(camera, width, height)


def _total_deviation(covariance: Array) -> float:
    """Return the square root of the sum of the variances along the axes of a ``(3, 3)`` covariance."""
    return math.sqrt(float(np.trace(covariance)))


def _top_view_axes(up: Array) -> Array:
    """Return the x and y axes ``(2, 3)`` of the view from above, in the world of the map.

    Both are unit vectors orthogonal to each other and to the unit vector *up* ``(3,)``, and y is x turned
    counter-clockwise as seen from above.  The x axis is the projection, onto the plane orthogonal to *up*, of
    that axis of the map's frame which is closest to the plane.
    """
    right = np.eye(3)[int(np.argmin(np.abs(up)))]
    right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right)])


def _take_evenly(points: Array, max_count: int) -> Array:
    return points[:: max(1, math.ceil(len(points) / max_count))]


def _camera_for_features(camera: Camera, map_cameras: list[Camera]) -> Camera:
    """Return the camera of the photo at the size in which features are detected, which may be its own size.

    If the focal length is above `_MAX_FOCAL_RATIO` times the median of the map's cameras, it is scaled down
    to this median.  If the photo has more than `_MAX_PIXEL_RATIO` times the pixels of the map's largest
    image, it is scaled down to that number.  The smaller scale of both counts, and no photo is enlarged.
    """
    map_focal_px = float(np.median([map_camera.fx for map_camera in map_cameras]))
    scale = map_focal_px / camera.fx if camera.fx > _MAX_FOCAL_RATIO * map_focal_px else 1.0
    max_pixels = _MAX_PIXEL_RATIO * max(map_camera.width * map_camera.height for map_camera in map_cameras)
    scale = min(scale, math.sqrt(max_pixels / (camera.width * camera.height)))
    if scale >= 1.0:
        return camera
    return _resize_camera(camera, max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the image of *camera*, resampled to *width* by *height* pixels."""
    scale_x, scale_y = width / camera.width, height / camera.height
    # The first pixel's centre is (0, 0), so that the corner of the image, which stays, is (-0.5, -0.5).
    return Camera(
        fx=camera.fx * scale_x,
        fy=camera.fy * scale_y,
        cx=(camera.cx + 0.5) * scale_x - 0.5,
        cy=(camera.cy + 0.5) * scale_y - 0.5,
        width=width,
        height=height,
    )


def _undistort_features(pixels: Array, lens: Lens) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return ``(n, 2)`` pixels without distortion, and whether each of them is valid, ``(n,)``.

    A pixel is invalid where the inverse of the distortion did not converge, see `_MAX_ROUND_TRIP_PX`.
    """
    if not len(pixels) or lens.is_pinhole:
        return pixels, np.ones(len(pixels), dtype=bool)
    with np.errstate(all="ignore"):
        undistorted = lens.undistort_pixels(pixels)
        round_trip_px = np.abs(lens.distort_pixels(undistorted) - pixels).max(axis=1)
    return undistorted, np.isfinite(round_trip_px) & (round_trip_px <= _MAX_ROUND_TRIP_PX)
