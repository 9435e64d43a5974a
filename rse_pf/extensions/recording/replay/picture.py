"""Draw the matches of a command: inliers, outliers, and the projections of their points by the pose.

The background is the thumbnail of the frame if there is one.  Thumbnails are untrusted input: they are opened
only in a process with limits, and their size is checked before they are decoded.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, MissingExtra
from rse_pf.geometry import Array, Camera, transform

__all__ = ["INLIER", "MAX_THUMBNAIL_PX", "OUTLIER", "match_picture"]

# The colours (RGB) can be distinguished by colour-blind readers (Okabe and Ito 2008).
INLIER = (0, 114, 178)  # colour of inliers, and of the lines to their projections: blue
OUTLIER = (213, 94, 0)  # colour of outliers: vermilion
REPROJECTED = (230, 159, 0)  # colour of the lines from outliers to the projections of their points: orange
MAX_THUMBNAIL_PX = 1 << 20  # largest number of pixels of a thumbnail that is decoded
_MAX_THUMBNAIL_BYTES = 1 << 20  # largest JPEG of a thumbnail that is opened
_WIDTH_PX = 960  # width of the picture
_MIN_HEIGHT_PX = 120  # smallest height of the picture, for malformed sizes of the camera
_MAX_HEIGHT_PX = 1920  # largest height of the picture, for malformed sizes of the camera
_BACKGROUND = (238, 240, 243)  # colour of the picture without a thumbnail
# White: blended with the thumbnail, and the outline of the dots.
_WHITE = (255, 255, 255)
_MAX_DRAWN = 5000  # largest number of matches that are drawn: bounds the time
_MIN_DEPTH_M = 1e-6  # smallest depth of a point that is projected: others are behind the camera


def match_picture(
    *,
    camera: Camera,
    points_world: Array,
    pixels: Array,
    inliers: npt.NDArray[np.intp],
    T_camera_world: Array | None,
    thumbnail: bytes | None,
) -> bytes:
    """Return a PNG with a dot for each inlier, a cross for each outlier, and a line to its projection.

    Args:
        camera: Camera of the frame.
        points_world: ``(n, 3)``, points of the matches, metres.
        pixels: ``(n, 2)``, pixels of the matches.
        inliers: Indices of the inliers.
        T_camera_world: ``(4, 4)``, the pose; None draws no lines.
        thumbnail: JPEG of the frame; None, or an image that cannot be decoded, gives a plain background.

    Raises:
        MissingExtra: Pillow is not installed.
    """
    image_module, draw_module = _pillow()
    scale = _WIDTH_PX / camera.width
    height = min(_MAX_HEIGHT_PX, max(_MIN_HEIGHT_PX, round(camera.height * scale)))
    size = (_WIDTH_PX, height)
    image = image_module.new("RGB", size, _BACKGROUND)
    if thumbnail is not None:
        try:
            frame = _decode(thumbnail).convert("L").convert("RGB").resize(size)
            image = image_module.blend(frame, image_module.new("RGB", size, _WHITE), 0.35)
        except BadRequest:
            pass
    draw = draw_module.Draw(image)
    agrees = np.zeros(len(pixels), dtype=np.bool_)
    agrees[inliers[inliers < len(pixels)]] = True
    finite = np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e6).all(axis=1)
    shown = np.flatnonzero(finite)[:_MAX_DRAWN]
    if T_camera_world is not None:
        is_near, projected = _project_near(points_world[shown], T_camera_world, camera)
        drawn = shown[is_near]
        _draw_lines(draw, pixels[drawn] * scale, projected[is_near] * scale, agrees[drawn])
    for row in shown[
        np.argsort(agrees[shown], kind="stable")
    ]:  # outliers first, so that inliers are drawn over them
        u, v = pixels[row] * scale
        if agrees[row]:
            draw.ellipse((u - 4, v - 4, u + 4, v + 4), fill=INLIER, outline=_WHITE)
        else:
            draw.line((u - 4, v - 4, u + 4, v + 4), fill=OUTLIER, width=2)
            draw.line((u - 4, v + 4, u + 4, v - 4), fill=OUTLIER, width=2)
    file = io.BytesIO()
    image.save(file, format="PNG")
    return file.getvalue()


def _project_near(
    points_world: Array, T_camera_world: Array, camera: Camera
) -> tuple[npt.NDArray[np.bool_], Array]:
    """Return which points are projected within two image sizes, and the projections ``(n, 2)`` of all, px."""
    with np.errstate(all="ignore"):
        points_camera = transform(T_camera_world, points_world)
        in_front = points_camera[:, 2] > _MIN_DEPTH_M
        points_camera[~in_front] = 1.0
        projected = camera.project(points_camera)
    reach = 2.0 * max(camera.width, camera.height)
    return in_front & (np.abs(projected) < reach).all(axis=1), projected


def _draw_lines(draw: Any, seen: Array, projected: Array, agrees: npt.NDArray[np.bool_]) -> None:
    """Draw a line from each observed pixel to the projection of its point, both in pixels of the picture."""
    for (x, y), (u, v), is_inlier in zip(seen, projected, agrees, strict=True):
        draw.line((x, y, u, v), fill=INLIER if is_inlier else REPROJECTED, width=1)


def _decode(thumbnail: bytes) -> Any:
    """Decode a thumbnail; raises BadRequest if it is too large, or not a JPEG."""
    image_module, _ = _pillow()
    if len(thumbnail) > _MAX_THUMBNAIL_BYTES:
        raise BadRequest(f"a thumbnail of {len(thumbnail)} bytes is too large", hint="record smaller ones")
    try:
        image = image_module.open(io.BytesIO(thumbnail), formats=("JPEG",))
        if image.width * image.height > MAX_THUMBNAIL_PX:
            raise BadRequest(
                f"a thumbnail of {image.width}x{image.height} px is too large", hint="record smaller ones"
            )
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError, image_module.DecompressionBombError) as error:
        raise BadRequest("a thumbnail is no JPEG", hint="leave it out") from error
    return image


def _pillow() -> tuple[Any, Any]:
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise MissingExtra("pillow", "local") from error
    return Image, ImageDraw
