"""transforms.json fits the documented schema, has the axes of OpenGL, and is upright if gravity is known."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
import pytest

from rse_pf.extensions.map_export.nerfstudio import encode_nerfstudio
from rse_pf.geometry import inverse, transform
from rse_pf.slam.ply import decode_ply
from tests.kit.exact_maps import points_map

Row = Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Size = Annotated[int, msgspec.Meta(gt=0)]
Text = Annotated[str, msgspec.Meta(min_length=1)]


class IntrinsicsSchema(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The intrinsics, which stand at the top of the file or in each frame."""

    fl_x: Positive | msgspec.UnsetType = msgspec.UNSET
    fl_y: Positive | msgspec.UnsetType = msgspec.UNSET
    cx: Positive | msgspec.UnsetType = msgspec.UNSET
    cy: Positive | msgspec.UnsetType = msgspec.UNSET
    w: Size | msgspec.UnsetType = msgspec.UNSET
    h: Size | msgspec.UnsetType = msgspec.UNSET
    k1: float | msgspec.UnsetType = msgspec.UNSET
    k2: float | msgspec.UnsetType = msgspec.UNSET
    p1: float | msgspec.UnsetType = msgspec.UNSET
    p2: float | msgspec.UnsetType = msgspec.UNSET


class FrameSchema(IntrinsicsSchema, forbid_unknown_fields=True, kw_only=True):
    """A frame, as nerfstudio's page "Data conventions" documents it; it may have intrinsics of its own."""

    file_path: Text
    transform_matrix: Annotated[list[Row], msgspec.Meta(min_length=4, max_length=4)]
    depth_file_path: Text | msgspec.UnsetType = msgspec.UNSET
    mask_path: Text | msgspec.UnsetType = msgspec.UNSET


class TransformsSchema(IntrinsicsSchema, forbid_unknown_fields=True, kw_only=True):
    """The whole file; its intrinsics are here if all frames have the same camera, else in each frame."""

    camera_model: Literal["OPENCV", "OPENCV_FISHEYE"]
    frames: Annotated[list[FrameSchema], msgspec.Meta(min_length=1)]
    applied_transform: Annotated[list[Row], msgspec.Meta(min_length=3, max_length=3)] | msgspec.UnsetType = (
        msgspec.UNSET
    )
    applied_scale: float | msgspec.UnsetType = msgspec.UNSET
    ply_file_path: Text | msgspec.UnsetType = msgspec.UNSET


def valid(files: dict[str, bytes]) -> TransformsSchema:
    document = msgspec.json.decode(files["transforms.json"], type=TransformsSchema)
    holders = [document] if document.fl_x is not msgspec.UNSET else document.frames
    for holder in holders:
        named = [getattr(holder, name) for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
        assert msgspec.UNSET not in named
    return document


def test_the_file_fits_the_documented_schema() -> None:
    version, _ = points_map()
    files = encode_nerfstudio(version)

    found = valid(files)

    assert (found.fl_x, found.fl_y, found.cx, found.cy) == (500.0, 510.0, 320.5, 238.5)
    assert (found.w, found.h, found.k1, found.p2) == (640, 480, 0.0, 0.0)
    assert found.frames[0].fl_x is msgspec.UNSET
    assert found.frames[1].file_path == "images/robot-1-000010.jpg"
    assert found.applied_transform is msgspec.UNSET
    points, colours = decode_ply(files[str(found.ply_file_path)])
    np.testing.assert_array_equal(points, version.points)
    np.testing.assert_array_equal(colours, version.colours)


def test_a_map_that_knows_gravity_is_turned_so_that_z_points_up() -> None:
    version, _ = points_map(up=[0.0, -1.0, 0.0])  # y of the world points down, as in a first camera
    files = encode_nerfstudio(version)

    found = valid(files)

    turn = np.vstack([np.array(found.applied_transform), [0, 0, 0, 1]])
    np.testing.assert_allclose(turn[:3, :3] @ [0, -1, 0], [0, 0, 1], atol=1e-9)
    for frame, keyframe in zip(found.frames, version.keyframes, strict=True):
        kept = inverse(turn) @ np.array(frame.transform_matrix) @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(kept, keyframe.T_world_camera, atol=1e-9)
    points, _ = decode_ply(files["points.ply"])
    np.testing.assert_allclose(points, transform(turn, version.points.astype(float)), atol=1e-5)
    assert valid(encode_nerfstudio(points_map(up=[0.0, 0.0, 1.0])[0])).applied_transform is msgspec.UNSET


@pytest.mark.parametrize(
    "up", [[0.0, 0.0], ["a", 0.0, 1.0], [0.0, 0.0, 9.81], [float("nan")] * 3, [0, 0, 1], 5]
)
def test_a_wrong_gravity_in_a_map_is_no_gravity(up: object) -> None:
    version, _ = points_map(up=up)  # type: ignore[arg-type]

    assert version.up is None
    assert valid(encode_nerfstudio(version)).applied_transform is msgspec.UNSET
