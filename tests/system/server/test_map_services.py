"""A robot of the SDK asks a real server to align clouds, recognise a place, and find itself in a map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import client_sdk
from rse_pf.geometry import exp_se3, pose_difference
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.services.mapping.icp import IcpReply, IcpRequest
from rse_pf.services.mapping.localise import LocaliseReply, LocaliseRequest
from rse_pf.services.mapping.place import PlaceReply, PlaceRequest
from tests.kit.synthetic_maps import make_room, make_world

pytest.importorskip("small_gicp", reason="the extra maps is not installed")

pytestmark = pytest.mark.system

DEADLINE_S = 60.0
WORLD = make_world(1)


async def test_clouds_are_aligned_places_recognised_and_views_located(
    start_server: Any, tmp_path: Path
) -> None:
    builtin = "from rse_pf.services.builtin import builtin_services as make\n"
    (tmp_path / "served_in_tests.py").write_text(builtin)
    server = start_server(keys=True)
    rng = np.random.default_rng(5)
    poses = [WORLD.pose(turn) for turn in np.linspace(0.1, 0.5, 12)]
    keyframes = tuple(WORLD.keyframe(n, "map", T, T, rng) for n, T in enumerate(poses))
    truth = WORLD.pose(0.31)
    seen = WORLD.keyframe(0, "robot-1", truth, np.eye(4), np.random.default_rng(9))
    view: dict[str, Any] = {
        "map": encode_map(MapVersion(keyframes=keyframes)),
        "camera": seen.camera,
        "pixels": seen.pixels.ravel(),
        "descriptors": seen.descriptors.tobytes(),
    }
    start = exp_se3(np.array([0.03, 0.02, -0.01, 0.02, 0.0, 0.01]))
    clouds = IcpRequest(
        target=make_room(0, points=3000).ravel().astype(np.float32),
        source=make_room(100, points=3000).ravel().astype(np.float32),
        T_target_source=start.ravel(),
    )

    async with client_sdk.connect(server.url, token=server.token(), codec="bin") as robot:

        async def call(service: str, request: Any, reply: Any) -> Any:
            return (await robot.call(service, request, reply_type=reply, deadline_s=DEADLINE_S)).reply

        aligned = await call("icp", clouds, IcpReply)
        place = await call("place", PlaceRequest(**view), PlaceReply)
        located = await call("localise", LocaliseRequest(**view), LocaliseReply)

    assert aligned.verdict == "ok", aligned.reason
    metres, degrees = pose_difference(np.reshape(aligned.T_target_source, (4, 4)), np.eye(4))
    assert metres <= 0.02
    assert degrees <= 0.5
    assert place.candidates
    assert (place.candidates[0].inliers or 0) >= 30
    assert located.verdict == "ok", located.reason
    assert located.T_map_camera is not None
    assert pose_difference(np.reshape(located.T_map_camera, (4, 4)), truth)[0] <= 0.03
