"""Render images and depths of the simulated world, and add the noise of a Kinect.

The renderer needs numpy only.  The same world, pose and random generator give the same image; an image of
640x480 pixels takes about a tenth of a second on one core.

Source:
    Depth noise: Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 3 (axial).
    Mip maps: Williams, SIGGRAPH 1983.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.simulator.world import DEPTH_M, HEIGHT_M, ROOM_M, Face, World
from rse_pf.geometry import Array, Camera

__all__ = ["Renderer", "add_depth_noise", "add_image_noise"]

_Image = npt.NDArray[np.float32]

_NEAR_M = 0.05  # depth of the near plane: nearer parts of faces are not drawn
_MIP_BIAS = 0.7
"""Added to a mip level before truncation; 0.5 would round, 0.7 prefers a coarser level: less aliasing."""
_MIN_MIP_COSINE = 0.05  # a smaller cosine of incidence counts as this in the choice of a mip level: less blur
_MAX_MIP_LEVELS = 12  # levels of a texture of 2048x2048 texels, the largest that is supported

# Brightness of the surfaces in a room, by which the colour of a texture is multiplied
_LAMP_BELOW_CEILING_M = 0.35  # vertical distance of each room's lamp from the middle of the ceiling
_AMBIENT = 0.68  # brightness without the lamp of the room
_LAMP = 0.62  # brightness that the lamp adds to a surface at distance 0
_LAMP_FALLOFF = 0.12
"""Per m^2: the lamp's part is divided by 1 + this times the squared distance from the lamp."""
_CORNER_SHADE = 0.28  # darkening at the edges of a face, where surfaces meet: 0 is none, 1 is black
_CORNER_FALLOFF = 70.0
"""Per m^2: `_CORNER_SHADE` is divided by 1 + this times the squared distance of a point from the nearest edge
of its face."""
_FACING_LIGHT = 0.06
"""This share of the brightness is multiplied by the cosine of incidence of the camera's ray."""

# What a Kinect measures of depths and colours
_DISPARITY_M_PX = 0.075 * 580.0
"""Baseline (m) times focal length (px) of a Kinect: disparity is this over depth."""
_DISPARITY_STEPS = 8.0  # a Kinect measures disparities in steps of 1/8 px
_MIN_DEPTH_M = 0.4  # smallest depth that a Kinect measures
_MAX_DEPTH_M = 6.0  # largest depth of a reading; farther surfaces give none
_GRAZING_COSINE = 0.10  # smallest cosine of incidence at which a surface gives a reading
_SHADOW_RATIO = 1.06
"""A pixel gives no reading if its depth is more than this many times that of a pixel near it: the nearer
surface shades it from the infrared projector."""
_RANDOM_HOLES = 0.002  # fraction of random pixels without a reading
_IMAGE_NOISE = 2.0  # standard deviation of the image noise, in grey levels of 255


