"""A depth camera for the rendered world: it draws faces, then adds the noise of a Kinect.

The camera is written in numpy alone.  The same world, pose and random generator give the same image; one of
640x480 pixels takes about a tenth of a second on one core.

Source:
    Depth noise after Nguyen, Izadi and Lovell, 3DIMPVT 2012, eq. 3 (axial); textures by mip maps
    after Williams, SIGGRAPH 1983.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.simulator.world import DEPTH_M, HEIGHT_M, ROOM_M, Face, World
from rse_pf.geometry import Array, Camera

__all__ = ["Painter", "add_depth_noise", "add_image_noise"]

_Image = npt.NDArray[np.float32]
_NEAR_M = 0.05
# Baseline times focal length of a Kinect: disparity in px = this / depth in m.
_DISPARITY_M_PX = 0.075 * 580.0
_DISPARITY_STEPS = 8.0
_GRAZING_COSINE = 0.10


class Painter:
    """Draw one world as one camera sees it."""

    def __init__(self, world: World, camera: Camera) -> None:
        self._faces, self._camera = world.faces, camera
        size = (camera.height, camera.width)
        rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float32)
        self._rays_camera = np.stack(
            [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(size)]
        ).astype(np.float32)
        self._shortening = 1.0 / np.sqrt((self._rays_camera**2).sum(axis=0)).ravel()
        self._starts, self._texels, self._levels = _mip_maps(world)
        faces = world.faces
        self._axis = np.array([face.axis for face in faces], dtype=np.int8)
        self._texture = np.array([face.texture for face in faces], dtype=np.int32)
        self._texel_m = np.array([face.texel_m for face in faces], dtype=np.float32)
        # One row per coordinate or channel: a gather from a short row stays in the cache.
        self._low = np.array([face.low for face in faces], dtype=np.float32).T.copy()
        self._size = np.array([face.high for face in faces], dtype=np.float32).T - self._low
        self._a = np.array([face.a for face in faces], dtype=np.float32).T.copy()
        self._b = np.array([face.b for face in faces], dtype=np.float32).T - self._a
        self._side = np.array([len(texture) for texture in world.textures], dtype=np.int32)
        self._lamp_x = np.array([(face.room + 0.5) * ROOM_M for face in faces], dtype=np.float32)

    def draw(self, T_world_camera: Array) -> tuple[_Image, _Image, _Image]:
        """Return colour ``(h, w, 3)`` 0..255, depth ``(h, w)`` in metres and the cosine of incidence.

        All three are without noise.  Depth is 0 where the ray leaves the world.
        """
        rotation = T_world_camera[:3, :3].astype(np.float32)
        rays = np.tensordot(rotation, self._rays_camera, axes=1)
        origin = T_world_camera[:3, 3].astype(np.float32)
        depth_m, ids = self._rasterise(T_world_camera, rays, origin)
        missed = ids < 0
        depth_m[missed] = 1.0
        face = np.maximum(ids, 0).ravel().astype(np.intp)
        t, rays = depth_m.ravel(), rays.reshape(3, -1)
        points = origin[:, None] + t * rays
        axis = self._axis[face]
        along_x, along_z = axis == 0, axis == 2
        cosine = np.abs(np.where(along_x, rays[0], np.where(along_z, rays[2], rays[1]))) * self._shortening
        u = np.where(along_x, points[1], points[0])
        v = np.where(along_z, points[1], points[2])
        u, v, right, top = (
            u - self._low[0][face],
            v - self._low[1][face],
            self._size[0][face],
            self._size[1][face],
        )
        value = self._sample(face, u, v, t, cosine)
        edge = np.minimum(np.minimum(u, right - u), np.minimum(v, top - v))
        light = self._light(face, points, edge, cosine)
        colour = np.empty((len(face), 3), dtype=np.float32)
        for channel in range(3):
            colour[:, channel] = (self._a[channel][face] + value * self._b[channel][face]) * light
        depth_m[missed] = 0.0
        colour[missed.ravel()] = 0.0
        return colour.reshape(*ids.shape, 3), depth_m, cosine.reshape(ids.shape)

    def _rasterise(
        self, T_world_camera: Array, rays: _Image, origin: _Image
    ) -> tuple[_Image, npt.NDArray[np.int32]]:
        """Return depth and face number of each pixel; each face is tested only inside its bounding box."""
        depth_m = np.full(rays.shape[1:], np.inf, dtype=np.float32)
        ids = np.full(rays.shape[1:], -1, dtype=np.int32)
        with np.errstate(divide="ignore"):
            inverse_rays = (1.0 / rays).astype(np.float32)
        for number, face in enumerate(self._faces):
            height = (float(origin[face.axis]) - face.offset) * face.sign
            box = self._screen_box(face, T_world_camera) if height > 0 else None
            if box is None:
                continue
            first, second = (other for other in range(3) if other != face.axis)
            t = (face.offset - origin[face.axis]) * inverse_rays[face.axis][box]
            nearer = (t > _NEAR_M) & (t < depth_m[box])
            if not nearer.any():
                continue
            u = origin[first] + t * rays[first][box]
            v = origin[second] + t * rays[second][box]
            nearer &= (u >= face.low[0]) & (u <= face.high[0]) & (v >= face.low[1]) & (v <= face.high[1])
            np.copyto(depth_m[box], t, where=nearer)
            ids[box][nearer] = number
        return depth_m, ids

    def _screen_box(self, face: Face, T_world_camera: Array) -> tuple[slice, slice] | None:
        """Return the rows and columns that a face may cover, after clipping at the near plane."""
        first, second = (other for other in range(3) if other != face.axis)
        corners = np.empty((4, 3))
        corners[:, face.axis] = face.offset
        corners[:, first] = [face.low[0], face.high[0], face.high[0], face.low[0]]
        corners[:, second] = [face.low[1], face.low[1], face.high[1], face.high[1]]
        seen = (corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        following = np.roll(seen, -1, axis=0)
        crossing = (seen[:, 2] < _NEAR_M) != (following[:, 2] < _NEAR_M)
        start, end = seen[crossing], following[crossing]
        share = (_NEAR_M - start[:, 2]) / (end[:, 2] - start[:, 2])
        visible = np.concatenate((seen[seen[:, 2] >= _NEAR_M], start + share[:, None] * (end - start)))
        if not len(visible):
            return None
        pixels = self._camera.project(visible)
        low = np.clip(np.floor(pixels.min(axis=0)), 0, [self._camera.width, self._camera.height])
        high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, [self._camera.width, self._camera.height])
        if (low >= high).any():
            return None
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _sample(self, face: npt.NDArray[np.intp], u: _Image, v: _Image, t: _Image, cosine: _Image) -> _Image:
        """Return texture values, bilinear in the mip level whose texel is as large as the pixel."""
        texel_m = self._texel_m[face]
        pixel_m = t / np.float32(self._camera.fx) / np.sqrt(np.maximum(cosine, np.float32(0.05)))
        texture = self._texture[face].astype(np.intp)
        wanted = (np.log2(np.maximum(pixel_m / texel_m, 1.0)) + np.float32(0.7)).astype(np.int32)
        level = np.minimum(wanted, self._levels[texture])
        scale = np.exp2(-level.astype(np.float32)) / texel_m
        side = self._side[texture] >> level
        start = self._starts[texture, level]
        x, y = u * scale - np.float32(0.5), v * scale - np.float32(0.5)
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = x - x0, y - y0
        mask = side - 1
        left, row = x0.astype(np.int32) & mask, y0.astype(np.int32) & mask
        right = (left + 1) & mask
        lower, upper = start + row * side, start + ((row + 1) & mask) * side
        a, b, c, d = (
            self._texels.take(place) for place in (lower + left, lower + right, upper + left, upper + right)
        )
        below, above = a + (b - a) * fx, c + (d - c) * fx
        value: _Image = below + (above - below) * fy
        return value

    def _light(self, face: npt.NDArray[np.intp], points: _Image, edge: _Image, cosine: _Image) -> _Image:
        """Return brightness: a lamp in the middle of the room, and darker where surfaces meet."""
        x, y, z = points[0] - self._lamp_x[face], points[1] - DEPTH_M / 2, points[2] - (HEIGHT_M - 0.35)
        lamp = 0.68 + 0.62 / (1.0 + 0.12 * (x * x + y * y + z * z))
        corner = 1.0 - 0.28 / (1.0 + 70.0 * edge * edge)
        light: _Image = lamp * corner * (0.94 + 0.06 * cosine)
        return light


def add_depth_noise(depth_m: _Image, cosine: _Image, rng: np.random.Generator) -> _Image:
    """Return depth as a Kinect reports it: noisy, in steps of disparity, with holes.

    Noise is ``0.0012 + 0.0019 (z - 0.4)^2`` m; readings are multiples of 1/8 px of disparity; there
    are none beyond 0.4 to 6 m, at grazing angles, and in the shadow beside a nearer surface.
    """
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    noisy = depth_m + sigma * rng.standard_normal(depth_m.shape, dtype=np.float32)
    steps = np.rint(_DISPARITY_STEPS * _DISPARITY_M_PX / np.maximum(noisy, 0.1))
    measured = (_DISPARITY_STEPS * _DISPARITY_M_PX / np.maximum(steps, 1)).astype(np.float32)
    holes = (depth_m < 0.4) | (depth_m > 6.0) | (cosine < _GRAZING_COSINE)
    for shift in (1, 2, 3):
        holes[:, shift:] |= depth_m[:, shift:] > 1.06 * depth_m[:, :-shift]
    holes[:, :-1] |= depth_m[:, :-1] > 1.06 * depth_m[:, 1:]
    holes[1:] |= depth_m[1:] > 1.06 * depth_m[:-1]
    holes[:-1] |= depth_m[:-1] > 1.06 * depth_m[1:]
    holes |= rng.random(depth_m.shape, dtype=np.float32) < 0.002
    measured[holes] = 0.0
    return measured


def add_image_noise(colour: _Image, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Return the ``(h, w, 3)`` uint8 image of a sensor with noise of two grey levels."""
    noisy = colour + 2.0 * rng.standard_normal(colour.shape, dtype=np.float32)
    return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)


def _mip_maps(world: World) -> tuple[npt.NDArray[np.int32], _Image, npt.NDArray[np.int32]]:
    """Return where each level of each texture starts, all texels in one row, and the last levels."""
    starts = np.zeros((len(world.textures), 12), dtype=np.int32)
    last = np.zeros(len(world.textures), dtype=np.int32)
    rows: list[_Image] = []
    total = 0
    for number, texture in enumerate(world.textures):
        level, image = 0, texture
        while True:
            starts[number, level] = total
            rows.append(image.ravel())
            total += image.size
            if len(image) == 1:
                break
            image = (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / np.float32(
                4
            )
            level += 1
        last[number] = level
    return starts, np.concatenate(rows), last
