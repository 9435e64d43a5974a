"""object-recognition: find textured objects and AprilTags in an image, without trained weights.

An object is known by one picture of its flat side, ``objects/NAME.png``, and its width in metres in
``objects/objects.json``.  Features: SIFT, Lowe 2004; pose of a plane: IPPE, Collins and Bartoli 2014; tags:
AprilTag 36h11, Olson 2011.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest
from rse_pf.wire.arrays import Array

__all__ = ["Found", "Reply", "Request", "serve"]

_OBJECTS = Path(__file__).parent / "objects"
_MAX_SIDE_PX = 2000
_RATIO = 0.75
_INLIER_PX = 3.0
_MIN_INLIERS = 15
_CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])

cv2.setNumThreads(1)
_sift = cv2.SIFT_create(nfeatures=2000)


class Request(msgspec.Struct):
    """An undistorted ``image`` (JPEG or PNG), ``camera`` (fx, fy, cx, cy in px), and the size of the tags.

    With ``tags_only`` no object is looked for, which is many times faster.
    """

    image: bytes
    camera: Array
    tag_m: float = 0.1
    tags_only: bool = False


class Found(msgspec.Struct):
    """``T_camera_object``: 16 numbers, row-major, metres; from its centre x right, y down, z into it.

    ``name`` is that of the picture, or ``tag36h11:ID``.
    """

    name: str
    T_camera_object: Array
    inliers: int
    rmse_px: float


class Reply(msgspec.Struct):
    """What was found, objects first; an empty list is an answer too."""

    found: list[Found]


class _Model:
    """The features of one object, with their places on it."""

    def __init__(self, name: str, width_m: float) -> None:
        picture = cv2.imread(str(_OBJECTS / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        keypoints, self.descriptors = _sift.detectAndCompute(picture, None)
        height_px, width_px = picture.shape
        places = cv2.KeyPoint_convert(keypoints) - (np.array([width_px, height_px]) - 1) / 2
        self.name = name
        self.points_m = np.column_stack((places * (width_m / width_px), np.zeros(len(places))))


_models = [_Model(*item) for item in json.loads((_OBJECTS / "objects.json").read_text()).items()]


def serve(request: Request) -> Reply:
    """Return the objects and tags that the image shows.

    Raises:
        BadRequest: The image cannot be read or is too large, or the camera or the size of the tags is wrong.
    """
    if len(request.camera) != 4 or not (request.camera[:2] > 0).all() or not request.tag_m > 0:
        raise BadRequest("camera must be fx, fy, cx, cy, and tag_m above 0", hint="see the README")
    data = np.frombuffer(request.image, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None or max(image.shape) > _MAX_SIDE_PX:
        raise BadRequest("not an image of at most 2000 px a side", hint="send JPEG or PNG bytes")
    fx, fy, cx, cy = request.camera
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if request.tags_only:
        return Reply(found=_tags(image, K, request.tag_m))
    keypoints, descriptors = _sift.detectAndCompute(image, None)
    objects = [_object(model, keypoints, descriptors, K) for model in _models]
    return Reply(
        found=[recognised for recognised in objects if recognised is not None]
        + _tags(image, K, request.tag_m)
    )


def _object(model: _Model, keypoints: Any, descriptors: Any, K: npt.NDArray[Any]) -> Found | None:
    """Match one object's features, keep those of one plane, and estimate its pose."""
    if descriptors is None or len(keypoints) < 2:
        return None
    pairs = cv2.BFMatcher().knnMatch(model.descriptors, descriptors, k=2)
    good = [best for best, second in pairs if best.distance < _RATIO * second.distance]
    if len(good) < _MIN_INLIERS:
        return None
    points_m = model.points_m[[match.queryIdx for match in good]]
    pixels = np.array([keypoints[match.trainIdx].pt for match in good])
    _, mask = cv2.findHomography(points_m[:, :2], pixels, cv2.RANSAC, _INLIER_PX)
    agreeing = np.flatnonzero(mask) if mask is not None else np.empty(0, np.intp)
    if len(agreeing) < _MIN_INLIERS:
        return None
    return _pose(model.name, points_m[agreeing], pixels[agreeing], K)


def _tags(image: npt.NDArray[Any], K: npt.NDArray[Any], tag_m: float) -> list[Found]:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, identities, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    names = [] if identities is None else [f"tag36h11:{identity}" for identity in identities.ravel()]
    return [
        _pose(name, tag_m * _CORNERS, seen.reshape(4, 2).astype(np.float64), K)
        for name, seen in zip(names, corners, strict=True)
    ]


def _pose(name: str, points_m: npt.NDArray[Any], pixels: npt.NDArray[Any], K: npt.NDArray[Any]) -> Found:
    """Return the better one of the two poses that a plane allows, refined."""
    _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(points_m, pixels, K, None, turns[0], shifts[0])
    error = cv2.projectPoints(points_m, turn, shift, K, None)[0].reshape(-1, 2) - pixels
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    rmse_px = float(np.sqrt((error**2).sum(axis=1).mean()))
    return Found(name=name, T_camera_object=T.ravel(), inliers=len(pixels), rmse_px=rmse_px)
