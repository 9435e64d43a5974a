"""The bridge's ROS services for maps: publish a map, relocalise in the live map, localise in a stored map."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import numpy as np

from client_sdk.live import LiveMapper
from client_sdk.mapper import Mapper
from client_sdk.robot import Robot
from client_sdk.transfer.data_client import DataClient
from ros_bridge.access import data_client
from ros_bridge.options import BridgeOptions
from rse_pf.errors import NotFound, UsageError
from rse_pf.geometry import Camera
from rse_pf.wire.live_map import PUBLISH, LiveMapRequest

__all__ = ["MapServices", "as_json"]

# Deadline of each command that these services send to the platform, in seconds.
_CALL_S = 20.0


class MapServices:
    """The ROS services of one bridge that use maps of the tenant.

    Each method returns a reply of JSON values.
    """

    def __init__(self, robot: Robot, mapper: Mapper | LiveMapper, options: BridgeOptions) -> None:
        """Describe the services; the connection to the data service is opened when it is first needed."""
        self._robot, self._mapper, self._options = robot, mapper, options
        self._data: DataClient | None = None
        self._object: tuple[str, str] | None = None

    def close(self) -> None:
        """Close the connection to the data service, if it is open."""
        if self._data is not None:
            self._data.close()

    async def publish(self) -> dict[str, Any]:
        """Publish the live map, or commit the robot's own map as the next version of the map ``publish_as``.

        Raises:
            UsageError: The map is the robot's own, and the parameter ``publish_as`` is empty.
            RsePfError: The platform rejected it.
        """
        if isinstance(self._mapper, LiveMapper):
            request = LiveMapRequest(map=self._mapper.name)
            answer = await self._robot.call(PUBLISH, request, deadline_s=_CALL_S, keep=True)
            return dict(answer.reply)
        name = self._options.publish_as
        if not name:
            raise UsageError("the robot's own map has no name", hint="set the parameter publish_as, or map")
        encoded = await asyncio.to_thread(self._mapper.encoded_map)
        version = await asyncio.to_thread(self._client.update_map, name, encoded, note="rse-pf-ros")
        return {"map": name, "version": version}

    async def relocalise(self) -> dict[str, Any]:
        """Let the mapper request a relocalisation with the next keyframe, without the usual pause.

        Return the name of the live map, whether the robot is aligned with it now, and the reason if it is
        not.

        Raises:
            UsageError: The robot does not use a live map.
        """
        if not isinstance(self._mapper, LiveMapper):
            raise UsageError("this robot uses no live map to relocalise in", hint="set the parameter map")
        self._mapper.relocalise()
        return {"map": self._mapper.name, "aligned": self._mapper.aligned, "reason": self._mapper.reason}

    async def localise(self, camera: Camera | None) -> dict[str, Any]:
        """Return the reply of the service ``localise``: the pose of the last tracked image in a stored map.

        Args:
            camera: The camera of the images; None before the first image.

        Raises:
            UsageError: The parameter ``localise_in`` is empty, or no image with depth has a pose yet.
            RsePfError: The map does not exist, or the platform rejected the request.
        """
        name = self._options.localise_in
        if not name:
            raise UsageError("no map to localise in", hint="set the parameter localise_in")
        features = self._mapper.features
        if features is None or camera is None:
            raise UsageError("there is no image with depth and a pose yet", hint="wait for a pose")
        request: dict[str, Any] = {
            "map": {"object": await asyncio.to_thread(self._object_of, name)}, "camera": camera,
            "pixels": np.asarray(features.pixels, np.float32),
            "descriptors": np.ascontiguousarray(features.descriptors).tobytes(),
        }  # fmt: skip
        answer = await self._robot.call("localise", request, deadline_s=_CALL_S, keep=True)
        return dict(answer.reply)

    @property
    def _client(self) -> DataClient:
        if self._data is None:
            self._data = data_client(self._options)
        return self._data

    def _object_of(self, name: str) -> str:
        """Return the digest of the newest version of the map *name*, uploaded as an object of this robot.

        A service can read only the objects of the robot that calls it.

        Raises:
            NotFound: There is no such map.
        """
        version = str(self._client.maps().get(name, ""))
        if not version:
            raise NotFound(f"there is no map {name[:80]!r}", hint="rse-pf map list shows the maps")
        if self._object is None or self._object[0] != version:
            self._object = version, self._client.upload(self._client.download_map(name, version))
        return self._object[1]


def as_json(value: Any) -> str:
    """Return *value*, the reply of a service, as JSON: arrays as lists, bytes in base64."""
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, bytes):
        import base64

        return base64.b64encode(value).decode()
    raise TypeError(type(value).__name__)
