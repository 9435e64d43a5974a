"""A robot that an operator takes out of a live map leaves nothing there: a platform of real processes."""

from __future__ import annotations

import asyncio
import hashlib
import secrets
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import client_sdk
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound
from rse_pf.identity import RobotId, object_name
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.firewall import ensure_key
from rse_pf.maps.format import MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.slam.keyframe_points import ObjectReference
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.map_server_setup import MAP
from tests.server.live_map.map_server.test_keyframe_objects import keyframe_request, some_points

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(180)]

FORGOTTEN, OTHER = RobotId("default", "robot-1"), RobotId("default", "robot-2")
KEYFRAMES = 3
SETTINGS = PlatformSettings().replace(live={"images": True, "publish_pause_s": 0.1})


class Driver:
    """A robot that stores points and an image of each keyframe, *depth_m* away."""

    def __init__(self, url: str, token: str, robot: RobotId, depth_m: float) -> None:
        self.robot = client_sdk.connect(url, token=token, codec="bin")
        self.points = some_points(depth_m)
        self.image = f"the image of {robot}".encode()
        self.names = [object_name(robot, reference(data).digest) for data in (self.points, self.image)]

    async def drive(self) -> None:
        for data in (self.points, self.image):
            await self.robot.store_object(data)
        for number in range(KEYFRAMES):
            made = keyframe_request(number, reference(self.points), reference(self.image))
            request: dict[str, Any] = msgspec.msgpack.decode(made)
            await self.robot.call("live-keyframe", request, deadline_s=30.0)


def reference(data: bytes) -> ObjectReference:
    return ObjectReference(hashlib.sha256(data).hexdigest(), len(data))


def images_of(version: MapVersion, robot: RobotId) -> Any:
    return (version.provenance or {}).get("images", {}).get(robot.folder)


async def test_a_forgotten_robot_is_in_no_later_version_and_not_in_the_store(tmp_path: Path) -> None:
    state = tmp_path / "platform"
    objects = state / "objects"

    async def operator(*words: str) -> None:
        code = await asyncio.to_thread(main, ["map", *words, "--store", f"dir:{objects}"])
        assert code == 0

    async with LocalPlatform(SETTINGS, servers=1, port=0, state=state, data=True) as platform:
        key = ensure_key(state, seed=secrets.token_bytes(32), key_id="unused")

        def driver(robot: RobotId, depth_m: float) -> Driver:
            token = key.issue(robot.name, now=time.time(), token_id=robot.name, settings=SETTINGS.auth)
            return Driver(platform.url, token, robot, depth_m)

        gone, stays = driver(FORGOTTEN, 2.0), driver(OTHER, 3.0)
        async with gone.robot, stays.robot:
            await gone.drive()
            await stays.drive()
            store, maps = DirectoryStore(objects), MapRegistry(DirectoryStore(objects), "default")
            await operator("publish", MAP)
            before = maps.load(MAP, "head")
            assert set(np.round(before.points[:, 2], 3)) == {2.0, 3.0}, "both are in the map"
            assert len(images_of(before, FORGOTTEN)) == KEYFRAMES

            await operator("live", "forget", MAP, FORGOTTEN.name)
            for name in gone.names:
                with pytest.raises(NotFound):
                    store.head(name)
            assert not list(store.list(f"objects/{FORGOTTEN.folder}/"))
            assert all(store.head(name).size for name in stays.names)

            await gone.robot.store_object(gone.points)  # it was on its way
            await operator("publish", MAP)
            after = maps.load(MAP, "head")
            assert set(np.round(after.points[:, 2], 3)) == {3.0}
            assert {keyframe.robot for keyframe in after.keyframes} == {str(OTHER)}
            assert images_of(after, FORGOTTEN) is None
            assert len(images_of(after, OTHER)) == KEYFRAMES