class Renderer:
    """Draw one world as one pinhole camera sees it, by rasterising its faces with a depth buffer."""

    def __init__(self, world: World, camera: Camera) -> None:
        faces = world.faces
        self._faces, self._camera = faces, camera
        size = (camera.height, camera.width)
        rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
        self._rays_camera = np.stack(
            [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(size)]
        ).astype(np.float32)
        self._inverse_ray_lengths = 1.0 / np.sqrt((self._rays_camera**2).sum(axis=0)).ravel()
        self._level_starts, self._texels, self._last_levels = _make_mip_maps(world)
        self._corners = np.array([_corners(face) for face in faces])
        self._axis = np.array([face.axis for face in faces], dtype=np.int8)
        self._texture = np.array([face.texture for face in faces], dtype=np.int32)
        self._texel_m = np.array([face.texel_m for face in faces], dtype=np.float32)
        # One row for each coordinate or colour channel: lookups in a short row stay in the processor's cache.
        self._low = np.array([face.low for face in faces], dtype=np.float32).T.copy()
        self._size = np.array([face.high for face in faces], dtype=np.float32).T - self._low
        self._colour_0 = np.array([face.colour_0 for face in faces], dtype=np.float32).T.copy()
        self._colour_range = np.array([face.colour_1 for face in faces], dtype=np.float32).T - self._colour_0
        self._side = np.array([len(texture) for texture in world.textures], dtype=np.int32)
        self._lamp_x = np.array([(face.room + 0.5) * ROOM_M for face in faces], dtype=np.float32)

    def draw(self, T_world_camera: Array) -> tuple[_Image, _Image, _Image]:
        """Draw the world from a ``(4, 4)`` pose, without noise.

        Returns:
            Colours ``(h, w, 3)`` of 0..255, depths ``(h, w)`` in metres along the optical axis, and cosines
            ``(h, w)`` of the angle between ray and surface normal, 0..1.  Where a ray meets no face, depth
            and colour are 0, and the cosine has no meaning.
        """
        # 1. Find the nearest face of each pixel.
        R_world_camera = T_world_camera[:3, :3].astype(np.float32)
        rays = np.tensordot(R_world_camera, self._rays_camera, axes=1)
        origin = T_world_camera[:3, 3].astype(np.float32)
        depth_m, face_numbers = self._rasterise(T_world_camera, rays, origin)
        has_no_face = face_numbers < 0
        depth_m[has_no_face] = 1.0
        # 2. Compute the point on the face, and its coordinates from the face's lower corner.
        face = np.maximum(face_numbers, 0).ravel().astype(np.intp)
        depths, rays = depth_m.ravel(), rays.reshape(3, -1)
        points = origin[:, None] + depths * rays
        axis = self._axis[face]
        is_x, is_z = axis == 0, axis == 2
        cosine = np.abs(np.where(is_x, rays[0], np.where(is_z, rays[2], rays[1]))) * self._inverse_ray_lengths
        u = np.where(is_x, points[1], points[0])
        v = np.where(is_z, points[1], points[2])
        u, v = u - self._low[0][face], v - self._low[1][face]
        width, height = self._size[0][face], self._size[1][face]
        # 3. Sample the texture, and apply the light.
        value = self._sample_texture(face, u, v, depths, cosine)
        edge_distance = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v))
        light = self._brightness(face, points, edge_distance, cosine)
        colour = np.empty((len(face), 3), dtype=np.float32)
        for channel in range(3):
            colour[:, channel] = (
                self._colour_0[channel][face] + value * self._colour_range[channel][face]
            ) * light
        # 4. Set depth and colour of pixels without a face to 0.
        depth_m[has_no_face] = 0.0
        colour[has_no_face.ravel()] = 0.0
        return colour.reshape(*face_numbers.shape, 3), depth_m, cosine.reshape(face_numbers.shape)

    def _rasterise(
        self, T_world_camera: Array, rays: _Image, origin: _Image
    ) -> tuple[_Image, npt.NDArray[np.int32]]:
        """Return depth ``(h, w)`` (infinite without a face) and face number (-1 without) of each pixel.

        The face is the nearest one that shows the camera its visible side; the others are skipped.  *rays*
        ``(3, h, w)`` are the directions of the pixels in the world, scaled to the depth 1, and *origin*
        ``(3,)`` is the position of the camera.  A face is tested only within its bounding box in the image.
        """
        depth_m = np.full(rays.shape[1:], np.inf, dtype=np.float32)
        face_numbers = np.full(rays.shape[1:], -1, dtype=np.int32)
        with np.errstate(divide="ignore"):
            inverse_rays = (1.0 / rays).astype(np.float32)
        for number in self._faces_in_view(T_world_camera):
            face = self._faces[number]
            distance_in_front = (float(origin[face.axis]) - face.offset) * face.sign
            box = self._bounding_box(number, T_world_camera) if distance_in_front > 0 else None
            if box is None:
                continue
            u_axis, v_axis = (axis for axis in range(3) if axis != face.axis)
            face_depth = (face.offset - origin[face.axis]) * inverse_rays[face.axis][box]
            is_visible = (face_depth > _NEAR_M) & (face_depth < depth_m[box])
            if not is_visible.any():
                continue
            u = origin[u_axis] + face_depth * rays[u_axis][box]
            v = origin[v_axis] + face_depth * rays[v_axis][box]
            is_visible &= (u >= face.low[0]) & (u <= face.high[0]) & (v >= face.low[1]) & (v <= face.high[1])
            np.copyto(depth_m[box], face_depth, where=is_visible)
            face_numbers[box][is_visible] = number
        return depth_m, face_numbers

    def _faces_in_view(self, T_world_camera: Array) -> list[int]:
        """Return the numbers of all faces but those that lie wholly beyond one side of the field of view."""
        corners = (self._corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        low, high = self._rays_camera[:2, 0, 0], self._rays_camera[:2, -1, -1]
        depths = corners[..., 2:]
        is_beyond = np.concatenate(
            (corners[..., :2] < low * depths, corners[..., :2] > high * depths, depths < _NEAR_M), axis=-1
        )
        in_view: list[int] = np.flatnonzero(~np.any(np.all(is_beyond, axis=1), axis=1)).tolist()
        return in_view

    def _bounding_box(self, number: int, T_world_camera: Array) -> tuple[slice, slice] | None:
        """Return rows and columns of a face's bounding box in the image; None if the face is not in view.

        The box is that of the part of the face that is farther than the near plane.
        """
        corners_camera = (self._corners[number] - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        # Edges that cross the near plane contribute their intersection with it.
        next_corners = np.roll(corners_camera, -1, axis=0)
        is_crossing = (corners_camera[:, 2] < _NEAR_M) != (next_corners[:, 2] < _NEAR_M)
        start, end = corners_camera[is_crossing], next_corners[is_crossing]
        fraction = (_NEAR_M - start[:, 2]) / (end[:, 2] - start[:, 2])
        intersections = start + fraction[:, None] * (end - start)
        visible = np.concatenate((corners_camera[corners_camera[:, 2] >= _NEAR_M], intersections))
        if not len(visible):
            return None
        pixels = self._camera.project(visible)
        low = np.clip(np.floor(pixels.min(axis=0)), 0, [self._camera.width, self._camera.height])
        high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, [self._camera.width, self._camera.height])
        if (low >= high).any():
            return None
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _sample_texture(
        self, face: npt.NDArray[np.intp], u: _Image, v: _Image, depths: _Image, cosine: _Image
    ) -> _Image:
        """Return texture values 0..1, bilinear in the mip level whose texels are about as large as a pixel.

        All arguments are ``(n,)`` for n pixels: the number of the face, the coordinates *u* and *v* of the
        point from the lower corner of the face (m), the depth (m), and the cosine of the angle of incidence.
        """
        # 1. Choose the mip level by the width of a pixel on the face over that of a texel.
        texel_m = self._texel_m[face]
        pixel_m = (
            depths / np.float32(self._camera.fx) / np.sqrt(np.maximum(cosine, np.float32(_MIN_MIP_COSINE)))
        )
        texture = self._texture[face].astype(np.intp)
        wanted = (np.log2(np.maximum(pixel_m / texel_m, 1.0)) + np.float32(_MIP_BIAS)).astype(np.int32)
        level = np.minimum(wanted, self._last_levels[texture])
        # 2. Find the four texels around the point; textures repeat, and their sides are powers of two.
        scale = np.exp2(-level.astype(np.float32)) / texel_m
        side = self._side[texture] >> level
        start = self._level_starts[texture, level]
        x, y = u * scale - np.float32(0.5), v * scale - np.float32(0.5)
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = x - x0, y - y0
        mask = side - 1
        left, row = x0.astype(np.int32) & mask, y0.astype(np.int32) & mask
        right = (left + 1) & mask
        lower, upper = start + row * side, start + ((row + 1) & mask) * side
        lower_left, lower_right, upper_left, upper_right = (
            self._texels.take(index) for index in (lower + left, lower + right, upper + left, upper + right)
        )
        # 3. Interpolate between the four texels.
        below = lower_left + (lower_right - lower_left) * fx
        above = upper_left + (upper_right - upper_left) * fx
        value: _Image = below + (above - below) * fy
        return value

    def _brightness(
        self, face: npt.NDArray[np.intp], points: _Image, edge_distance: _Image, cosine: _Image
    ) -> _Image:
        """Return the brightness ``(n,)`` of ``(3, n)`` points, by which their colours are multiplied.

        A point is lit by the lamp of the room of its *face*; it is darker near an edge of its face, and a
        little brighter if its face is perpendicular to the ray.  *edge_distance* ``(n,)``, m, is that from
        the nearest edge.
        """
        x, y = points[0] - self._lamp_x[face], points[1] - DEPTH_M / 2
        z = points[2] - (HEIGHT_M - _LAMP_BELOW_CEILING_M)
        lamp = _AMBIENT + _LAMP / (1.0 + _LAMP_FALLOFF * (x * x + y * y + z * z))
        corner = 1.0 - _CORNER_SHADE / (1.0 + _CORNER_FALLOFF * edge_distance * edge_distance)
        brightness: _Image = lamp * corner * ((1.0 - _FACING_LIGHT) + _FACING_LIGHT * cosine)
        return brightness


def _corners(face: Face) -> Array:
    """Return the corners ``(4, 3)`` of a face in the world, one after the other along its border."""
    u_axis, v_axis = (axis for axis in range(3) if axis != face.axis)
    corners = np.empty((4, 3))
    corners[:, face.axis] = face.offset
    corners[:, u_axis] = [face.low[0], face.high[0], face.high[0], face.low[0]]
    corners[:, v_axis] = [face.low[1], face.low[1], face.high[1], face.high[1]]
    return corners


def add_depth_noise(depth_m: _Image, cosine: _Image, rng: np.random.Generator) -> _Image:
    """Return the depths ``(h, w)``, metres, that a Kinect would measure; 0 where it would measure none.

    The noise has a standard deviation of ``0.0012 + 0.0019 (z - 0.4)^2`` m for the exact depth z, and the
    disparity of a measured depth is a multiple of 1/8 px.  There is no reading below 0.4 m and above 6 m, at
    grazing angles of incidence (*cosine* below 0.1), on the far side of depth edges, and at 0.2 % random
    pixels.
    """
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    noisy = depth_m + sigma * rng.standard_normal(depth_m.shape, dtype=np.float32)
    steps = np.rint(_DISPARITY_STEPS * _DISPARITY_M_PX / np.maximum(noisy, 0.1))
    measured = (_DISPARITY_STEPS * _DISPARITY_M_PX / np.maximum(steps, 1)).astype(np.float32)
    holes = (depth_m < _MIN_DEPTH_M) | (depth_m > _MAX_DEPTH_M) | (cosine < _GRAZING_COSINE)
    # The infrared projector is beside the camera: the shadow of a near surface is 3 px wide on its right
    # side, and 1 px on the others.
    for shift in (1, 2, 3):
        holes[:, shift:] |= depth_m[:, shift:] > _SHADOW_RATIO * depth_m[:, :-shift]
    holes[:, :-1] |= depth_m[:, :-1] > _SHADOW_RATIO * depth_m[:, 1:]
    holes[1:] |= depth_m[1:] > _SHADOW_RATIO * depth_m[:-1]
    holes[:-1] |= depth_m[:-1] > _SHADOW_RATIO * depth_m[1:]
    holes |= rng.random(depth_m.shape, dtype=np.float32) < _RANDOM_HOLES
    measured[holes] = 0.0
    return measured


def add_image_noise(colour: _Image, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Return colours ``(h, w, 3)`` of 0..255 as uint8, with Gaussian noise (standard deviation 2)."""
    noisy = colour + _IMAGE_NOISE * rng.standard_normal(colour.shape, dtype=np.float32)
    return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)


def _make_mip_maps(world: World) -> tuple[npt.NDArray[np.int32], _Image, npt.NDArray[np.int32]]:
    """Return the mip maps of all textures of a world in one array.

    Level 0 is the texture itself; a texel of each further level is the mean of four of the level before.

    Returns:
        The start of each level ``(textures, 12)`` in the array, the array of all texels, and the number of
        the last level ``(textures,)`` of each texture, which has one texel.
    """
    level_starts = np.zeros((len(world.textures), _MAX_MIP_LEVELS), dtype=np.int32)
    last_levels = np.zeros(len(world.textures), dtype=np.int32)
    texels: list[_Image] = []
    total = 0
    for number, texture in enumerate(world.textures):
        level, image = 0, texture
        while True:
            level_starts[number, level] = total
            texels.append(image.ravel())
            total += image.size
            if len(image) == 1:
                break
            four_texels = image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]
            image = four_texels / np.float32(4)
            level += 1
        last_levels[number] = level
    return level_starts, np.concatenate(texels), last_levels
